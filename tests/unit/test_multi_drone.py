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
from tests.support.compiling import quick_jit

BOTH, RAMMER = RaceRules(blame=BOTH_OUT), RaceRules(blame=RAMMER_OUT)
coordinate = st.floats(-1.0, 1.0, width=32)
vector = st.tuples(coordinate, coordinate, coordinate)


RACES, DRONES = 8, 3
RACE = MultiDroneRace(flytrack_env.make("FlyTrack-v0"), DRONES)
PARAMS = RACE.default_params
step_batch = quick_jit(RACE.step_batch)
reset_all = quick_jit(jax.vmap(RACE.reset, (0, None)))


def sticks(seed, *shape):
    return 0.3 * jax.random.uniform(jax.random.key(seed), (*shape, 4), minval=-1.0, maxval=1.0)


def starts(seed, params=PARAMS):
    return reset_all(jax.random.split(jax.random.key(seed), RACES), params)


def step_all(states, actions, params=PARAMS):
    """Step all races, none of which is over: every test flies the same program."""
    flown = step_batch(jax.random.key(0), states, actions, params)
    assert not flown[5]["race_over"].any()
    return flown


def with_drones(states, drones):
    return states._replace(
        inner=states.inner._replace(plant=states.inner.plant._replace(drone=drones))
    )


def reordered(tree, order):
    return jax.tree.map(lambda leaf: leaf[:, order], tree)


@pytest.mark.slow  # four programs are compiled
def test_one_drone_flies_bit_for_bit_as_in_the_single_environment():
    race = MultiDroneRace(flytrack_env.make("FlyTrackRobust-v0"), 1)
    env, params = race.env, race.env.default_params
    keys = jax.random.split(jax.random.key(0), 32)
    single = jax.vmap(env.reset, (0, None))(keys, params)
    raced = jax.vmap(race.reset, (0, None))(keys, race.default_params)
    num_ended = 0
    for step in range(80):
        actions, key = sticks(step, 32), jax.random.key(step)
        assert_array_equal(raced[0][:, 0], single[0])
        single = env.step_batch(key, single[1], actions, params)
        raced = race.step_batch(key, raced[1], actions[:, None], race.default_params)
        for index in (2, 3, 4):
            assert_array_equal(raced[index][:, 0], single[index])
        last = "final_observation"
        assert_array_equal(raced[5][last][:, 0], single[5][last])
        num_ended += int(raced[5]["race_over"].sum())
    assert num_ended > 5


@settings(max_examples=5, deadline=None)
@given(st.permutations(range(DRONES)), st.integers(0, 2**31))
def test_the_order_of_drones_does_not_matter(order, seed):
    order = np.array(order)
    _, states = starts(seed)
    moved = reordered(states, order)
    for step in range(5):
        actions = sticks(seed + step, RACES, DRONES)
        raced = step_all(states, actions)
        raced_moved = step_all(moved, actions[:, order])
        states, moved = raced[1], raced_moved[1]
        jax.tree.map(assert_array_equal, reordered(raced, order), raced_moved)


def test_a_race_begins_with_given_drones_unless_two_are_in_one_place():
    observations, states = jax.tree.map(lambda leaf: leaf[0], starts(8))
    drones, gates = states.inner.plant.drone, states.inner.race.gate_index
    assert_allclose(observations, RACE.begin(drones, gates, PARAMS)[0], atol=2e-5)
    assert observations.shape == (DRONES, *RACE.observation_space().shape)
    together = jax.tree.map(lambda leaf: leaf.at[1].set(leaf[0]), drones)
    with pytest.raises(ValueError, match="drones 0 and 1: found starts 0 m apart"):
        RACE.begin(together, gates, PARAMS)


@settings(max_examples=100, deadline=None)
@given(vector, vector, vector, st.floats(0.0, 1.0))
def test_no_collision_passes_between_two_steps(direction, other_direction, offset, moment):
    """Two drones at 30 m/s that touch at some moment of the step do not get past each other."""
    moves = [
        0.3 * np.array(heading) / max(np.linalg.norm(heading), 1e-3)
        for heading in (direction, other_direction)
    ]
    # At that moment, within a diameter.
    apart = 0.29 * np.array(offset) / max(np.linalg.norm(offset), 1.0)
    paths = [
        Path(Vec3(*(at - moment * move)), Vec3(*(at + (1.0 - moment) * move)))
        for at, move in zip((np.zeros(3), apart), moves, strict=True)
    ]
    assert is_put_out(*paths, BOTH) and is_put_out(*reversed(paths), BOTH)
    assert is_put_out(*paths, RAMMER) or is_put_out(*reversed(paths), RAMMER)


