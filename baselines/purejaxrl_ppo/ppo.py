"""Proximal policy optimisation, top to bottom, as PureJaxRL writes it.

Source: J. Schulman et al., arXiv 1707.06347; C. Lu et al., PureJaxRL. One ``jit``, a ``scan`` over
updates. What differs from PureJaxRL, and why:

- Truncation is bootstrapped: the value of the final observation is added to the last reward of an
  episode that the time limit cut off, because the race would have gone on.
- Environments are stepped as a batch where they offer ``step_batch`` (faster).
- Minibatches come from an affine permutation, i -> a i + b mod n, because a sort of 65,536 keys per epoch
  costs as much as the environments.
- The standard deviation has a floor (``networks.py``), so that exploration cannot die out early.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax.training.train_state import TrainState

from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.networks import ActorCritic, make_network


class Batch(NamedTuple):
    """One update's experience; leaves (num_steps, num_envs, ...)."""

    observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    reward: jax.Array
    done: jax.Array


class Runner(NamedTuple):
    """What the scan over updates carries."""

    train_state: TrainState
    env_state: Any
    observation: jax.Array
    episode_return: jax.Array
    key: jax.Array


def batched_step(env: Any) -> Callable:
    """Return a step of a whole batch with one key: the environment's own, else a vmap."""
    if hasattr(env, "step_batch"):
        return env.step_batch

    def step(key: jax.Array, states: Any, actions: jax.Array, params: Any) -> tuple:
        keys = jax.random.split(key, actions.shape[0])
        return jax.vmap(env.step, in_axes=(0, 0, 0, None))(keys, states, actions, params)

    return step


def generalized_advantages(batch: Batch, last_value: jax.Array, gamma: float, gae_lambda: float) -> jax.Array:
    """Return GAE advantages, (num_steps, num_envs); arXiv 1506.02438, equation 16.

    The reward of a truncated step already holds the bootstrapped value of its final observation.
    """

    def backwards(carry: tuple, step: tuple) -> tuple:
        advantage, next_value = carry
        reward, value, done = step
        delta = reward + gamma * next_value * (1.0 - done) - value
        advantage = delta + gamma * gae_lambda * (1.0 - done) * advantage
        return (advantage, value), advantage

    start = (jnp.zeros_like(last_value), last_value)
    steps = (batch.reward, batch.value, batch.done)
    return jax.lax.scan(backwards, start, steps, reverse=True)[1]


def affine_permutation(key: jax.Array, size: int) -> jax.Array:
    """Return a pseudo-random permutation of ``size`` indices without sorting.

    Multiples of an odd number permute a power of two; other sizes fall back on a sort.
    """
    if size & (size - 1):
        return jax.random.permutation(key, size)
    factor, offset = jax.random.bits(key, (2,), jnp.uint32)
    index = jnp.arange(size, dtype=jnp.uint32) * (factor | 1) + offset
    return (index & (size - 1)).astype(jnp.int32)


