"""Batches of pytrees packed as a few matrices, one per dtype.

Handing an array to a compiled function and taking one from it costs about a microsecond; a state
has some fifty leaves and the parameters as many again.
"""

import math
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.fusion import compute_once

# What Gymnasium makes of Python's own numbers, by the kind of a dtype.
HOST_DTYPES = {"f": np.float64, "i": np.int64, "u": np.int64, "b": np.bool_}


@dataclass(frozen=True, eq=False)
class Layout:
    """Structure of a pytree, dtypes of its matrices, and the slot of each leaf.

    Equal layouts are one object: every call of a compiled function hashes and compares them.

    Attributes:
        slots: a leaf's shape, matrix, first row, and the row after its last.
    """

    structure: Any
    dtypes: tuple[Any, ...]
    slots: tuple[tuple[tuple[int, ...], int, int, int], ...]

    def __reduce__(self) -> tuple[Any, ...]:
        forms = tuple((shape, self.dtypes[matrix]) for shape, matrix, *_ in self.slots)
        return _layout, (self.structure, forms)


@cache
def _layout(structure: Any, forms: tuple[tuple[tuple[int, ...], Any], ...]) -> Layout:
    dtypes = tuple(dict.fromkeys(dtype for _, dtype in forms))
    ends, slots = [0] * len(dtypes), []
    for shape, dtype in forms:
        matrix = dtypes.index(dtype)
        first, ends[matrix] = ends[matrix], ends[matrix] + math.prod(shape)
        slots.append((shape, matrix, first, ends[matrix]))
    return Layout(structure, dtypes, tuple(slots))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Packed:
    """A batch of pytrees as matrices (rows, num_envs).

    A number of all environments is contiguous.
    """

    matrices: tuple[jax.Array, ...]
    layout: Layout = field(metadata={"static": True})

    def unpack(self) -> Any:
        """Return the batch that was packed, leaves (num_envs, ...)."""
        rows = (
            (shape, self.matrices[matrix][first:end])
            for shape, matrix, first, end in self.layout.slots
        )
        leaves = [part.T.reshape(-1, *shape) for shape, part in rows]
        return jax.tree.unflatten(self.layout.structure, leaves)

    def unpack_one(self) -> Any:
        """Return the pytree that is packed as a batch of one."""
        return jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[1:]), self.unpack())

    def to_python(self) -> Any:
        """Return the pytree that is packed as a batch of one: Python's numbers, new arrays."""
        rows = [np.asarray(matrix)[:, 0] for matrix in self.matrices]
        numbers = [row.tolist() for row in rows]  # at once: each conversion costs as much as this
        leaves = [
            rows[matrix][first:end].reshape(shape).copy() if shape else numbers[matrix][first]
            for shape, matrix, first, end in self.layout.slots
        ]
        return jax.tree.unflatten(self.layout.structure, leaves)

    def to_host(self) -> Any:
        """Return the batch as new, writable arrays of NumPy: float64, int64 and bool."""
        arrays: list[np.ndarray] = [
            np.array(matrix, HOST_DTYPES[matrix.dtype.kind]) for matrix in self.matrices
        ]
        leaves = [
            arrays[matrix][first:end].T.reshape(-1, *shape) if shape else arrays[matrix][first]
            for shape, matrix, first, end in self.layout.slots
        ]
        return jax.tree.unflatten(self.layout.structure, leaves)


def pack(batch: Any) -> Packed:
    """Return a batch of pytrees, leaves (num_envs, ...), packed; works under ``jit``."""
    leaves, structure = jax.tree.flatten(batch)
    layout = _layout(structure, tuple((leaf.shape[1:], leaf.dtype) for leaf in leaves))
    columns: list[list[jax.Array]] = [[] for _ in layout.dtypes]
    # The fence: a concatenation would compute each of its parts again for every element.
    for leaf, (_, matrix, *_) in zip(compute_once(leaves), layout.slots, strict=True):
        columns[matrix].append(leaf.reshape(leaf.shape[0], -1).T)
    return Packed(tuple(jnp.concatenate(parts) for parts in columns), layout)


@jax.jit
def pack_one(tree: Any) -> Packed:
    """Return one pytree as a packed batch of one; its leaves are arrays of NumPy."""
    return pack(jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], tree))
