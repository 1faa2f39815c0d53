"""The environment as a gymnax client sees it: protocol, ends, actions and observations."""

from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from flytrack_env.env import FlyTrack
from flytrack_env.episodes import clip_action
from flytrack_env.model_file import ModelFileError
from flytrack_env.observations import OBSERVATION, OBSERVATION_SIZE
from flytrack_env.state import Action, pack
from flytrack_env.tracks import TrackError, load_track
from tests.contract.test_registration import CAUSES, RACE
from tests.support.coasting import drone_at
from tests.support.wrapped_flights import ENDS, NUM_ENVS, arrays, before_ends, fly, steps_of


@pytest.fixture(scope="module")
def flight(env):
    """300 random steps of 16 drones, extreme sticks among them."""
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (300, NUM_ENVS, 4)).astype(np.float32)
    actions[:, :4] = np.sign(actions[0, :4])
    actions[:, 4:6] = np.sign(actions[:, 4:6]) * np.float32(np.inf)
    actions[:, 6] *= 1e30
    return fly(env, actions=actions)


# --- The protocol -------------------------------------------------------------------------------


def test_default_parameters_are_used_when_none_are_given(env, flight):
    """Without ``jit``, which changes nothing either."""
    key, action = jax.random.key(3), np.full(4, 0.3, np.float32)
    keys, states = jnp.stack([key] * NUM_ENVS), flight.start
    expected = steps_of(env)(
        keys, states, np.tile(action, (NUM_ENVS, 1)), arrays(env.default_params)
    )
    with jax.disable_jit():
        found = env.step(key, jax.tree.map(lambda leaf: leaf[0], states), action)
    expected = jax.tree.map(lambda leaf: leaf[0], expected)
    chex.assert_trees_all_close(found, expected, rtol=1e-5, atol=1e-5)


def test_spaces_contain_every_observation_of_flights_that_end_in_many_ways(env, params, flight):
    space, actions = env.observation_space(params), env.action_space(params)
    assert space.shape == (OBSERVATION_SIZE,) and actions.shape == (4,) and env.num_actions == 4
    assert np.isfinite(space.low).all() and np.isfinite(space.high).all()
    assert actions.contains(actions.sample(jax.random.key(0)))
    for array in (flight.observations, flight.info["final_observation"]):
        assert ((array >= np.asarray(space.low)) & (array <= np.asarray(space.high))).all()
    assert flight.terminated.sum() > 30
    assert (
        sum(flight.info[cause].any() for cause in CAUSES) >= 3
        and flight.info["gates_passed"].max() >= 1
    )
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


def test_parameters_can_differ_between_environments(env, params):
    masses = jnp.array([0.5, 1.0, 2.0])
    batched = params.replace(model=params.model._replace(m=masses))
    none = jax.tree.map(lambda _: None, params)
    axes = none.replace(model=none.model._replace(m=0))
    tilted = drone_at((15.0, 2.0, 1.35), quat=(0.9, 0.3, 0.3, 0.1))
    state = env.begin(tilted, 0, params)
    step = jax.jit(jax.vmap(env.step_env, in_axes=(None, None, None, axes)))
    acc_w = env.drone(step(None, state, jnp.zeros(4), batched)[1]).acc_w
    weightless = np.stack([np.asarray(acc_w.x), np.asarray(acc_w.y)])
    assert_allclose(weightless * masses, weightless[:, 1:2].repeat(3, 1), rtol=1e-4)


# --- Ends of episodes ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ends(env):
    """One step of a batch with every row of ``ENDS``, from a race that has gone on for a while."""
    params = arrays(env.default_params)
    counted = {"gates_passed": jnp.full(len(ENDS), 8), "laps": jnp.full(len(ENDS), 1)}
    counted["lap_start_s"] = jnp.full(len(ENDS), 0.7)
    states, actions = before_ends(env, params, ENDS.values())
    begun = states._replace(race=states.race._replace(**counted))
    return env.step_batch(jax.random.key(8), begun, actions, params)


@pytest.mark.parametrize("name", ENDS)
def test_every_end_has_its_own_cause_and_flags(name, ends):
    row, (*_, causes, is_truncated) = list(ENDS).index(name), ENDS[name]
    _, _, _, terminated, truncated, info = ends
    assert {cause for cause in CAUSES if bool(info[cause][row])} == causes
    assert bool(terminated[row]) is bool(causes) and bool(truncated[row]) is is_truncated


