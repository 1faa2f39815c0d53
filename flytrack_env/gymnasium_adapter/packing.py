"""Batches of pytrees packed as one matrix of 32-bit words.

Handing an array to a compiled function, or taking one from it, costs one to four microseconds; a
state has some fifty leaves and the parameters as many again.
"""

import math
import operator
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.fusion import compute_once

# What Gymnasium makes of Python's own numbers, by the kind of a dtype.
HOST_DTYPES = {"f": np.float64, "i": np.int64, "u": np.int64, "b": np.bool_}
# Of Python's struct, of each dtype's words. True is the word 1.0, whose third byte is not zero.
FORMATS = {
    np.dtype(name): code
    for name, code in {
        "float32": "f",
        "int32": "i",
        "uint32": "I",
        "float64": "d",
        "int64": "q",
        "uint64": "Q",
        "bool": "2x?x",
    }.items()
}
WORD = np.dtype(np.float32)  # most leaves are of this dtype; of others, the bits are moved as it


@dataclass(frozen=True, eq=False)
class Layout:
    """Structure of a pytree, and where its leaves are: those of one dtype are neighbours.

    Equal layouts are one object: every call of a compiled function hashes and compares them.

    Attributes:
        groups: each dtype, with the first row of its words and the row after its last.
        slots: a leaf's shape, group, first value of the group, and the value after its last.
    """

    structure: Any
    groups: tuple[tuple[Any, int, int], ...]
    slots: tuple[tuple[tuple[int, ...], int, int, int], ...]

    @property
    def num_rows(self) -> int:
        """Number of words of one pytree."""
        return int(self.groups[-1][2])

    def __reduce__(self) -> tuple[Any, ...]:
        forms = tuple((shape, self.groups[group][0]) for shape, group, *_ in self.slots)
        return _layout, (self.structure, forms)


@cache
def _layout(structure: Any, forms: tuple[tuple[tuple[int, ...], Any], ...]) -> Layout:
    dtypes = list(dict.fromkeys(dtype for _, dtype in forms))
    counts, slots = [0] * len(dtypes), []
    for shape, dtype in forms:
        group = dtypes.index(dtype)
        first, counts[group] = counts[group], counts[group] + math.prod(shape)
        slots.append((shape, group, first, counts[group]))
    groups, end = [], 0
    for dtype, count in zip(dtypes, counts, strict=True):
        first, end = end, end + count * _words_per_value(dtype)
        groups.append((dtype, first, end))
    return Layout(structure, tuple(groups), tuple(slots))


def _words_per_value(dtype: Any) -> int:
    return max(dtype.itemsize // WORD.itemsize, 1)


def _as_pairs(words: Any, size: int) -> Any:
    """Return the words of values, (rows, num_envs), a value's own beside each other."""
    return words.reshape(-1, size, words.shape[1]).swapaxes(1, 2)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Packed:
    """A batch of pytrees as a matrix (rows, num_envs).

    A number of all environments is contiguous.

    Attributes:
        words: of all leaves; those of flags are 0.0 or 1.0.
    """

    words: jax.Array | np.ndarray
    layout: Layout = field(metadata={"static": True})

    def unpack(self) -> Any:
        """Return the batch that was packed, leaves (num_envs, ...); works under ``jit``."""

        def restore(dtype: Any, words: Any) -> Any:
            if dtype.kind == "b":
                return words != 0
            size = _words_per_value(dtype)
            return jax.lax.bitcast_convert_type(
                words if size == 1 else _as_pairs(words, size), dtype
            )

        values = [restore(dtype, self.words[first:end]) for dtype, first, end in self.layout.groups]
        leaves = [
            values[group][first:end].T.reshape(-1, *shape)
            for shape, group, first, end in self.layout.slots
        ]
        return jax.tree.unflatten(self.layout.structure, leaves)

    def unpack_one(self) -> Any:
        """Return the pytree that is packed as a batch of one."""
        return jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[1:]), self.unpack())

    def to_host(self) -> Any:
        """Return the batch as new, writable arrays of NumPy: float64, int64 and bool."""
        words = np.asarray(self.words)

        def restore(dtype: Any, words: np.ndarray) -> np.ndarray:
            if dtype.kind == "b":
                return words != 0
            size, num_envs = _words_per_value(dtype), words.shape[1]
            if size > 1:
                words = np.ascontiguousarray(_as_pairs(words, size)).reshape(-1, size * num_envs)
            return words.view(dtype).astype(HOST_DTYPES[dtype.kind])

        arrays = [restore(dtype, words[first:end]) for dtype, first, end in self.layout.groups]
        leaves = [
            arrays[group][first:end].T.reshape(-1, *shape) if shape else arrays[group][first]
            for shape, group, first, end in self.layout.slots
        ]
        return jax.tree.unflatten(self.layout.structure, leaves)


def from_words(words: jax.Array, layout: Layout) -> Packed:
    """Return the packed batch of these words; rows beyond are left out."""
    return Packed(words[: layout.num_rows], layout)


def make_reader(layout: Layout, first_row: int) -> Callable[[Any], tuple[Any, ...]]:
    """Return a function of a buffer of words that returns the leaves as Python's numbers.

    Args:
        layout: of scalars.
        first_row: at which their words begin in the buffer.

    Raises:
        ValueError: leaves that are no scalars.
    """
    shapes = [shape for shape, *_ in layout.slots]
    if any(shapes):
        raise ValueError(f"layout: found leaves of shapes {shapes}, expected scalars")
    counts = [(end - first) // _words_per_value(dtype) for dtype, first, end in layout.groups]
    formats = [
        count * FORMATS[dtype] for count, (dtype, *_) in zip(counts, layout.groups, strict=True)
    ]
    read = struct.Struct(f"<{first_row * WORD.itemsize}x{''.join(formats)}").unpack_from
    starts = np.cumsum([0, *counts])
    pick = operator.itemgetter(*(int(starts[group]) + first for _, group, first, _ in layout.slots))
    return lambda buffer: pick(read(buffer))


def pack(batch: Any) -> Packed:
    """Return a batch of pytrees, leaves (num_envs, ...), packed; works under ``jit``."""
    leaves, structure = jax.tree.flatten(batch)
    layout = _layout(structure, tuple((leaf.shape[1:], leaf.dtype) for leaf in leaves))
    columns: list[list[jax.Array]] = [[] for _ in layout.groups]
    # The fence: a concatenation would compute each of its parts again for every element.
    for leaf, (_, group, *_) in zip(compute_once(leaves), layout.slots, strict=True):
        is_flag = leaf.dtype.kind == "b"
        rows = leaf.astype(WORD) if is_flag else jax.lax.bitcast_convert_type(leaf, WORD)
        columns[group].append(rows.reshape(leaf.shape[0], -1).T)
    return Packed(jnp.concatenate([part for parts in columns for part in parts]), layout)


def pack_one(tree: Any) -> Packed:
    """Return one pytree as a packed batch of one."""
    return pack(jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], tree))
