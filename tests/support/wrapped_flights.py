"""Random flights of FlyTrack in wrappers, which the tests of these share."""

from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp

from flytrack_env.env import EnvParams, FlyTrack

NUM_STEPS, NUM_ENVS = 100, 8


@cache
def wrapped(*wrappers: Any) -> Any:
    """Return FlyTrack in wrappers, the innermost first."""
    env: Any = FlyTrack()
    for wrapper in wrappers:
        env = wrapper(env)
    return env


def fly(env: Any, **changes: Any) -> Any:
    """Return observations, states, rewards, ends and infos of random flights, leaves (T, N, ...).

    ``changes`` are of the default parameters. One shape for all tests: compiling is what takes time.
    """
    return _fly(env, jax.random.key(0), env.default_params.replace(**changes))


@partial(jax.jit, static_argnums=0)
def _fly(env: Any, key: jax.Array, params: EnvParams) -> Any:
    key_reset, key_actions, key_steps = jax.random.split(key, 3)
    actions = jax.random.uniform(key_actions, (NUM_STEPS, NUM_ENVS, 4), minval=-1.0)
    first, start = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(key_reset, NUM_ENVS), params)

    def one(state: Any, inputs: Any) -> Any:
        index, action = inputs
        keys = jax.random.split(jax.random.fold_in(key_steps, index), NUM_ENVS)
        outputs = jax.vmap(env.step, in_axes=(0, 0, 0, None))(keys, state, action, params)
        return outputs[1], outputs

    outputs = jax.lax.scan(one, start, (jnp.arange(NUM_STEPS), actions))[1]
    return (first, start), actions, outputs
