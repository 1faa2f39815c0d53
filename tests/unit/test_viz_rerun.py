"""The recording, read back with Rerun's own reader and compared number by number."""

import importlib
import math
import os
import time
from pathlib import Path

import numpy as np
import pytest

from flytrack_env.tracks import load_track
from tests.support.recordings import Recording, make_sequence, rotate

rr = pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra flytrack[viz])")
viz = importlib.import_module("flytrack_env.viz_rerun")

STEPS = 250
QUARTER_TURN = math.sqrt(0.5)
SCALARS = {f"/plots/action/{name}": i for i, name in enumerate(("roll", "pitch", "yaw", "thrust"))}


SEQUENCE = make_sequence(STEPS)
GATES = load_track("flytrack").rows()


def record(folder: Path, sequence=SEQUENCE, gates=GATES, **options) -> Recording:
    """Return what was recorded as the only file of an empty folder."""
    path = folder / "flight.rrd"
    viz.visualize_state_action_sequence(sequence, gates, str(path), **options)
    assert list(folder.iterdir()) == [path]
    return Recording(path)


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Recording:
    return record(tmp_path_factory.mktemp("viz"), app_id="test_app")


def test_pose_is_the_states(recording):
    translation = recording.series("/world/drone", "Transform3D:translation")
    rotation = recording.series("/world/drone", "Transform3D:quaternion")
    assert len(translation) == len(rotation) == STEPS
    for step in (0, 1, 100, STEPS - 1):
        x, _ = SEQUENCE[step]
        np.testing.assert_array_equal(translation[step], x[0:3])
        # Rerun stores the scalar part last.
        np.testing.assert_allclose(rotation[step], x[[10, 11, 12, 9]], atol=1e-6)


def test_scalars_are_the_states_and_actions(recording):
    x = np.array([pair[0] for pair in SEQUENCE], float)
    u = np.array([pair[1] for pair in SEQUENCE], float)
    expected = {
        "/plots/speed": np.sqrt((x[:, 3:6] ** 2).sum(axis=1)),
        "/plots/angular_speed": np.sqrt((x[:, 13:16] ** 2).sum(axis=1)),
        **{entity: u[:, column] for entity, column in SCALARS.items()},
    }
    for entity, values in expected.items():
        found = recording.series(entity, "Scalars:scalars")
        np.testing.assert_allclose(found, values, rtol=1e-12, err_msg=entity)
    assert recording.once("/plots/speed", "SeriesLines:names").tolist() == ["speed [m/s]"]


def test_app_id_and_timelines(recording):
    assert recording.app_id == "test_app"
    assert recording.timelines == {"step", "sim_time"}
    grid = [(step, step * 10_000_000) for step in range(STEPS)]
    for entity in ("/world/drone", "/plots/speed", "/plots/angular_speed", *SCALARS):
        assert sorted(recording.times[entity]) == grid, entity
    assert sorted(recording.times["/world/trajectory/recent"]) == grid[1:]


def test_trajectory_at_a_step_is_the_path_up_to_it(recording):
    positions = np.array([x[0:3] for x, _ in SEQUENCE])
    for step in range(1, STEPS):
        flown = recording.latest_strip("/world/trajectory/flown", step)
        recent = recording.latest_strip("/world/trajectory/recent", step)
        assert len(recent) >= 2
        # The two meet in one point, so that the line has no hole.
        path = recent if flown is None else flown + recent[1:]
        assert flown is None or flown[-1] == recent[0]
        np.testing.assert_array_equal(path, positions[: step + 1])


def test_static_data_is_logged_once_whatever_the_length(recording, tmp_path):
    assert [key for key, rows in recording.static.items() if len(rows) != 1] == []
    short = record(tmp_path, make_sequence(2))
    assert set(short.static) == set(recording.static)
    moving = {entity for entity, _ in recording.rows}
    assert not any(entity.startswith("/world/gates") for entity in moving)
    assert moving & {"/world", "/world/drone/motors", "/world/drone/arms"} == set()
    right, forward, up = 3, 5, 1  # Rerun's numbers for directions
    assert recording.once("/world", "ViewCoordinates:xyz").tolist() == [[right, forward, up]]


