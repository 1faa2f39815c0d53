"""Ends of episodes: every cause, what begins after it, and the step of five values across it."""

import copy
import pickle
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytrack_env.env import EnvParams, FlyTrack
from flytrack_env.observations import OBSERVATION_SIZE
from flytrack_env.wrappers import LegacyStep
from tests.support.trees import assert_close, stack

CAUSES = ("crash", "ground", "out_of_bounds", "missed_gate", "battery_empty")


# Position, velocity, extra fields of the drone, steps already flown, action; causes; truncated.
IN_FRONT = (12.55, 2.0, 1.35)
FAST = (-10.0, 0.0, 0.0)
ZERO = (0.0, 0.0, 0.0, 0.0)
NAN = float("nan")
ENDS = {
    "flies on": ((15.0, 2.0, 1.35), FAST, {}, 100, ZERO, set(), False),
    "passes": (IN_FRONT, FAST, {}, 100, ZERO, set(), False),
    "frame": ((12.55, 3.0, 1.35), FAST, {}, 100, ZERO, {"crash"}, False),
    "frame above": ((12.55, 2.0, 2.4), FAST, {}, 100, ZERO, {"crash"}, False),
    "missed": ((12.55, 4.0, 1.35), FAST, {}, 100, ZERO, {"missed_gate"}, False),
    "ground": ((15.0, 2.0, 0.01), (0.0, 0.0, -5.0), {}, 100, ZERO, {"ground"}, False),
    "wall +x": ((25.49, 2.0, 1.0), (5.0, 0.0, 0.0), {}, 100, ZERO, {"out_of_bounds"}, False),
    "wall -x": ((-2.49, 9.0, 1.0), (-5.0, 0.0, 0.0), {}, 100, ZERO, {"out_of_bounds"}, False),
    "wall +y": ((15.0, 34.99, 1.0), (0.0, 5.0, 0.0), {}, 100, ZERO, {"out_of_bounds"}, False),
    "wall -y": ((15.0, -2.99, 1.0), (0.0, -5.0, 0.0), {}, 100, ZERO, {"out_of_bounds"}, False),
    "ceiling": ((15.0, 2.0, 6.34), (0.0, 0.0, 5.0), {}, 100, ZERO, {"out_of_bounds"}, False),
    "corner": (
        (25.49, 2.0, 0.01),
        (9.0, 0, -9.0),
        {},
        100,
        ZERO,
        {"ground", "out_of_bounds"},
        False,
    ),
    "battery": ((15.0, 2.0, 1.35), FAST, {"battery_v": 22.0001}, 9, ZERO, {"battery_empty"}, False),
    "low battery": ((15.0, 2.0, 1.35), FAST, {"battery_v": 22.01}, 9, ZERO, set(), False),
    "nan roll": ((15.0, 2.0, 1.35), FAST, {}, 100, (NAN, 0.0, 0.0, 0.0), {"crash"}, False),
    "nan thrust": ((15.0, 2.0, 1.35), FAST, {}, 100, (0.0, 0.0, 0.0, NAN), {"crash"}, False),
    "time limit": ((15.0, 2.0, 1.35), FAST, {}, 999, ZERO, set(), True),
    "one before": ((15.0, 2.0, 1.35), FAST, {}, 998, ZERO, set(), False),
    "frame at time limit": ((12.55, 3.0, 1.35), FAST, {}, 999, ZERO, {"crash"}, True),
    "pass at time limit": (IN_FRONT, FAST, {}, 999, ZERO, set(), True),
}


@pytest.fixture(scope="module")
def ends(env: FlyTrack, params: EnvParams, make_drone: Any, step_all: Any) -> tuple[Any, ...]:
    """One step of every row of ``ENDS`` from a race that has gone on for a while."""
    states, actions = [], []
    for position, velocity, fields, time, action, _, _ in ENDS.values():
        fields = {name: jnp.float32(value) for name, value in fields.items()}
        state = env.begin(make_drone(position, velocity, **fields), 0, params)
        race = state.race._replace(
            gates_passed=jnp.int32(8),
            laps=jnp.int32(1),
            lap_start_s=jnp.float32(0.7),
            lap_time_s=jnp.float32(0.7),
        )
        states.append(state._replace(race=race, time=jnp.int32(time)))
        actions.append(action)
    states, actions = stack(states), jnp.array(actions, jnp.float32)
    keys = jax.random.split(jax.random.key(7), len(ENDS))
    return keys, states, actions, step_all(keys, states, actions, params)


@pytest.mark.parametrize("name", ENDS)
def test_every_end_has_its_own_cause_and_flags(name: str, ends: tuple[Any, ...]) -> None:
    row = list(ENDS).index(name)
    *_, causes, is_truncated = ENDS[name]
    _, _, _, terminated, truncated, info = ends[3]
    assert {cause for cause in CAUSES if bool(info[cause][row])} == causes
    assert bool(terminated[row]) is bool(causes)
    assert bool(truncated[row]) is is_truncated


