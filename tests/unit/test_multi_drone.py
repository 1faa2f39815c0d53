"""Races: of one drone the single environment; drones do not depend on their order, and meet."""

import pickle

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import flytrack_env
from flytrack_env.multi_drone import MultiDroneRace, Opponent, RaceRules, Versus, idle
from flytrack_env.multi_drone.collisions import Path, is_put_out
from flytrack_env.multi_drone.opponents import Standing, observe_opponents, rank_of
from flytrack_env.multi_drone.rules import BOTH_OUT, RAMMER_OUT, check_rules
from flytrack_env.quaternion import Vec3
from flytrack_env.references import shipped_reference
from flytrack_env.tracks import GateFrame

BOTH, RAMMER = RaceRules(blame=BOTH_OUT), RaceRules(blame=RAMMER_OUT)
coordinate = st.floats(-1.0, 1.0, width=32)
vector = st.tuples(coordinate, coordinate, coordinate)


RACES, DRONES = 8, 3
RACE = MultiDroneRace(flytrack_env.make("FlyTrack-v0"), DRONES)
PARAMS = RACE.default_params
step_all = jax.jit(jax.vmap(RACE.step_env, (0, 0, None)))
reset_all = jax.jit(jax.vmap(RACE.reset, (0, None)))


def sticks(seed, *shape):
    return 0.3 * jax.random.uniform(jax.random.key(seed), (*shape, 4), minval=-1.0, maxval=1.0)


def starts(seed, params=PARAMS):
    return reset_all(jax.random.split(jax.random.key(seed), RACES), params)


def with_drones(states, drones):
    return states._replace(
        inner=states.inner._replace(plant=states.inner.plant._replace(drone=drones))
    )


def places_moved(tree, order):
    return jax.tree.map(lambda leaf: leaf[:, order], tree)


def test_one_drone_flies_bit_for_bit_as_in_the_single_environment():
    race = MultiDroneRace(flytrack_env.make("FlyTrackRobust-v0"), 1)
    env, params = race.env, race.env.default_params
    keys = jax.random.split(jax.random.key(0), 32)
    alone, alone_states = jax.vmap(env.reset, (0, None))(keys, params)
    found, states = jax.vmap(race.reset, (0, None))(keys, race.default_params)
    assert_array_equal(found[:, 0], alone)
    num_ended = 0
    for step in range(80):
        actions, key = sticks(step, 32), jax.random.key(step)
        expected = env.step_batch(key, alone_states, actions, params)
        flown = race.step_batch(key, states, actions[:, None], race.default_params)
        alone_states, states = expected[1], flown[1]
        for one, other in zip((flown[0], *flown[2:5]), (expected[0], *expected[2:5]), strict=True):
            assert_array_equal(one[:, 0], other)
        assert_array_equal(flown[5]["final_observation"][:, 0], expected[5]["final_observation"])
        num_ended += int(flown[5]["race_over"].sum())
    assert num_ended > 5


@settings(max_examples=10, deadline=None)
@given(st.permutations(range(DRONES)), st.integers(0, 2**31))
def test_the_order_of_drones_does_not_matter(order, seed):
    order = np.array(order)
    _, states = starts(seed)
    moved = places_moved(states, order)
    for step in range(5):
        actions = sticks(seed + step, RACES, DRONES)
        flown = step_all(states, actions, PARAMS)
        found = step_all(moved, actions[:, order], PARAMS)
        states, moved = flown[1], found[1]
        jax.tree.map(assert_array_equal, places_moved(flown, order), found)


def test_drones_far_apart_fly_as_alone():
    size = RACE.env.observation_space().shape[0]
    _, states = starts(5)
    drone = states.inner.plant.drone
    far = drone.pos_w._replace(y=drone.pos_w.y + jnp.array([0.0, 4.0, -4.0]))
    states = with_drones(states, drone._replace(pos_w=far))
    alone = states._replace(is_out=jnp.zeros((RACES, DRONES), bool).at[:, 1:].set(True))
    for n in range(40):
        actions = sticks(n, RACES, DRONES)
        together, apart = step_all(states, actions, PARAMS), step_all(alone, actions, PARAMS)
        states, alone = together[1], apart[1]
        assert_array_equal(together[0][:, 0, :size], apart[0][:, 0, :size])
        assert_array_equal(together[2][:, 0], apart[2][:, 0])