def test_who_runs_into_the_other_is_out():
    hovering, fast = Path(Vec3(0.4, 0, 0), Vec3(0.4, 0, 0)), Path(Vec3(0, 0, 0), Vec3(0.3, 0, 0))
    assert is_put_out(fast, hovering, RAMMER) and not is_put_out(hovering, fast, RAMMER)
    assert is_put_out(hovering, fast, BOTH)
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
    centred = jnp.zeros((RACES, DRONES, 4))
    thin = params._replace(rules=params.rules._replace(collision_radius=0.01))
    missed, collided = step_all(states, centred, thin), step_all(states, centred, params)
    hit = np.array([True, True, False])
    assert_array_equal(collided[5]["collision"], np.tile(hit, (RACES, 1)))
    assert not missed[3][:, :2].any() and collided[3][:, :2].all()
    cost = np.where(hit, params.flight.reward.termination, 0.0)
    assert_allclose(collided[2] - missed[2], np.tile(cost, (RACES, 1)), atol=1e-5)
    after = step_all(collided[1], jnp.ones((RACES, DRONES, 4)), params)
    assert not after[2][:, :2].any() and after[3][:, :2].all() and not after[5]["collision"].any()
    x, x_after = (result[1].inner.plant.drone.pos_w.x for result in (collided, after))
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
    field = [standing(0, 2.5), standing(0, 4.0, True), standing(0, 3.0), standing(0, 1.0, True)]
    ranks = [
        int(rank_of(drone, [opponent for opponent in field if opponent is not drone]))
        for drone in field
    ]
    assert ranks == [2, 3, 1, 4]


@pytest.fixture(scope="module")
def duel():
    """The id of a drone and a ghost."""
    return gymnax.make("FlyTrackDuel-v0")[0]


@pytest.mark.slow
def test_a_ghost_flies_its_line_and_stops_for_nobody(duel):
    env, ghost = duel, duel.race.ghosts[1]
    ghost_w, progress = np.stack(ghost.pos_w, axis=-1), np.asarray(ghost.progress)
    lap_s = 0.01 * np.argmax(progress >= env.race.env.default_params.course.num_gates)
    assert abs(lap_s - shipped_reference("flytrack", "standing").time_s) < 0.03
    observation, state = env.reset(jax.random.key(0))
    step_duel = quick_jit(env.step)
    action = jnp.array([0.0, 0.0, 0.0, -0.2])
    for step in range(60):
        observation, state, *_, info = step_duel(jax.random.key(step), state, action)
        assert not info["race_over"]
    assert info["gap_gates"] < -0.5 and info["rank"] == 2
    learner, gate = jax.tree.map(
        lambda leaf: leaf[0],
        (state.entrants.inner.plant.drone.pos_w, state.entrants.inner.race.gate),
    )
    apart = gate.to_frame(Vec3(*ghost_w[60]) - learner)
    assert_allclose(observation[29:32] * 3.0, np.array(apart), atol=1e-3)
    observed = env.race.observe(state.entrants, env.race.default_params)[0]
    assert_allclose(observed, observation, atol=1e-5)
    # The race is over with the learner, though the ghost would fly on.
    out = state._replace(entrants=state.entrants._replace(is_out=jnp.array([True, False])))
    _, _, reward, terminated, truncated, info = step_duel(jax.random.key(0), out, action)
    assert info["race_over"] and terminated and not truncated and reward == 0.0


def test_a_duel_can_be_pickled(duel):
    copy = pickle.loads(pickle.dumps(duel))
    start, observation = duel.reset(jax.random.key(0)), copy.reset(jax.random.key(0))
    jax.tree.map(assert_array_equal, start, observation)


def test_drones_that_would_have_flown_on_are_truncated_when_the_race_is_over():
    _, states = starts(1)
    is_out = jnp.tile(jnp.array([True, False, True]), (RACES, 1))
    params = PARAMS._replace(flight=PARAMS.flight.replace(max_steps_in_episode=1))
    flown = step_batch(
        jax.random.key(0), states._replace(is_out=is_out), jnp.zeros((RACES, DRONES, 4)), params
    )
    reward, terminated, truncated, info = flown[2:]
    assert info["race_over"].all() and not reward[is_out].any()
    assert_array_equal(terminated, is_out)
    assert_array_equal(truncated, ~is_out)