def test_ended_episodes_begin_as_reset_does(
    params: EnvParams, reset_many: Any, ends: tuple[Any, ...]
) -> None:
    keys, _, _, (observation, states, _, terminated, truncated, _) = ends
    done = np.asarray(terminated | truncated)
    assert (np.asarray(states.race.laps)[~done] == 1).all()
    fresh_observation, fresh = reset_many(keys, params)
    for leaf, expected in zip(jax.tree.leaves(states), jax.tree.leaves(fresh), strict=True):
        np.testing.assert_allclose(np.asarray(leaf)[done], np.asarray(expected)[done], atol=1e-5)
    np.testing.assert_allclose(np.asarray(observation)[done], np.asarray(fresh_observation)[done], atol=1e-5)
    for leaf in (states.time, states.race.gates_passed, states.race.laps):
        assert not np.asarray(leaf)[done].any()
    for leaf in (states.race.lap_start_s, states.race.lap_time_s):
        assert not np.asarray(leaf)[done].any()


def test_final_observation_is_the_one_before_the_reset(
    env: FlyTrack, params: EnvParams, step_env_all: Any, ends: tuple[Any, ...]
) -> None:
    _, states, actions, (observation, _, reward, terminated, truncated, info) = ends
    before_reset, _, rewards, flags, _ = step_env_all(None, states, actions, params)
    assert np.isfinite(info["final_observation"]).all() and np.isfinite(reward).all()
    np.testing.assert_allclose(info["final_observation"], before_reset, atol=1e-6)
    np.testing.assert_allclose(reward, rewards, atol=1e-6)
    np.testing.assert_array_equal(terminated, flags)
    done = np.asarray(terminated | truncated)
    differs = (np.asarray(observation) != np.asarray(info["final_observation"])).any(axis=1)
    np.testing.assert_array_equal(differs, done)


def test_batch_step_ends_the_same_episodes_and_resets_them_apart(
    env: FlyTrack, params: EnvParams, ends: tuple[Any, ...]
) -> None:
    _, states, actions, single = ends
    batch = env.step_batch(jax.random.key(8), states, actions, params)
    assert_close(batch[2:], single[2:], 2e-5)
    done = np.asarray(batch[3] | batch[4])
    observation, state = batch[:2]
    assert_close(
        jax.tree.map(lambda leaf: leaf[~done], (observation, state)),
        jax.tree.map(lambda leaf: leaf[~done], single[:2]),
        2e-5,
    )
    race = state.race
    for leaf in (state.time, race.gates_passed, race.laps, race.lap_start_s, race.lap_time_s):
        assert not np.asarray(leaf)[done].any()
    starts = np.stack([np.asarray(leaf)[done] for leaf in env.drone(state).pos_w], -1)
    assert len(np.unique(starts, axis=0)) == done.sum()
    other = env.step_batch(jax.random.key(9), states, actions, params)[1]
    assert (np.asarray(env.drone(other).pos_w.x) != np.asarray(env.drone(state).pos_w.x))[done].all()
    expected = jax.jit(jax.vmap(env.observe, in_axes=(None, 0, None, None)))(None, state, None, params)
    np.testing.assert_allclose(observation, expected, atol=1e-6)


def test_batch_step_equals_vmap_of_step_env_where_nothing_ends(
    env: FlyTrack, params: EnvParams, step_env_all: Any, ends: tuple[Any, ...]
) -> None:
    _, states, actions, (_, _, _, terminated, truncated, _) = ends
    going = ~np.asarray(terminated | truncated)
    rows = np.resize(np.flatnonzero(going), len(going))
    states, actions = jax.tree.map(lambda leaf: leaf[rows], (states, actions))
    batch = env.step_batch(jax.random.key(10), states, actions, params)
    observation, state, reward, flags, info = step_env_all(None, states, actions, params)
    assert not (batch[3] | batch[4]).any()
    assert_close(batch[:4], (observation, state, reward, flags))
    assert_close({name: batch[5][name] for name in info}, info)


@pytest.mark.parametrize(
    "clone", [copy.copy, copy.deepcopy, lambda wrapped: pickle.loads(pickle.dumps(wrapped))]
)
def test_legacy_step_survives_copies(clone: Any, env: FlyTrack) -> None:
    wrapped = clone(LegacyStep(env))
    assert wrapped.name == "FlyTrack-v0" and wrapped.num_actions == 4
    with pytest.raises(AttributeError):
        getattr(wrapped, "no_such_" + "attribute")
    observation, _ = jax.eval_shape(wrapped.reset, jax.random.key(0))
    assert observation.shape == (OBSERVATION_SIZE,)


def test_legacy_step_returns_five_values(env: FlyTrack, params: EnvParams, ends: tuple[Any, ...]) -> None:
    keys, states, actions, (observation, after, reward, terminated, truncated, info) = ends
    wrapped = LegacyStep(env)
    outputs = jax.jit(jax.vmap(wrapped.step, in_axes=(0, 0, 0, None)))(keys, states, actions, params)
    assert len(outputs) == 5
    assert_close(outputs, (observation, after, reward, terminated | truncated, info), 1e-5)
