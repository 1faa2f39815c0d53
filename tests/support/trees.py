"""Batches of trees and their comparison, for tests."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def stack(trees: list[Any]) -> Any:
    """Return a batch of equal trees."""
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(x) for x in leaves]), *trees)


def assert_close(a: Any, b: Any, tolerance: float = 1e-5) -> None:
    """Compare two trees leaf by leaf."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance)
