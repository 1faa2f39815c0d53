"""Track files of strangers: whatever one holds, it is a track that can be flown, or a TrackError in words."""

import copy
import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from flytrack_env.references import (
    ReferenceFileError,
    is_model_of,
    shipped_reference,
    shipped_references,
)
from flytrack_env.tracks import Track, TrackError, build_course, load_track, save_track
from tests.support.trees import as_toml

GATE: dict[str, Any] = {"id": 7, "direction": "+y", "opening": 1.5, "frame": 2.7}
TREE: dict[str, Any] = {
    "name": "small",
    "start": {"position": [-4.0, 0.0, 1.0], "quaternion": [1.0, 0.0, 0.0, 0.0]},
    "bounds": {"low": [-5.0, -5.0, 0.0], "high": [15.0, 5.0, 5.0]},
    "gates": [
        {**GATE, "position": [0.0, 0.0, 1.5], "quaternion": [0.0, 0.0, 0.0, 1.0]},
        {**GATE, "id": 3, "position": [10.0, 1.0, 1.6], "quaternion": [1.0, 0.0, 0.0, 0.0]},
    ],
}
PLACES = [
    *(("name",), ("start",), ("start", "position"), ("start", "position", 1), ("start", "quaternion")),
    *(("bounds",), ("bounds", "low"), ("bounds", "high", 2), ("gates",), ("gates", 0), ("gates", 1, "id")),
    *(
        ("gates", 0, "position"),
        ("gates", 1, "quaternion", 3),
        ("gates", 1, "direction"),
        ("gates", 0, "frame"),
    ),
    *(("gates", 1, "opening"), ("gates", 0, "new"), ("new",)),
]
TEXTS = st.text(st.characters(exclude_categories=["Cs"]))
SCALARS = st.one_of(
    st.booleans(), st.integers(), st.integers(min_value=10**30), st.floats(), st.floats(-20.0, 20.0), TEXTS
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXTS, inner, max_size=4),
    max_leaves=8,
)


def load(path: Path, content: bytes) -> Track | None:
    """Return the track of a file's bytes, None where it is refused as it should be."""
    path.write_bytes(content)
    try:
        return load_track(path)
    except TrackError as error:
        said = str(error)
        assert said.startswith(str(path)) and len(said) < 2000 and said.isprintable()
        return None


def check(track: Track, path: Path) -> None:
    """Raise AssertionError unless a track can be flown, and comes back as it is."""
    course = build_course(track)
    assert all(np.isfinite(leaf).all() for leaf in (*course.gates.centre, *course.bounds_high))
    assert all(math.isclose(math.hypot(*gate.quaternion), 1.0) for gate in track.gates)
    assert all(0.0 < gate.opening < gate.frame for gate in track.gates)
    assert track.rows().shape == (len(track.gates), 8) and track.rows().dtype == float
    save_track(path, track)
    assert load_track(path) == track


def with_value(place: tuple[Any, ...], value: Any) -> dict[str, Any]:
    """Return a track's tree with another value in a place."""
    tree = copy.deepcopy(TREE)
    *way, last = place
    holder: Any = tree
    for name in way:
        holder = holder[name]
    holder[last] = value
    return tree