@settings(max_examples=200, deadline=None)
@given(vector, vector, vector, st.floats(0.0, 1.0))
def test_no_collision_passes_between_two_steps(direction, other_direction, offset, moment):
    """Two drones at 30 m/s that touch at some moment of the step do not get past each other."""
    fast = 30.0 * 0.01
    moves = [
        fast * np.array(one) / max(np.linalg.norm(one), 1e-3)
        for one in (direction, other_direction)
    ]
    # At that moment, within a diameter.
    apart = 0.29 * np.array(offset) / max(np.linalg.norm(offset), 1.0)
    paths = [
        Path(Vec3(*(at - moment * move)), Vec3(*(at + (1.0 - moment) * move)))
        for at, move in zip((np.zeros(3), apart), moves, strict=True)
    ]
    assert bool(is_put_out(*paths, BOTH)) and bool(is_put_out(*reversed(paths), BOTH))
    one_out = [bool(is_put_out(*pair, RAMMER)) for pair in (paths, reversed(paths))]
    assert any(one_out)


def test_who_runs_into_the_other_is_out():
    still, fast = Path(Vec3(0.4, 0, 0), Vec3(0.4, 0, 0)), Path(Vec3(0, 0, 0), Vec3(0.3, 0, 0))
    assert is_put_out(fast, still, RAMMER) and not is_put_out(still, fast, RAMMER)
    assert is_put_out(still, fast, BOTH)
    ahead = Path(Vec3(0.5, 0, 0), Vec3(0.81, 0, 0))
    assert not is_put_out(fast, ahead, BOTH)


def test_a_collision_puts_out_and_costs_what_a_crash_costs():
    params = PARAMS._replace(rules=PARAMS.rules._replace(blame=BOTH_OUT))
    _, states = starts(0, params)
    # Two drones fly at each other, the third is where it was.
    drone = jax.tree.map(lambda leaf: leaf.at[:, 1].set(leaf[:, 0]), states.inner.plant.drone)
    y = drone.pos_w.y.at[:, 1].add(0.31)
    vel_w = Vec3(0 * y, jnp.broadcast_to(jnp.array([5.0, -5.0, 0.0]), y.shape), 0 * y)
    states = with_drones(states, drone._replace(pos_w=drone.pos_w._replace(y=y), vel_w=vel_w))
    idle = jnp.zeros((RACES, DRONES, 4))
    missed = step_all(
        states, idle, params._replace(rules=params.rules._replace(collision_radius=0.01))
    )
    flown = step_all(states, idle, params)
    hit = np.array([True, True, False])
    assert_array_equal(flown[5]["collision"], np.tile(hit, (RACES, 1)))
    assert not missed[3][:, :2].any() and flown[3][:, :2].all()
    cost = np.where(hit, params.flight.reward.termination, 0.0)
    assert_allclose(flown[2] - missed[2], np.tile(cost, (RACES, 1)), atol=1e-5)
    after = step_all(flown[1], jnp.ones((RACES, DRONES, 4)), params)
    assert (
        (after[2][:, :2] == 0.0).all() and after[3][:, :2].all() and not after[5]["collision"].any()
    )
    x, x_after = (one[1].inner.plant.drone.pos_w.x for one in (flown, after))
    assert_array_equal(x[:, :2], x_after[:, :2])


def standing(x, progress=0.0, is_out=False):
    return Standing(
        Vec3(*map(jnp.float32, (x, 0, 0))),
        Vec3(*map(jnp.float32, (1, 0, 0))),
        jnp.float32(progress),
        jnp.asarray(is_out),
    )


def test_opponents_are_seen_nearest_first_in_the_gate_frame():
    to_left = GateFrame(Vec3(0, 5, 0), Vec3(0.0, 1.0, 0.0), Vec3(0.0, 0.0, 1.0), 0.5, 0.8)
    others = [standing(9.0), standing(-3.0, 2.0), standing(0.5, is_out=True), standing(6.0)]
    rows = np.array(observe_opponents(standing(0.0, 1.0), others, to_left)).reshape(3, 7)
    # World x is to the right of a gate that is flown through along y.
    assert_allclose(rows[:, 1] * 3.0, [3.0, -6.0, -9.0], atol=1e-6)
    assert_allclose(rows[:, 6], [1.0, -1.0, -1.0])
    (out,) = np.array(observe_opponents(standing(0.0), others[2:3], to_left)).reshape(1, 7)
    assert_allclose(out, [-10.0, 0, 0, 0, 0, 0, -10.0])


