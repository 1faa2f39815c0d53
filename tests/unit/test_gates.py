"""Gates: meeting them, and racing through them at any step size."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flytrack_env.quaternion import Vec3
from flytrack_env.race import advance_race, start_race
from flytrack_env.tracks import Gate, Track, build_course, cross_gate
from tests.support.coasting import coasting_env, drone_at

NUM = 8  # segments at once: one shape, compiled once
# So near an edge, float32 and float64 may differ, of segments of a usual size.
CLOSE_M, USUAL_M = 2e-3, 100.0
FARTHEST_M = 2.0**40  # that what moves a thousand km out of bounds in a step may reach
EVENTS = ("pass", "frame", "miss", "none")

seeds = st.integers(0, 2**32 - 1)
cross = jax.jit(jax.vmap(cross_gate, in_axes=(None, 0, 0, None)))


def gate_of(turn, centre, direction, opening, thickness):
    """Return a gate; thickness: of its frame, m."""
    quat = tuple(turn.as_quat(scalar_first=True).tolist())
    return Gate(0, tuple(centre), quat, direction, opening, opening + 2.0 * thickness)


def course_of(*gates):
    """Return the course of some gates, with bounds that do not matter."""
    bounds = ((-1e3, -1e3, -1e3), (1e3, 1e3, 1e3))
    return build_course(Track("test", gates, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), *bounds))


def frame_of(gate):
    """Return the gate's flight frame as scalars."""
    return course_of(gate, gate).gate(0)


def vectors(rows):
    """Return rows (N, 3) as a vector of columns, float32."""
    return Vec3(*jnp.asarray(np.asarray(rows, np.float32).T))


def names(crossing):
    """Return the event of each crossing by name; two at once would be a bug."""
    flags = np.stack([crossing.is_pass, crossing.is_frame, crossing.is_miss])
    assert (flags.sum(axis=0) <= 1).all()
    return [EVENTS[int(np.argmax([*column, True]))] for column in flags.T]


@pytest.mark.parametrize(("y", "event"), [(0.0, "pass"), (1.0, "frame"), (2.0, "miss")])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_point_on_the_plane_is_counted_once(y, event, sign):
    facing_x = gate_of(Rotation.from_euler("z", -90, degrees=True), np.zeros(3), 1.0, 1.5, 0.6)
    points = [(sign * x, y, 0.0) for x in (-0.2, 0.0, 0.3)]
    forward = [event, "none"]
    backward = ["none", "frame" if event == "frame" else "none"]
    crossing = cross(frame_of(facing_x), vectors(points[:2]), vectors(points[1:]), 0.15)
    assert names(crossing) == (forward if sign > 0 else backward)


def event_in_float64(gate, start, end, radius):
    """Return what a segment does to a gate, by rotating it into the gate's own frame.

    There, the gate is flown along +-y and stands in x and z.

    Returns:
        The event, how near float32 may get it wrong (m), and where the plane is crossed (world).
    """
    turn = Rotation.from_quat(gate.quaternion, scalar_first=True)
    before, after = turn.inv().apply(np.stack([start, end]) - gate.position)
    y0, y1 = gate.direction * before[1], gate.direction * after[1]
    if (y0 < 0.0) == (y1 < 0.0):
        return "none", min(abs(y0), abs(y1)), end
    share = y0 / (y0 - y1)
    aside = max(abs(before + share * (after - before))[[0, 2]])
    free, solid = 0.5 * gate.opening - radius, 0.5 * gate.frame + radius
    doubt = min(abs(y0), abs(y1), abs(aside - free), abs(aside - solid)) * min(1.0, abs(y0 - y1))
    if free < aside <= solid:
        event = "frame"
    elif y1 < 0.0:
        event = "none"
    else:
        event = "pass" if aside <= free else "miss"
    return event, doubt, start + share * (end - start)


