"""PPO's parts against closed forms, and the whole on tiny problems."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import environment, spaces
from numpy.testing import assert_allclose, assert_array_equal

from baselines.purejaxrl_ppo import Config, load_checkpoint, make_network, make_train, ppo
from baselines.purejaxrl_ppo.checkpoint import save_checkpoint
from baselines.purejaxrl_ppo.metrics import summarize_episodes
from flytrack_env import FlyTrack
from flytrack_env.observations import OBSERVATION_SIZE
from flytrack_env.wrappers import GateMask
from tests.support.coasting import Coasting
from tests.support.compiling import quick_jit


@struct.dataclass
class ProbeState:
    time: jax.Array


@struct.dataclass
class ProbeParams:
    max_steps_in_episode: int = 8


class Probe(environment.Environment):
    """Reward 1 each step; ends every 8 steps, by truncation or by termination; the clock is hidden.

    Variants: reward(time, action, length); num_choices of discrete actions.
    """

    def __init__(self, terminates, reward=lambda time, action, length: 1.0, num_choices=0):
        super().__init__()
        self.terminates, self.reward, self.num_choices = terminates, reward, num_choices

    @property
    def default_params(self):
        return ProbeParams()

    def step_env(self, key, state, action, params):
        reward = jnp.asarray(self.reward(state.time, action, params.max_steps_in_episode), float)
        state = ProbeState(time=state.time + 1)
        at_end = state.time >= params.max_steps_in_episode
        terminated = at_end if self.terminates else jnp.asarray(False)
        return jnp.zeros(2), state, reward.reshape(()), terminated, {}

    def is_truncated(self, state, params):
        return (state.time >= params.max_steps_in_episode) & (not self.terminates)

    def reset_env(self, key, params):
        return jnp.zeros(2), ProbeState(time=jnp.int32(0))

    def action_space(self, params):
        return (
            spaces.Discrete(self.num_choices) if self.num_choices else spaces.Box(-1.0, 1.0, (1,))
        )


def tiny(**changes):
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


def train(env, params=None, **changes):
    """Return the trained network and its parameters."""
    config, params = tiny(**changes), env.default_params if params is None else params
    runner, _ = quick_jit(make_train(env, params, config))(jax.random.key(0))
    return ppo.make_network_for(env, params, config), runner.train_state.params


# Mean over the 8 steps of the discounted sum of what is left of a reward of 1 each.
VALUE_OF_EIGHT = np.mean([(1 - 0.9**left) / (1 - 0.9) for left in range(1, 9)])
SWITCHES = ("bootstrap_at_truncation", "batched_step", "affine_shuffle", "anneal_every_gradient")
ALL_OFF = {"min_std": 0.0, **dict.fromkeys(SWITCHES, False)}


# The clock is hidden, so a constant reward of 1 has one value: 1 / (1 - gamma) if it never ends.
@pytest.mark.parametrize(
    ("changes", "expected", "near"),
    [
        pytest.param({}, 10.0, 0.05, id="on"),
        pytest.param(ALL_OFF, VALUE_OF_EIGHT, 0.1, id="all off", marks=pytest.mark.slow),
    ],
)
def test_value_bootstraps_through_truncation_unless_switched_off(changes, expected, near):
    network, params = train(Probe(terminates=False), **changes)
    assert float(network.apply(params, jnp.zeros(2), method="value")) == pytest.approx(
        expected, rel=near
    )


def test_memory_tells_what_no_observation_shows():
    # Reward 1 on the last of three steps, to be counted, from 0 again after every reset: values
    # 0.81, 0.9, 1.
    env = Probe(True, reward=lambda time, action, length: time == length - 1)
    network, params = train(env, ProbeParams(max_steps_in_episode=3), memory_size=8)
    unseen, first = jnp.zeros((1, 6, 2)), network.first_memory((1, 6))
    done = jnp.array([[False, False, True] * 2])
    unroll, value_of = (
        quick_jit(partial(network.apply, method=method)) for method in ("unroll", "value_of")
    )
    values = unroll(params, first, unseen, done)[1][0]
    assert_allclose(values, [0.81, 0.9, 1.0] * 2, atol=0.04)
    memory = network.first_memory()
    for value in values[:3]:
        assert_allclose(value_of(params, memory, unseen[0, 0]), value, atol=1e-5)
        memory, _ = network.act(params, memory, unseen[0, 0])


def test_a_critic_sees_the_state_and_the_policy_does_not():
    config = tiny(memory_size=8, encoder_sizes=(8,), critic_sees_state=True, state_coef=1.0)
    network = make_network(config)
    rows = jax.random.normal(jax.random.key(1), (5, OBSERVATION_SIZE + 3))
    memory = network.first_memory((5,))
    moved = rows.at[:, 3:].add(1.0)

    @quick_jit
    def seen(key):
        """Return what is done and valued, also of other states, and what errors teach."""
        params = network.init(key, rows)
        _, policy, value = network.apply(params, memory, rows, method="step")
        _, action = network.act(params, memory, rows[:, :3])
        _, same_policy, other_value = network.apply(params, memory, moved, method="step")
        arguments = memory[:, None], rows[:, None], jnp.zeros((5, 1), bool)
        gradient = jax.grad(lambda p: network.apply(p, *arguments, method="unroll")[2])(params)
        return policy.mode(), action, same_policy.mode(), value, other_value, gradient["params"]

    mode, action, same_mode, value, other_value, gradient = seen(jax.random.key(0))
    assert_allclose(jnp.clip(mode, -1.0, 1.0), action, atol=1e-6)
    assert_array_equal(same_mode, mode)
    assert (np.abs(other_value - value) > 1e-3).all()
    # The error of the state's estimate teaches what the memory is made of.
    kernels = [gradient[part] for part in ("encoder", "estimator")]
    assert all(np.abs(leaf).max() > 0.0 for leaf in jax.tree.leaves(kernels))


def test_an_image_is_seen_by_convolutions_and_flown_by_what_is_stored(tmp_path):
    env = GateMask(FlyTrack(plant=Coasting()), size=(16, 16))
    config = Config(hidden_sizes=(8,), memory_size=4)
    network = ppo.make_network_for(env, env.default_params, config)
    image = np.random.default_rng(0).choice(np.uint8([0, 255]), env.image_shape)
    params = quick_jit(network.init)(jax.random.key(0), image[None])
    description = {"env_id": "FlyTrackMask-v0", "track": "flytrack", "missed_gate": "terminate"}
    shapes = {"observation_size": 16, "image_shape": (16, 16, 1)}
    save_checkpoint(tmp_path / "a.safetensors", params, config, description | shapes)
    checkpoint = load_checkpoint(tmp_path / "a.safetensors")
    checkpoint.check_fits(env)
    act = quick_jit(network.act)
    memory, action = act(params, network.first_memory(), image)
    again = act(checkpoint.params, checkpoint.network.first_memory(), image)
    assert checkpoint.network == network
    assert_array_equal(memory, again[0])
    assert action.shape == (4,) and (np.asarray(action) == again[1]).all()


def learnt_in_one_step(reward, **choices):
    """Return the policy and the value that are learnt in episodes of one step."""
    network, params = train(Probe(True, reward, **choices), ProbeParams(max_steps_in_episode=1))
    return network.apply(params, jnp.zeros(2))


def test_rewarded_action_is_learnt():
    # Reward 1 - (u - 0.4)^2 on one step: the best mean is 0.4, its value 1 less the variance.
    policy, value = learnt_in_one_step(lambda time, action, length: 1.0 - (action - 0.4) ** 2)
    assert float(policy.mode()[0]) == pytest.approx(0.4, abs=0.05)
    variance = float(policy.stddev()[0]) ** 2
    assert float(value) == pytest.approx(1.0 - variance, abs=0.05)


def test_rewarded_choice_is_learnt():
    policy, value = learnt_in_one_step(lambda time, action, length: action == 2, num_choices=3)
    assert float(policy.probs[2]) > 0.95
    assert float(value) == pytest.approx(1.0, abs=0.05)


def test_gae_equals_the_definition():
    rng = np.random.default_rng(0)
    reward, value = rng.normal(size=(2, 6, 3))
    done = rng.random((6, 3)) < 0.3
    last_value, gamma, lam = rng.normal(size=3), 0.97, 0.9
    batch = ppo.Batch(
        (), None, None, None, jnp.asarray(value), jnp.asarray(reward), jnp.asarray(done)
    )
    advantages = ppo.generalized_advantages(batch, jnp.asarray(last_value), gamma, lam)
    next_value = np.concatenate([value[1:], last_value[None]])
    delta = reward + gamma * next_value * ~done - value
    for start in range(6):
        is_same_episode = np.cumprod(np.vstack([np.ones(3), ~done[start:-1]]), axis=0)
        weights = (gamma * lam) ** np.arange(6 - start)[:, None] * is_same_episode
        total = (weights * delta[start:]).sum(axis=0)
        assert_allclose(advantages[start], total, atol=1e-5)


@pytest.mark.parametrize("size", [64, 4096, 96])
def test_affine_permutation_is_a_permutation(size):
    first = ppo.affine_permutation(jax.random.key(0), size)
    assert_array_equal(np.sort(first), np.arange(size))
    assert not np.array_equal(first, ppo.affine_permutation(jax.random.key(1), size))


def test_episodes_are_averaged_over_those_that_ended():
    log = {
        "done": jnp.array([[True, False], [False, True]]),
        "episode_return": jnp.array([[1.0, 50.0], [60.0, 3.0]]),
        "laps": jnp.array([[2, 9], [9, 4]]),
    }
    summary = summarize_episodes(log)
    assert summary["episode_return"] == 2.0
    assert summary["episode_laps"] == 3.0
    assert summary["episodes_ended"] == 2


def test_an_initial_action_of_another_length_is_refused():
    with pytest.raises(ValueError, match="initial_action"):
        make_train(Probe(False), ProbeParams(), tiny(initial_action=(0.0, 0.0)))