def test_ranks_are_by_progress_and_those_that_are_out_come_last():
    field = [
        standing(0, 2.5),
        standing(0, 4.0, is_out=True),
        standing(0, 3.0),
        standing(0, 1.0, is_out=True),
    ]
    ranks = [int(rank_of(one, [other for other in field if other is not one])) for one in field]
    assert ranks == [2, 3, 1, 4]


def test_a_ghost_flies_its_line_and_stops_for_nobody():
    env = gymnax.make("FlyTrackDuel-v0")[0]
    ghost = env.race.ghosts[1]
    states = np.stack([np.asarray(leaf) for leaf in (*ghost.pos_w, ghost.progress)], axis=-1)
    length_m = np.linalg.norm(np.diff(states[:380, :3], axis=0), axis=1).sum()
    assert 40.0 < length_m < 120.0 and (np.diff(states[:, 3]) > -0.5).all()
    lap = shipped_reference("flytrack", "standing").time_s
    assert (
        abs(0.01 * np.argmax(states[:, 3] >= env.race.env.default_params.course.num_gates) - lap)
        < 0.03
    )
    observation, state = env.reset(jax.random.key(0))
    behind = []
    for step in range(60):
        observation, state, *_, info = env.step(
            jax.random.key(step), state, jnp.array([0.0, 0.0, 0.0, -0.2])
        )
        behind.append(-float(info["gap_gates"]))
        assert not info["race_over"]
    assert behind[-1] > 0.5 and info["rank"] == 2
    drone = state.entrants.inner.plant.drone
    frame = state.entrants.inner.race.gate
    gate = jax.tree.map(lambda leaf: leaf[0], frame)
    apart = Vec3(*(states[60, axis] - drone.pos_w[axis][0] for axis in range(3)))
    assert_allclose(observation[29:32] * 3.0, np.array(gate.to_frame(apart)), atol=1e-3)
    seen = env.race.observe(state.entrants, env.race.default_params)[0]
    assert_allclose(seen, observation, atol=1e-5)


def test_a_duel_can_be_pickled():
    env = gymnax.make("FlyTrackDuel-v0")[0]
    copy = pickle.loads(pickle.dumps(env))
    start, observation = env.reset(jax.random.key(0)), copy.reset(jax.random.key(0))
    jax.tree.map(assert_array_equal, start, observation)


def test_drones_that_would_have_flown_on_are_truncated_when_the_race_is_over():
    race = MultiDroneRace(RACE.env, DRONES, "first")
    _, states = race.reset(jax.random.key(1))
    states = states._replace(is_out=jnp.array([True, False, True]))
    _, _, reward, terminated, truncated, info = race.step_env(states, jnp.zeros((DRONES, 4)))
    assert info["race_over"].all() and reward[0] == 0.0
    assert terminated.tolist() == [True, False, True] and truncated.tolist() == [False, True, False]


def test_a_view_refuses_what_does_not_fit():
    def make_view(count, size, over="first"):
        return Versus(
            MultiDroneRace(RACE.env, 2, over), [idle(RACE)._replace(observation_size=size)] * count
        )

    for arguments, message in (
        ((2, 29), "opponents: found 2, expected 1"),
        ((1, 30), "found 30, expected 29 or 36"),
        ((1, 29, "all"), "expected 'first'"),
    ):
        with pytest.raises(ValueError, match=message):
            make_view(*arguments)
    for arguments, message in (
        (("FlyTrackDuel-v0", 3), "expected 2 to 2"),
        (("FlyTrackRace-v0", 9), "expected 2 to 8"),
        (("FlyTrackRelay-v0",), "race_id"),
    ):
        with pytest.raises(ValueError, match=message):
            flytrack_env.make_race(*arguments)
    with pytest.raises(ValueError, match="ghosts"):
        MultiDroneRace(RACE.env, 2, ghosts={2: None})


