"""Recordings of races and of several flights, read back: gates, passes, laps, forces, what ended them."""

import importlib
import math
import resource
import signal
from dataclasses import replace

import numpy as np
import pytest

from flytrack_env.flown_race import follow_race
from flytrack_env.references import ghost_rollout, shipped_references
from flytrack_env.rollout import save_rollout
from flytrack_env.state import BATTERY, POSITION, QUATERNION, VELOCITY
from flytrack_env.tracks import build_course, load_track, save_track
from tests.support.recordings import Recording, layout_of, make_sequence, rotate

pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra flytrack[viz])")
viz = importlib.import_module("flytrack_env.viz_rerun")
command = importlib.import_module("flytrack_env.viz_rerun.command")

TRACK = load_track("flytrack")
STEPS = 450
STATES, ACTIONS = ghost_rollout(shipped_references(TRACK, ("nominal",)), STEPS)
RACE = follow_race(STATES[:, POSITION], TRACK)


def aside(shift: float) -> np.ndarray:
    """Return the states of a flight beside the time-optimal one."""
    states = STATES.copy()
    states[:, POSITION] += (0.0, shift, 0.0)
    return states


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Recording:
    """Two flights on one time line; the second has forces, an end of its own, and goes on for less long."""
    forces_w = np.tile([1.0, -2.0, 3.0], (300, 1))
    forces_w[:100] = np.nan
    second = viz.ShownFlight(
        "plant / 2", aside(0.2)[:300], ACTIONS[:300], ended="test says so", residuals_w={"base": forces_w}
    )
    path = tmp_path_factory.mktemp("viz") / "two.rrd"
    viz.write_recording(path, [viz.ShownFlight("policy", STATES, ACTIONS), second], TRACK)
    return Recording(path)


SECOND = "flights/plant\\ \\/\\ 2"


def test_every_flight_has_its_own_entities_on_one_time_line(recording):
    for entity, states in (("/world/drone", STATES), (f"/world/{SECOND}/drone", aside(0.2)[:300])):
        found = recording.series(entity, "Transform3D:translation")
        np.testing.assert_allclose(found, states[:, POSITION], rtol=1e-6)
        steps = np.arange(len(states)).tolist()
        assert sorted(recording.times[entity]) == [(step, step * 10_000_000) for step in steps]
    speed = recording.series(f"/plots/{SECOND}/speed", "Scalars:scalars")
    np.testing.assert_allclose(speed, np.linalg.norm(STATES[:300, VELOCITY], axis=1), rtol=1e-6)
    names = recording.once(f"/plots/{SECOND}/speed", "SeriesLines:names").tolist()
    assert names == ["plant / 2: speed [m/s]"]
    assert [key for key, rows in recording.static.items() if len(rows) != 1] == []


def test_applied_battery_distance_and_angles_are_those_of_the_flight(recording):
    expected = {
        "battery": STATES[:, BATTERY],
        "gate_distance": RACE.gate_distance_m,
        **{f"applied/{name}": STATES[:, 16 + i] for i, name in enumerate(("roll", "pitch", "yaw", "thrust"))},
    }
    for path, values in expected.items():
        found = recording.series(f"/plots/{path}", "Scalars:scalars")
        np.testing.assert_allclose(found, values, rtol=1e-6, err_msg=path)
    angles = [
        recording.series(f"/plots/orientation/{name}", "Scalars:scalars") for name in ("roll", "pitch", "yaw")
    ]
    for row in (0, 100, STEPS - 1):
        half = [0.5 * math.radians(angle[row]) for angle in angles]
        (sr, sp, sy), (cr, cp, cy) = np.sin(half), np.cos(half)
        made = [cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy]
        made += [cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy]
        assert abs(np.dot(made, STATES[row, QUATERNION])) == pytest.approx(1.0, abs=1e-6)
    for angle in angles:
        assert np.abs(np.diff(angle)).max() < 180.0  # no jump from 180 to -180


def test_gates_open_towards_the_direction_in_which_they_are_flown(recording):
    vectors = recording.once("/world/gates/direction", "Arrows3D:vectors")
    origins = recording.once("/world/gates/direction", "Arrows3D:origins")
    np.testing.assert_allclose(origins, [gate.position for gate in TRACK.gates], rtol=1e-6)
    np.testing.assert_allclose(vectors, np.stack(build_course(TRACK).gates.forward, axis=-1), atol=1e-6)
    corners = recording.once("/world/gates/inner", "LineStrips3D:strips")
    for vector, corner in zip(vectors, corners, strict=True):
        np.testing.assert_allclose((corner[1:4] - corner[0]) @ vector, 0.0, atol=1e-5)
    for one in RACE.passes:
        assert STATES[one.row, VELOCITY] @ vectors[one.gate] > 0.0