def test_batch_step_resets_episodes_apart(env, params, ends):
    observation, state, _, terminated, truncated, _ = ends
    done = np.asarray(terminated | truncated)
    race = state.race
    for leaf in (state.time, race.gates_passed, race.laps, race.lap_start_s, race.lap_time_s):
        assert not np.asarray(leaf)[done].any()  # begun again, with nothing counted yet
    starts = np.stack([np.asarray(leaf)[done] for leaf in env.drone(state).pos_w], -1)
    assert len(np.unique(starts, axis=0)) == done.sum()
    expected = jax.jit(jax.vmap(env.observe, in_axes=(None, 0, None, None)))(
        None, state, None, params
    )
    assert_allclose(observation, expected, atol=1e-6)


# --- Actions ------------------------------------------------------------------------------------


def test_actions_beyond_the_range_are_clipped_and_integers_are_as_good(env, flight):
    corners = np.resize(np.array([[1, -1, 1, 1], [-1, 1, -1, -1]], np.float32), (NUM_ENVS, 4))
    factors = np.resize(np.array([1.001, 7.0, 1e30, np.inf], np.float32).repeat(2), NUM_ENVS)[
        :, None
    ]
    keys, params = jax.random.split(jax.random.key(11), NUM_ENVS), arrays(env.default_params)
    both = jnp.asarray(corners * factors), jnp.asarray(corners)
    chex.assert_trees_all_equal(
        *(steps_of(env)(keys, flight.start, actions, params) for actions in both)
    )
    assert clip_action(jnp.array([3, 0, -2, 1])) == clip_action(jnp.array([1.0, 0.0, -1.0, 1.0]))


@pytest.mark.parametrize("shape", [(), (3,), (5,), (4, 1), (1, 4)])
def test_actions_of_another_shape_are_refused(shape, env, params):
    state = env.begin(drone_at((15.0, 2.0, 1.35)), 0, params)
    for step, key in ((env.step, jax.random.key(0)), (env.step_env, None)):
        with pytest.raises(ValueError, match=r"action: found shape .*expected \(4,\)"):
            step(key, state, jnp.zeros(shape), params)
    with pytest.raises(ValueError):
        two = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), state)
        env.step_batch(jax.random.key(0), two, jnp.zeros((2, 3)), params)


# --- Construction -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"track": "monza"}, TrackError, "track: found 'monza', expected one of .*flytrack"),
        ({"track": Path("no/such.toml")}, TrackError, "no/such.toml: cannot be read"),
        ({"model": "no/such.json"}, ModelFileError, "no/such.json: cannot be read"),
        (
            {"plant": "nominal"},
            TypeError,
            r"plant: found str, expected a subclass of plants\.Plant",
        ),
        ({"missed_gate": "ignore"}, ValueError, "missed_gate: found 'ignore', expected one of"),
        ({"reward": {"speed": 1.0}}, ValueError, "reward: found 'speed', expected one of progress"),
        (
            {"reward": {"progress": "much"}},
            ValueError,
            r"reward\.progress: found 'much', expected a finite",
        ),
    ],
)
def test_wrong_arguments_say_what_was_expected(arguments, error, message):
    with pytest.raises(error, match=message):
        FlyTrack(**arguments)


# --- Observation --------------------------------------------------------------------------------


def expected_observation(x, gate_index):
    """Return the observation of a state (21,) before a gate, from the track's data, in NumPy."""
    track = load_track("flytrack")
    gates = [track.gates[(gate_index + i) % len(track.gates)] for i in (0, 1)]
    axes = [Rotation.from_quat(g.quaternion, scalar_first=True).as_matrix() for g in gates]
    forward, next_forward = (g.direction * a[:, 1] for g, a in zip(gates, axes, strict=True))
    to_gate = np.stack([forward, np.cross(axes[0][:, 2], forward), axes[0][:, 2]])
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
    limits = np.asarray(env.observation_space(params).high)
    rows, signs = np.array([0, 1, 3, 18, 19, 22]), np.array([-1, 1, -1, 1, -1, 1])
    assert_allclose(observation[rows], signs * limits[rows])
