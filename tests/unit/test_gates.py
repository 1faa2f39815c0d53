"""Gates: meeting them, and racing through them at any step size."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from flytrack_env.quaternion import Vec3
from flytrack_env.race import advance_race, start_race
from flytrack_env.tracks import Gate, Track, build_course, cross_gate
from tests.support.coasting import coasting_env, drone_at

RADIUS = 0.15
EVENTS = ("pass", "frame", "miss", "none")

cross = jax.jit(jax.vmap(cross_gate, in_axes=(None, 0, 0, None)))


def course_of(*gates):
    """Return the course of some gates, with bounds that do not matter."""
    bounds = ((-1e3, -1e3, -1e3), (1e3, 1e3, 1e3))
    return build_course(Track("test", gates, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), *bounds))


def frame_of(gate):
    """Return the gate's flight frame as scalars."""
    return jax.tree.map(lambda table: jnp.asarray(table[0]), course_of(gate, gate).gates)


def to_world(gate, points):
    """Return points (N, 3) of the flight frame in the world, computed from the gate's data."""
    matrix = Rotation.from_quat(gate.quaternion, scalar_first=True).as_matrix()
    forward, up = gate.direction * matrix[:, 1], matrix[:, 2]
    axes = np.stack([forward, np.cross(up, forward), up])
    return Vec3(*jnp.asarray((points @ axes + gate.position).astype(np.float32)).T)


def names(crossing):
    """Return the event of each crossing by name; two at once would be a bug."""
    flags = np.stack([crossing.is_pass, crossing.is_frame, crossing.is_miss])
    assert (flags.sum(axis=0) <= 1).all()
    return [EVENTS[int(np.argmax([*column, True]))] for column in flags.T]


