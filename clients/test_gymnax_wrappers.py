"""gymnax's own wrappers on every id."""

from typing import Any

import gymnax
import jax
import numpy as np
import pytest
from gymnax.wrappers import FlattenObservationWrapper, GymnaxToGymWrapper, LogWrapper

from flytrack_env.registration import ENVIRONMENTS

NUM_ENVS, NUM_STEPS = 32, 300

every_id = pytest.mark.parametrize("env_id", sorted(ENVIRONMENTS))


def fly_at_random(env: Any, params: Any) -> tuple[Any, Any]:
    """Return observations at the reset (N, ...), and all outputs of ``step``, leaves (T, N, ...).

    Keys and actions do not depend on the wrapper, so that two flights can be compared.
    """
    reset_key, steps_key = jax.random.split(jax.random.key(0))
    observations, states = jax.vmap(env.reset, (0, None))(
        jax.random.split(reset_key, NUM_ENVS), params
    )

    def step(states: Any, key: jax.Array) -> tuple[Any, Any]:
        keys = jax.random.split(key, NUM_ENVS)
        actions = jax.vmap(env.action_space(params).sample)(keys)
        outputs = jax.vmap(env.step, (0, 0, 0, None))(keys, states, actions, params)
        return outputs[1], outputs

    return observations, jax.lax.scan(step, states, jax.random.split(steps_key, NUM_STEPS))[1]


@every_id
def test_the_log_is_that_of_the_episodes_flown(env_id: str) -> None:
    env, params = gymnax.make(env_id)
    wrapped = LogWrapper(FlattenObservationWrapper(env))
    start, outputs = jax.jit(lambda: fly_at_random(wrapped, params))()
    observations, _, rewards, terminated, truncated, info = jax.tree.map(np.asarray, outputs)
    space = wrapped.observation_space(params)
    for some in (start, observations, info["final_observation"]):
        assert some.shape[-1:] == space.shape
        assert (some >= space.low).all() and (some <= space.high).all()
    assert (info["returned_episode"] == (terminated | truncated)).all()
    assert info["returned_episode"].sum() > NUM_ENVS
    for one in range(NUM_ENVS):
        ends = np.flatnonzero(info["returned_episode"][:, one])
        lengths = np.diff(ends, prepend=-1)
        returns = [episode.sum() for episode in np.split(rewards[:, one], ends + 1)[: len(ends)]]
        assert (info["returned_episode_lengths"][ends, one] == lengths).all()
        np.testing.assert_allclose(info["returned_episode_returns"][ends, one], returns, atol=1e-4)


@every_id
def test_gymnax_to_gym_wrapper_flies_what_the_environment_flies(env_id: str) -> None:
    env, params = gymnax.make(env_id)
    wrapped: Any = GymnaxToGymWrapper(env, params, seed=0)
    observation, _ = wrapped.reset(seed=5)
    key, reset_key = jax.random.split(jax.random.key(5))
    expected, state = env.reset(reset_key, params)
    wrapped.action_space.seed(0)
    for _ in range(NUM_STEPS):
        np.testing.assert_allclose(observation, expected, atol=1e-5)
        assert wrapped.observation_space.contains(np.asarray(observation))
        action = wrapped.action_space.sample()
        observation, *outcome, info = wrapped.step(action)
        key, step_key = jax.random.split(key)
        expected, state, *expected_outcome, expected_info = env.step(
            step_key, state, action, params
        )
        np.testing.assert_allclose(outcome, expected_outcome, atol=1e-5)
        assert set(info) == set(expected_info)