def test_gate_centres_and_rectangles_are_in_the_world(recording):
    centres = recording.once("/world/gates/centre", "Points3D:positions")
    np.testing.assert_allclose(centres, GATES[:, 1:4], atol=1e-6)
    labels = recording.once("/world/gates/centre", "Points3D:labels").tolist()
    assert labels == [f"gate {i}" for i in (0, 1, 2, 3, 4, 8, 9, 10)]
    for name, edge in (("outer", 2.7), ("inner", 1.5)):
        strips = recording.once(f"/world/gates/{name}", "LineStrips3D:strips")
        assert strips.shape == (len(GATES), 5, 3)
        np.testing.assert_array_equal(strips[:, 0], strips[:, 4])
        for gate, strip in zip(GATES, strips, strict=True):
            around = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
            local = [0.5 * edge * np.array([x, 0.0, z]) for x, z in around]
            corners = [gate[1:4] + rotate(gate[4:8], corner) for corner in local]
            np.testing.assert_allclose(strip[:4], corners, atol=1e-5)
    # By hand: the inner square of gate 0 at (12.5, 2, 1.35), yaw 270 degrees: local x is along -y.
    expected = [(12.5, 2.75, 0.6), (12.5, 1.25, 0.6), (12.5, 1.25, 2.1), (12.5, 2.75, 2.1)]
    np.testing.assert_allclose(strips[0, :4], expected, atol=1e-5)


def test_gate_lying_flat_has_its_rectangle_in_the_horizontal_plane(tmp_path):
    """Rolled 90 degrees about x, local z points along -y; extra columns are ignored."""
    gate = np.array([[5, 1.0, 2.0, 3.0, QUARTER_TURN, QUARTER_TURN, 0, 0, 99.0]])
    found = record(tmp_path, make_sequence(2), gate)
    inner = found.once("/world/gates/inner", "LineStrips3D:strips")[0]
    expected = [(0.25, 2.75, 3), (1.75, 2.75, 3), (1.75, 1.25, 3), (0.25, 1.25, 3)]
    np.testing.assert_allclose(inner[:4], expected, atol=1e-6)


def test_body_is_the_handouts(recording):
    front_left, front_right = (0.15, 0.09, 0), (0.15, -0.09, 0)
    back_left, back_right = (-0.15, 0.14, 0), (-0.15, -0.14, 0)
    motors = recording.once("/world/drone/motors", "Points3D:positions")
    np.testing.assert_allclose(motors, [front_left, front_right, back_left, back_right])
    arms = recording.once("/world/drone/arms", "LineStrips3D:strips")
    np.testing.assert_allclose(arms, [[front_left, back_right], [front_right, back_left]])
    (ray,) = recording.once("/world/drone/camera", "Arrows3D:vectors")
    assert ray[0] > 0 and ray[1] == 0
    assert math.degrees(math.atan2(ray[2], ray[0])) == pytest.approx(40.0, abs=1e-4)


def test_drone_yawed_left_looks_along_y(tmp_path):
    x = np.zeros(21, np.float32)
    x[[9, 12]] = QUARTER_TURN
    found = record(tmp_path, [(x, np.zeros(4))])
    qx, qy, qz, qw = found.series("/world/drone", "Transform3D:quaternion")[0]
    quaternion = np.array([qw, qx, qy, qz])
    np.testing.assert_allclose(rotate(quaternion, np.array([1.0, 0, 0])), (0, 1, 0), atol=1e-6)
    (ray,) = found.once("/world/drone/camera", "Arrows3D:vectors")
    pitch = math.radians(40)
    direction = rotate(quaternion, ray / np.linalg.norm(ray))
    np.testing.assert_allclose(direction, (0, math.cos(pitch), math.sin(pitch)), atol=1e-6)


def test_nan_outside_the_pose_is_a_gap_in_its_plot(tmp_path):
    found = record(tmp_path, with_state(3, np.nan))
    speed = found.series("/plots/speed", "Scalars:scalars")
    assert np.isnan(speed).tolist() == [False, False, True]


def test_callers_own_recording_is_left_alone(tmp_path):
    before = rr.get_data_recording()
    record(tmp_path, make_sequence(1), np.zeros((0, 8)))
    assert rr.get_data_recording() is before


