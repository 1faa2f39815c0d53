"""Sums and means over one update's experience, wherever it lies: on one device, or in shards on several."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

AXIS = "devices"  # of the mesh that the environments are spread over


class Across(NamedTuple):
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
        return self.averaged(values.mean())

    def variance(self, values: jax.Array) -> jax.Array:
        """Return the mean squared distance from the mean of all values."""
        return jnp.var(values) if self.axis is None else self.mean((values - self.mean(values)) ** 2)

    def averaged(self, tree: Any) -> Any:
        """Return the mean over devices of every leaf: of gradients and means of equal shards."""
        return tree if self.axis is None else jax.lax.pmean(tree, self.axis)
