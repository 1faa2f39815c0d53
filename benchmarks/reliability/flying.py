"""Flies batches of checked environments on the device, and counts what comes of every step."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from baselines.purejaxrl_ppo import load_checkpoint
from benchmarks.champion import CHAMPION
from benchmarks.reliability.actions import draw_actions, draw_words
from benchmarks.reliability.checked import INSIDE, VIOLATIONS, as_bits
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.observations import OBSERVATION_SIZE
from flytrack_env.params import EnvParams
from flytrack_env.terminations import Causes

PILOTED_SHARE = 1 / 16  # of the environments: the champion flies them, and full stick now and then
BURST_ONE_IN = 16  # of the times that a stick is held
ENDS = (*Causes._fields, "truncated")
NEVER = np.iinfo(np.int32).max


class Tally(NamedTuple):
    """What flights came to, per environment, int32: (num_envs,), and per violation (violations, num_envs).

    episodes: that ended. ends: by cause. violations: steps that show one. first: the first such step.
    """

    episodes: jax.Array
    ends: dict[str, jax.Array]
    violations: jax.Array
    first: jax.Array


Pilot = Callable[[jax.Array], jax.Array]


@cache
def load_pilot() -> Pilot:
    """Return the champion of the FlyTrack course: observations (num_envs, size) -> actions (num_envs, 4)."""
    checkpoint = load_checkpoint(CHAMPION)

    def act(observations: jax.Array) -> jax.Array:
        seen = observations[:, :OBSERVATION_SIZE]
        policy: Any = checkpoint.network.apply(checkpoint.params, seen, method="policy")
        return policy.mode()

    return act


def piloted_actions(pilot: Pilot, observations: jax.Array, seed: jax.Array, step: jax.Array) -> jax.Array:
    """Return the pilot's actions, and full stick on all four where a burst is drawn."""
    words = draw_words(~seed, step, len(observations))
    is_burst = (words.held[:, :1] >> 8) % BURST_ONE_IN == 0
    return jnp.where(is_burst, jnp.where(words.held >> 31 == 0, 1.0, -1.0), pilot(observations))


def look_from_outside(env: EpisodicEnvironment, actions: jax.Array, outputs: tuple[Any, ...]) -> jax.Array:
    """Return the bits of OUTSIDE, shifted above those of INSIDE, (num_envs,); outputs: of the step."""
    observation, _, _, terminated, _, info = outputs
    observations, limit = (observation, info["final_observation"]), env.observation_space().high
    is_finite = sum((rows * 0.0).sum(axis=1) for rows in observations) == 0.0
    is_inside = jnp.stack([(jnp.abs(rows) <= limit).all(axis=1) for rows in observations]).all(axis=0)
    is_ignored = jnp.isnan(actions).any(axis=1) & ~(terminated & info["crash"])
    return as_bits((~is_finite, ~is_inside, is_ignored)) << len(INSIDE)


@partial(jax.jit, static_argnames=("env", "pilot", "num_envs", "is_batched"))
def fly(
    env: EpisodicEnvironment,
    pilot: Pilot,
    seed: jax.Array,
    params: EnvParams,
    num_steps: jax.Array,
    num_envs: int,
    is_batched: bool,
) -> Tally:
    """Return what ``num_steps`` steps of every environment come to, from a reset on.

    seed: uint32 scalar, which decides all of it. params: the same for all, or batched.
    """
    axis = 0 if is_batched else None
    num_piloted = round(num_envs * PILOTED_SHARE)
    keys = draw_words(seed, jnp.int32(-1), num_envs).now[:, :2]
    observations, states = jax.vmap(env.reset, in_axes=(0, axis))(keys, params)
    nothing = jnp.zeros(num_envs, jnp.int32)
    tally = Tally(
        episodes=nothing,
        ends=dict.fromkeys(ENDS, nothing),
        violations=jnp.zeros((len(VIOLATIONS), num_envs), jnp.int32),
        first=jnp.full(num_envs, NEVER),
    )

    def one(step: jax.Array, carry: tuple[Any, ...]) -> tuple[Any, ...]:
        observations, states, tally = carry
        actions = draw_actions(seed, step, num_envs - num_piloted)
        piloted = piloted_actions(pilot, observations[num_envs - num_piloted :], seed, step)
        actions = jnp.concatenate([actions, piloted])
        keys = draw_words(seed + 1, step, num_envs).now[:, :2]
        if is_batched:
            outputs = jax.vmap(env.step, in_axes=(0, 0, 0, 0))(keys, states, actions, params)
        else:
            outputs = env.step_batch(keys[0], states, actions, params)
        observations, states, _, terminated, truncated, info = outputs
        bits = info["violations"] | look_from_outside(env, actions, outputs)
        tally = add(tally, step, info, terminated | truncated, bits)
        return observations, states, tally

    return jax.lax.fori_loop(0, num_steps, one, (observations, states, tally))[2]


def add(tally: Tally, step: jax.Array, info: dict[str, jax.Array], done: jax.Array, bits: jax.Array) -> Tally:
    """Return the tally after another step of all environments."""
    ends = {name: count + (info[name] & done) for name, count in tally.ends.items()}

    def count() -> tuple[jax.Array, jax.Array]:
        flags = (bits >> jnp.arange(len(VIOLATIONS))[:, None]) & 1
        first = jnp.minimum(tally.first, jnp.where(bits != 0, step, NEVER))
        return tally.violations + flags, first

    violations, first = jax.lax.cond(bits.any(), count, lambda: (tally.violations, tally.first))
    return Tally(tally.episodes + done, ends, violations, first)