@settings(max_examples=400, deadline=None)
@given(place=st.sampled_from(PLACES), value=VALUES)
@example(place=("gates", 1, "id"), value=2**53)
@example(place=("gates", 1, "id"), value=2**53 - 1)
@example(place=("name",), value="../../etc/passwd\0\n")
def test_any_value_anywhere_is_a_track_or_a_refusal(
    place: tuple[Any, ...], value: Any, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.toml"
    track = load(path, as_toml(with_value(place, value)))
    if track is not None:
        check(track, path)


@settings(max_examples=200, deadline=None)
@given(tree=st.dictionaries(TEXTS | st.sampled_from(list(TREE)), VALUES, max_size=5))
def test_any_toml_file_is_refused_in_words(
    tree: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    assert load(tmp_path_factory.getbasetemp() / "any.toml", as_toml(tree)) is None


@settings(max_examples=300, deadline=None)
@given(start=st.integers(0, 400), end=st.integers(0, 400), put=st.binary(max_size=20) | TEXTS.map(str.encode))
def test_random_damage_is_a_refusal_or_a_track(
    start: int, end: int, put: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path, content = tmp_path_factory.getbasetemp() / "damaged.toml", as_toml(TREE)
    track = load(path, content[:start] + put + content[max(start, end) :])
    if track is not None:
        check(track, path)


@pytest.mark.parametrize("spaces", [60_000, 100_000])
def test_a_key_of_spaces_is_refused_soon(spaces: int, tmp_path: Path) -> None:
    started_s = time.process_time()
    content = b'"' + b" " * spaces + b'" = 1\n' + b" " * spaces + b"\n" + as_toml(TREE)
    assert load(tmp_path / "spaces.toml", content) is None
    assert time.process_time() - started_s < 5.0


def test_very_many_dots_in_all_are_refused_soon(tmp_path: Path) -> None:
    started_s = time.process_time()
    lines = [f"a{index}." + ".".join("a" * 998) + " = 1" for index in range(120)]
    content = ("[" + ".".join("b" * 1000) + "]\n" + "\n".join(lines)).encode()
    assert load(tmp_path / "dots.toml", content) is None
    assert time.process_time() - started_s < 1.0


def test_a_pipe_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    with pytest.raises(TrackError, match=r"pipe\.toml: .*found a folder, pipe or device"):
        load_track(tmp_path / "pipe.toml")


def test_the_tree_of_these_tests_is_a_track(tmp_path: Path) -> None:
    track = load(tmp_path / "small.toml", as_toml(TREE))
    assert track is not None and [gate.id for gate in track.gates] == [7, 3]


DIGITS = b"0x" + b"f" * 5000
MANY = "a number of thousands of digits"


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b'"id" = 3', b'"id" = ' + DIGITS, f"id: found {MANY}, expected less"),
        (b'"id" = 3', b'"id" = 9007199254740992', r"id: found 9007199254740992, expected less than 2\^53"),
        (
            b'"frame" = 2.7',
            b'"frame" = ' + b"[" * 250 + b"]" * 250,
            "frame: found .{0,80}, expected a number",
        ),
        (b"[10.0, 1.0, 1.6]", DIGITS, f"position: found {MANY}, expected 3"),
        (b'"frame" = 2.7', b'"' + b"y" * 5000 + b'" = 1', r"frame: missing"),
        (b'"frame" = 2.7', b'"frame" = 2.7, "' + b"y" * 5000 + b'" = 1', r"'yyy+': unknown"),
        (b'"+y"', b'"' + b"y" * 5000 + b'"', "direction: found 'yyy.{0,80}, expected one of"),
    ],
)
def test_what_cannot_be_written_out_is_refused_in_few_words(
    old: bytes, new: bytes, reason: str, tmp_path: Path
) -> None:
    path, content = tmp_path / "bad.toml", as_toml(TREE)
    assert old in content
    path.write_bytes(content.replace(old, new, 1))
    with pytest.raises(TrackError, match=reason) as caught:
        load_track(path)
    assert len(str(caught.value)) < 500


def test_a_key_of_very_many_parts_is_refused_before_it_takes_minutes(tmp_path: Path) -> None:
    path = tmp_path / "dots.toml"
    path.write_text("a" + ".a" * 2**16 + " = 1\n")
    started_s = time.process_time()
    with pytest.raises(TrackError, match=r"dots\.toml: not a TOML file: found lines of very many dots"):
        load_track(path)
    assert time.process_time() - started_s < 1.0


def test_large_files_are_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "large.toml"
    with path.open("wb") as file:
        file.truncate(2**40)  # sparse: takes no room
    with pytest.raises(TrackError, match=r"large\.toml: cannot be read: found 1099511627776 bytes"):
        load_track(path)


def test_old_and_foreign_line_ends_are_read(tmp_path: Path) -> None:
    path, content = tmp_path / "lines.toml", as_toml(TREE)
    for end in (b"\r\n", b"\r"):
        path.write_bytes(content.replace(b"\n", end))
        assert load_track(path).name == "small"


@pytest.mark.parametrize(
    "name", ["../references/flytrack", "x" * 300, "a\0b", "flytrack_nominal_flying.npz/.."]
)
def test_a_name_leads_to_no_other_file(name: str, tmp_path: Path) -> None:
    track = Track(**{**vars(load_track("flytrack")), "name": name})
    assert not is_model_of(name, "nominal", None)  # type: ignore[arg-type]  # it is not looked at
    with pytest.raises(ReferenceFileError, match=r"reference: found no .{1,60}, expected one of"):
        shipped_reference(name)
    with pytest.raises(ReferenceFileError, match="reference: found no"):
        shipped_references(track, ("nominal",))
