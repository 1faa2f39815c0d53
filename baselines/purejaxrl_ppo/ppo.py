"""Proximal policy optimisation, top to bottom, as PureJaxRL writes it.

Source: J. Schulman et al., arXiv 1707.06347; C. Lu et al., PureJaxRL. Differences from PureJaxRL,
the reason for each, and the setting (``config.py``) that switches it off:

- Truncation is bootstrapped: the value of the final observation is added to the last reward of an
  episode that the time limit cut off, because the race would have gone on
  (``bootstrap_at_truncation = false``).
- Environments are stepped as a batch where they offer ``step_batch``, which is faster
  (``batched_step = false``: one by one under ``vmap``).
- Minibatches come from an affine permutation, i -> a i + b mod n, because sorting all keys of an
  epoch costs as much as the environments (``affine_shuffle = false``).
- The standard deviation has a floor, so that exploration cannot die out early, and starts at 0.5,
  because random full stick crashes at once (``min_std = 0``, ``initial_std = 1``).
- The untrained policy's mean thrust is about that of hovering, so that its episodes last
  (``initial_action`` of zeros).
- The step size falls with every gradient step, which is optax's own schedule, and not to 0, so that
  the last updates still learn (``anneal_every_gradient = false``,
  ``final_learning_rate_fraction = 0``).
- The network may remember (``memory_size = 0``: it does not), so that it can adapt to the drone it
  flies.
- The critic may see the state while the policy has sensors only (``critic_sees_state = false``: it
  does not), so that it need not guess what the policy's memory has yet to find out. The memory may
  be taught the state by an estimate of it (``state_coef = 0``: it is not).
- One update is a function of its own (``Algorithm``), so that a run can be logged, stored and
  resumed between updates; ``make_train`` is PureJaxRL's: one ``jit``, a ``scan`` over updates.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax.training.train_state import TrainState
from gymnax.environments import spaces

from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.metrics import summarize_episodes, summarize_race
from baselines.purejaxrl_ppo.networks import IMAGE_AXES, ActorCritic, Memory, make_network
from flytrack_env.wrappers import StateObservation

Metrics = dict[str, jax.Array]


class Batch(NamedTuple):
    """One update's experience; leaves (num_steps, num_envs, ...).

    Memory and observation are those before the step.
    """

    memory: Memory
    observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    reward: jax.Array
    done: jax.Array


class Episodes(NamedTuple):
    """Every environment's episode.

    Attributes:
        so_far: return so far, (num_envs,).
        length: number of steps so far, (num_envs,).
        last_return: return of the last episode that ended, (num_envs,).
    """

    so_far: jax.Array
    length: jax.Array
    last_return: jax.Array


class Runner(NamedTuple):
    """The carry of the loop over updates: all that a run needs to continue."""

    train_state: TrainState
    env_state: Any
    memory: Memory
    observation: jax.Array
    episodes: Episodes
    key: jax.Array


class Algorithm(NamedTuple):
    """PPO on one environment, as two functions to be jitted.

    Attributes:
        start: key -> runner, before the first update.
        update: runner -> (runner, metrics), one update; metrics are scalars.
    """

    start: Callable[[jax.Array], Runner]
    update: Callable[[Runner], tuple[Runner, Metrics]]


def choose_step(env: Any, config: Config) -> Callable[..., Any]:
    """Return a step of a whole batch with one key: the environment's own, else a vmap."""
    if config.batched_step and hasattr(env, "step_batch"):
        return env.step_batch

    def step(key: jax.Array, states: Any, actions: jax.Array, params: Any) -> tuple[Any, ...]:
        keys = jax.random.split(key, actions.shape[0])
        return jax.vmap(env.step, in_axes=(0, 0, 0, None))(keys, states, actions, params)

    return step


