"""The shipped course against the handout's table, and everything the loader refuses."""

import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flytrack_env.tracks import Gate, Track, TrackError, available_tracks, build_course, load_track

HANDOUT_ROWS = np.array(
    [
        [0, 12.5, 2.0, 1.35, -0.707107, 0, 0, 0.707107],
        [1, 6.5, 6.0, 1.35, -0.382684, 0, 0, 0.923879],
        [2, 5.5, 14.0, 1.35, -0.258819, 0, 0, 0.965926],
        [3, 2.5, 24.0, 1.35, 0.000000, 0, 0, 1.000000],
        [4, 7.5, 30.0, 1.35, -0.642788, 0, 0, 0.766044],
        [8, 18.5, 22.0, 1.35, -0.087155, 0, 0, 0.996195],
        [9, 20.5, 14.0, 1.35, 0.087155, 0, 0, 0.996195],
        [10, 18.5, 6.0, 1.35, 0.382684, 0, 0, 0.923879],
    ]
)
HANDOUT_YAWS_DEG = (270.0, 225.0, 210.0, 180.0, 260.0, 190.0, 170.0, 135.0)
MINUS_Y_IDS = {0, 1, 2, 3}

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


def test_shipped_course_is_the_handouts_table() -> None:
    assert "flytrack" in available_tracks()
    track = load_track("flytrack")
    np.testing.assert_allclose(track.rows(), HANDOUT_ROWS, atol=1e-6)
    assert all(gate.opening == 1.5 and gate.frame == 2.7 for gate in track.gates)
    assert track.start_position == (18.6, 2.0, 0.1)


def test_shipped_quaternions_are_the_handouts_yaws() -> None:
    for gate, yaw_deg in zip(load_track("flytrack").gates, HANDOUT_YAWS_DEG, strict=True):
        half = math.radians(yaw_deg) / 2.0
        overlap = gate.quaternion[0] * math.cos(half) + gate.quaternion[3] * math.sin(half)
        assert abs(overlap) == pytest.approx(1.0, abs=1e-9)
        assert math.hypot(*gate.quaternion) == pytest.approx(1.0, abs=1e-12)


def test_shipped_directions() -> None:
    directions = {gate.id: gate.direction for gate in load_track("flytrack").gates}
    assert directions == {i: -1.0 if i in MINUS_Y_IDS else 1.0 for i in directions}


def test_directions_lead_to_the_next_gate() -> None:
    gates = load_track("flytrack").gates
    for i, gate in enumerate(gates):
        psi = 2.0 * math.atan2(gate.quaternion[3], gate.quaternion[0])
        forward = gate.direction * np.array([-math.sin(psi), math.cos(psi)])
        before, after = gates[i - 1].position[:2], gates[(i + 1) % len(gates)].position[:2]
        assert forward @ (np.subtract(gate.position[:2], before)) > 0.0, f"gate {gate.id}"
        assert forward @ (np.subtract(after, gate.position[:2])) > 0.0, f"gate {gate.id}"


def test_shipped_bounds_and_start() -> None:
    track = load_track("flytrack")
    centres = HANDOUT_ROWS[:, 1:4]
    np.testing.assert_allclose(track.bounds_low[:2], centres.min(axis=0)[:2] - 5.0)
    np.testing.assert_allclose(track.bounds_high, centres.max(axis=0) + 5.0)
    assert track.bounds_low[2] == 0.0
    w, _, _, z = track.start_quaternion
    yaw = 2.0 * math.atan2(z, w)
    to_gate = centres[0] - track.start_position
    assert math.cos(yaw - math.atan2(to_gate[1], to_gate[0])) == pytest.approx(1.0, abs=1e-9)


def test_course_has_the_flight_frames_of_the_track() -> None:
    track = load_track("flytrack")
    course = build_course(track)
    assert course.num_gates == len(HANDOUT_ROWS)
    psi = np.radians(HANDOUT_YAWS_DEG)
    signs = np.array([gate.direction for gate in track.gates])
    forward = np.stack([-signs * np.sin(psi), signs * np.cos(psi), 0.0 * psi])
    np.testing.assert_allclose(np.stack(course.gates.forward), forward, atol=1e-5)
    np.testing.assert_allclose(np.stack(course.gates.up), [0.0 * psi, 0.0 * psi, 0.0 * psi + 1.0])
    np.testing.assert_allclose(np.stack(course.gates.centre).T, HANDOUT_ROWS[:, 1:4], rtol=1e-6)
    left = np.stack([-forward[1], forward[0], forward[2]])
    np.testing.assert_allclose(np.stack(course.gates.left()), left, atol=1e-5)


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
