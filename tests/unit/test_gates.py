"""Gates: looking them up, meeting them, and racing through them at any step size."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flytrack_env.env import FlyTrack
from flytrack_env.quaternion import Vec3
from flytrack_env.tracks import Course, Crossing, Gate, GateFrame, Track, build_course, cross_gate

RADIUS = 0.15
FREE = 0.6  # half of the 1.5 m opening less the radius
SOLID = 1.5  # half of the 2.7 m frame plus the radius
EVENTS = ("pass", "frame", "miss", "none")

cross = jax.jit(jax.vmap(cross_gate, in_axes=(None, 0, 0, None)))


def course_of(*gates: Gate) -> Course:
    """Return the course of some gates, with bounds that do not matter."""
    bounds = ((-1e3, -1e3, -1e3), (1e3, 1e3, 1e3))
    return build_course(Track("test", gates, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), *bounds))


def gate_at(centre: tuple[float, ...], rotation: Rotation, direction: float = 1.0, gate_id: int = 0) -> Gate:
    """Return a gate of the usual size."""
    quat = tuple(rotation.as_quat(scalar_first=True).tolist())
    return Gate(gate_id, centre, quat, direction, 1.5, 2.7)


def frame_of(gate: Gate) -> GateFrame:
    """Return the gate's flight frame as scalars."""
    return jax.tree.map(lambda table: jnp.asarray(table[0]), course_of(gate, gate).gates)


def to_world(gate: Gate, points: np.ndarray) -> Vec3:
    """Return points (N, 3) of the flight frame in the world, computed from the gate's data."""
    matrix = Rotation.from_quat(gate.quaternion, scalar_first=True).as_matrix()
    forward, up = gate.direction * matrix[:, 1], matrix[:, 2]
    axes = np.stack([forward, np.cross(up, forward), up])
    return Vec3(*jnp.asarray((points @ axes + gate.position).astype(np.float32)).T)


def names(crossing: Crossing) -> list[str]:
    """Return the event of each crossing by name; two at once would be a bug."""
    flags = np.stack([crossing.is_pass, crossing.is_frame, crossing.is_miss])
    assert (flags.sum(axis=0) <= 1).all()
    return [EVENTS[int(np.argmax([*column, True]))] for column in flags.T]


@pytest.mark.parametrize("num_gates", range(2, 12))
def test_gate_lookup_equals_the_table(num_gates: int) -> None:
    rng = np.random.default_rng(num_gates)
    gates = [
        gate_at(tuple(rng.normal(size=3)), Rotation.random(rng=rng), rng.choice([-1.0, 1.0]), i)
        for i in range(num_gates)
    ]
    course = course_of(*gates)
    assert course.num_gates == num_gates
    indices = jnp.arange(num_gates)
    looked_up = jax.vmap(course.gate)(indices)
    jax.tree.map(np.testing.assert_array_equal, looked_up, course.gates)
    np.testing.assert_array_equal(
        jax.vmap(course.next_index)(indices), (np.arange(num_gates) + 1) % num_gates
    )


GATES = {
    "along x": gate_at((0.0, 0.0, 0.0), Rotation.from_euler("z", -90, degrees=True)),
    "against its y": gate_at((12.5, 2.0, 1.35), Rotation.from_euler("z", 270, degrees=True), -1.0),
    "oblique": gate_at((-3.0, 7.0, 2.0), Rotation.from_euler("z", 37, degrees=True)),
    "tilted": gate_at((1.0, 2.0, 3.0), Rotation.from_euler("zyx", [75, 20, -35], degrees=True), -1.0),
    "lying": gate_at((0.0, 0.0, 5.0), Rotation.from_euler("x", 90, degrees=True)),
}


def ring(distance: float) -> list[tuple[float, float]]:
    """Return points at that distance, the larger of the two axes, from the centre."""
    d, some = distance, 0.4 * distance
    return [(d, some), (-d, some), (some, d), (-some, -d), (d, d), (-d, d), (-d, -d), (d, 0.0)]