@pytest.mark.parametrize("is_back", [False, True])
def test_gates_alone_are_taken_to_be_flown_as_the_flight_passes_them(tmp_path, is_back):
    """The handout's rows do not say from which side."""
    states = STATES[::-1].copy() if is_back else STATES
    pairs = list(zip(states, ACTIONS, strict=True))
    viz.visualize_state_action_sequence(pairs, TRACK.rows(), str(tmp_path / "flight.rrd"))
    found = Recording(tmp_path / "flight.rrd").once("/world/gates/direction", "Arrows3D:vectors")
    forward = np.stack(build_course(TRACK).gates.forward, axis=-1)
    np.testing.assert_allclose(found, -forward if is_back else forward, atol=1e-6)


def test_passes_are_marked_where_and_when_they_were(recording):
    rows = recording.rows["/world/passes", "Points3D:positions"]
    times = recording.times["/world/passes"]
    assert [step for step, _ in times] == [one.row for one in RACE.passes]
    for count, points in enumerate(rows, start=1):
        np.testing.assert_allclose(points, [one.pos_w for one in RACE.passes[:count]], rtol=1e-6)
    assert [step for step, _ in recording.times["/world/laps"]] == [one.row for one in RACE.passes if one.lap]
    (label,) = recording.rows["/world/laps", "Points3D:labels"]
    lap = next(one for one in RACE.passes if one.lap)
    assert label == [f"lap 1: {lap.lap_time_s:.3f} s"]


def test_events_and_table_say_what_happened(recording):
    texts = [text for (text,) in recording.rows["/events", "TextLog:text"]]
    rows = [*(one.row for one in RACE.passes), STEPS - 1]
    assert [step for step, _ in recording.times["/events"]] == rows
    first, lap = RACE.passes[0], RACE.passes[7]
    assert texts[0] == f"policy: passed gate 0 at {first.time_s:.3f} s"
    expected = f"policy: passed gate 10 at {lap.time_s:.3f} s; lap 1: {lap.lap_time_s:.3f} s"
    assert texts[7] == expected
    assert texts[-1] == "policy: ended: all steps flown"
    (last,) = recording.rows[f"/events/{SECOND}", "TextLog:text"][-1]
    assert last == "plant / 2: ended: test says so"
    (table,) = recording.once("/about", "TextDocument:text")
    assert f"| policy | all steps flown | 4.49 | {len(RACE.passes)} | {lap.lap_time_s:.3f} |" in table


def test_forces_are_arrows_at_the_drone_where_they_are_known(recording):
    entity = f"/world/{SECOND}/residual/base"
    vectors = recording.series(entity, "Arrows3D:vectors")
    np.testing.assert_allclose(vectors, np.tile([0.1, -0.2, 0.3], (200, 1)), rtol=1e-6)
    origins = recording.series(entity, "Arrows3D:origins")
    np.testing.assert_allclose(origins, aside(0.2)[100:300, POSITION], rtol=1e-6)
    assert sorted(recording.times[entity])[0] == (100, 1_000_000_000)
    size = recording.series(f"/plots/{SECOND}/residual/base", "Scalars:scalars")
    np.testing.assert_allclose(size[100:], math.sqrt(14.0), rtol=1e-6)
    assert np.isnan(size[:100]).all()


def test_viewer_opens_laid_out(recording):
    """The views that open, what they look at, and that everything logged is in one of them."""
    views = layout_of(recording.path)
    second = f"/plots/{SECOND}"
    for title, line in (
        ("speed [m/s]", "speed"),
        ("angular speed [rad/s]", "angular_speed"),
        ("battery [V]", "battery"),
        ("distance to the next gate [m]", "gate_distance"),
        ("roll angle [deg]", "orientation/roll"),
        ("pitch angle [deg]", "orientation/pitch"),
        ("yaw angle [deg]", "orientation/yaw"),
    ):
        assert views[title] == ("TimeSeries", "/", [f"/plots/{line}", f"{second}/{line}"])
    for stick in ("roll", "pitch", "yaw", "thrust"):
        lines = [f"{root}/{kind}/{stick}" for root in ("/plots", second) for kind in ("action", "applied")]
        assert views[f"{stick} stick"] == ("TimeSeries", "/", lines)
    assert views["force left open [m/s²]"][2] == ["/plots/residual/**", f"{second}/residual/**"]
    assert views["course"] == ("3D", "/world", ["$origin/**"])
    assert views["follow policy"] == ("3D", "/world/chase", ["/world/**"])
    assert views["follow plant / 2"] == ("3D", f"/world/{SECOND}/chase", ["/world/**"])
    assert views["what happened"] == ("TextLog", "/", ["/events/**"])
    assert views["flights"] == ("TextDocument", "/about", ["$origin/**"])
    shown = {line for _, origin, lines in views.values() for line in lines}
    plotted = {entity for entity, _ in recording.rows if entity.startswith("/plots/")}
    hidden = {entity for entity in plotted - shown if f"{entity.rpartition('/')[0]}/**" not in shown}
    assert plotted and not hidden