@pytest.mark.parametrize(("y", "event"), [(0.0, "pass"), (1.0, "frame"), (2.0, "miss")])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_point_on_the_plane_is_counted_once(y, event, sign):
    gate = gate_of(Rotation.from_euler("z", -90, degrees=True), (0.0, 0.0, 0.0), 1.0, 1.5, 0.6)
    points = sign * np.array([[-0.2, 0.0, 0.0], [0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
    points[:, 1] = y
    crossing = cross(frame_of(gate), to_world(gate, points[:2]), to_world(gate, points[1:]), RADIUS)
    forward = [event, "none"]
    backward = ["none", "frame" if event == "frame" else "none"]
    assert names(crossing) == (forward if sign > 0 else backward)


NUM = 8  # segments at once: one shape, compiled once
CLOSE_M, USUAL_M = (
    2e-3,
    100.0,
)  # so near an edge, float32 and float64 may differ, of segments of a usual size
FARTHEST_M = 2.0**40  # that what moves a thousand km out of bounds in a step may reach

unit_turns = st.integers(0, 2**32 - 1).map(
    lambda seed: Rotation.random(rng=np.random.default_rng(seed))
)
centres = st.tuples(*[st.floats(-50.0, 50.0)] * 3)
openings = st.floats(0.4, 5.0)
thicknesses = st.floats(0.01, 3.0)


def vectors(rows):
    """Return rows (N, 3) as a vector of columns, float32."""
    return Vec3(*jnp.asarray(np.asarray(rows, np.float32).T))


def gate_of(turn, centre, direction, opening, thickness):
    """Return a gate; thickness: of its frame, m."""
    quat = tuple(turn.as_quat(scalar_first=True).tolist())
    return Gate(0, tuple(centre), quat, direction, opening, opening + 2.0 * thickness)


def events_in_float64(gate, start, end, radius):
    """Return what a segment (world, m) does to a gate, and how near float32 may get it wrong, m.

    By rotating the segment into the gate's own frame, where it is flown along +-y and stands in x
    and z.
    """
    turn = Rotation.from_quat(gate.quaternion, scalar_first=True)
    (x0, y0, z0), (x1, y1, z1) = turn.inv().apply(np.stack([start, end]) - gate.position)
    y0, y1 = gate.direction * y0, gate.direction * y1
    if not (y0 < 0.0) ^ (y1 < 0.0):
        return "none", min(abs(y0), abs(y1))
    share = y0 / (y0 - y1)
    at = max(abs(x0 + share * (x1 - x0)), abs(z0 + share * (z1 - z0)))
    free, solid = 0.5 * gate.opening - radius, 0.5 * gate.frame + radius
    doubt = min(abs(y0), abs(y1), abs(at - free), abs(at - solid)) * min(1.0, abs(y0 - y1))
    if free < at <= solid:
        return "frame", doubt
    if y1 < 0.0:
        return "none", doubt
    return ("pass" if at <= free else "miss"), doubt


@settings(max_examples=60, deadline=None)
@given(
    turn=unit_turns,
    centre=centres,
    direction=st.sampled_from([1.0, -1.0]),
    opening=openings,
    thickness=thicknesses,
    radius=st.floats(0.01, 0.19),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_segment_meets_any_gate_as_in_the_gates_own_frame(
    turn,
    centre,
    direction,
    opening,
    thickness,
    radius,
    seed,
):
    """Even of a far or degenerate segment: one event at most, and a fraction from 0 to 1."""
    gate = gate_of(turn, centre, direction, opening, thickness)
    rng = np.random.default_rng(seed)
    spread = (
        rng.choice([0.0, 1e-40, 0.3, 0.3, 1.0, 1.0, 4.0, 4.0, FARTHEST_M], (2, NUM, 1)) * opening
    )
    start, end = np.asarray(centre) + spread * rng.uniform(-1.0, 1.0, (2, NUM, 3))
    end[0] = start[0]
    crossing = cross(frame_of(gate), vectors(start), vectors(end), np.float32(radius))
    found, size_m = names(crossing), np.abs([start, end]).max(axis=(0, 2))
    assert found[0] == "none"
    for index in range(NUM):
        expected, doubt = events_in_float64(gate, start[index], end[index], radius)
        if doubt > CLOSE_M * max(1.0, size_m[index] / USUAL_M):
            assert found[index] == expected
    fraction, offset = np.asarray(crossing.fraction), np.asarray(crossing.offset)
    assert ((fraction >= 0.0) & (fraction <= 1.0)).all()
    assert (np.isfinite(offset) & (offset >= 0.0)).all()
    assert (offset[np.asarray(crossing.is_pass)] <= 1.0).all()


# --- Races: coasting flights along a row of gates -----------------------------------------------

ROW = (2.0, 4.0, 6.0, 8.0)


@pytest.mark.parametrize("dt", [0.002, 0.01, 0.05])
def test_coasting_through_the_gates_does_not_depend_on_the_time_step(dt):
    env = coasting_env(*ROW)
    params = env.default_params.replace(dt=dt)
    step = jax.jit(jax.vmap(env.transition, in_axes=(0, None, None)))
    flights = [((-0.5, 0.3, 2.1), (9.7, -0.2, 0.1)), ((0.0, 0.0, 2.0), (5.0, 0.0, 0.0))]
    states = [env.begin(drone_at(*flight), 0, params) for flight in flights]
    state = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    passed, num_laps = [], np.zeros(2, int)
    for _ in range(round(1.8 / dt)):
        state, _, causes, events = step(state, jnp.zeros(4), params)
        assert not causes.any().any()
        passed.append(np.asarray(state.race.gates_passed))
        num_laps += np.asarray(events.is_lap)
    assert_array_equal(passed[-1], 4)
    assert_array_equal(num_laps, 1)
    assert_array_equal(state.race.laps, 1)
    assert_allclose(state.race.lap_time_s, [8.5 / 9.7, 8.0 / 5.0], atol=1e-3)
    # Each gate is counted in the step that takes the drone across it.
    third = dt * (1 + np.argmax(np.array(passed) >= 3, axis=0))
    crossing = np.array([6.5 / 9.7, 6.0 / 5.0])
    assert (third >= crossing - 1e-4).all() and (third <= crossing + dt + 1e-4).all()


LENGTH = 24  # legs of a path
fly_race = jax.jit(
    lambda race, starts, ends, times, dts, course, radius: jax.lax.scan(
        lambda race, leg: advance_race(race, *leg, course, radius), race, (starts, ends, times, dts)
    )
)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), num_gates=st.sampled_from([2, 3, 8]))
def test_a_race_counts_what_its_gates_see_one_after_the_other(seed, num_gates):
    """Passes, laps and the next gate along a random path, against a reading in float64."""
    rng = np.random.default_rng(seed)
    gates = [
        gate_of(
            Rotation.random(rng=rng), rng.uniform(-3.0, 3.0, 3), rng.choice([-1.0, 1.0]), 4.0, 0.5
        )
        for _ in range(num_gates)
    ]
    course = course_of(*gates)
    points = rng.uniform(-4.0, 4.0, (LENGTH + 1, 3))
    first = int(rng.integers(num_gates))
    times = np.arange(LENGTH, dtype=np.float32) * 0.01
    arguments = (
        vectors(points[:-1]),
        vectors(points[1:]),
        times,
        np.full(LENGTH, np.float32(0.01)),
    )
    last, events = fly_race(
        start_race(jnp.int32(first), course), *arguments, course, np.float32(0.1)
    )
    index, passed = first, 0
    for leg, (start, end) in enumerate(pairwise(points)):
        event, doubt = events_in_float64(gates[index], start, end, 0.1)
        assume(doubt > CLOSE_M)
        num_passed = int(event == "pass")
        if event == "pass":
            local = Rotation.from_quat(gates[index].quaternion, scalar_first=True).inv()
            before, after = (
                local.apply(point - gates[index].position)[1] for point in (start, end)
            )
            middle = start + before / (before - after) * (end - start)
            event, doubt = events_in_float64(gates[(index + 1) % len(gates)], middle, end, 0.1)
            assume(doubt > CLOSE_M)
            num_passed += int(event == "pass")
        index, passed = (index + num_passed) % len(gates), passed + num_passed
        assert int(events.num_passed[leg]) == num_passed
        assert bool(events.is_frame[leg]) == (event == "frame")
        assert bool(events.is_miss[leg]) == (event == "miss")
    assert int(last.gate_index) == index and int(last.gates_passed) == passed
    assert int(last.laps) == passed // len(gates) == int(np.asarray(events.is_lap).sum())
    assert 0.0 <= float(last.lap_time_s) <= LENGTH * 0.01 + 1e-6