@settings(max_examples=60, deadline=None)
@given(seed=seeds)
def test_any_segment_meets_any_gate_as_in_the_gates_own_frame(seed):
    """Even of a far or degenerate segment: one event at most, and a fraction from 0 to 1."""
    rng = np.random.default_rng(seed)
    centre, opening, radius = (
        rng.uniform(-50.0, 50.0, 3),
        rng.uniform(0.4, 5.0),
        0.19 * rng.random(),
    )
    direction, thickness = rng.choice([-1.0, 1.0]), rng.uniform(0.01, 3.0)
    gate = gate_of(Rotation.random(rng=rng), centre, direction, opening, thickness)
    sizes = [0.0, 1e-40, 0.3, 0.3, 1.0, 1.0, 4.0, 4.0, FARTHEST_M]
    spread = opening * rng.choice(sizes, (2, NUM, 1))
    start, end = centre + spread * rng.uniform(-1.0, 1.0, (2, NUM, 3))
    end[0] = start[0]
    crossing = cross(frame_of(gate), vectors(start), vectors(end), np.float32(radius))
    events, size_m = names(crossing), np.abs([start, end]).max(axis=(0, 2))
    assert events[0] == "none"
    for index in range(NUM):
        expected, doubt, _ = event_in_float64(gate, start[index], end[index], radius)
        if doubt > CLOSE_M * max(1.0, size_m[index] / USUAL_M):
            assert events[index] == expected
    fraction, offset = np.asarray(crossing.fraction), np.asarray(crossing.offset)
    assert ((fraction >= 0.0) & (fraction <= 1.0)).all()
    assert (np.isfinite(offset) & (offset >= 0.0)).all()
    assert (offset[np.asarray(crossing.is_pass)] <= 1.0).all()


@pytest.mark.parametrize("dt", [0.002, 0.05])
def test_a_lap_time_does_not_depend_on_the_time_step(dt):
    env = coasting_env(2.0, 4.0, 6.0, 8.0)
    params, step = env.default_params.replace(dt=dt), jax.jit(env.transition)
    state = env.begin(drone_at((-0.5, 0.3, 2.1), (9.7, -0.2, 0.1)), 0, params)
    num_laps = 0
    for _ in range(round(1.2 / dt)):
        state, _, causes, events = step(state, jnp.zeros(4), params)
        assert not any(causes)
        num_laps += int(events.is_lap)
    assert state.race.gates_passed == 4 and state.race.laps == num_laps == 1
    assert float(state.race.lap_time_s) == pytest.approx(8.5 / 9.7, abs=1e-3)


LENGTH, RADIUS = 24, 0.1  # legs of a path, and of the drone
fly_race = jax.jit(
    lambda race, legs, course: jax.lax.scan(
        lambda race, leg: advance_race(race, *leg, course, np.float32(RADIUS)), race, legs
    )
)


@settings(max_examples=30, deadline=None)
@given(seed=seeds, num_gates=st.sampled_from([2, 3, 8]))
def test_a_race_counts_what_its_gates_see_one_after_the_other(seed, num_gates):
    """Passes, laps and the next gate along a random path, against a reading in float64."""
    rng, gates = np.random.default_rng(seed), []
    for centre in rng.uniform(-3.0, 3.0, (num_gates, 3)):
        direction = rng.choice([-1.0, 1.0])
        gates.append(gate_of(Rotation.random(rng=rng), centre, direction, 4.0, 0.5))
    course, points = course_of(*gates), rng.uniform(-4.0, 4.0, (LENGTH + 1, 3))
    times = np.arange(LENGTH, dtype=np.float32) * 0.01
    legs = vectors(points[:-1]), vectors(points[1:]), times, np.full(LENGTH, np.float32(0.01))
    index, passed = int(rng.integers(num_gates)), 0
    race = start_race(jnp.int32(index), course)
    last, events = jax.device_get(fly_race(race, legs, course))
    for leg, (start, end) in enumerate(pairwise(points)):
        event, num_passed = "pass", 0
        while event == "pass" and num_passed < 2:
            event, doubt, start = event_in_float64(gates[index], start, end, RADIUS)
            assume(doubt > CLOSE_M)
            if event == "pass":
                index, num_passed = (index + 1) % num_gates, num_passed + 1
        passed += num_passed
        assert events.num_passed[leg] == num_passed
        assert events.is_frame[leg] == (event == "frame")
        assert events.is_miss[leg] == (event == "miss")
    assert last.gate_index == index and last.gates_passed == passed
    assert last.laps == passed // num_gates == events.is_lap.sum()
    assert 0.0 <= last.lap_time_s <= LENGTH * 0.01 + 1e-6
