"""A boundary that XLA's CPU compiler does not fuse across.

XLA on the CPU fuses a value into each of its users and computes it again in every one of them. A
state of scalar leaves has some fifty outputs per step that share one chain of physics, so that the
chain was compiled fifty times over (measured: 13 times slower). ``lax.optimization_barrier`` is
removed before fusion and does not help. A conditional does: what goes into it is computed once.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

Tree = TypeVar("Tree")

_compute_once_p = Primitive("flytrack_compute_once")
_compute_once_p.multiple_results = True


def compute_once(tree: Tree) -> Tree:
    """Return the same pytree of arrays, computed once for all its users.

    The identity, for ``jit``, ``vmap`` and differentiation too; a hint that matters for speed on the
    CPU only.
    """
    leaves, structure = jax.tree.flatten(tree)
    leaves = [jnp.asarray(leaf) for leaf in leaves]
    places = [i for i, leaf in enumerate(leaves) if leaf.size and _is_number(leaf)]
    if places:
        fenced = _compute_once_p.bind(*(leaves[i] for i in places))
        for i, leaf in zip(places, fenced, strict=True):
            leaves[i] = leaf
    return jax.tree.unflatten(structure, leaves)


def _is_number(leaf: jax.Array) -> bool:
    """Return whether a leaf can be negated: not a typed random key."""
    return not jnp.issubdtype(leaf.dtype, jax.dtypes.extended)


def _fence(*leaves: jax.Array) -> tuple[jax.Array, ...]:
    def is_impossible(x: tuple[jax.Array, ...]) -> jax.Array:
        probe = x[0].ravel()[0].astype(jnp.float32)
        return (probe == probe) & (probe != probe)

    def change(x: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        return tuple(jnp.logical_not(leaf) if leaf.dtype == bool else -leaf for leaf in x)

    return jax.lax.while_loop(is_impossible, change, leaves)


def _batch(leaves, axes):  # type: ignore[no-untyped-def]
    return _compute_once_p.bind(*leaves), axes


def _jvp(primals, tangents):  # type: ignore[no-untyped-def]
    return _compute_once_p.bind(*primals), list(tangents)


_compute_once_p.def_impl(lambda *leaves: list(leaves))
_compute_once_p.def_abstract_eval(lambda *avals: list(avals))
batching.primitive_batchers[_compute_once_p] = _batch
ad.primitive_jvps[_compute_once_p] = _jvp
mlir.register_lowering(_compute_once_p, lambda ctx, *leaves: list(leaves))
mlir.register_lowering(_compute_once_p, mlir.lower_fun(_fence, multiple_results=True), platform="cpu")
