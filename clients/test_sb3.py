"""Stable-Baselines3: its checker, and its PPO on single and vectorised Gymnasium environments."""

import gymnasium
import gymnax
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env

from clients import sb3_ppo
from clients.sb3_vec_env import SameStepVecEnv
from flytrack_env.registration import ENVIRONMENTS

NUM_ENVS, MAX_STEPS = 16, 80

every_id = pytest.mark.parametrize("env_id", sorted(ENVIRONMENTS))


def make_vec(env_id: str = "FlyTrack-v0") -> SameStepVecEnv:
    """Return a few environments side by side, with episodes so short that some are truncated."""
    params = gymnax.make(env_id)[1].replace(max_steps_in_episode=MAX_STEPS)
    return SameStepVecEnv(
        gymnasium.make_vec(
            f"flytrack_env:{env_id}", NUM_ENVS, vectorization_mode="vector_entry_point", params=params
        )
    )


def test_ppo_improves_on_its_own_first_evaluation() -> None:
    outcome = sb3_ppo.measure(seed=0)
    assert outcome.return_gain >= sb3_ppo.RETURN_MARGIN, outcome
    assert outcome.gate_gain >= sb3_ppo.GATE_MARGIN, outcome


@every_id
def test_check_env_passes_without_a_warning(env_id: str) -> None:
    # pytest turns every warning into an error (pyproject.toml).
    check_env(gymnasium.make(f"flytrack_env:{env_id}"))


@every_id
def test_ppo_learns_from_a_single_environment(env_id: str) -> None:
    model = PPO("MlpPolicy", f"flytrack_env:{env_id}", n_steps=128, batch_size=64, device="cpu", seed=0)
    before = [parameter.detach().numpy().copy() for parameter in model.policy.parameters()]
    model.learn(256)
    after = [parameter.detach().numpy() for parameter in model.policy.parameters()]
    assert all(np.isfinite(values).all() for values in after)
    assert any((old != new).any() for old, new in zip(before, after, strict=True))
    assert model.num_timesteps == 256


@every_id
def test_many_at_once_say_where_episodes_ended(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    envs = make_vec(env_id)
    step, given = envs.env.step, []
    monkeypatch.setattr(envs.env, "step", lambda actions: given.append(step(actions)) or given[-1])
    envs.seed(3)
    start = envs.reset()
    num_terminated, num_truncated = 0, 0
    generator = np.random.default_rng(0)
    for _ in range(150):
        actions = generator.uniform(-1, 1, (NUM_ENVS, 4)).astype(np.float32)
        observations, rewards, done, infos = envs.step(actions)
        expected = given[-1]
        assert observations is expected[0] and rewards is expected[1]
        np.testing.assert_array_equal(done, expected[2] | expected[3])
        for index, info in enumerate(infos):
            assert bool(info) == done[index]
            if done[index]:
                final = expected[4]["final_obs"][index]
                np.testing.assert_array_equal(info["terminal_observation"], final)
                assert info["TimeLimit.truncated"] == (expected[3][index] and not expected[2][index])
                assert info["gates_passed"] == expected[4]["final_info"]["gates_passed"][index]
        num_terminated += expected[2].sum()
        num_truncated += (done & ~expected[2]).sum()
    assert num_terminated > 0 and num_truncated > 0
    seeds = list(range(3, 3 + NUM_ENVS))
    np.testing.assert_array_equal(start, envs.env.reset(seed=seeds)[0])


def test_a_reset_without_a_seed_draws_on() -> None:
    envs, again = make_vec(), make_vec()
    for one in (envs, again):
        one.seed(1)
    first, second = envs.reset(), envs.reset()
    assert (first != second).any()
    np.testing.assert_array_equal(again.reset(), first)
    np.testing.assert_array_equal(again.reset(), second)


def test_options_reach_the_next_reset_only() -> None:
    envs = make_vec()
    envs.set_options({"battery_v": 22.5})
    battery = 22  # its place in the observation: volts above 23, docs/environment.md
    np.testing.assert_allclose(envs.reset()[:, battery], -0.5, atol=1e-5)
    assert (np.abs(envs.reset()[:, battery] + 0.5) > 1e-3).any()


def test_what_cannot_be_adapted_is_refused() -> None:
    other = gymnasium.make_vec("CartPole-v1", 2, vectorization_mode="sync")
    with pytest.raises(ValueError, match="env: found autoreset_mode"):
        SameStepVecEnv(other)
    envs = make_vec()
    envs.set_options([{"battery_v": 22.5}] + [{}] * (NUM_ENVS - 1))
    with pytest.raises(ValueError, match="options: found"):
        envs.reset()
    with pytest.raises(NotImplementedError, match="env_method"):
        envs.env_method("step")