def generalized_advantages(
    batch: Batch, last_value: jax.Array, gamma: float, gae_lambda: float
) -> jax.Array:
    """Return GAE advantages, (num_steps, num_envs); arXiv 1506.02438, equation 16.

    The reward of a truncated step already holds the bootstrapped value of its final observation.
    """

    def backwards(carry: tuple[Any, ...], step: tuple[Any, ...]) -> tuple[Any, ...]:
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
    network: Any,  # an ActorCritic; flax types what its ``apply`` returns as a union
    batch: Batch,
    advantage: jax.Array,
    target: jax.Array,
    config: Config,
) -> tuple[jax.Array, Metrics]:
    """Return the clipped objective plus clipped value loss of a minibatch, and its parts."""
    policy, value, state_error = network.apply(
        network_params, batch.memory, batch.observation, batch.done, method="unroll"
    )
    log_prob = policy.log_prob(batch.action)
    value_clipped = batch.value + jnp.clip(value - batch.value, -config.clip_eps, config.clip_eps)
    value_error = jnp.maximum((value - target) ** 2, (value_clipped - target) ** 2)
    value_loss = 0.5 * value_error.mean()

    log_ratio = log_prob - batch.log_prob
    ratio = jnp.exp(log_ratio)
    advantage_std = jnp.sqrt(jnp.var(advantage))
    advantage = (advantage - advantage.mean()) / (advantage_std + 1e-8)
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
    if config.state_coef:
        loss, parts["state_error"] = loss + config.state_coef * state_error, state_error
    return loss, parts


def make_schedule(config: Config) -> optax.Schedule:
    """Return the step size over the number of gradient steps, linear over all updates."""
    last = config.learning_rate * config.final_learning_rate_fraction
    if config.anneal_every_gradient:
        num_gradients = config.num_updates * config.gradients_per_update
        return optax.linear_schedule(config.learning_rate, last, num_gradients)
    by_update = optax.linear_schedule(config.learning_rate, last, config.num_updates)
    return lambda count: by_update(count // config.gradients_per_update)


def make_optimizer(config: Config) -> optax.GradientTransformation:
    """Return Adam with gradient clipping and linear annealing."""
    adam = optax.adam(make_schedule(config), eps=config.adam_eps)
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), adam)


def make_network_for(env: Any, env_params: Any, config: Config) -> ActorCritic:
    """Return the network with as many outputs as the environment has actions.

    Raises:
        ValueError: ``initial_action`` of another length than the environment's actions.
    """
    space = env.action_space(env_params)
    observation, _ = jax.eval_shape(env.reset, jax.random.key(0), env_params)
    sees_image = observation.ndim == IMAGE_AXES
    if isinstance(space, spaces.Discrete):
        return make_network(config, int(space.n), sees_image)
    if space.shape != (len(config.initial_action),):
        raise ValueError(
            f"initial_action: found {len(config.initial_action)} values, expected the "
            f"environment's action shape {space.shape}"
        )
    return make_network(config, sees_image=sees_image)


