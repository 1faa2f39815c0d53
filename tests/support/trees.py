"""Batches of trees, their comparison, and trees as TOML, for tests."""

import json
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


def as_toml(tree: dict[str, Any]) -> bytes:
    """Return a tree as TOML, one line for each name at the top."""
    return "".join(f"{_toml(name)} = {_toml(value)}\n" for name, value in tree.items()).encode()


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_toml(name)} = {_toml(one)}" for name, one in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return repr(value) if isinstance(value, float) else json.dumps(value)