CROSSINGS = [
    *[((-0.1, 0.1, y, z), "pass") for y, z in [(0.0, 0.0), *ring(FREE - 1e-3)]],
    *[((-0.1, 0.1, y, z), "frame") for d in (FREE + 1e-3, 0.75, 1.35, SOLID - 1e-3) for y, z in ring(d)],
    *[((-0.1, 0.1, y, z), "miss") for d in (SOLID + 1e-3, 3.0, 40.0) for y, z in ring(d)],
    *[((0.1, -0.1, y, z), "none") for y, z in [(0.0, 0.0), *ring(FREE - 1e-3)]],
    *[((0.1, -0.1, y, z), "frame") for d in (FREE + 1e-3, SOLID - 1e-3) for y, z in ring(d)],
    *[((0.1, -0.1, y, z), "none") for y, z in ring(SOLID + 1e-3)],
    *[((a, b, y, z), "none") for a, b in ((-2.0, -0.1), (0.1, 2.0), (-0.1, -2.0)) for y, z in ring(0.3)],
    ((-50.0, 30.0, 0.0, 0.0), "pass"),  # fast
    ((-0.3, -0.3, 0.0, 0.0), "none"),  # parallel to the plane, before it
    ((0.3, 0.3, 0.0, 0.0), "none"),
]


@pytest.mark.parametrize("name", GATES)
def test_crossings_perpendicular_to_the_gate(name: str) -> None:
    gate = GATES[name]
    rows = np.array([row for row, _ in CROSSINGS])
    start, end = rows[:, [0, 2, 3]], rows[:, [1, 2, 3]]
    crossing = cross(frame_of(gate), to_world(gate, start), to_world(gate, end), RADIUS)
    expected = [event for _, event in CROSSINGS]
    assert names(crossing) == expected
    passed = np.array(expected) == "pass"
    offsets = np.abs(rows[passed, 2:]).max(axis=1) / FREE
    np.testing.assert_allclose(crossing.offset[passed], offsets, atol=1e-4)


OBLIQUE = [
    # Where the path meets the plane decides, not where it begins or ends.
    ((-1.0, -1.0, 0.0), (1.0, 1.0, 0.0), "pass", 0.5),
    ((-1.0, -2.0, 0.0), (3.0, 6.0, 0.0), "pass", 0.25),
    ((-1.0, 0.0, 0.0), (1.0, 2.0, 0.0), "frame", 0.5),
    ((-1.0, 0.0, 0.5), (3.0, 0.0, -11.5), "miss", 0.25),
    ((-1.0, 0.0, 0.0), (1.0, 0.0, 3.2), "miss", 0.5),
    ((2.0, 2.0, 1.0), (-2.0, -2.0, -1.0), "none", 0.5),
    ((2.0, 0.0, 0.0), (-2.0, 2.0, 0.0), "frame", 0.5),
]


@pytest.mark.parametrize("name", GATES)
def test_oblique_crossings_are_interpolated(name: str) -> None:
    gate = GATES[name]
    start, end = (np.array([row[i] for row in OBLIQUE]) for i in (0, 1))
    crossing = cross(frame_of(gate), to_world(gate, start), to_world(gate, end), RADIUS)
    assert names(crossing) == [row[2] for row in OBLIQUE]
    np.testing.assert_allclose(crossing.fraction, [row[3] for row in OBLIQUE], atol=1e-5)


def test_moving_within_the_plane_is_no_event() -> None:
    gate = GATES["along x"]
    start, end = np.array([[0.0, -3.0, 0.0]] * 2), np.array([[0.0, 3.0, 0.0], [0.0, 0.0, 0.0]])
    crossing = cross(frame_of(gate), to_world(gate, start), to_world(gate, end), RADIUS)
    assert names(crossing) == ["none", "none"]
    np.testing.assert_array_equal(crossing.fraction, 1.0)