def test_no_arrow_stands_where_a_force_is_not_known(tmp_path):
    forces_w = np.ones((10, 3))
    forces_w[[0, 4, 5, 9]] = np.nan
    flight = viz.ShownFlight("log", STATES[:10], ACTIONS[:10], residuals_w={"base": forces_w})
    viz.write_recording(tmp_path / "flight.rrd", [flight], TRACK)
    found = Recording(tmp_path / "flight.rrd")
    at = [step for step, _ in found.times["/world/residual/base"]]
    arrows = dict(zip(at, found.rows["/world/residual/base", "Arrows3D:vectors"], strict=True))
    counts = {step: len(one) for step, one in arrows.items()}
    assert counts == {**dict.fromkeys((1, 2, 3, 6, 7, 8), 1), 4: 0, 9: 0}


def test_chasing_eye_looks_where_the_drone_flies(recording):
    rotations = recording.series("/world/chase", "Transform3D:quaternion")
    for row in (0, 50, 300):
        x, y, z, w = rotations[row]
        ahead = rotate(np.array([w, x, y, z]), np.array([1.0, 0.0, 0.0]))
        velocity = STATES[row, VELOCITY]
        nose = rotate(STATES[row, QUATERNION], np.array([1.0, 0.0, 0.0]))
        expected = velocity[:2] + nose[:2]
        assert ahead[2] == pytest.approx(0.0, abs=1e-6)
        np.testing.assert_allclose(ahead[:2], expected / np.linalg.norm(expected), atol=1e-5)


def test_path_begins_anew_where_a_flight_does(tmp_path):
    restarts = np.zeros(STEPS, bool)
    restarts[[0, 200, 201]] = True
    flight = viz.ShownFlight("pieces", STATES, ACTIONS, restarts=restarts)
    viz.write_recording(tmp_path / "flight.rrd", [flight], None)
    found = Recording(tmp_path / "flight.rrd")
    positions = STATES[:, POSITION].astype(np.float32)
    strips = found.rows["/world/trajectory/recent", "LineStrips3D:strips"]
    at = [step for step, _ in found.times["/world/trajectory/recent"]]
    for row in (150, 205, STEPS - 1):
        block = math.isqrt(STEPS)
        start = (row - 1) // block * block
        cuts = [one for one in (200, 201) if start < one <= row]
        expected = np.split(positions[start : row + 1], [one - start for one in cuts])
        for strip, piece in zip(strips[at.index(row)], expected, strict=True):
            np.testing.assert_array_equal(strip, piece)
    flown = found.rows["/world/trajectory/flown", "LineStrips3D:strips"][-1]
    assert [len(strip) for strip in flown] == [200, 1, 442 - 201]


def test_times_of_a_log_are_kept(tmp_path):
    time_s = 7.0 + np.cumsum(np.random.default_rng(1).uniform(0.002, 0.02, 40))
    flight = viz.ShownFlight("log", STATES[:40], ACTIONS[:40], time_s=time_s)
    viz.write_recording(tmp_path / "flight.rrd", [flight], TRACK)
    found = Recording(tmp_path / "flight.rrd")
    seconds = [nanoseconds * 1e-9 for _, nanoseconds in sorted(found.times["/world/drone"])]
    np.testing.assert_allclose(seconds, time_s - time_s[0], atol=1e-9)
    assert ("/plots/gate_distance", "Scalars:scalars") not in found.rows  # races are flown at 100 Hz


