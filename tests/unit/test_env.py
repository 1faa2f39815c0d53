"""The environment as a gymnax client sees it: protocol, ends, actions and observations."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from flytrack_env.episodes import clip_action
from flytrack_env.observations import OBSERVATION, OBSERVATION_SIZE
from flytrack_env.state import Action, pack
from flytrack_env.tracks import load_track
from tests.contract.test_registration import CAUSES, RACE
from tests.support.coasting import direction_of_flight, drone_at
from tests.support.compiling import quick_jit
from tests.support.wrapped_flights import ENDS, NUM_ENVS, arrays, before_ends, fly


@pytest.fixture(scope="module")
def step(env):
    """The step of a batch, compiled once for all tests: of several keys it uses the first."""
    compiled = quick_jit(env.step_batch)
    return lambda keys, *arguments: compiled(keys[0], *arguments)


@pytest.fixture(scope="module")
def flight(env, step):
    """300 random steps of 16 drones, extreme sticks among them."""
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (300, NUM_ENVS, 4)).astype(np.float32)
    actions[:, :4] = np.sign(actions[0, :4])
    actions[:, 4:6] = np.sign(actions[:, 4:6]) * np.float32(np.inf)
    actions[:, 6] *= 1e30
    return fly(env, actions=actions, step=step)


# --- The protocol -------------------------------------------------------------------------------


def test_spaces_contain_every_observation_of_flights_that_end_in_many_ways(env, params, flight):
    space, actions = env.observation_space(params), env.action_space(params)
    assert space.shape == (OBSERVATION_SIZE,) and actions.shape == (4,) and env.num_actions == 4
    assert actions.contains(actions.sample(jax.random.key(0)))
    low, high = np.asarray(space.low), np.asarray(space.high)
    assert np.isfinite([low, high]).all()
    for array in (flight.observations, flight.info["final_observation"]):
        assert ((low <= array) & (array <= high)).all()
    assert flight.terminated.sum() > 30 and flight.info["gates_passed"].max() >= 1
    assert sum(flight.info[cause].any() for cause in CAUSES) >= 3
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((flight.states, flight.rewards)))


def test_info_belongs_to_the_step_not_to_the_reset(env, flight):
    done, states, info = flight.ended, flight.states, flight.info
    assert set(info) == {*CAUSES, *RACE, "terminated", "truncated", "final_observation"}
    assert_array_equal(np.stack([info[cause] for cause in CAUSES]).any(axis=0), flight.terminated)
    assert_array_equal(info["terminated"], flight.terminated)
    assert_array_equal(info["truncated"], flight.truncated)
    # An ended episode still shows its own count.
    assert (info["gates_passed"][1:] >= states.race.gates_passed[:-1]).all()
    offset = np.stack(env.drone(states).pos_w) - np.stack(states.race.gate.centre)
    distance = np.linalg.norm(offset, axis=0)
    assert_allclose(info["gate_distance_m"][~done], distance[~done], atol=1e-4)


# --- Ends of episodes ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ends(env, step):
    """Causes of an end, and whether terminated and truncated, after a step of each of ``ENDS``."""
    params, names, outcomes = arrays(env.default_params), list(ENDS), {}
    for batch in (names[:NUM_ENVS], names[-NUM_ENVS:]):
        states, actions = before_ends(env, params, [ENDS[name] for name in batch])
        outcome = step([jax.random.key(8)], states, actions, params)
        terminated, truncated, info = jax.device_get(outcome[3:])
        for row, name in enumerate(batch):
            causes = {cause for cause in CAUSES if info[cause][row]}
            outcomes[name] = (causes, terminated[row], truncated[row])
    return outcomes


@pytest.mark.parametrize("name", ENDS)
def test_every_end_has_its_own_cause_and_flags(name, ends):
    *_, causes, is_truncated = ENDS[name]
    assert ends[name] == (causes, bool(causes), is_truncated)


# --- Actions ------------------------------------------------------------------------------------


def test_actions_beyond_the_range_are_clipped_and_integers_are_as_good(env, step, flight):
    corners = np.resize(np.float32([[1, -1, 1, 1], [-1, 1, -1, -1]]), (NUM_ENVS, 4))
    factors = np.resize(np.float32([1.001, 7.0, 1e30, np.inf]).repeat(2), (NUM_ENVS, 1))
    keys, params = jax.random.split(jax.random.key(11), NUM_ENVS), arrays(env.default_params)
    beyond, within = (
        step(keys, flight.start, actions, params) for actions in (factors * corners, corners)
    )
    chex.assert_trees_all_equal(beyond, within)
    assert clip_action(jnp.array([3, 0, -2, 1])) == clip_action(jnp.array([1.0, 0.0, -1.0, 1.0]))


@pytest.mark.parametrize("shape", [(), (3,), (5,), (4, 1), (1, 4)])
def test_actions_of_another_shape_are_refused(shape, env, params):
    state = env.begin(drone_at((15.0, 2.0, 1.35)), 0, params)
    for step in (env.step, env.step_env):
        with pytest.raises(ValueError, match=r"action: found shape .*expected \(4,\)"):
            step(jax.random.key(0), state, jnp.zeros(shape), params)


# --- Observation --------------------------------------------------------------------------------


def expected_observation(x, gate_index):
    """Return the observation of a state (21,) before a gate, from the track's data, in NumPy."""
    track = load_track("flytrack")
    gates = [track.gates[(gate_index + i) % len(track.gates)] for i in (0, 1)]
    forward, next_forward = map(direction_of_flight, gates)
    up = Rotation.from_quat(gates[0].quaternion, scalar_first=True).as_matrix()[:, 2]
    to_gate = np.stack([forward, np.cross(up, forward), up])
    body = Rotation.from_quat(x[9:13], scalar_first=True).as_matrix()
    centre, next_centre = (np.array(g.position) for g in gates)
    quantities = (
        to_gate @ (x[0:3] - centre),
        to_gate @ x[3:6],
        (to_gate @ body).ravel(),
        x[13:16],
        x[16:20],
        [x[20] - 23.0],
        to_gate @ (next_centre - centre),
        to_gate @ next_forward,
    )
    rows = zip(OBSERVATION, quantities, strict=True)
    return np.concatenate([np.clip(np.array(q) / e.scale, -e.limit, e.limit) for e, q in rows])


def test_observation_index_by_index(flight):
    assert [entry.size for entry in OBSERVATION] == [3, 3, 9, 3, 4, 1, 3, 3]
    rows = np.flatnonzero(np.arange(flight.rewards.size) % 7 == 0)
    observed, drones, gates = jax.tree.map(
        lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[rows],
        (flight.observations, flight.states.plant.drone, flight.states.race.gate_index),
    )
    x = np.asarray(jax.vmap(pack)(drones), float)
    assert set(gates) == set(range(8))
    expected = np.stack([expected_observation(*row) for row in zip(x, gates, strict=True)])
    assert_allclose(observed, expected, atol=2e-5)


def test_observation_is_clipped_to_its_range(env, params):
    drone = drone_at(
        (1e6, -1e6, 0.0), (1e5, 0.0, 0.0), applied=Action(2.0, -2.0, 0.0, 0.0), battery_v=30.0
    )
    observation = env.observe(None, env.begin(drone, 0, params), None, params)
    assert env.observation_space(params).contains(observation)
    assert_allclose(observation, expected_observation(np.asarray(pack(drone), float), 0), atol=2e-5)