@pytest.mark.parametrize(("y", "event"), [(0.0, "pass"), (1.0, "frame"), (2.0, "miss")])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_point_on_the_plane_is_counted_once(y: float, event: str, sign: float) -> None:
    gate = GATES["along x"]
    points = sign * np.array([[-0.2, 0.0, 0.0], [0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
    points[:, 1] = y
    crossing = cross(frame_of(gate), to_world(gate, points[:2]), to_world(gate, points[1:]), RADIUS)
    forward = [event, "none"]
    backward = ["none", "frame" if event == "frame" else "none"]
    assert names(crossing) == (forward if sign > 0 else backward)


NUM_PIECES = 6
coordinate = st.floats(-4.0, 4.0, width=32)


@settings(max_examples=150, deadline=None)
@given(
    name=st.sampled_from(sorted(GATES)),
    start=st.tuples(*[coordinate] * 3),
    end=st.tuples(*[coordinate] * 3),
    cuts=st.lists(st.floats(0.0, 1.0), min_size=NUM_PIECES - 1, max_size=NUM_PIECES - 1),
)
@example("oblique", (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), [0.1, 0.2, 0.3, 0.4, 0.45])
@example("tilted", (2.0, 1.0, 0.0), (-1.0, 1.0, 0.1), [0.1, 0.2, 0.3, 0.4, 0.8])
def test_cutting_a_path_into_pieces_gives_the_same_events(
    name: str, start: tuple[float, ...], end: tuple[float, ...], cuts: list[float]
) -> None:
    begin, finish = np.array(start), np.array(end)
    travel = finish[0] - begin[0]
    assume(min(abs(begin[0]), abs(finish[0]), abs(travel)) > 1e-2)
    meeting = begin - begin[0] / travel * (finish - begin)
    for edge in (FREE, SOLID):
        assume(abs(np.abs(meeting[1:]).max() - edge) > 1e-3)
    gate = GATES[name]
    fractions = np.array([0.0, *sorted(cuts), 1.0])
    points = begin + fractions[:, None] * (finish - begin)
    starts = np.concatenate([points[:-1], begin[None]])
    ends = np.concatenate([points[1:], finish[None]])
    crossing = cross(frame_of(gate), to_world(gate, starts), to_world(gate, ends), RADIUS)
    events = names(crossing)
    assert [event for event in events[:-1] if event != "none"] == [
        event for event in events[-1:] if event != "none"
    ]


# --- Races: coasting flights along a row of gates -----------------------------------------------

ROW = (2.0, 4.0, 6.0, 8.0)
Row = Callable[[list[float]], Track]
Envs = Callable[[Track, str], FlyTrack]


@pytest.mark.parametrize("dt", [0.002, 0.01, 0.05])
def test_coasting_through_the_gates_does_not_depend_on_the_time_step(
    dt: float, coasting_envs: Envs, row_track: Row, make_drone: Any
) -> None:
    env = coasting_envs(row_track(list(ROW)), "terminate")
    params = env.default_params.replace(dt=dt)
    step = jax.jit(jax.vmap(env.transition, in_axes=(0, None, None)))
    flights = [((-0.5, 0.3, 2.1), (9.7, -0.2, 0.1)), ((0.0, 0.0, 2.0), (5.0, 0.0, 0.0))]
    states = [env.begin(make_drone(*flight), 0, params) for flight in flights]
    state = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    passed, num_laps = [], np.zeros(2, int)
    for _ in range(round(1.8 / dt)):
        state, _, causes, events = step(state, jnp.zeros(4), params)
        assert not causes.any().any()
        passed.append(np.asarray(state.race.gates_passed))
        num_laps += np.asarray(events.is_lap)
    np.testing.assert_array_equal(passed[-1], 4)
    np.testing.assert_array_equal(num_laps, 1)
    np.testing.assert_array_equal(state.race.laps, 1)
    np.testing.assert_allclose(state.race.lap_time_s, [8.5 / 9.7, 8.0 / 5.0], atol=1e-3)
    # Each gate is counted in the step that takes the drone across it.
    third = dt * (1 + np.argmax(np.array(passed) >= 3, axis=0))
    crossing = np.array([6.5 / 9.7, 6.0 / 5.0])
    assert (third >= crossing - 1e-4).all() and (third <= crossing + dt + 1e-4).all()


def transition_of(env: FlyTrack, drone: Any, dt: float = 0.01, gate_index: int = 0) -> tuple[Any, Any, Any]:
    """Return the state, causes and events after one coasting step."""
    params = env.default_params.replace(dt=dt)
    state = env.begin(drone, gate_index, params)
    state, _, causes, events = jax.jit(env.transition)(state, jnp.zeros(4), params)
    return state, causes, events


def test_two_gates_in_one_step_both_count(coasting_envs: Envs, row_track: Row, make_drone: Any) -> None:
    env = coasting_envs(row_track([0.0, 0.4]), "terminate")
    params = env.default_params
    step = jax.jit(jax.vmap(env.transition, in_axes=(0, None, None)))
    cases = [  # y, speed; passed, laps, lap time
        (0.0, 100.0, 2, 1, 0.006),
        (0.0, 50.0, 1, 0, 0.0),
        (0.3, 100.0, 2, 1, 0.006),
    ]
    drones = [make_drone((-0.2, y, 2.0), (speed, 0.0, 0.0)) for y, speed, *_ in cases]
    states = [env.begin(drone, 0, params) for drone in drones]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    state, _, causes, events = step(stacked, jnp.zeros(4), params)
    np.testing.assert_array_equal(events.num_passed, [case[2] for case in cases])
    np.testing.assert_array_equal(state.race.gates_passed, [case[2] for case in cases])
    np.testing.assert_array_equal(state.race.laps, [case[3] for case in cases])
    np.testing.assert_array_equal(events.is_lap, [case[3] == 1 for case in cases])
    np.testing.assert_allclose(state.race.lap_time_s, [case[4] for case in cases], atol=1e-6)
    np.testing.assert_array_equal(state.race.gate_index, [case[2] % 2 for case in cases])
    np.testing.assert_allclose(events.offset[2], 0.5, atol=1e-4)
    assert not causes.any().any()


@pytest.mark.parametrize(
    ("y", "vy", "crash", "missed"),
    [(1.0, 0.0, True, False), (2.0, 0.0, False, True), (0.4, 60.0, True, False)],
)
def test_the_second_gate_of_a_step_can_be_touched_too(
    y: float,
    vy: float,
    crash: bool,
    missed: bool,
    coasting_envs: Envs,
    row_track: Row,
    make_drone: Any,
) -> None:
    env = coasting_envs(row_track([0.0, 0.4]), "terminate")
    _, causes, events = transition_of(env, make_drone((-0.2, y, 2.0), (100.0, vy, 0.0)))
    assert (bool(causes.crash), bool(causes.missed_gate)) == (crash, missed)
    assert int(events.num_passed) == (1 if vy else 0)


def test_missed_gate_terminates_or_flies_on(coasting_envs: Envs, row_track: Row, make_drone: Any) -> None:
    drone = make_drone((-0.05, 2.0, 2.0), (10.0, 0.0, 0.0))
    for setting, is_ended in (("terminate", True), ("fly_on", False)):
        env = coasting_envs(row_track(list(ROW)), setting)
        state, causes, events = transition_of(
            env, drone._replace(pos_w=drone.pos_w._replace(x=jnp.float32(1.95)))
        )
        assert bool(events.is_miss)
        assert bool(causes.missed_gate) is bool(causes.any()) is is_ended
        assert int(state.race.gate_index) == int(state.race.gates_passed) == 0


def test_after_flying_on_the_same_gate_can_be_flown(
    coasting_envs: Envs, row_track: Row, make_drone: Any
) -> None:
    env = coasting_envs(row_track(list(ROW)), "fly_on")
    params = env.default_params.replace(dt=1.0)
    step = jax.jit(env.transition)
    # Past the gate, back around it, through it, and back through it: (x, y), gates passed.
    legs = [((3.0, 2.0), 0), ((1.0, 3.0), 0), ((1.0, 0.0), 0), ((3.0, 0.0), 1), ((1.0, 0.0), 1)]
    state = env.begin(make_drone((1.0, 2.0, 2.0)), 0, params)
    for (x, y), passed in legs:
        pos_w = env.drone(state).pos_w
        velocity = pos_w._replace(x=x - pos_w.x, y=y - pos_w.y, z=jnp.float32(0.0))
        state = state._replace(plant=state.plant._replace(vel_w=velocity))
        state, _, causes, _ = step(state, jnp.zeros(4), params)
        assert not bool(causes.any())
        assert int(state.race.gates_passed) == int(state.race.gate_index) == passed


@pytest.mark.parametrize("y", [0.0, 2.0])
@pytest.mark.parametrize("gate_index", [0, 1])
def test_flying_backwards_counts_nothing(
    y: float, gate_index: int, coasting_envs: Envs, row_track: Row, make_drone: Any
) -> None:
    env = coasting_envs(row_track(list(ROW)), "terminate")
    state, causes, events = transition_of(
        env, make_drone((5.0, y, 2.0), (-9.0, 0.0, 0.0)), dt=0.5, gate_index=gate_index
    )
    assert not bool(causes.any())
    assert int(events.num_passed) == int(state.race.gates_passed) == 0
    assert int(state.race.gate_index) == gate_index


def test_the_frame_is_solid_from_behind(coasting_envs: Envs, row_track: Row, make_drone: Any) -> None:
    env = coasting_envs(row_track(list(ROW)), "fly_on")
    _, causes, _ = transition_of(env, make_drone((2.05, 1.0, 2.0), (-10.0, 0.0, 0.0)))
    assert bool(causes.crash)
