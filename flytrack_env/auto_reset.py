"""Auto-reset of a batch of which, as a rule, few episodes end in the same step.

Sampling, observing and selecting a start for every environment cost almost as much as the step. So
only as many starts are sampled as a step is likely to need, and they are scattered to the environments
that ended. Each start goes to one environment at most: environments stay independent of each other.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

Tree = TypeVar("Tree")

# Starts per round. Random actions end 1 episode in 70 per step, so that one round is the rule.
ONE_IN = 32
SPARE = 8
ROW = 64


def find_ended(ended: jax.Array, count: int) -> jax.Array:
    """Return the indices of the first ``count`` true elements of a vector, then its length.

    The same as ``jnp.nonzero`` with a size, at a third of its cost on the CPU: the running count is a
    product with a triangle of ones within rows of 64 (exact), and a short sum over the rows.
    """
    rows = jnp.pad(ended, (0, -ended.shape[0] % ROW)).reshape(-1, ROW).astype(jnp.float32)
    in_row = rows @ jnp.triu(jnp.ones((ROW, ROW), jnp.float32))
    totals = in_row[:, -1]
    running = (in_row + (jnp.cumsum(totals) - totals)[:, None]).reshape(-1)
    found = jnp.searchsorted(running, jnp.arange(1, count + 1, dtype=jnp.float32))
    return jnp.minimum(found, ended.shape[0])


Sample = Callable[[jax.Array, Any], Tree]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def reset_ended(sample: Sample[Tree], ended: jax.Array, olds: Tree, inputs: Any) -> Tree:
    """Return ``olds`` with a fresh start in the place of each environment that ended.

    sample: returns the starts of some environments, leaves (count, ...), from their indices (count,)
    and ``inputs``. ended: (num_envs,). olds: leaves (num_envs, ...).
    """
    num_envs = ended.shape[0]
    count = min(num_envs, num_envs // ONE_IN + SPARE)

    def is_pending(carry: tuple[jax.Array, Tree]) -> jax.Array:
        return carry[0].any()

    def reset_some(carry: tuple[jax.Array, Tree]) -> tuple[jax.Array, Tree]:
        pending, states = carry
        places = find_ended(pending, count)  # an index beyond the end is dropped
        put = partial(jax.tree.map, lambda old, new: old.at[places].set(new, mode="drop"))
        return pending.at[places].set(False, mode="drop"), put(states, sample(places, inputs))

    # A conditional would copy every leaf in each of its branches, which cost more than the reset.
    return jax.lax.while_loop(is_pending, reset_some, (ended, olds))[1]


@reset_ended.defjvp
def _reset_ended_jvp(sample, primals, tangents):  # type: ignore[no-untyped-def]
    """Differentiate the same function without its loop, which has no reverse mode."""
    ended, olds, inputs = primals

    def reset(olds: Tree, inputs: Any) -> Tree:
        def choose(start: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(ended.reshape((-1,) + (1,) * (old.ndim - 1)), start, old)

        return jax.tree.map(choose, sample(jnp.arange(ended.shape[0]), inputs), olds)

    return jax.jvp(reset, (olds, inputs), tangents[1:])
