"""Recordings, read back with Rerun's own reader and compared number by number."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flytrack.cli import main
from flytrack_env.flown_race import follow_race
from flytrack_env.references import ghost_restarts, ghost_rollout, shipped_references
from flytrack_env.rollout import save_rollout
from flytrack_env.state import POSITION, Action
from flytrack_env.tracks import build_course, load_track
from tests.support.recordings import Recording, make_flight, make_sequence

rr = pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra flytrack[viz])")
viz = importlib.import_module("flytrack_env.viz_rerun")

TRACK = load_track("flytrack")
GATES = TRACK.rows()
STEPS = 450
STATES, ACTIONS = ghost_rollout(shipped_references(TRACK, ("nominal",)), STEPS)
RACE = follow_race(STATES[:, POSITION], TRACK)
SECOND = "flights/plant\\ \\/\\ 2"


def record(folder, sequence, gates=GATES, **options):
    """Return what was recorded as the only file of an empty folder."""
    path = folder / "flight.rrd"
    viz.visualize_state_action_sequence(sequence, gates, str(path), **options)
    assert list(folder.iterdir()) == [path]
    return Recording(path)


def test_handouts_function_records_the_numbers_that_it_is_given(tmp_path):
    handout = record(tmp_path, make_sequence(100), app_id="test_app")
    x, u = (part.astype(float) for part in make_flight(100))
    assert_array_equal(handout.series("/world/drone", "Transform3D:translation"), x[:, 0:3])
    rotation = handout.series("/world/drone", "Transform3D:quaternion")
    assert_allclose(rotation, x[:, [10, 11, 12, 9]], atol=1e-6)  # scalar last
    speeds = np.linalg.norm(x[:, 3:6], axis=1), np.linalg.norm(x[:, 13:16], axis=1)
    expected = dict(zip([f"action/{name}" for name in Action._fields], u.T, strict=True))
    expected |= dict(zip(("speed", "angular_speed"), speeds, strict=True))
    grid = [(step, step * 10_000_000) for step in range(100)]
    for path, values in expected.items():
        plotted = handout.series(f"/plots/{path}", "Scalars:scalars")
        assert_allclose(plotted, values, rtol=1e-12, err_msg=path)
        assert sorted(handout.times[f"/plots/{path}"]) == grid, path
    assert handout.app_id == "test_app" and handout.timelines == {"step", "sim_time"}


@pytest.mark.parametrize("is_back", [False, True])
def test_gates_alone_are_flown_as_the_flight_passes_them(tmp_path, is_back):
    """The handout's rows do not tell the direction of flight."""
    states = STATES[::-1].copy() if is_back else STATES
    recording = record(tmp_path, list(zip(states, ACTIONS, strict=True)))
    vectors = recording.once("/world/gates/direction", "Arrows3D:vectors")
    forward = np.stack(build_course(TRACK).gates.forward, axis=-1)
    assert_allclose(vectors, -forward if is_back else forward, atol=1e-6)


def test_a_ghost_does_not_jump_where_its_start_or_lap_ends(tmp_path):
    references = shipped_references(TRACK, ("nominal",))
    num_steps = 900
    states, actions = ghost_rollout(references, num_steps)
    restarts = ghost_restarts(references, num_steps)
    start_s, lap_s = (references[kind].time_s for kind in ("standing", "flying"))
    rows = [0, *(int(np.ceil(100.0 * (start_s + lap * lap_s))) for lap in range(2))]
    assert np.flatnonzero(restarts).tolist() == rows
    steps_m = np.linalg.norm(np.diff(states[:, POSITION], axis=0), axis=1)
    speeds_m = 0.01 * np.linalg.norm(states[:-1, 3:6], axis=1)
    is_jump = np.abs(steps_m - speeds_m) > 0.1
    assert set(np.flatnonzero(is_jump) + 1) == {rows[1]}  # which a line would draw as motion
    ghost = viz.Trajectory("ghost", states, actions, restarts=restarts)
    viz.write_recording(tmp_path / "ghost.rrd", [ghost], TRACK)
    recording = Recording(tmp_path / "ghost.rrd")
    for path in ("speed", "battery", "orientation/yaw"):
        plotted = recording.series(f"/plots/{path}", "Scalars:scalars")
        assert np.flatnonzero(np.isnan(plotted)).tolist() == rows[1:], path


def with_state(index, value):
    """Return a flight of three steps whose last state has that value there."""
    sequence = make_sequence(3)
    sequence[2][0][index] = value
    return sequence


def test_nan_outside_the_pose_is_a_gap_and_rounded_quaternions_are_normalised(tmp_path):
    sequence = with_state(slice(9, 13), 0.5004)
    sequence[2][0][3] = np.nan
    before = rr.get_data_recording()
    recording = record(tmp_path, sequence, np.zeros((0, 8)))
    assert rr.get_data_recording() is before  # the caller's own
    speed = recording.series("/plots/speed", "Scalars:scalars")
    assert np.isnan(speed).tolist() == [False, False, True]
    rotation = recording.series("/world/drone", "Transform3D:quaternion")[2]
    assert_allclose(rotation, np.full(4, 0.5), atol=1e-7)