@pytest.mark.slow  # three programs are compiled
def test_a_learner_meets_its_opponents_alone_and_in_a_batch():
    def act(gain, seen):
        return jnp.tanh(gain * seen[..., :4])

    race = MultiDroneRace(RACE.env, 2, "first")
    env = Versus(race, [Opponent(act, race.observation_space().shape[0], jnp.float32(0.1))])
    _, states = jax.vmap(env.reset, (0, None))(jax.random.split(jax.random.key(0), 4), None)
    actions = sticks(3, 4)
    batch = env.step_batch(jax.random.key(1), states, actions, env.default_params)
    single = jax.vmap(env.step, (None, 0, 0, None))(jax.random.key(1), states, actions, None)
    is_going = ~np.asarray(batch[5]["race_over"])
    for one, other in zip((batch[0], *batch[2:5]), (single[0], *single[2:5]), strict=True):
        assert_allclose(one[is_going], other[is_going], atol=2e-5)
    both = jnp.stack([actions, act(0.1, states.observations[:, 0])], axis=1)
    by_hand = race.step_batch(jax.random.key(1), states.entrants, both, race.default_params)
    assert_allclose(batch[0], by_hand[0][:, 0], atol=2e-5)


@pytest.mark.filterwarnings(
    "ignore:The old environment creation API"
)  # PettingZoo's own, in its tests
def test_pettingzoo_accepts_the_race():
    pytest.importorskip("pettingzoo")
    from pettingzoo.test import parallel_api_test

    from flytrack_env.multi_drone.pettingzoo_api import ParallelRace

    race = ParallelRace(flytrack_env.make_race("FlyTrackRace-v0", DRONES))
    parallel_api_test(race, num_cycles=150)
    race.reset(seed=1)
    with pytest.raises(ValueError, match=r"found \['drone_0'\], expected"):
        race.step({"drone_0": np.zeros(4)})
    with pytest.raises(ValueError, match=r"actions\['drone_0'\]: found shape \(3,\)"):
        race.step({agent: np.zeros(3) for agent in race.agents})


def test_a_race_begins_on_the_grid_and_is_over_for_all_at_once():
    params = PARAMS._replace(rules=PARAMS.rules._replace(first_slot=0))
    _, states = starts(3, params)
    x, y, _ = (np.asarray(one) for one in states.inner.plant.drone.pos_w)
    second, third = (np.hypot(x[:, n] - x[:, 0], y[:, n] - y[:, 0]) for n in (1, 2))
    assert_allclose(second, np.hypot(1.0, 0.5), atol=1e-4)
    assert_allclose(third, 1.0, atol=1e-4)
    num_over = 0
    for step in range(150):  # without thrust none stays in the air for longer
        thrust = jnp.full((RACES, DRONES, 4), -1.0)
        flown = RACE.step_batch(jax.random.key(step), states, thrust, params)
        over = np.asarray(flown[5]["race_over"])
        assert_array_equal(over.all(axis=1), over.any(axis=1))
        assert flown[3][over].all() and not flown[1].is_out[over].any()
        states = flown[1]
        num_over += over[:, 0].sum()
    assert num_over >= RACES


def test_observations_at_the_start_are_those_of_the_drones_that_begin():
    observations, states = RACE.reset(jax.random.key(8))
    drones, gates = states.inner.plant.drone, states.inner.race.gate_index
    assert_allclose(observations, RACE.begin(drones, gates, PARAMS)[0], atol=2e-5)
    assert observations.shape == (DRONES, *RACE.observation_space().shape)


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ({"column_spacing": 0.3}, "start inside each other"),
        ({"blame": 2}, "blame"),
        ({"first_slot": 2}, "slot of 0 to 1"),
        ({"collision_radius": 0.0}, "more than 0 m"),
    ],
)
def test_rules_that_no_race_can_be_flown_by_are_refused(rules, message):
    with pytest.raises(ValueError, match=message):
        check_rules(RaceRules(**rules), 2)


@pytest.mark.parametrize("num_drones", [0, 9, 2.0])
def test_another_number_of_drones_is_refused(num_drones):
    with pytest.raises(ValueError, match="expected 1 to 8"):
        MultiDroneRace(flytrack_env.make("FlyTrack-v0"), num_drones)


def test_drones_that_start_inside_each_other_are_refused():
    _, states = RACE.reset(jax.random.key(0))
    drones = jax.tree.map(lambda leaf: leaf.at[1].set(leaf[0]), states.inner.plant.drone)
    with pytest.raises(ValueError, match="drones 0 and 1: found starts 0 m apart"):
        RACE.begin(drones, jnp.zeros(DRONES, jnp.int32), PARAMS)
