"""Pytrees of many small leaves as a few arrays, one per dtype.

Handing an array to a compiled function and taking one from it costs about a microsecond; a state
has some fifty leaves and the parameters as many again.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.fusion import compute_once

Packed = tuple[jax.Array, ...]
# float32, int32 and bool, as what Gymnasium makes of Python's own numbers.
HOST_DTYPES = {"f": np.float64, "i": np.int64, "b": np.bool_}


class Layout(NamedTuple):
    """Structure of a pytree of arrays, with which it is packed and unpacked. Hashable.

    structure: of the pytree. shapes, dtypes: of its leaves, in their order.
    """

    structure: Any
    shapes: tuple[tuple[int, ...], ...]
    dtypes: tuple[Any, ...]

    @classmethod
    def of(cls, tree: Any) -> "Layout":
        """Return the layout of a pytree of arrays, numbers or shapes."""
        leaves, structure = jax.tree.flatten(tree)
        forms = ((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
        return cls(structure, *zip(*forms, strict=True))

    @property
    def kinds(self) -> tuple[Any, ...]:
        """The dtypes that occur, each once: one array of a packed pytree each."""
        return tuple(dict.fromkeys(self.dtypes))

    @property
    def places(self) -> list[tuple[int, slice]]:
        """Which array of a packed pytree holds each leaf, and in which rows."""
        ends, places = dict.fromkeys(self.kinds, 0), []
        for shape, dtype in zip(self.shapes, self.dtypes, strict=True):
            start, ends[dtype] = ends[dtype], ends[dtype] + math.prod(shape)
            places.append((self.kinds.index(dtype), slice(start, ends[dtype])))
        return places

    def pack(self, tree: Any) -> Packed:
        """Return a pytree as vectors, one per kind."""
        return self._join([jnp.asarray(leaf).reshape(-1) for leaf in jax.tree.leaves(tree)])

    def unpack(self, packed: Packed) -> Any:
        """Return the pytree that ``pack`` was given."""
        rows = zip(self.places, self.shapes, strict=True)
        leaves = [packed[kind][place].reshape(shape) for (kind, place), shape in rows]
        return jax.tree.unflatten(self.structure, leaves)

    def pack_batch(self, trees: Any) -> Packed:
        """Return a batch, leaves (num_envs, ...), as matrices (rows, num_envs), one per kind.

        The batch is the last axis, so that a scalar per environment stays contiguous.
        """
        # The fence: a concatenation would compute each of its parts again for every element.
        return self._join(
            [leaf.reshape(leaf.shape[0], -1).T for leaf in compute_once(jax.tree.leaves(trees))]
        )

    def unpack_batch(self, packed: Packed) -> Any:
        """Return the batch that ``pack_batch`` was given."""
        rows = zip(self.places, self.shapes, strict=True)
        leaves = [packed[kind][place].T.reshape(-1, *shape) for (kind, place), shape in rows]
        return jax.tree.unflatten(self.structure, leaves)

    def _join(self, leaves: list[jax.Array]) -> Packed:
        groups: dict[Any, list[jax.Array]] = {kind: [] for kind in self.kinds}
        for leaf, dtype in zip(leaves, self.dtypes, strict=True):
            groups[dtype].append(leaf)
        return tuple(jnp.concatenate(group) for group in groups.values())


class Columns:
    """The numbers of a step on their way to NumPy: few arrays of float32, int32 and bool.

    example: a pytree of arrays or shapes, of one environment.
    """

    def __init__(self, example: Any):
        dtypes = {"f": jnp.float32, "i": jnp.int32, "u": jnp.int32, "b": jnp.bool_}
        self.layout = Layout.of(
            jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, dtypes[leaf.dtype.kind]), example)
        )
        self.host_dtypes = [HOST_DTYPES[np.dtype(kind).kind] for kind in self.layout.kinds]
        self.places = list(zip(self.layout.places, self.layout.shapes, strict=True))

    def gather(self, tree: Any, is_batch: bool = False) -> Packed:
        """Return a pytree, of one environment or a batch, packed; works under ``jit``."""
        leaves = zip(compute_once(jax.tree.leaves(tree)), self.layout.dtypes, strict=True)
        cast = [leaf.astype(dtype) for leaf, dtype in leaves]
        return self.layout.pack_batch(cast) if is_batch else self.layout.pack(cast)

    def plain(self, packed: Packed) -> Any:
        """Return the pytree of one environment with Python's own numbers; leaves with axes are arrays."""
        numbers = [np.asarray(array).tolist() for array in packed]
        leaves = [
            np.array(numbers[kind][place], self.host_dtypes[kind]).reshape(shape)
            if shape
            else numbers[kind][place.start]
            for (kind, place), shape in self.places
        ]
        return jax.tree.unflatten(self.layout.structure, leaves)

    def batched(self, packed: Packed) -> Any:
        """Return the pytree of a batch, leaves (num_envs, ...): new, writable NumPy arrays."""
        arrays: list[np.ndarray] = [
            np.array(array, dtype) for array, dtype in zip(packed, self.host_dtypes, strict=True)
        ]
        leaves = [
            arrays[kind][place].T.reshape(-1, *shape) if shape else arrays[kind][place.start]
            for (kind, place), shape in self.places
        ]
        return jax.tree.unflatten(self.layout.structure, leaves)
