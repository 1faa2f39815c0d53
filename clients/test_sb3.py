"""Stable-Baselines3: its checker, single environments, and the adapter for vector environments."""

from typing import Any

import gymnasium
import gymnax
import jax.numpy as jnp
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env

from clients import entries, sb3_ppo
from clients.sb3_vec_env import SameStepVecEnv
from flytrack_env.registration import ENVIRONMENTS

NUM_ENVS, MAX_STEPS = 16, 80


def make_vec() -> SameStepVecEnv:
    """Return a few environments with episodes so short that some are truncated."""
    params = gymnax.make("FlyTrack-v0")[1].replace(max_steps_in_episode=MAX_STEPS)
    settings = {"autoreset_mode": "SameStep", "params": params}
    return SameStepVecEnv(gymnasium.make_vec("flytrack_env:FlyTrack-v0", NUM_ENVS, **settings))


@pytest.mark.parametrize("env_id", sorted(ENVIRONMENTS))
def test_check_env_passes_without_a_warning(env_id: str) -> None:
    # pytest turns every warning into an error (pyproject.toml).
    check_env(gymnasium.make(f"flytrack_env:{env_id}"))


def test_ppo_learns_from_a_single_environment() -> None:
    model = PPO(
        "MlpPolicy", "flytrack_env:FlyTrack-v0", n_steps=128, batch_size=64, device="cpu", seed=0
    )
    model.learn(256)
    assert all(np.isfinite(values.detach().numpy()).all() for values in model.policy.parameters())


def test_the_adapter_passes_on_the_ends_of_episodes() -> None:
    envs, plain = make_vec(), make_vec().env
    envs.seed(3)
    seeds: Any = list(range(3, 3 + NUM_ENVS))
    np.testing.assert_array_equal(envs.reset(), plain.reset(seed=seeds)[0])
    ended = []
    for actions in np.random.default_rng(0).uniform(-1, 1, (150, NUM_ENVS, 4)).astype(np.float32):
        observations, rewards, done, infos = envs.step(actions)
        expected, expected_rewards, terminated, truncated, plain_infos = plain.step(actions)
        np.testing.assert_array_equal(observations, expected)
        np.testing.assert_array_equal(rewards, expected_rewards)
        np.testing.assert_array_equal(done, terminated | truncated)
        assert [bool(info) for info in infos] == done.tolist()
        for index in np.flatnonzero(done):
            info = infos[index]
            np.testing.assert_array_equal(
                info["terminal_observation"], plain_infos["final_obs"][index]
            )
            assert info["TimeLimit.truncated"] == (truncated[index] and not terminated[index])
            assert info["gates_passed"] == plain_infos["final_info"]["gates_passed"][index]
            ended.append(info["TimeLimit.truncated"])
    assert set(ended) == {True, False}


def test_seeds_and_options_reach_the_next_reset_only() -> None:
    envs, again = make_vec(), make_vec()
    for one in (envs, again):
        one.seed(1)
    first, second = envs.reset(), envs.reset()
    assert (first != second).any()
    np.testing.assert_array_equal(again.reset(), first)
    np.testing.assert_array_equal(again.reset(), second)
    envs.set_options({"battery_v": 22.5})
    battery = 22  # its index in the observation: volts above 23, docs/environment.md
    np.testing.assert_allclose(envs.reset()[:, battery], -0.5, atol=1e-5)
    assert (np.abs(envs.reset()[:, battery] + 0.5) > 1e-3).any()


def test_unsupported_environments_and_options_are_refused() -> None:
    with pytest.raises(ValueError, match="env: found autoreset_mode"):
        SameStepVecEnv(gymnasium.make_vec("CartPole-v1", 2, vectorization_mode="sync"))
    envs = make_vec()
    envs.set_options([{"battery_v": 22.5}] + [{}] * (NUM_ENVS - 1))
    with pytest.raises(ValueError, match="options: found"):
        envs.reset()
    with pytest.raises(NotImplementedError, match="env_method"):
        envs.env_method("step")


def test_the_entry_of_the_benchmark_flies_what_was_trained() -> None:
    model = sb3_ppo.make_model(seed=1)
    observations = np.random.default_rng(0).normal(size=(16, 29)).astype(np.float32)
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose(
        np.clip(entries.act_of(model)(jnp.asarray(observations)), -1, 1), expected, atol=1e-6
    )
