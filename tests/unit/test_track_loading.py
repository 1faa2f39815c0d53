"""Files of tracks: what is read and written, and everything that is refused."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flytrack_env.tracks import (
    Gate,
    Track,
    TrackError,
    available_tracks,
    load_track,
    save_track,
)

VALID = """name = "small"

[start]
position = [-4.0, 0.0, 1.0]
quaternion = [1.0, 0.0, 0.0, 0.0]

[bounds]
low = [-5.0, -5.0, 0.0]
high = [15.0, 5.0, 5.0]

[[gates]]
id = 7
position = [0.0, 0.0, 1.5]
quaternion = [0.707107, 0.0, 0.0, -0.707107]
direction = "+y"
opening = 1.5
frame = 2.7

[[gates]]
id = 3
position = [10.0, 1.0, 1.6]
quaternion = [0.0, 0.0, 0.0, 1.0]
direction = "-y"
opening = 1
frame = 2
"""
SECOND_GATE = VALID[VALID.index("[[gates]]\nid = 3") :]


def test_valid_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "small.toml"
    path.write_text(VALID, encoding="utf-8")
    track = load_track(path)
    assert load_track(str(path)) == track
    assert (track.name, [gate.id for gate in track.gates]) == ("small", [7, 3])
    assert [gate.direction for gate in track.gates] == [1.0, -1.0]
    assert (track.gates[1].opening, track.gates[1].frame) == (1.0, 2.0)
    assert track.bounds_high == (15.0, 5.0, 5.0)


# What is replaced, by what, the field that the message names, and a part of its reason.
REFUSALS = {
    "missing name": ('name = "small"\n', "", "name", "missing"),
    "empty name": ('name = "small"', 'name = ""', "name", "non-empty string"),
    "number as name": ('name = "small"', "name = 3", "name", "non-empty string"),
    "missing start": (
        VALID[VALID.index("[start]") : VALID.index("[bounds]")],
        "",
        "start",
        "missing",
    ),
    "missing start position": ("position = [-4.0, 0.0, 1.0]\n", "", "position", "missing"),
    "missing gate field": ('direction = "+y"\n', "", "direction", "missing"),
    "missing last gate's field": ("frame = 2\n", "", "frame", "missing"),
    "unknown top field": ('name = "small"', 'name = "small"\nlaps = 3', "laps", "unknown"),
    "unknown start field": (
        "[1.0, 0.0, 0.0, 0.0]",
        "[1.0, 0.0, 0.0, 0.0]\nyaw = 0",
        "yaw",
        "unknown",
    ),
    "unknown gate field": ("opening = 1\n", "opening = 1\ncolour = 2\n", "colour", "unknown"),
    "start is no table": (
        VALID[VALID.index("[start]") : VALID.index("[bounds]")],
        "start = 1\n",
        "start",
        "table",
    ),
    "string as number": ("[10.0, 1.0, 1.6]", '["a", 1.0, 1.6]', "position", "expected a number"),
    "bool as number": ("[10.0, 1.0, 1.6]", "[true, 1.0, 1.6]", "position", "expected a number"),
    "number as list": ("[10.0, 1.0, 1.6]", "10.0", "position", "expected 3 numbers"),
    "list as number": ("frame = 2\n", "frame = [2]\n", "frame", "expected a number"),
    "two coordinates": ("[10.0, 1.0, 1.6]", "[10.0, 1.0]", "position", "expected 3 numbers"),
    "five quaternion parts": (
        "[0.0, 0.0, 0.0, 1.0]",
        "[0.0, 0.0, 0.0, 0.0, 1.0]",
        "quaternion",
        "expected 4 numbers",
    ),
    "nan position": ("[10.0, 1.0, 1.6]", "[nan, 1.0, 1.6]", "position", "finite"),
    "infinite bounds": ("[15.0, 5.0, 5.0]", "[inf, 5.0, 5.0]", "high", "finite"),
    "nan opening": ("opening = 1\n", "opening = nan\n", "opening", "finite"),
    "long gate quaternion": ("[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.0, 0.5, 1.0]", "quaternion", "norm"),
    "zero start quaternion": ("[1.0, 0.0, 0.0, 0.0]", "[0.0, 0.0, 0.0, 0.0]", "quaternion", "norm"),
    "wrong direction": ('"-y"', '"y"', "direction", "expected one of"),
    "number as direction": ('"-y"', "-1", "direction", "expected one of"),
    "zero opening": ("opening = 1\n", "opening = 0\n", "opening", "> 0"),
    "negative opening": ("opening = 1\n", "opening = -1\n", "opening", "> 0"),
    "opening equals frame": ("frame = 2\n", "frame = 1\n", "frame", "more than the opening"),
    "opening beyond frame": ("frame = 2.7", "frame = 1.2", "frame", "more than the opening"),
    "duplicate id": ("id = 3", "id = 7", "id", "used twice"),
    "real id": ("id = 3", "id = 3.5", "id", "integer"),
    "bool id": ("id = 3", "id = true", "id", "integer"),
    "gate outside": ("[10.0, 1.0, 1.6]", "[16.0, 1.0, 1.6]", "position", "inside the bounds"),
    "first gate outside": ("[0.0, 0.0, 1.5]", "[0.0, 0.0, 5.5]", "position", "inside the bounds"),
    "start outside": ("[-4.0, 0.0, 1.0]", "[-6.0, 0.0, 1.0]", "position", "inside the bounds"),
    "start below": ("[-4.0, 0.0, 1.0]", "[-4.0, 0.0, -1.0]", "position", "inside the bounds"),
    "bounds reversed": ("[15.0, 5.0, 5.0]", "[15.0, -6.0, 5.0]", "high", "more than low"),
    "one gate": (SECOND_GATE, "", "gates", "at least two"),
    "huge integer": ("[10.0, 1.0, 1.6]", f"[1{400 * '0'}, 1.0, 1.6]", "position", "finite"),
}


def line_of_refusal(text: str, old: str, new: str, field: str) -> int:
    """Return the line of the replaced field, or of its table's header where it is missing."""
    lines = text.splitlines()
    at = VALID[: VALID.index(old)].count("\n")
    for number in (at, at + 1):
        if new and number < len(lines) and lines[number].startswith(field):
            return number + 1
    headers = [n for n in range(min(at + 1, len(lines))) if lines[n].startswith("[")]
    return (headers[-1] if headers and not old.startswith("[") else 0) + 1


