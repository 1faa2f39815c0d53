"""Sums and means over all environments, on one device or in shards on several."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

AXIS = "devices"  # the mesh axis over which the environments are sharded


class Collectives(NamedTuple):
    """Reductions to scalars over all environments.

    axis: of the mesh whose devices hold equal shards of the environments; None: one device holds all.
    """

    axis: str | None = None

    def sum(self, values: jax.Array) -> jax.Array:
        """Return the sum of all values."""
        total = values.sum()
        return total if self.axis is None else jax.lax.psum(total, self.axis)

    def mean(self, values: jax.Array) -> jax.Array:
        """Return the mean of all values."""
        return self.average(values.mean())

    def variance(self, values: jax.Array) -> jax.Array:
        """Return the variance of all values."""
        return jnp.var(values) if self.axis is None else self.mean((values - self.mean(values)) ** 2)

    def average(self, tree: Any) -> Any:
        """Return the mean over devices of every leaf, such as gradients and means of equal shards."""
        if self.axis is None:
            return tree
        values, as_tree = ravel_pytree(tree)  # one message instead of one per leaf
        return as_tree(jax.lax.pmean(values, self.axis))
