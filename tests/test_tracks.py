"""The shipped courses, the FlyTrack one against the handout's table, and everything the loader refuses."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnax
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from docs.draw_tracks import digest, draw_track, drawn_tracks
from flytrack_env.tracks import (
    DEMANDS,
    Gate,
    Limits,
    Track,
    TrackError,
    available_tracks,
    build_course,
    load_track,
    save_track,
    way_length,
)

DOCS = Path(__file__).parent.parent / "docs"

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


@pytest.mark.parametrize("name", ["flytrack", "figure_eight", "speedway"])
def test_directions_lead_to_the_next_gate(name: str) -> None:
    gates = load_track(name).gates
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


def test_shipped_tracks_are_the_promised_ones_under_their_own_names() -> None:
    assert available_tracks() == ("figure_eight", "flytrack", "speedway", "split_s")
    assert all(load_track(name).name == name for name in available_tracks())


def test_figure_eight_crosses_itself_and_turns_both_ways() -> None:
    centres = load_track("figure_eight").rows()[:, 1:4]
    legs = np.roll(centres, -1, axis=0) - centres
    before, after = np.roll(legs, 1, axis=0), legs
    turns = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    assert (turns > 0.0).any() and (turns < 0.0).any()
    # Two legs lead through the middle: one from gate 3 to 4, the other one 2.5 m below, from gate 7 to 0.
    for start, end, height in ((3, 4, 4.0), (7, 0, 1.5)):
        np.testing.assert_allclose(0.5 * (centres[start] + centres[end]), [0.0, 0.0, height], atol=1e-9)


def test_split_s_dives_through_the_gate_below_the_one_before() -> None:
    track = load_track("split_s")
    upper, lower = track.gates[2:4]
    assert upper.position[:2] == lower.position[:2]
    assert upper.position[2] - lower.position[2] == 6.0
    gates = build_course(track).gates
    ahead = np.stack(gates.forward, axis=-1)
    np.testing.assert_allclose(ahead[2], [1.0, 0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(ahead[3], -ahead[2], atol=1e-5)


def test_speedway_is_large() -> None:
    track, usual = load_track("speedway"), load_track("flytrack")
    assert way_length(build_course(track)) > 3.0 * way_length(build_course(usual))
    assert all(gate.opening == 2.5 and gate.frame == 4.5 for gate in track.gates)


@pytest.mark.parametrize("name", available_tracks())
def test_starts_face_the_first_gate(name: str) -> None:
    track = load_track(name)
    w, _, _, z = track.start_quaternion
    way = np.subtract(track.gates[0].position, track.start_position)
    off_deg = math.degrees(2.0 * math.atan2(z, w) - math.atan2(way[1], way[0]))
    assert abs((off_deg + 180.0) % 360.0 - 180.0) < 1.0


@pytest.mark.parametrize("name", available_tracks())
def test_gymnax_makes_every_track_by_name_and_by_path(name: str, tmp_path: Path) -> None:
    path = tmp_path / "my own.toml"
    save_track(path, load_track(name))
    for reference in (name, path, str(path)):
        env, params = gymnax.make("FlyTrack-v0", track=reference)
        assert env.track == load_track(name)
        assert params.course.num_gates == len(env.track.gates)
        key = jax.random.key(0)
        observation, state = jax.eval_shape(env.reset, key, params)
        action = jax.ShapeDtypeStruct((env.num_actions,), np.float32)
        assert jax.eval_shape(env.step, key, state, action, params)[0].shape == observation.shape


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


# --- Documentation ------------------------------------------------------------------------------


def test_documented_table_is_that_of_the_files() -> None:
    text = (DOCS / "tracks.md").read_text(encoding="utf-8")
    rows = {cells[0].strip("` "): [cell.strip() for cell in cells[1:5]] for cells in table_rows(text)}
    assert set(rows) == set(available_tracks())
    for name, cells in rows.items():
        track = load_track(name)
        heights = [gate.position[2] for gate in track.gates]
        assert cells == [
            str(len(track.gates)),
            f"{track.gates[0].opening:g}",
            f"{way_length(build_course(track)):.1f}",
            f"{min(heights):g} to {max(heights):g}",
        ]


def test_measured_tracks_are_the_shipped_ones_and_those_with_a_picture() -> None:
    lines = (DOCS / "results" / "tracks.md").read_text(encoding="utf-8").splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    measured = {row[0]: row[1:3] for row in cells[2:]}
    expected = {
        re.sub(r"random_(\d+)", r"random_track(\1)", name): [
            str(len(track.gates)),
            f"{way_length(build_course(track)):.1f}",
        ]
        for name, track in drawn_tracks().items()
    }
    assert measured == expected, "measure again: python -m benchmarks.tracks"


def test_documented_limits_are_the_checks() -> None:
    text = (DOCS / "tracks.md").read_text(encoding="utf-8")
    table = text[text.index("| demand |") :]
    rows = dict(re.findall(r"^\| ([a-z ]+) \| (.*) \|$", table, re.MULTILINE)[1:])
    limits = Limits()
    numbers = {
        "opening": [f"{limits.min_opening:g} m"],
        "spacing": [f"{limits.min_spacing:g} to {limits.max_spacing:g} m"],
        "turn": [f"{limits.max_turn_deg:g} deg"],
        "own gate": [],
        "path": [f"{limits.clearance:g} m"],
        "frames": [f"{limits.clearance:g} m"],
        "bounds": [f"{limits.clearance:g} m"],
        "ground": [],
        "start": [
            f"{limits.min_start_distance:g} to {limits.max_spacing:g} m",
            f"{limits.max_start_turn_deg:g} deg",
        ],
    }
    assert tuple(rows) == tuple(numbers) == DEMANDS
    assert all(number in rows[demand] for demand in DEMANDS for number in numbers[demand])


def table_rows(text: str) -> list[list[str]]:
    """Return the cells of every row of the table of tracks: the rows that begin with a name in code."""
    return [line.strip("|").split("|") for line in text.splitlines() if line.startswith("| `")]


@pytest.mark.parametrize("name", drawn_tracks())
def test_every_track_has_a_picture_of_itself_in_the_docs(name: str) -> None:
    with Image.open(DOCS / "tracks" / f"{name}.png") as image:
        assert image.text["Track"] == digest(drawn_tracks()[name]), "draw again: python -m docs.draw_tracks"
        assert min(image.size) > 500
    assert f"](tracks/{name}.png)" in (DOCS / "tracks.md").read_text(encoding="utf-8")


def test_pictures_exist_of_shipped_tracks_and_can_be_drawn_of_any(tmp_path: Path) -> None:
    assert set(available_tracks()) < set(drawn_tracks())
    draw_track(tmp_path / "split_s.png", load_track("split_s"))
    with Image.open(tmp_path / "split_s.png") as drawn, Image.open(DOCS / "tracks/split_s.png") as shipped:
        assert drawn.size == shipped.size