@pytest.mark.parametrize("case", REFUSALS)
def test_refusals_name_file_line_field_and_reason(case: str, tmp_path: Path) -> None:
    old, new, field, reason = REFUSALS[case]
    assert VALID.count(old) == 1, "the replaced text must be unique"
    path = tmp_path / "bad.toml"
    text = VALID.replace(old, new)
    path.write_text(text, encoding="utf-8")
    with pytest.raises(TrackError) as caught:
        load_track(path)
    message = str(caught.value)
    assert message.startswith(f"{path}, line ")
    line = int(re.search(r", line (\d+): ", message).group(1))
    assert line == line_of_refusal(text, old, new, field)
    rest = message.split(f", line {line}: ")[1]
    assert re.match(rf"(\[\S+\](\[\d\])? )?{field}: ", rest)
    assert reason in rest


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("name = \n", "line 1"),
        (VALID.replace("id = 3", "id = "), "line 20"),
        (VALID + "frame = 3\n", "frame|overwrite"),
    ],
)
def test_bad_toml_names_the_file_and_what_the_parser_says(text: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(TrackError, match=rf"{re.escape(str(path))}: not a TOML file: .*({reason})"):
        load_track(path)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    missing, binary = tmp_path / "none.toml", tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    for path in (missing, binary, str(missing)):
        with pytest.raises(TrackError, match=rf"{re.escape(str(path))}: cannot be read: "):
            load_track(path)


@pytest.mark.parametrize("name", ["monza", "", "../tracks/flytrack", "FLYTRACK"])
def test_unknown_name_lists_the_shipped_ones(name: str) -> None:
    with pytest.raises(TrackError, match=rf"track: found '{name}', expected one of .*flytrack"):
        load_track(name)


def reals(low: float, high: float) -> st.SearchStrategy[float]:
    """Return finite floats of a range, open at both ends."""
    return st.floats(low, high, exclude_min=True, exclude_max=True)


@st.composite
def quaternions(draw: st.DrawFn) -> tuple[float, ...]:
    """Draw a unit quaternion."""
    vector = draw(st.tuples(*[reals(-1.0, 1.0)] * 4).filter(lambda q: math.hypot(*q) > 0.1))
    return tuple(value / math.hypot(*vector) for value in vector)


@st.composite
def tracks(draw: st.DrawFn) -> Track:
    """Draw a track that the loader must accept."""
    low = draw(st.tuples(*[reals(-100.0, 0.0)] * 3))
    high = draw(st.tuples(*[reals(1.0, 100.0)] * 3))
    inside = st.tuples(*(reals(a, b) for a, b in zip(low, high, strict=True)))
    ids = draw(st.lists(st.integers(0, 99), min_size=2, max_size=6, unique=True))
    gates = []
    for gate_id in ids:
        opening = draw(reals(0.1, 3.0))
        frame = draw(reals(opening, 5.0))
        sign = draw(st.sampled_from([-1.0, 1.0]))
        gates.append(Gate(gate_id, draw(inside), draw(quaternions()), sign, opening, frame))
    return Track("any", tuple(gates), draw(inside), draw(quaternions()), low, high)


@settings(max_examples=50, deadline=None)
@given(track=tracks())
def test_valid_tracks_round_trip(
    track: Track, write_toml: Callable[[Track], str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "round_trip.toml"
    path.write_text(write_toml(track), encoding="utf-8")
    read = load_track(path)
    np.testing.assert_allclose(read.rows(), track.rows(), atol=1e-12)
    np.testing.assert_allclose(read.start_quaternion, track.start_quaternion, atol=1e-12)
    for name in ("name", "start_position", "bounds_low", "bounds_high"):
        assert getattr(read, name) == getattr(track, name)
    for a, b in zip(read.gates, track.gates, strict=True):
        assert (a.direction, a.opening, a.frame) == (b.direction, b.opening, b.frame)


@settings(max_examples=100, deadline=None)
@given(track=tracks(), name=st.text(min_size=1))
def test_saved_tracks_are_read_back_equal(
    track: Track, name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "saved.toml"
    try:
        name.encode()
    except UnicodeEncodeError:
        name = "any"
    track = replace(track, name=name)
    save_track(path, track)
    assert load_track(path) == track


@pytest.mark.parametrize("name", available_tracks())
def test_shipped_tracks_are_saved_and_read_back_equal(name: str, tmp_path: Path) -> None:
    save_track(tmp_path / "copy.toml", load_track(name))
    assert load_track(tmp_path / "copy.toml") == load_track(name)


def first_gate_with(**fields: Any) -> Track:
    """Return the FlyTrack course with other fields of its first gate."""
    track = load_track("flytrack")
    return replace(track, gates=(replace(track.gates[0], **fields), *track.gates[1:]))


UNSAVEABLE = {
    "nan": (
        lambda: first_gate_with(position=(math.nan, 2.0, 1.35)),
        "position: found nan, expected a finite",
    ),
    "long quaternion": (lambda: first_gate_with(quaternion=(1.0, 0.0, 0.0, 1.0)), "quaternion: found norm"),
    "rounded quaternion": (
        lambda: first_gate_with(quaternion=(0.7071, 0.0, 0.0, 0.7071)),
        "gates: would not be read back",
    ),
    "list": (lambda: replace(load_track("flytrack"), bounds_low=[-2.5, -3.0, 0.0]), "bounds_low: would not"),
    "direction": (lambda: first_gate_with(direction=0.5), "cannot be written: KeyError"),
    "surrogate": (lambda: replace(load_track("flytrack"), name="\ud800"), "cannot be written: Unicode"),
    "no name": (lambda: replace(load_track("flytrack"), name=""), "name: found '', expected a non-empty"),
    "no track": (lambda: "flytrack", "cannot be written: AttributeError"),
}


@pytest.mark.parametrize("case", UNSAVEABLE)
def test_what_would_not_come_back_is_not_saved(case: str, tmp_path: Path) -> None:
    build, reason = UNSAVEABLE[case]
    path = tmp_path / "saved.toml"
    with pytest.raises(TrackError, match=rf"{re.escape(str(path))}.*{re.escape(reason)}"):
        save_track(path, build())
    assert not list(tmp_path.iterdir())


def test_tracks_are_saved_under_a_name_that_can_be_loaded(tmp_path: Path) -> None:
    with pytest.raises(TrackError, match=r"path: found '.*track.json', expected one that ends in .toml"):
        save_track(tmp_path / "track.json", load_track("flytrack"))