def make_ppo(
    env: Any, env_params: Any, config: Config, divide: Callable[[Any], Any] = lambda rows: rows
) -> Algorithm:
    """Return PPO on a gymnax environment with its parameters.

    Args:
        env: the environment.
        env_params: of it.
        config: hyperparameters.
        divide: shares out minibatches, (num_minibatches, rows, ...), among devices (devices.py).

    Raises:
        ValueError: a configuration that cannot be trained with.
    """
    config.check()
    if config.critic_sees_state:
        env = StateObservation(env)
    network: Any = make_network_for(env, env_params, config)
    optimizer, schedule = make_optimizer(config), make_schedule(config)
    step_all = choose_step(env, config)
    # What minibatches are drawn from: steps, or whole environments where the order of their steps
    # matters.
    num_rows = config.num_envs if config.memory_size else config.batch_size

    def as_rows(leaf: jax.Array) -> jax.Array:
        if config.memory_size:
            return leaf.swapaxes(0, 1)
        return leaf.reshape(config.batch_size, *leaf.shape[2:])

    def collect_step(runner: Runner, _: None) -> tuple[Runner, tuple[Batch, dict[str, jax.Array]]]:
        key, key_action, key_step = jax.random.split(runner.key, 3)
        memory, policy, value = network.apply(
            runner.train_state.params, runner.memory, runner.observation, method="step"
        )
        action, log_prob = policy.sample_and_log_prob(seed=key_action)
        observation, env_state, reward, terminated, truncated, info = step_all(
            key_step, runner.env_state, action, env_params
        )
        done = terminated | truncated
        total, length = runner.episodes.so_far + reward, runner.episodes.length + 1
        last_return = jnp.where(done, total, runner.episodes.last_return)
        if config.bootstrap_at_truncation:
            # Few steps see a truncation, so that its value is rarely worth computing.
            final_value = jax.lax.cond(
                truncated.any(),
                lambda: network.apply(
                    runner.train_state.params, memory, info["final_observation"], method="value_of"
                ),
                lambda: jnp.zeros_like(value),
            )
            reward = reward + config.gamma * final_value * (truncated & ~terminated)
        batch = Batch(runner.memory, runner.observation, action, log_prob, value, reward, done)
        log = {
            **{name: leaf for name, leaf in info.items() if leaf.shape == done.shape},
            "done": done,
            "truncated": truncated,
            "episode_return": total,
            "episode_length": length,
            "last_return": last_return,
        }
        runner = runner._replace(
            env_state=env_state,
            memory=jax.tree.map(lambda leaf: jnp.where(done[:, None], 0.0, leaf), memory),
            observation=observation,
            episodes=Episodes(jnp.where(done, 0.0, total), jnp.where(done, 0, length), last_return),
            key=key,
        )
        return runner, (batch, log)

    def update_minibatch(
        train_state: TrainState, minibatch: tuple[Any, ...]
    ) -> tuple[TrainState, Metrics]:
        gradient = jax.grad(ppo_loss, has_aux=True)
        grads, parts = gradient(train_state.params, network, *minibatch, config)
        return train_state.apply_gradients(grads=grads), parts

    def update_epoch(
        train_state: TrainState, key: jax.Array, data: tuple[Any, ...]
    ) -> tuple[TrainState, Metrics]:
        permutation = affine_permutation if config.affine_shuffle else jax.random.permutation
        order = permutation(key, num_rows)
        shuffled = jax.tree.map(lambda leaf: leaf[order], data)
        minibatches = jax.tree.map(
            lambda leaf: leaf.reshape(config.num_minibatches, -1, *leaf.shape[1:]), shuffled
        )
        return jax.lax.scan(update_minibatch, train_state, divide(minibatches))

    def update(runner: Runner) -> tuple[Runner, Metrics]:
        runner, (batch, log) = jax.lax.scan(collect_step, runner, None, config.num_steps)
        last_value: Any = network.apply(
            runner.train_state.params, runner.memory, runner.observation, method="value_of"
        )
        advantage = generalized_advantages(batch, last_value, config.gamma, config.gae_lambda)
        target = advantage + batch.value
        data = jax.tree.map(as_rows, (batch, advantage, target))
        key, *epoch_keys = jax.random.split(runner.key, config.update_epochs + 1)
        train_state, parts = jax.lax.scan(
            lambda train_state, key: update_epoch(train_state, key, data),
            runner.train_state,
            jnp.stack(epoch_keys),
        )
        metrics = {
            **summarize_episodes(log),
            **summarize_race(log),
            **jax.tree.map(jnp.mean, parts),
            "last_return": log["last_return"].mean(),
            "explained_variance": 1.0 - jnp.var(target - batch.value) / jnp.var(target),
            "learning_rate": jnp.asarray(schedule(runner.train_state.step)),
        }
        return runner._replace(train_state=train_state, key=key), metrics

    def start(key: jax.Array) -> Runner:
        key, key_network, key_reset = jax.random.split(key, 3)
        reset_keys = jax.random.split(key_reset, config.num_envs)
        observation, env_state = jax.vmap(env.reset, in_axes=(0, None))(reset_keys, env_params)
        params = network.init(key_network, observation[:1])
        nothing = jnp.zeros(config.num_envs)
        return Runner(
            train_state=TrainState.create(apply_fn=network.apply, params=params, tx=optimizer),
            env_state=env_state,
            memory=network.first_memory((config.num_envs,)),
            observation=observation,
            episodes=Episodes(nothing, nothing.astype(jnp.int32), nothing),
            key=key,
        )

    return Algorithm(start, update)


def make_train(
    env: Any, env_params: Any, config: Config
) -> Callable[[jax.Array], tuple[Runner, Metrics]]:
    """Return ``train(key) -> (runner, metrics)``, a whole run, to be jitted.

    The metrics have shape (num_updates,).

    Raises:
        ValueError: a configuration that cannot be trained with.
    """
    ppo = make_ppo(env, env_params, config)

    def train(key: jax.Array) -> tuple[Runner, Metrics]:
        return jax.lax.scan(
            lambda runner, _: ppo.update(runner), ppo.start(key), None, config.num_updates
        )

    return train