def ppo_loss(
    network_params: Any,
    network: ActorCritic,
    batch: Batch,
    advantage: jax.Array,
    target: jax.Array,
    config: Config,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the clipped objective plus clipped value loss, and its parts."""
    policy, value = network.apply(network_params, batch.observation)
    log_prob = policy.log_prob(batch.action)
    value_clipped = batch.value + jnp.clip(value - batch.value, -config.clip_eps, config.clip_eps)
    value_error = jnp.maximum((value - target) ** 2, (value_clipped - target) ** 2)
    value_loss = 0.5 * value_error.mean()

    log_ratio = log_prob - batch.log_prob
    ratio = jnp.exp(log_ratio)
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    clipped_ratio = jnp.clip(ratio, 1.0 - config.clip_eps, 1.0 + config.clip_eps)
    policy_loss = -jnp.minimum(ratio * advantage, clipped_ratio * advantage).mean()
    entropy = policy.entropy().mean()
    loss = policy_loss + config.value_coef * value_loss - config.entropy_coef * entropy
    parts = {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": entropy,
        "approx_kl": ((ratio - 1.0) - log_ratio).mean(),
        "clip_fraction": (jnp.abs(ratio - 1.0) > config.clip_eps).mean(),
    }
    return loss, parts


def make_train_state(key: jax.Array, observation_size: int, config: Config) -> TrainState:
    """Return fresh network parameters with Adam, gradient clipping and linear annealing."""
    network = make_network(config)
    schedule = optax.linear_schedule(
        config.learning_rate,
        config.learning_rate * config.final_learning_rate_fraction,
        config.num_updates * config.update_epochs * config.num_minibatches,
    )
    optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(schedule, eps=1e-5))
    params = network.init(key, jnp.zeros((1, observation_size)))
    return TrainState.create(apply_fn=network.apply, params=params, tx=optimizer)


def make_train(
    env: Any,
    env_params: Any,
    config: Config,
    report: Callable[[dict[str, Any]], None] | None = None,
) -> Callable[[jax.Array], tuple[Runner, dict[str, jax.Array]]]:
    """Return ``train(key) -> (runner, metrics)``, to be jitted.

    env, env_params: a gymnax environment and its parameters. report: called on the host with the
    metrics of every update as it ends. metrics: leaves (num_updates,).

    Raises:
        ValueError: a configuration that cannot be trained with.
    """
    config.check()
    network = make_network(config)
    step_all = batched_step(env)

    def collect_step(runner: Runner, _: None) -> tuple[Runner, tuple]:
        key, key_action, key_step = jax.random.split(runner.key, 3)
        policy, value = network.apply(runner.train_state.params, runner.observation)
        action, log_prob = policy.sample_and_log_prob(seed=key_action)
        observation, env_state, reward, terminated, truncated, info = step_all(
            key_step, runner.env_state, action, env_params
        )
        done = terminated | truncated
        episode_return = runner.episode_return + reward
        # Few steps see a truncation, so that its value is rarely worth computing.
        final_value = jax.lax.cond(
            truncated.any(),
            lambda: network.apply(runner.train_state.params, info["final_observation"], method="value"),
            lambda: jnp.zeros_like(value),
        )
        bootstrapped = reward + config.gamma * final_value * (truncated & ~terminated)
        batch = Batch(runner.observation, action, log_prob, value, bootstrapped, done)
        log = {
            "done": done,
            "episode_return": episode_return,
            **{name: leaf for name, leaf in info.items() if leaf.shape == done.shape},
        }
        runner = runner._replace(
            env_state=env_state,
            observation=observation,
            episode_return=jnp.where(done, 0.0, episode_return),
            key=key,
        )
        return runner, (batch, log)

    def update_minibatch(train_state: TrainState, minibatch: tuple) -> tuple[TrainState, dict]:
        gradient = jax.grad(ppo_loss, has_aux=True)
        grads, parts = gradient(train_state.params, network, *minibatch, config)
        return train_state.apply_gradients(grads=grads), parts

    def update_epoch(train_state: TrainState, key: jax.Array, data: tuple) -> tuple:
        order = affine_permutation(key, config.batch_size)
        shuffled = jax.tree.map(lambda leaf: leaf[order], data)
        minibatches = jax.tree.map(
            lambda leaf: leaf.reshape(config.num_minibatches, -1, *leaf.shape[1:]), shuffled
        )
        return jax.lax.scan(update_minibatch, train_state, minibatches)

    def update(runner: Runner, _: None) -> tuple[Runner, dict[str, jax.Array]]:
        runner, (batch, log) = jax.lax.scan(collect_step, runner, None, config.num_steps)
        last_value = network.apply(runner.train_state.params, runner.observation, method="value")
        advantage = generalized_advantages(batch, last_value, config.gamma, config.gae_lambda)
        target = advantage + batch.value
        data = jax.tree.map(
            lambda leaf: leaf.reshape(config.batch_size, *leaf.shape[2:]),
            (batch, advantage, target),
        )
        key, *epoch_keys = jax.random.split(runner.key, config.update_epochs + 1)
        train_state, parts = jax.lax.scan(
            lambda train_state, key: update_epoch(train_state, key, data),
            runner.train_state,
            jnp.stack(epoch_keys),
        )
        metrics = {
            **summarise_episodes(log),
            **jax.tree.map(jnp.mean, parts),
            "explained_variance": 1.0 - jnp.var(target - batch.value) / jnp.var(target),
        }
        if report is not None:
            jax.debug.callback(report, metrics)
        return runner._replace(train_state=train_state, key=key), metrics

    def train(key: jax.Array) -> tuple[Runner, dict[str, jax.Array]]:
        key, key_network, key_reset = jax.random.split(key, 3)
        reset_keys = jax.random.split(key_reset, config.num_envs)
        observation, env_state = jax.vmap(env.reset, in_axes=(0, None))(reset_keys, env_params)
        runner = Runner(
            train_state=make_train_state(key_network, observation.shape[-1], config),
            env_state=env_state,
            observation=observation,
            episode_return=jnp.zeros(config.num_envs),
            key=key,
        )
        return jax.lax.scan(update, runner, None, config.num_updates)

    return train


def summarise_episodes(log: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Return means over the episodes that ended in an update; 0 where none did.

    ``log`` holds (num_steps, num_envs) arrays: done, episode_return and the environment's info.
    """
    done = log["done"]
    num_ended = jnp.maximum(done.sum(), 1)
    per_episode = partial(jnp.where, done)
    return {
        f"episode_{name}" if not name.startswith("episode_") else name: (
            per_episode(values, 0).sum() / num_ended
        )
        for name, values in log.items()
        if name != "done"
    }