def make_view(count, size, over="first"):
    opponents = [idle(RACE)._replace(observation_size=size)] * count
    return Versus(MultiDroneRace(RACE.env, 2, over), opponents)


REFUSALS = {
    "opponents: found 2, expected 1": lambda: make_view(2, 29),
    "found 30, expected 29 or 36": lambda: make_view(1, 30),
    "expected 'first'": lambda: make_view(1, 29, "all"),
    "expected 2 to 2": lambda: flytrack_env.make_race("FlyTrackDuel-v0", 3),
    "expected 2 to 8": lambda: flytrack_env.make_race("FlyTrackRace-v0", 9),
    "race_id": lambda: flytrack_env.make_race("FlyTrackRelay-v0"),
    "found 0, expected 1 to 8": lambda: MultiDroneRace(RACE.env, 0),
    "found 2.0, expected 1 to 8": lambda: MultiDroneRace(RACE.env, 2.0),
    "ghosts": lambda: MultiDroneRace(RACE.env, 2, ghosts={2: None}),
    "start inside each other": lambda: check_rules(RaceRules(column_spacing=0.3), 2),
    "blame": lambda: check_rules(RaceRules(blame=2), 2),
    "slot of 0 to 1": lambda: check_rules(RaceRules(first_slot=2), 2),
    "more than 0 m": lambda: check_rules(RaceRules(collision_radius=0.0), 2),
}


@pytest.mark.parametrize("message", REFUSALS)
def test_what_cannot_be_raced_is_refused(message):
    with pytest.raises(ValueError, match=message):
        REFUSALS[message]()


@pytest.mark.slow  # two programs are compiled
def test_a_learner_meets_its_opponents_in_a_batch():
    def act(gain, seen):
        return jnp.tanh(gain * seen[..., :4])

    race = MultiDroneRace(RACE.env, 2, "first")
    env = Versus(race, [Opponent(act, race.observation_space().shape[0], jnp.float32(0.1))])
    keys = jax.random.split(jax.random.key(0), 4)
    _, states = jax.jit(jax.vmap(env.reset, (0, None)))(keys, env.default_params)
    actions, key = sticks(3, 4), jax.random.key(1)
    batch = env.step_batch(key, states, actions, env.default_params)
    both = jnp.stack([actions, act(0.1, states.observations[:, 0])], axis=1)
    by_hand = race.step_batch(key, states.entrants, both, race.default_params)
    for index in (0, 2, 3, 4):
        assert_allclose(batch[index], by_hand[index][:, 0], atol=2e-5)


@pytest.mark.filterwarnings(
    "ignore:The old environment creation API"
)  # PettingZoo's own, in its tests
def test_pettingzoo_accepts_the_race():
    pytest.importorskip("pettingzoo")
    from pettingzoo.test import parallel_api_test

    from flytrack_env.multi_drone.pettingzoo_api import ParallelRace

    race = ParallelRace(flytrack_env.make_race("FlyTrackRace-v0", 2))
    parallel_api_test(race, num_cycles=60)
    race.reset(seed=1)
    with pytest.raises(ValueError, match=r"found \['drone_0'\], expected"):
        race.step({"drone_0": np.zeros(4)})
    with pytest.raises(ValueError, match=r"actions\['drone_0'\]: found shape \(3,\)"):
        race.step({agent: np.zeros(3) for agent in race.agents})


def test_a_race_begins_on_the_grid_and_is_over_for_all_at_once():
    params = PARAMS._replace(rules=PARAMS.rules._replace(first_slot=0))
    _, states = starts(3, params)
    slots = np.stack(states.inner.plant.drone.pos_w[:2], axis=-1)
    distances = np.linalg.norm(slots[:, 1:] - slots[:, :1], axis=-1)
    assert_allclose(distances, np.tile([np.hypot(1.0, 0.5), 1.0], (RACES, 1)), atol=1e-4)
    num_over = 0
    for step in range(150):  # without thrust none stays in the air for longer
        thrust = -jnp.ones((RACES, DRONES, 4))
        flown = step_batch(jax.random.key(step), states, thrust, params)
        over = np.asarray(flown[5]["race_over"])
        assert_array_equal(over.all(axis=1), over.any(axis=1))
        assert flown[3][over].all() and not flown[1].is_out[over].any()
        states = flown[1]
        num_over += over[:, 0].sum()
    assert num_over >= RACES