BAD_FLIGHTS = {
    "none": ([], "flights: found names \\[\\], expected at least one"),
    "alike": ([("a", {}), ("a", {})], "found names \\['a', 'a'\\], expected at least one, each once"),
    "no states": ([("a", {"states": np.zeros((0, 21))})], "a: found no steps"),
    "states": ([("a", {"states": np.zeros((STEPS, 20))})], r"a: states: found shape \(450, 20\)"),
    "actions": ([("a", {"actions": np.zeros((3, 4))})], r"a: actions: found shape \(3, 4\), expected \(450"),
    "time": ([("a", {"time_s": np.zeros(STEPS)})], "a: time_s: found times that do not grow"),
    "nan time": ([("a", {"time_s": np.full(STEPS, np.nan)})], "a: time_s: found times that do not grow"),
    "restarts": ([("a", {"restarts": np.zeros(3, bool)})], r"a: restarts: found shape \(3,\)"),
    "forces": ([("a", {"residuals_w": {"m": np.zeros(3)}})], r"a: residuals_w m: found shape \(3,\)"),
    "pose": ([("a", {"states": np.zeros((STEPS, 21))})], r"a: states\[0\]: found quaternion norm 0"),
}


@pytest.mark.parametrize("case", BAD_FLIGHTS)
def test_flights_that_cannot_be_shown_are_refused(tmp_path, case):
    flights, reason = BAD_FLIGHTS[case]
    made = [viz.ShownFlight(name, **{"states": STATES, "actions": ACTIONS, **more}) for name, more in flights]
    with pytest.raises(ValueError, match=reason):
        viz.write_recording(tmp_path / "flight.rrd", made, TRACK)
    assert list(tmp_path.iterdir()) == []


def test_full_disk_leaves_no_recording(tmp_path, capsys):
    """A limit on file sizes, which the system reports to the writer as it does a full disk."""
    save_rollout(tmp_path / "flight.npy", STATES, ACTIONS)
    out = tmp_path / "out" / "flight.rrd"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        status = command.main([str(tmp_path / "flight.npy"), "--out", str(out)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert status == 1
    error = capsys.readouterr().err
    assert f"recording_path {out}: found a path that cannot be written" in error and "File too large" in error
    assert list(out.parent.iterdir()) == []


def test_command_shows_rollouts_beside_the_ghost(tmp_path, capsys):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        save_rollout(tmp_path / folder / "flight.npy", STATES[:20], ACTIONS[:20])
    out = tmp_path / "both.rrd"
    files = [str(tmp_path / folder / "flight.npy") for folder in ("a", "b")]
    assert command.main([*files, "--out", str(out), "--ghost", "time_optimal"]) == 0
    assert capsys.readouterr().out == f"{out}: 20 steps, {out.stat().st_size} bytes\n"
    found = Recording(out)
    (table,) = found.once("/about", "TextDocument:text")
    names = [line.split("|")[1].strip() for line in table.splitlines()[2:]]
    assert names == ["a_flight", "b_flight", "time-optimal"]
    ghost = found.series("/world/flights/time-optimal/drone", "Transform3D:translation")
    np.testing.assert_allclose(ghost, STATES[:20, POSITION], rtol=1e-6)


def test_demo_needs_no_file(tmp_path, capsys):
    assert command.main(["--out", str(tmp_path / "demo.rrd"), "--track", "split_s"]) == 0
    (table,) = Recording(tmp_path / "demo.rrd").once("/about", "TextDocument:text")
    assert "| time-optimal | all steps flown | 11.99 |" in table
    assert list(tmp_path.iterdir()) == [tmp_path / "demo.rrd"]


def test_command_reads_pickles_only_where_asked(tmp_path, capsys):
    pairs = np.empty((30, 2), object)
    for step, pair in enumerate(make_sequence(30)):
        pairs[step] = pair
    np.save(tmp_path / "flight.npy", pairs, allow_pickle=True)
    arguments = [str(tmp_path / "flight.npy"), "--out", str(tmp_path / "flight.rrd")]
    assert command.main(arguments) == 1
    assert "pickled" in capsys.readouterr().err
    assert command.main([*arguments, "--allow-pickle"]) == 0


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["a.npy", "a.npy"], "expected one of its own"),
        (["--ghost", "time_optimal", "--track", "TRACK"], "reference: found no 'own_nominal_"),
        (["--serve", "absent.rrd"], "absent.rrd: cannot be read"),
        (["a.npy", "--serve", "b.rrd"], "rollouts: found beside --serve"),
        (["a.npy", "--port", "1234"], "port: found beside no --serve"),
        (["a.npy", "--out", "a.npy"], "--out: found a.npy, which is read"),
    ],
)
def test_command_refuses_in_one_line(tmp_path, capsys, monkeypatch, arguments, reason):
    monkeypatch.chdir(tmp_path)
    save_track(tmp_path / "own.toml", replace(TRACK, name="own"))
    assert command.main([one.replace("TRACK", "own.toml") for one in arguments]) == 1
    error = capsys.readouterr().err
    assert reason in error and error.startswith("error: ") and error.count("\n") == 1
    assert not (tmp_path / "rollout.rrd").exists()
