"""Any tree of arrays as named NumPy arrays, and back into a tree that says what it expects.

Random keys are of JAX's default implementation.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.messages import quote_name


def name_of(path: Any) -> str:
    """Return the path of a leaf as a dotted name."""
    return jax.tree_util.keystr(path, simple=True, separator=".")


def is_key(leaf: Any) -> bool:
    """Return whether an array, or its shape and type, is one of random keys."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def as_named_arrays(tree: Any) -> dict[str, np.ndarray]:
    """Return the leaves of a tree by their dotted paths, bit for bit; random keys as their words."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {
        name_of(path): np.asarray(
            jax.random.key_data(leaf) if isinstance(leaf, jax.Array) and is_key(leaf) else leaf
        )
        for path, leaf in leaves
    }


def find_misfits(arrays: dict[str, np.ndarray], target: Any) -> list[str]:
    """Return, leaf by leaf, where named arrays are not what a tree of shapes and types expects."""
    expected = _forms(target)
    lines = []
    for name, (shape, dtype) in expected.items():
        found = arrays.get(name)
        if found is None:
            lines.append(f"{name}: missing, expected {dtype} of shape {shape}")
        elif found.shape != shape:
            lines.append(f"{name}: found shape {found.shape}, expected shape {shape}")
        elif found.dtype != dtype:
            lines.append(f"{name}: found {found.dtype}, expected {dtype}")
    return lines + [f"{quote_name(name)}: found, but not expected" for name in arrays if name not in expected]


def from_named_arrays(arrays: dict[str, np.ndarray], target: Any) -> Any:
    """Return the tree that ``target`` (shapes and types) describes, of arrays that fit it (find_misfits)."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(target)
    return jax.tree.unflatten(structure, [_read(arrays[name_of(path)], leaf) for path, leaf in leaves])


def _read(array: np.ndarray, wanted: Any) -> jax.Array:
    words = jnp.asarray(array)
    return jax.random.wrap_key_data(words) if is_key(wanted) else words


def _forms(target: Any) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Return shape and type of every leaf as it is stored, by its path."""
    forms = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(target):
        stored = jax.eval_shape(jax.random.key_data, leaf) if is_key(leaf) else leaf
        forms[name_of(path)] = (tuple(stored.shape), np.dtype(stored.dtype))
    return forms
