"""The shipped courses, random ones, and the check that finds every fault of a course's geometry."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flytrack_env import tracks
from flytrack_env.params import EnvParams
from flytrack_env.quaternion import Vec3
from flytrack_env.resets import ResetParams
from tests.support.tables import FOLDER

HANDOUT = np.genfromtxt(FOLDER / "handout_gates.csv", delimiter=",", skip_header=1)
HANDOUT_ROWS, HANDOUT_YAWS_DEG = HANDOUT[:, :8], HANDOUT[:, 8]


def test_shipped_course_is_the_handouts_table_with_its_flight_frames():
    track = tracks.load_track("flytrack")
    assert_allclose(track.rows(), HANDOUT_ROWS, atol=1e-6)
    assert all(gate.opening == 1.5 and gate.frame == 2.7 for gate in track.gates)
    assert track.start_position == (18.6, 2.0, 0.1)
    assert [gate.direction for gate in track.gates] == [-1.0] * 4 + [1.0] * 4
    centres = HANDOUT_ROWS[:, 1:4]
    assert_allclose(track.bounds_low[:2], centres.min(axis=0)[:2] - 5.0)
    assert_allclose(track.bounds_high, centres.max(axis=0) + 5.0)
    assert track.bounds_low[2] == 0.0
    # The directions of flight, from the yaws that the handout lists beside the quaternions.
    psi, signs = np.radians(HANDOUT_YAWS_DEG), np.repeat([-1.0, 1.0], 4)
    forward = np.stack([-signs * np.sin(psi), signs * np.cos(psi), 0.0 * psi])
    assert_allclose(np.stack(tracks.build_course(track).gates.forward), forward, atol=1e-5)


NUM_GATES, RADIUS, HEIGHT = 6, 10.0, 2.0


def yaw_of(heading_deg):
    """Return the attitude of a gate that is flown along a heading with direction +1."""
    half = math.radians(heading_deg - 90.0) / 2.0
    return (math.cos(half), 0.0, 0.0, math.sin(half))


def ring(radius=RADIUS):
    """Return gates on a circle, anticlockwise, gate 0 at (radius, 0); starts are 5 m before it."""
    gates = []
    for i in range(NUM_GATES):
        angle = 2.0 * math.pi * i / NUM_GATES
        centre = (radius * math.cos(angle), radius * math.sin(angle), HEIGHT)
        gates.append(tracks.Gate(10 + i, centre, yaw_of(math.degrees(angle) + 90.0), 1.0, 1.5, 2.7))
    wall = radius + 5.0
    return tracks.Track(
        "ring",
        tuple(gates),
        (radius, -5.0, 0.1),
        yaw_of(180.0),
        (-wall, -wall, 0.0),
        (wall, wall, 7.0),
    )


def changed(index, **fields):
    """Return the ring with other fields of one gate."""
    gates = list(RING.gates)
    gates[index] = replace(gates[index], **fields)
    return replace(RING, gates=tuple(gates))


RING = ring()
ALIKE = {"quaternion": RING.gates[0].quaternion}  # flown the same way as gate 10
ON_WAY = tuple(
    tracks.sample_way(tracks.build_course(RING), 1001)[0][505].tolist()
)  # from gate 10 to 11


# How the message about a break of the ring begins, the course, and the demand that it breaks.
BREAKS = {
    "gate 12: opening of 0.5 m, expected at least 0.6 m": (changed(2, opening=0.5), "opening"),
    "gates 10 and 11: 3.00 m apart": (changed(1, position=(RADIUS, 3, HEIGHT)), "spacing"),
    "gates 15 and 10: 41.00 m apart, expected 5 to 40 m": (ring(41.0), "spacing"),
    "gate 12: 150 deg between its direction of flight and": (changed(2, direction=-1.0), "turn"),
    "gate 12: the way from gate 11 to 12 ": (changed(2, direction=-1.0), "own gate"),  # from behind
    # 8 m beside gate 10, 0.3 m ahead, and flown the same way: its plane is crossed at once, far to
    # the side.
    "gate 11: the way from gate 10 to 11 misses it": (
        changed(1, position=(RADIUS - 8.0, 0.3, HEIGHT), **ALIKE),
        "own gate",
    ),
    "gate 13: 0.00 m from the way from gate 10 to 11": (
        changed(3, position=ON_WAY, quaternion=yaw_of(120.0)),  # across it
        "path",
    ),
    "gates 10 and 13: frames 0.20 m apart": (
        changed(3, position=(12.9, 0.0, HEIGHT), **ALIKE),
        "frames",
    ),
    "gate 10: frame 0.85 m out of bounds (high x)": (
        replace(RING, bounds_high=(10.5, 15, 7)),
        "bounds",
    ),
    "start: 180 deg off the direction of": (
        replace(RING, start_position=(RADIUS, 5.0, HEIGHT)),
        "start",
    ),
    "start: gate 13 is 0.00 m from": (changed(3, position=(11.0, -2.5, HEIGHT), **ALIKE), "start"),
    "start: 0.25 m too near the bounds or beyond": (
        replace(RING, bounds_low=(-15, -5.2, 0)),
        "start",
    ),
}


@pytest.mark.parametrize("text", BREAKS)
def test_every_break_is_found_and_named(text):
    track, demand = BREAKS[text]
    problems = tracks.find_problems(track)
    assert [p for p in problems if p.demand == demand and p.text.startswith(text)], problems


def test_every_demand_has_a_break():
    assert {demand for _, demand in BREAKS.values()} == set(tracks.DEMANDS)


def test_the_unbroken_ring_is_feasible_but_by_limits_of_ones_own():
    assert tracks.find_problems(RING) == ()
    problems = tracks.find_problems(RING, tracks.Limits(min_opening=1.51))
    assert len(problems) == NUM_GATES and {problem.demand for problem in problems} == {"opening"}


def test_default_clearances_are_what_starts_need():
    radius, starts = EnvParams.drone_radius, ResetParams()
    limits = tracks.Limits()
    assert limits.drone_radius == radius
    assert limits.clearance == pytest.approx(starts.course_offset + radius)
    assert limits.start_clearance == pytest.approx(starts.start_position_noise + radius)


NUM_SEEDS = 40
NUM_SAMPLES = 100
DRONE_RADIUS = 0.15
BEYOND = 3  # samples of the next way: enough to be through the gate at the end of this one


@pytest.fixture(scope="module")
def drawn():
    """Courses of the first seeds."""
    return [tracks.random_track(seed) for seed in range(NUM_SEEDS)]


CROSS = jax.jit(tracks.cross_gate)


def assert_flies_through(track):
    """Check that the way passes its next gate once, misses it never, and touches no gate at all."""
    course = tracks.build_course(track)
    way = tracks.sample_way(course, NUM_SAMPLES).astype(np.float32)
    # From just behind a gate to just behind the next one.
    points = np.concatenate([way[:, 1:], np.roll(way, -1, axis=0)[:, 1:BEYOND]], axis=1)
    # Every segment of every way against every gate: (N, M, 1) against (num_gates,).
    starts, ends = (
        Vec3(*np.moveaxis(part[:, :, None], -1, 0)) for part in (points[:, :-1], points[:, 1:])
    )
    crossing = CROSS(course.gates, starts, ends, DRONE_RADIUS)
    events = (crossing.is_pass, crossing.is_frame, crossing.is_miss)
    passes, frames, misses = (np.asarray(event).sum(axis=1) for event in events)
    next_gate = np.roll(np.eye(len(track.gates), dtype=int), 1, axis=1)
    assert_array_equal(passes, next_gate, err_msg=track.name)
    assert not frames.any() and not (misses * next_gate).any(), track.name


@pytest.mark.parametrize("name", tracks.available_tracks())
def test_shipped_tracks_are_feasible_and_their_ways_pass_every_gate_in_turn(name):
    assert tracks.find_problems(tracks.load_track(name)) == ()
    assert_flies_through(tracks.load_track(name))


def test_only_such_courses_are_drawn_and_all_differ(drawn):
    for track in drawn:
        assert tracks.find_problems(track) == ()
        assert_flies_through(track)
    assert (
        len({track.gates for track in drawn}) == len({track.name for track in drawn}) == NUM_SEEDS
    )


def test_course_is_a_function_of_the_key(drawn):
    for key in (4, np.int64(4), jax.random.key(4), jax.random.PRNGKey(4)):
        assert tracks.random_track(key) == drawn[4]
    keys = jax.random.split(jax.random.key(0), 3)
    assert len({tracks.random_track(key).gates for key in keys}) == 3
    largest = 2**32 - 1
    assert tracks.random_track(largest) == tracks.random_track(jax.random.key(np.uint32(largest)))


def test_course_of_a_seed_stays_the_same():
    # Whoever publishes a seed publishes a course: a change of the drawing is a change of behaviour.
    track = tracks.random_track(0)
    assert track.name == "random_0_0"
    assert [gate.position for gate in track.gates[:2]] == [(9.61, 6.56, 2.42), (24.36, 5.44, 3.64)]
    assert track.start_position == (7.26, 12.08, 0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_gates": 2}, "num_gates: found 2, expected at least 3"),
        ({"size": (30.0, 10.0)}, r"size: found \(30.0, 10.0\), expected more than 10 m each"),
        (
            {"heights": (1.0, 3.0)},
            r"heights: found \(1.0, 3.0\), expected a range from 1.35 m upwards",
        ),
        ({"key": -1}, "key: found -1, expected 0 to 4294967295"),
        (
            {"key": jnp.zeros((3, 2), jnp.uint32)},
            r"key: found uint32 of shape \(3, 2\), expected one key",
        ),
        pytest.param(
            {"num_gates": 60},
            r"in 300 attempts; .* most often: spacing \(",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(tracks.TrackError, match=message):
        tracks.random_track(**{"key": 0, **arguments})
