"""Flights of any policy, by which training is judged."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

EVALUATION_SEED = 1234  # the same starts before and after training, and for every client
NUM_FLIGHTS = 256


class Outcome(NamedTuple):
    """Mean results of an evaluation before a training and of one after it.

    Returns are the client's own evaluation; gates are those passed in an episode.
    """

    return_before: float
    return_after: float
    gates_before: float
    gates_after: float

    def has_gained(self, return_margin: float, gate_margin: float) -> bool:
        """Return whether return and gates rose by at least these margins."""
        is_return_gained = self.return_after - self.return_before >= return_margin
        return is_return_gained and self.gates_after - self.gates_before >= gate_margin


def mean_gates(
    act: Callable[[jax.Array, jax.Array], jax.Array], env: Any, params: Any, num_steps: int
) -> float:
    """Return the gates passed in an episode, mean over ``NUM_FLIGHTS`` episodes on the same starts.

    Args:
        act: observation and key to action.
        env: with gymnax's 6-value step.
        num_steps: of the longest episode.
    """

    def fly(key: jax.Array) -> jax.Array:
        start_key, steps_key = jax.random.split(key)
        start = (*env.reset(start_key, params), jnp.int32(0), jnp.bool_(False))

        def step(carry: Any, key: jax.Array) -> Any:
            observation, state, gates, has_ended = carry
            act_key, step_key = jax.random.split(key)
            action = act(observation, act_key)
            observation, state, _, terminated, truncated, info = env.step(
                step_key, state, action, params
            )
            gates = jnp.where(has_ended, gates, info["gates_passed"])
            return (observation, state, gates, has_ended | terminated | truncated), None

        return jax.lax.scan(step, start, jax.random.split(steps_key, num_steps))[0][2]

    keys = jax.random.split(jax.random.key(EVALUATION_SEED), NUM_FLIGHTS)
    return float(jax.jit(jax.vmap(fly))(keys).mean())


def outcome_of(done: Any, returns: Any, gates: Any) -> Outcome:
    """Return mean results of the episodes that ended in the first and last tenth of a training.

    Of every step, (num_updates, ...): whether an episode ended, and its return and gates where it
    did.
    """
    done, returns, gates = map(np.asarray, (done, returns, gates))
    tenth = max(1, len(done) // 10)
    parts = slice(tenth), slice(-tenth, None)
    means = [
        float(values[part][done[part]].mean()) for values in (returns, gates) for part in parts
    ]
    return Outcome(*means)
