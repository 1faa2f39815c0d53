"""A PureJaxRL-style loop on FlyTrack-v0: one compiled scan, with gymnax's own ``LogWrapper``."""

from typing import Any

import gymnax
import jax
import jax.numpy as jnp
from gymnax.wrappers import LogWrapper

import flytrack_env  # noqa: F401  registers the ids with gymnax
from clients.flights import Outcome, outcome_of
from clients.learner import NUM_ENVS, NUM_STEPS, NUM_UPDATES, act, begin, learn

RETURN_MARGIN, GATE_MARGIN = 5.0, 2.0


def measure(seed: int) -> Outcome:
    """Train and return the results of the first and of the last episodes of the training."""
    env, params = gymnax.make("FlyTrack-v0")
    env = LogWrapper(env)

    def step(carry: Any, key: jax.Array) -> Any:
        training, observations, states = carry
        keys = jax.random.split(key, 1 + NUM_ENVS)
        actions = act(training, observations, keys[0])
        outputs = jax.vmap(env.step, (0, 0, 0, None))(keys[1:], states, actions, params)
        return (training, *outputs[:2]), (observations, actions, outputs[2], outputs[5])

    def update(carry: Any, key: jax.Array) -> Any:
        (training, *now), (*steps, info) = jax.lax.scan(
            step, carry, jax.random.split(key, NUM_STEPS)
        )
        done = info["returned_episode"]
        training = learn(training, key, now[0], (*steps, done, jnp.ones(done.shape)))
        return (training, *now), (done, info["returned_episode_returns"], info["gates_passed"])

    @jax.jit
    def train(key: jax.Array) -> Any:
        start = jax.vmap(env.reset, (0, None))(jax.random.split(key, NUM_ENVS), params)
        return jax.lax.scan(
            update, (begin(key, start[0]), *start), jax.random.split(key, NUM_UPDATES)
        )[1]

    return outcome_of(*train(jax.random.key(seed)))
