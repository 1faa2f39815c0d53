"""The shipped courses, the FlyTrack one against the handout's table."""

import math

import numpy as np
import pytest

from flytrack_env.tracks import available_tracks, build_course, load_track

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


def test_shipped_course_is_the_handouts_table_with_its_flight_frames() -> None:
    track = load_track("flytrack")
    np.testing.assert_allclose(track.rows(), HANDOUT_ROWS, atol=1e-6)
    assert all(gate.opening == 1.5 and gate.frame == 2.7 for gate in track.gates)
    assert track.start_position == (18.6, 2.0, 0.1)
    assert [gate.direction for gate in track.gates] == [-1.0] * 4 + [1.0] * 4
    centres = HANDOUT_ROWS[:, 1:4]
    np.testing.assert_allclose(track.bounds_low[:2], centres.min(axis=0)[:2] - 5.0)
    np.testing.assert_allclose(track.bounds_high, centres.max(axis=0) + 5.0)
    assert track.bounds_low[2] == 0.0
    yaw = 2.0 * math.atan2(track.start_quaternion[3], track.start_quaternion[0])
    to_gate = centres[0] - track.start_position
    assert math.cos(yaw - math.atan2(to_gate[1], to_gate[0])) == pytest.approx(1.0, abs=1e-9)
    course = build_course(track)
    assert course.num_gates == len(HANDOUT_ROWS)
    psi = np.radians(HANDOUT_YAWS_DEG)
    signs = np.repeat([-1.0, 1.0], 4)
    forward = np.stack([-signs * np.sin(psi), signs * np.cos(psi), 0.0 * psi])
    np.testing.assert_allclose(np.stack(course.gates.forward), forward, atol=1e-5)
    np.testing.assert_allclose(np.stack(course.gates.up).T, [[0.0, 0.0, 1.0]] * 8)
    np.testing.assert_allclose(np.stack(course.gates.centre).T, HANDOUT_ROWS[:, 1:4], rtol=1e-6)
    left = np.stack([-forward[1], forward[0], forward[2]])
    np.testing.assert_allclose(np.stack(course.gates.left()), left, atol=1e-5)


def test_shipped_tracks_are_the_promised_ones_under_their_own_names() -> None:
    assert available_tracks() == ("figure_eight", "flytrack", "speedway", "split_s")
    assert all(load_track(name).name == name for name in available_tracks())
