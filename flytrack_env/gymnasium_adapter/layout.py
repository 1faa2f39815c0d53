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


class Layout(NamedTuple):
    """Structure of a pytree of arrays: what is needed to take it apart and put it together.

    structure: of the pytree. shapes, dtypes: of its leaves, in their order. Hashable.
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

    def pack(self, tree: Any) -> Packed:
        """Return a pytree as vectors, one per kind."""
        leaves = [jnp.asarray(leaf).reshape(-1) for leaf in jax.tree.leaves(tree)]
        return self._join(leaves)

    def unpack(self, packed: Packed) -> Any:
        """Return the pytree that ``pack`` was given."""
        rows = zip(self._split(packed), self.shapes, strict=True)
        return jax.tree.unflatten(self.structure, [leaf.reshape(shape) for leaf, shape in rows])

    def pack_batch(self, trees: Any) -> Packed:
        """Return a batch, leaves (num_envs, ...), as matrices (rows, num_envs), one per kind.

        The batch is the last axis, so that a scalar per environment stays contiguous.
        """
        # The fence: a concatenation computes what it joins anew, number by number.
        leaves = [leaf.reshape(leaf.shape[0], -1).T for leaf in compute_once(jax.tree.leaves(trees))]
        return self._join(leaves)

    def unpack_batch(self, packed: Packed) -> Any:
        """Return the batch that ``pack_batch`` was given."""
        rows = zip(self._split(packed), self.shapes, strict=True)
        leaves = [leaf.T.reshape(leaf.shape[1], *shape) for leaf, shape in rows]
        return jax.tree.unflatten(self.structure, leaves)

    def _join(self, leaves: list[jax.Array]) -> Packed:
        groups: dict[Any, list[jax.Array]] = {kind: [] for kind in self.kinds}
        for leaf, dtype in zip(leaves, self.dtypes, strict=True):
            groups[dtype].append(leaf)
        return tuple(jnp.concatenate(group) for group in groups.values())

    def _split(self, packed: Packed) -> list[jax.Array]:
        arrays = dict(zip(self.kinds, packed, strict=True))
        starts: dict[Any, int] = {}
        leaves = []
        for shape, dtype in zip(self.shapes, self.dtypes, strict=True):
            start = starts.get(dtype, 0)
            starts[dtype] = start + math.prod(shape)
            leaves.append(arrays[dtype][start : starts[dtype]])
        return leaves
