"""PPO's parts against closed forms, and the whole on tiny problems."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import environment, spaces

from baselines.purejaxrl_ppo import Config, make_network, make_train
from baselines.purejaxrl_ppo.ppo import (
    Batch,
    affine_permutation,
    generalized_advantages,
    ppo_loss,
    summarise_episodes,
)


@struct.dataclass
class ProbeState:
    time: jax.Array


@struct.dataclass
class ProbeParams:
    max_steps_in_episode: int = 8


class Probe(environment.Environment):
    """Reward 1 each step; ends every 8 steps, by truncation or by termination."""

    def __init__(self, terminates: bool):
        super().__init__()
        self.terminates = terminates

    @property
    def default_params(self):
        return ProbeParams()

    def step_env(self, key, state, action, params):
        state = ProbeState(time=state.time + 1)
        at_end = state.time >= params.max_steps_in_episode
        terminated = at_end if self.terminates else jnp.asarray(False)
        return jnp.zeros(2), state, jnp.asarray(1.0), terminated, {}

    def is_truncated(self, state, params):
        return (state.time >= params.max_steps_in_episode) & (not self.terminates)

    def reset_env(self, key, params):
        return jnp.zeros(2), ProbeState(time=jnp.int32(0))

    def action_space(self, params):
        return spaces.Box(-1.0, 1.0, (1,))


def tiny(**changes) -> Config:
    settings = {
        "total_timesteps": 64 * 16 * 60,
        "num_envs": 64,
        "num_steps": 16,
        "num_minibatches": 4,
        "hidden_sizes": (16,),
        "initial_action": (0.0,),
        "learning_rate": 1e-2,
        "gamma": 0.9,
    }
    return Config(**{**settings, **changes})


def train_value(terminates: bool) -> float:
    env, config = Probe(terminates), tiny()
    runner, _ = jax.jit(make_train(env, env.default_params, config))(jax.random.key(0))
    network = make_network(config)
    return float(network.apply(runner.train_state.params, jnp.zeros(2), method="value"))


def test_value_bootstraps_through_truncation():
    # The clock is hidden, so a constant reward of 1 has one value: 1 / (1 - gamma) if it never ends.
    assert train_value(terminates=False) == pytest.approx(10.0, rel=0.05)


def test_value_stops_at_termination():
    # Mean over the 8 steps of the discounted sum of what is left: well below the endless value.
    expected = np.mean([(1 - 0.9**left) / (1 - 0.9) for left in range(1, 9)])
    assert train_value(terminates=True) == pytest.approx(expected, rel=0.1)


def test_gae_equals_the_definition():
    rng = np.random.default_rng(0)
    reward, value = rng.normal(size=(2, 6, 3))
    done = rng.random((6, 3)) < 0.3
    last_value, gamma, lam = rng.normal(size=3), 0.97, 0.9
    batch = Batch(None, None, None, jnp.asarray(value), jnp.asarray(reward), jnp.asarray(done))
    found = generalized_advantages(batch, jnp.asarray(last_value), gamma, lam)
    next_value = np.concatenate([value[1:], last_value[None]])
    delta = reward + gamma * next_value * ~done - value
    for env in range(3):
        for start in range(6):
            total, weight = 0.0, 1.0
            for step in range(start, 6):
                total += weight * delta[step, env]
                weight *= gamma * lam
                if done[step, env]:
                    break
            assert found[start, env] == pytest.approx(total, abs=1e-5)


@pytest.mark.parametrize("size", [64, 4096, 96])
def test_affine_permutation_is_a_permutation(size):
    first = affine_permutation(jax.random.key(0), size)
    np.testing.assert_array_equal(np.sort(first), np.arange(size))
    assert not np.array_equal(first, affine_permutation(jax.random.key(1), size))


def test_loss_at_the_old_policy():
    config = tiny(entropy_coef=0.01)
    network = make_network(config)
    observation = jax.random.normal(jax.random.key(0), (32, 2))
    params = network.init(jax.random.key(1), observation)
    policy, value = network.apply(params, observation)
    action = policy.sample(seed=jax.random.key(2))
    batch = Batch(observation, action, policy.log_prob(action), value, None, None)
    advantage, target = jax.random.normal(jax.random.key(3), (2, 32))
    loss, parts = ppo_loss(params, network, batch, advantage, target, config)
    parts = {name: float(part) for name, part in parts.items()}
    # At ratio 1 the objective is the mean normalised advantage, 0; the gaussian's entropy is known.
    assert parts["policy_loss"] == pytest.approx(0.0, abs=1e-5)
    assert parts["approx_kl"] == pytest.approx(0.0, abs=1e-6)
    assert parts["clip_fraction"] == 0.0
    entropy = 0.5 * np.log(2 * np.pi * np.e * config.initial_std**2)
    assert parts["entropy"] == pytest.approx(entropy, rel=1e-5)
    value_loss = 0.5 * float(np.mean((value - target) ** 2))
    assert parts["value_loss"] == pytest.approx(value_loss, rel=1e-5)
    assert float(loss) == pytest.approx(0.5 * value_loss - 0.01 * entropy, rel=1e-4)


def test_episodes_are_averaged_over_those_that_ended():
    log = {
        "done": jnp.array([[True, False], [False, True]]),
        "episode_return": jnp.array([[1.0, 50.0], [60.0, 3.0]]),
        "laps": jnp.array([[2, 9], [9, 4]]),
    }
    summary = summarise_episodes(log)
    assert summary["episode_return"] == 2.0
    assert summary["episode_laps"] == 3.0


def test_std_has_a_floor():
    config = tiny(initial_std=1e-4, min_std=0.05)
    network = make_network(config)
    params = network.init(jax.random.key(0), jnp.zeros((1, 2)))
    policy = network.apply(params, jnp.zeros((1, 2)), method="policy")
    np.testing.assert_allclose(policy.stddev(), 0.05, rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "field"),
    [({"total_timesteps": 100}, "total_timesteps"), ({"num_minibatches": 7}, "num_minibatches")],
)
def test_settings_that_cannot_train_are_refused(changes, field):
    with pytest.raises(ValueError, match=field):
        make_train(Probe(False), ProbeParams(), tiny(**changes))
