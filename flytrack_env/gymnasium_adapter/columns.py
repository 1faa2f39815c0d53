"""The numbers of a step, sorted by kind, so that few arrays cross from JAX to NumPy."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.fusion import compute_once

FLOATS, INTS, BOOLS = range(3)
HOST_DTYPES = (np.float64, np.int64, np.bool_)  # what Gymnasium makes of Python's own numbers
DEVICE_DTYPES = (jnp.float32, jnp.int32, jnp.bool_)


class Place(NamedTuple):
    """Where a leaf's numbers are: in which block, from which row on, and their shape."""

    block: int
    row: int
    shape: tuple[int, ...]


def _block_of(dtype: Any) -> int:
    if jnp.issubdtype(dtype, jnp.bool_):
        return BOOLS
    return INTS if jnp.issubdtype(dtype, jnp.integer) else FLOATS


class Columns:
    """A pytree of numbers as three blocks of rows: floats, integers and booleans.

    example: such a pytree, arrays or shapes, of one environment.
    """

    def __init__(self, example: Any):
        leaves, self.structure = jax.tree.flatten(example)
        sizes = [0, 0, 0]
        self.places: list[Place] = []
        for leaf in leaves:
            block = _block_of(leaf.dtype)
            self.places.append(Place(block, sizes[block], leaf.shape))
            sizes[block] += math.prod(leaf.shape)

    def gather(self, tree: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return a pytree's blocks, float32, int32 and bool; works under ``jit``.

        tree: of one environment, or of a batch with the environment as the leaves' first axis and as
        the blocks' last one.
        """
        rows: list[list[jax.Array]] = [[], [], []]
        batch: tuple[int, ...] = ()
        # The fence: a concatenation computes what it joins anew, number by number.
        for leaf, place in zip(compute_once(jax.tree.leaves(tree)), self.places, strict=True):
            batch = leaf.shape[: leaf.ndim - len(place.shape)]
            flat = leaf.reshape(*batch, -1).T if batch else leaf.reshape(-1)
            rows[place.block].append(flat.astype(DEVICE_DTYPES[place.block]))
        floats, ints, bools = (
            jnp.concatenate(group) if group else jnp.zeros((0, *batch), dtype)
            for group, dtype in zip(rows, DEVICE_DTYPES, strict=True)
        )
        return floats, ints, bools

    def plain(self, blocks: tuple[jax.Array, ...]) -> Any:
        """Return the pytree of one environment with Python's own numbers; leaves with axes are arrays."""
        numbers = [np.asarray(block).tolist() for block in blocks]
        leaves = [
            np.array(numbers[block][row : row + math.prod(shape)], HOST_DTYPES[block]).reshape(shape)
            if shape
            else numbers[block][row]
            for block, row, shape in self.places
        ]
        return jax.tree.unflatten(self.structure, leaves)

    def batched(self, blocks: tuple[jax.Array, ...]) -> Any:
        """Return the pytree of a batch, leaves (num_envs, ...): new, writable NumPy arrays."""
        arrays: list[np.ndarray] = [
            np.array(block, dtype) for block, dtype in zip(blocks, HOST_DTYPES, strict=True)
        ]
        leaves = []
        for block, row, shape in self.places:
            if shape:
                rows = arrays[block][row : row + math.prod(shape)]
                leaves.append(rows.T.reshape(-1, *shape))
            else:
                leaves.append(arrays[block][row])
        return jax.tree.unflatten(self.structure, leaves)
