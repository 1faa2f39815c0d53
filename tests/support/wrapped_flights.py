"""Flights of FlyTrack in wrappers, which tests share: each environment's step is compiled once."""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.env import FlyTrack
from flytrack_env.wrappers import (
    ActionDelay,
    ActionHistory,
    DomainRandomization,
    EpisodeStatistics,
    ObservationNoise,
)
from tests.support.coasting import drone_at
from tests.support.compiling import quick_jit
from tests.support.tables import table

NUM_ENVS, NUM_STEPS = 16, 60
COMMANDED = partial(ActionHistory, length=3)
APPLIED = partial(ActionHistory, length=1, kind="applied")
ALL = (DomainRandomization, ActionDelay, APPLIED, ObservationNoise, COMMANDED, EpisodeStatistics)


class Flight(NamedTuple):
    """Random flights: the reset's results, actions, and steps' results, (T, NUM_ENVS, ...)."""

    first: Any
    start: Any
    actions: Any
    observations: Any
    states: Any
    rewards: Any
    terminated: Any
    truncated: Any
    info: Any

    @property
    def ended(self):
        """Whether each step ended its episode."""
        return np.asarray(self.terminated | self.truncated)


@cache
def wrapped(*wrappers):
    """Return FlyTrack in wrappers, the innermost first."""
    env = FlyTrack()
    for wrapper in wrappers:
        env = wrapper(env)
    return env


@cache
def resets_of(env):
    """Return the compiled reset of NUM_ENVS environments."""
    return quick_jit(jax.vmap(env.reset, in_axes=(0, None)))


@cache
def steps_of(env):
    """Return the compiled step, with auto-reset, of NUM_ENVS environments."""
    return quick_jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))


def fly(env, params=None, actions=None, step=None, **wrappers):
    """Return flights of random actions, or of given ones (T, NUM_ENVS, 4).

    Args:
        step: in place of ``steps_of(env)``.
        wrappers: parameters of wrappers that are not the default ones.
    """
    step = steps_of(env) if step is None else step
    params = env.default_params if params is None else params
    params = arrays(params.replace(wrappers={**params.wrappers, **wrappers}))
    key_reset, key_actions, key_steps = jax.random.split(jax.random.key(0), 3)
    if actions is None:
        actions = jax.random.uniform(key_actions, (NUM_STEPS, NUM_ENVS, 4), minval=-1.0)
    first, start = resets_of(env)(jax.random.split(key_reset, NUM_ENVS), params)
    state, outputs = start, []
    for index, action in enumerate(actions):
        keys = jax.random.split(jax.random.fold_in(key_steps, index), NUM_ENVS)
        outputs.append(step(keys, state, action, params))
        state = outputs[-1][1]
    return Flight(first, start, actions, *jax.tree.map(lambda *leaves: np.stack(leaves), *outputs))


def arrays(params):
    """Return parameters as float32 arrays, so that no other type compiles a step again."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), params)


# One step on the FlyTrack course: position, velocity, other fields of the drone, steps already
# flown, action; causes; truncated.
ENDS = {
    name: (*own, set(causes), is_late) for name, (*own, causes, is_late) in table("ends").items()
}


def before_ends(env, params, ends, **fields):
    """Return a batch of states a step before some ``ENDS``, and the actions of that step."""
    positions, velocities, own, times, actions, *_ = zip(*ends, strict=True)
    drones = [
        drone_at(position, velocity, **values, **fields)
        for position, velocity, values in zip(positions, velocities, own, strict=True)
    ]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *drones)
    begin = quick_jit(jax.vmap(env.begin, in_axes=(0, None, None, 0)))
    states = begin(batch, 0, params, jnp.arange(len(drones), dtype=jnp.uint32))

    def with_time(path, leaf):
        is_time = getattr(path[-1], "name", "") == "time"
        return jnp.array(times, jnp.int32) if is_time else leaf

    states = jax.tree_util.tree_map_with_path(with_time, states)
    return states, jnp.array(actions, jnp.float32)
