"""Random courses: feasible, distinct, a function of the key; and what cannot be drawn is refused."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytrack_env import tracks
from flytrack_env.quaternion import Vec3

NUM_SEEDS = 40
NUM_SAMPLES = 100
DRONE_RADIUS = 0.15
BEYOND = 3  # samples of the next way: enough to be through the gate at the end of this one


@pytest.fixture(scope="module")
def drawn() -> list[tracks.Track]:
    """Courses of the first seeds."""
    return [tracks.random_track(seed) for seed in range(NUM_SEEDS)]


def test_only_feasible_courses_are_drawn_and_all_differ(drawn: list[tracks.Track]) -> None:
    assert all(tracks.find_problems(track) == () for track in drawn)
    assert len({track.gates for track in drawn}) == len({track.name for track in drawn}) == NUM_SEEDS


CROSS = jax.jit(tracks.cross_gate)


def count_events(track: tracks.Track) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return passes, frames and misses, (way, gate) each, of flying the way by the race's own geometry."""
    course = tracks.build_course(track)
    way = tracks.sample_way(course, NUM_SAMPLES).astype(np.float32)
    # From just behind a gate to just behind the next one.
    points = np.concatenate([way[:, 1:], np.roll(way, -1, axis=0)[:, 1:BEYOND]], axis=1)
    # Every segment of every way against every gate: (N, M, 1) against (num_gates,).
    starts, ends = (Vec3(*np.moveaxis(part[:, :, None], -1, 0)) for part in (points[:, :-1], points[:, 1:]))
    crossing = CROSS(course.gates, starts, ends, DRONE_RADIUS)
    events = (crossing.is_pass, crossing.is_frame, crossing.is_miss)
    return tuple(np.asarray(event).sum(axis=1) for event in events)


def assert_flies_through(track: tracks.Track) -> None:
    """Check that the way passes its next gate once, misses it never, and touches no gate at all."""
    passes, frames, misses = count_events(track)
    next_gate = np.roll(np.eye(len(track.gates), dtype=int), 1, axis=1)
    np.testing.assert_array_equal(passes, next_gate, err_msg=track.name)
    assert not frames.any() and not (misses * next_gate).any(), track.name


def test_way_passes_every_gate_in_turn_by_the_races_geometry(drawn: list[tracks.Track]) -> None:
    for track in drawn:
        assert_flies_through(track)


@pytest.mark.parametrize("name", tracks.available_tracks())
def test_way_of_shipped_tracks_passes_every_gate_in_turn(name: str) -> None:
    assert_flies_through(tracks.load_track(name))


def test_course_is_a_function_of_the_key(drawn: list[tracks.Track]) -> None:
    for seed in range(10):
        same = (
            tracks.random_track(seed),
            tracks.random_track(jax.random.key(seed)),
            tracks.random_track(jax.random.PRNGKey(seed)),
        )
        assert all(track == drawn[seed] for track in same)
    keys = jax.random.split(jax.random.key(0), 3)
    assert len({tracks.random_track(key).gates for key in keys}) == 3
    assert tracks.random_track(np.int64(4)) == drawn[4]
    assert tracks.random_track(2**32 - 1) == tracks.random_track(jax.random.key(np.uint32(2**32 - 1)))


def test_course_of_a_seed_stays_the_same() -> None:
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
        ({"heights": (1.0, 3.0)}, r"heights: found \(1.0, 3.0\), expected a range from 1.35 m upwards"),
        ({"key": -1}, "key: found -1, expected 0 to 4294967295"),
        ({"key": jnp.zeros((3, 2), jnp.uint32)}, r"key: found uint32 of shape \(3, 2\), expected one key"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(tracks.TrackError, match=message):
        tracks.random_track(**{"key": 0, **arguments})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "demand"),
    [
        ({"num_gates": 60}, "spacing"),
        ({"limits": tracks.Limits(max_turn_deg=1.0)}, "turn"),
        ({"limits": tracks.Limits(min_start_distance=20.0)}, "start"),
    ],
)
def test_demands_that_cannot_be_met_are_named(arguments: dict[str, Any], demand: str) -> None:
    assert demand in tracks.DEMANDS
    with pytest.raises(tracks.TrackError, match=rf"in 300 attempts; .* most often: {demand} \(\d+ times\)"):
        tracks.random_track(0, **arguments)