def test_a_minute_of_flight_is_written_fast_and_small(tmp_path):
    sequence = make_sequence(6000)
    path = tmp_path / "minute.rrd"
    start = time.perf_counter()
    viz.visualize_state_action_sequence(sequence, GATES, str(path))
    # The goal is 3 s; the rest is for a slow or busy machine.
    assert time.perf_counter() - start < 10.0
    assert path.stat().st_size < 10e6


def refuse(path: Path, reason: str, sequence=SEQUENCE, gates=GATES) -> None:
    """Expect a recording to be refused for a reason, a regular expression."""
    with pytest.raises(ValueError, match=reason):
        viz.visualize_state_action_sequence(sequence, gates, str(path))


def with_state(index, value) -> list:
    """Return a flight of three steps whose last state has that value there."""
    sequence = make_sequence(3)
    sequence[2][0][index] = value
    return sequence


BAD_INPUT = [
    ([], GATES, "sequence: found no steps"),
    (with_state(1, np.nan), GATES, r"sequence\[2\]: found position.*expected finite"),
    (with_state(9, np.inf), GATES, r"sequence\[2\]: found position.*expected finite"),
    (with_state(slice(9, 13), 0), GATES, r"sequence\[2\]: found quaternion norm 0"),
    (with_state(slice(9, 13), 0.501), GATES, "norm 1.002, expected 1 within 0.001"),
    ([(np.zeros(17), np.zeros(4))], GATES, r"sequence\[0\]: found shapes \[\(17,\)"),
    ([(np.zeros(21),)], GATES, r"sequence\[0\]: found shapes \[\(21,\)\], expected"),
    (SEQUENCE, np.zeros((3, 7)), r"gates: found shape \(3, 7\), expected \(N, >=8\)"),
    (SEQUENCE, np.zeros(8), r"gates: found shape \(8,\)"),
    (SEQUENCE, np.zeros((3, 8)), r"gates\[0\]: found quaternion norm 0"),
    (SEQUENCE, np.full((3, 8), np.nan), "gates: found ids"),
    (SEQUENCE, np.array([[0.0, np.nan, 0, 0, 1, 0, 0, 0]]), r"gates\[0\]: found position"),
    (SEQUENCE, np.array([[0.0, 1e35, 0, 0, 1, 0, 0, 0]]), r"gates\[0\]: found position.*within float32"),
    (SEQUENCE, [[0.0, 1.0], [2.0]], "gates: .*expected numbers"),
    (SEQUENCE, np.full((1, 8), "a"), "gates: .*expected numbers"),
    ([None], GATES, r"sequence\[0\]: found shapes None, expected"),
]


@pytest.mark.parametrize(("sequence", "gates", "reason"), BAD_INPUT)
def test_bad_input_is_refused_and_leaves_no_file(tmp_path, sequence, gates, reason):
    refuse(tmp_path / "flight.rrd", reason, sequence, gates)
    assert list(tmp_path.iterdir()) == []


def test_rounded_quaternion_is_renormalised(tmp_path):
    found = record(tmp_path, with_state(slice(9, 13), 0.5004))
    rotation = found.series("/world/drone", "Transform3D:quaternion")[2]
    np.testing.assert_allclose(rotation, np.full(4, 0.5), atol=1e-7)


@pytest.mark.parametrize("name", ["folder", "file/flight.rrd"])
def test_unwritable_path_is_refused(tmp_path, name):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("in the way")
    refuse(tmp_path / name, r"recording_path .*cannot be written.*expected")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder"]


def test_rerun_turned_off_is_an_error_and_no_empty_file(tmp_path, monkeypatch):
    monkeypatch.setenv("RERUN", "0")
    refuse(tmp_path / "flight.rrd", "RERUN: found it turned off")
    assert list(tmp_path.iterdir()) == []


def test_failure_midway_keeps_the_old_recording(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("disk full")

    path = tmp_path / "flight.rrd"
    path.write_bytes(b"old")
    monkeypatch.setattr(os, "replace", fail)
    refuse(path, "disk full")
    assert list(tmp_path.iterdir()) == [path] and path.read_bytes() == b"old"