@pytest.mark.parametrize(
    ("sequence", "gates", "reason"),
    [
        ([], GATES, "sequence: found no pairs"),
        (with_state(1, np.nan), GATES, r"sequence: states\[2\]: found position.*expected finite"),
        (with_state(slice(9, 13), 0), GATES, r"sequence: states\[2\]: found quaternion norm 0"),
        ([(np.zeros(17), np.zeros(4))], GATES, r"sequence: states: found shape \(1, 17\)"),
        (make_sequence(3), np.zeros((3, 7)), r"gates: found shape \(3, 7\), expected \(N, >=8\)"),
        (make_sequence(3), 1e35 * np.ones((1, 8)), r"gates\[0\]: found pos.*within float32"),
    ],
)
def test_bad_input_is_refused_and_leaves_no_file(tmp_path, sequence, gates, reason):
    with pytest.raises(ValueError, match=reason):
        viz.visualize_state_action_sequence(sequence, gates, str(tmp_path / "flight.rrd"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("count", "changes", "reason"),
    [
        (2, {}, r"found names \['a', 'a'\], expected at least one, each once"),
        (1, {"time_s": np.full(STEPS, np.nan)}, "a: time_s: found times that do not grow"),
        (1, {"residuals_w": {"m": np.zeros(3)}}, r"a: residuals_w m: found shape \(3,\)"),
    ],
)
def test_flights_that_cannot_be_shown_are_refused(tmp_path, count, changes, reason):
    made = [viz.Trajectory("a", **{"states": STATES, "actions": ACTIONS, **changes})] * count
    with pytest.raises(ValueError, match=reason):
        viz.write_recording(tmp_path / "flight.rrd", made, TRACK)


def test_where_rerun_is_turned_off_the_old_recording_stays(tmp_path, monkeypatch):
    path = tmp_path / "flight.rrd"
    path.write_bytes(b"old")
    monkeypatch.setenv("RERUN", "0")
    with pytest.raises(ValueError, match="RERUN: found it turned off"):
        viz.visualize_state_action_sequence(make_sequence(3), GATES, str(path))
    assert list(tmp_path.iterdir()) == [path] and path.read_bytes() == b"old"


def test_passes_laps_events_and_table_are_the_races(tmp_path):
    """Of two flights on one time line; the second has its own end and is shorter."""
    aside = STATES[:300] + 0.2 * np.eye(21, dtype=STATES.dtype)[1]  # to the side of the first
    second = viz.Trajectory("plant / 2", aside, ACTIONS[:300], ended="battery")
    viz.write_recording(
        tmp_path / "two.rrd", [viz.Trajectory("policy", STATES, ACTIONS), second], TRACK
    )
    recording = Recording(tmp_path / "two.rrd")
    rows = recording.rows["/world/passes", "Points3D:positions"]
    assert [step for step, _ in recording.times["/world/passes"]] == [
        gate_pass.row for gate_pass in RACE.passes
    ]
    for count, points in enumerate(rows, start=1):
        assert_allclose(points, [gate_pass.pos_w for gate_pass in RACE.passes[:count]], rtol=1e-6)
    first, lap = RACE.passes[0], RACE.passes[7]
    assert [step for step, _ in recording.times["/world/laps"]] == [lap.row]
    assert recording.rows["/world/laps", "Points3D:labels"] == [[f"lap 1: {lap.lap_time_s:.3f} s"]]
    texts = [text for (text,) in recording.rows["/events", "TextLog:text"]]
    assert texts[0] == f"policy: gate 0, {first.time_s:.3f} s"
    assert texts[7] == f"policy: gate 10, {lap.time_s:.3f} s"
    assert texts[8] == f"policy: lap 1, {lap.lap_time_s:.3f} s"
    assert texts[-1] == "policy: ended, all steps flown"
    assert recording.rows[f"/events/{SECOND}", "TextLog:text"][-1] == ["plant / 2: ended, battery"]
    (table,) = recording.once("/about", "TextDocument:text")
    assert (
        f"| policy | {lap.lap_time_s:.3f} | 4.49 | {len(RACE.passes)} | all steps flown |" in table
    )


def test_command_shows_rollouts_and_pickles_beside_the_ghost(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    pairs = np.empty((20, 2), object)
    for step in range(20):
        pairs[step] = STATES[step], ACTIONS[step]
    for folder in ("a", "b"):
        Path(folder).mkdir()
    save_rollout("a/flight.npy", STATES[:20], ACTIONS[:20])
    np.save("b/flight.npy", pairs, allow_pickle=True)
    main(["show", "a/flight.npy", "b/flight.npy", "--allow-pickle", "--ghost"])
    lines, out = capsys.readouterr().out.splitlines(), Path("runs/show/flights.rrd")
    assert lines[0] == "shown: a_flight, b_flight, time-optimal, 20 steps on flytrack"
    assert lines[1] == f"{out}: {out.stat().st_size} bytes"
    views = [f"{name}_flight_{view}.png" for name in "ab" for view in ("top", "side", "commands")]
    pictures = [*views, "comparison_top.png"]
    assert [Path(line.split(":")[0]).name for line in lines[2:]] == pictures
    assert all(out.with_name(name).read_bytes().startswith(b"\x89PNG") for name in pictures)
    recording = Recording(out)
    (table,) = recording.once("/about", "TextDocument:text")
    names = [line.split("|")[1].strip() for line in table.splitlines()[2:]]
    assert names == ["a_flight", "b_flight", "time-optimal"]
    for drone in ("drone", "flights/b_flight/drone", "flights/time-optimal/drone"):
        positions = recording.series(f"/world/{drone}", "Transform3D:translation")
        assert_allclose(positions, STATES[:20, POSITION], rtol=1e-6)
