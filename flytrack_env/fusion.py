"""A boundary that XLA's CPU compiler does not fuse across.

XLA on the CPU fuses a value into each of its users and computes it again in every one of them. A
state of scalar leaves has some fifty outputs per step that share one chain of physics, so that the
chain was compiled fifty times over (measured: 13 times slower). ``lax.optimization_barrier`` is
removed before fusion and does not help. A conditional does: what goes into it is computed once.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import core
from jax.dtypes import float0
from jax.experimental.custom_partitioning import (
    ArrayMapping,
    SdyShardingRule,
    custom_partitioning_p,
)
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jax.interpreters.partial_eval import dce_jaxpr, dce_rules
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from jaxlib.mlir import ir

Tree = TypeVar("Tree")

_compute_once_p = Primitive("flytrack_compute_once")
_compute_once_p.multiple_results = True


_unfused = ContextVar("unfused", default=False)


@contextmanager
def unfused() -> Iterator[None]:
    """Trace within this context what is compiled with ``UNFUSED``: without boundaries.

    For one environment: every value is computed once then, a number at a time.
    """
    token = _unfused.set(True)
    try:
        yield
    finally:
        _unfused.reset(token)


def is_unfused() -> bool:
    """Return whether what is traced now will not be fused."""
    return _unfused.get()


UNFUSED = {"xla_disable_hlo_passes": "fusion"}  # compiler_options of ``jax.jit``


def compute_once(tree: Tree) -> Tree:
    """Return the same pytree of arrays, computed once for all its users.

    The identity, for ``jit``, ``vmap`` and differentiation too; a hint that matters for speed on
    the CPU only.
    """
    leaves, structure = jax.tree.flatten(tree)
    leaves = [jnp.asarray(leaf) for leaf in leaves]
    if is_unfused():
        return jax.tree.unflatten(structure, leaves)
    indices = [i for i, leaf in enumerate(leaves) if leaf.size and _is_number(leaf)]
    if indices:
        fenced = _compute_once_p.bind(*(leaves[i] for i in indices))
        for i, leaf in zip(indices, fenced, strict=True):
            leaves[i] = leaf
    return jax.tree.unflatten(structure, leaves)


def _is_number(leaf: jax.Array) -> bool:
    """Return whether a leaf can be negated: not a typed random key."""
    return not jnp.issubdtype(leaf.dtype, jax.dtypes.extended)


def vary_like(tree: Tree, source: Any) -> Tree:
    """Return a tree whose leaves vary, within ``shard_map``, over all axes that ``source``'s do.

    The same numbers: what begins as a constant and is then carried by a loop needs the type of its
    end.
    """
    axes = frozenset().union(*(jax.typeof(leaf).mat.varying for leaf in jax.tree.leaves(source)))

    def vary(leaf: Any) -> Any:
        missing = tuple(sorted(axes - jax.typeof(leaf).mat.varying))
        return jax.lax.pcast(leaf, missing, to="varying") if missing else leaf

    return jax.tree.map(vary, tree)


def _fence(*leaves: jax.Array) -> tuple[jax.Array, ...]:
    def is_impossible(x: tuple[jax.Array, ...]) -> jax.Array:
        probe = x[0].ravel()[0].astype(jnp.float32)
        return (probe == probe) & (probe != probe)

    def change(x: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        return tuple(jnp.logical_not(leaf) if leaf.dtype == bool else -leaf for leaf in x)

    return jax.lax.while_loop(is_impossible, change, leaves)


def _lower_fence(ctx, *leaves):  # type: ignore[no-untyped-def]
    if _is_partitioned(
        ctx
    ):  # the probe of a loop that never runs would be sent between the devices
        return list(leaves)
    return _lower(_fence, ctx, *leaves)


def _lower(function: Callable[..., Any], ctx: Any, *values: Any) -> Any:
    """Lower a function as on one device: ``shard_map`` checks types that loops here do not keep."""
    plain = [core.ShapedArray(aval.shape, aval.dtype) for aval in ctx.avals_in]
    return mlir.lower_fun(function, multiple_results=True)(ctx.replace(avals_in=plain), *values)


def _is_partitioned(ctx: Any) -> bool:
    """Return whether XLA divides what is lowered now among devices.

    Not in ``pmap``, nor in ``shard_map`` over all axes of its mesh, whose body is that of one
    device.
    """
    context = ctx.module_context.axis_context
    if hasattr(context, "manual_axes"):
        return set(context.manual_axes) != set(context.mesh.axis_names)
    return getattr(context, "num_devices", 1) > 1


def _batch(leaves, axes):  # type: ignore[no-untyped-def]
    return _compute_once_p.bind(*leaves), axes


def _jvp(primals, tangents):  # type: ignore[no-untyped-def]
    # Derivatives are shared as values are. Of integers there are none.
    moving = [
        i
        for i, tangent in enumerate(tangents)
        if type(tangent) is not ad.Zero and tangent.dtype != float0
    ]
    fenced = _compute_once_p.bind(*(tangents[i] for i in moving)) if moving else []
    fenced_at = dict(zip(moving, fenced, strict=True))
    return _compute_once_p.bind(*primals), [
        fenced_at.get(i, tangent) for i, tangent in enumerate(tangents)
    ]


def _transpose(cotangents, *leaves):  # type: ignore[no-untyped-def]
    # What comes back is shared, too: by all that a value was computed from.
    given = [i for i, one in enumerate(cotangents) if type(one) is not ad.Zero]
    fenced = _compute_once_p.bind(*(cotangents[i] for i in given)) if given else []
    fenced_at = dict(zip(given, fenced, strict=True))
    return [fenced_at.get(i, one) for i, one in enumerate(cotangents)]


def _prune(is_used, equation):  # type: ignore[no-untyped-def]
    used = [i for i, one in enumerate(is_used) if one]
    invars, outvars = (
        [variables[i] for i in used] for variables in (equation.invars, equation.outvars)
    )
    return list(is_used), equation.replace(invars=invars, outvars=outvars) if used else None


_compute_once_p.def_impl(lambda *leaves: list(leaves))
_compute_once_p.def_abstract_eval(lambda *avals: list(avals))
batching.primitive_batchers[_compute_once_p] = _batch
ad.primitive_jvps[_compute_once_p] = _jvp
ad.primitive_transposes[_compute_once_p] = _transpose
dce_rules[_compute_once_p] = _prune
mlir.register_lowering(_compute_once_p, lambda ctx, *leaves: list(leaves))
mlir.register_lowering(_compute_once_p, _lower_fence, platform="cpu")


_one_kernel_p = Primitive("flytrack_one_kernel")
_one_kernel_p.multiple_results = True

# What XLA's CPU compiler can put into one function; anything else (a gather, a product of matrices,
# a call of a library) keeps a kernel of its own.
SIMPLE = frozenset(
    """
    abs add add_any and broadcast_in_dim bitcast_convert_type ceil clamp concatenate
    convert_element_type copy cos custom_jvp_call custom_vmap_call div dynamic_slice
    dynamic_update_slice eq exp floor flytrack_compute_once ge gt integer_pow iota is_finite jit
    le log logistic lt max min mul ne neg not or pad pjit population_count pow scan
    rem reshape round rsqrt select_n shift_left shift_right_arithmetic
    shift_right_logical sign sin slice sqrt square squeeze stop_gradient stack sub tanh transpose
    while xor flytrack_one_kernel
    """.split()  # noqa: SIM905, a table
)
MAX_FENCED = 64  # elements
SWITCH = "FLYTRACK_ONE_KERNEL"  # environment variable: 0 compiles without
ATTRIBUTES = {"xla_cpu_small_call": "true", "inlineable": "false"}


_in_kernel = ContextVar("in_kernel", default=False)


def is_in_kernel() -> bool:
    """Return whether what is traced now is to be part of a kernel."""
    return _in_kernel.get()


def has_kernels() -> bool:
    """Return whether what is compiled now can be one kernel: on the CPU, unless switched off.

    A kernel runs on one device, so that explicit mesh axes rule it out.
    """
    is_explicit = AxisType.Explicit in jax.sharding.get_abstract_mesh().axis_types
    return os.environ.get(SWITCH, "1") != "0" and jax.default_backend() == "cpu" and not is_explicit


def is_simple(jaxpr: Any) -> bool:
    """Return whether a (closed) jaxpr holds nothing but operations of ``SIMPLE``."""
    jaxpr = getattr(jaxpr, "jaxpr", jaxpr)
    inner = [value for eqn in jaxpr.eqns for value in eqn.params.values()]
    return all(eqn.primitive.name in SIMPLE for eqn in jaxpr.eqns) and all(
        is_simple(value) for value in inner if hasattr(value, "eqns") or hasattr(value, "jaxpr")
    )


def one_kernel(function: Callable[..., Tree]) -> Callable[..., Tree]:
    """Return a function of pytrees that the CPU runs as one kernel if it is made of ``SIMPLE``.

    Elsewhere, and with 0 in the environment variable of ``SWITCH``, the function itself.
    """

    def wrapped(*args: Any) -> Tree:
        leaves, structure = jax.tree.flatten(args)
        if not has_kernels() or not all(_is_number(jnp.asarray(leaf)) for leaf in leaves):
            return function(*args)

        def flat(*leaves: Any) -> Any:
            return function(*jax.tree.unflatten(structure, leaves))

        return _bind(flat, leaves)

    return wrapped


def _bind(
    function: Callable[..., Tree], leaves: Sequence[Any], element: "_Element | None" = None
) -> Tree:
    """Return the results of a function of leaves, computed by a kernel if it is made of ``SIMPLE``.

    Args:
        element: what the function is the batch of, if it is one.
    """
    # As on one device: loops do not keep the types that shard_map checks.
    avals = [jax.typeof(leaf) for leaf in leaves]
    plain = [core.ShapedArray(aval.shape, aval.dtype, aval.weak_type) for aval in avals]
    token = _in_kernel.set(True)
    try:
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*plain)
    finally:
        _in_kernel.reset(token)
    if not is_simple(closed):
        return function(*leaves)
    # XLA's compiler of such a call fails on an argument that nothing reads.
    jaxpr, is_used = dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars))
    kernel = ClosedJaxpr(jaxpr, closed.consts)
    used = [i for i, one in enumerate(is_used) if one]
    divided = None if element is None else _divided(kernel, used, element)
    results = _one_kernel_p.bind(*(leaves[i] for i in used), jaxpr=kernel, divided=divided)
    return jax.tree.unflatten(jax.tree.structure(shapes), results)


class _Element(NamedTuple):
    """A function of one element of a batch, and the axis of the batch in each argument.

    The axis is None for an argument that all elements share. In the results the batch is the last
    axis.
    """

    jaxpr: ClosedJaxpr
    dims: tuple[int | None, ...]

    def batch(self) -> Callable[..., Any]:
        """Return the function of a batch."""
        axes = [aval.ndim for aval in self.jaxpr.out_avals]
        return jax.vmap(jaxpr_as_fun(self.jaxpr), in_axes=self.dims, out_axes=axes)


def _divided(kernel: ClosedJaxpr, used: Sequence[int], element: _Element) -> ClosedJaxpr:
    """Return a kernel of a batch as an operation that XLA divides among devices along the batch.

    Left to itself it divides what is within the kernel, and its compiler of such a call has no
    collectives.

    Args:
        used: indices of the batch's arguments that the kernel has.
    """
    dims = [element.dims[i] for i in used]
    partial_element = element._replace(
        dims=tuple(dim if i in used else None for i, dim in enumerate(element.dims))
    )

    def part(*leaves: jax.Array) -> Any:
        leaf_at = dict(zip(used, leaves, strict=True))
        avals = enumerate(partial_element.jaxpr.in_avals)
        return _bind(
            partial_element.batch(),
            [leaf_at[i] if i in leaf_at else jnp.zeros(a.shape, a.dtype) for i, a in avals],
        )

    def partition(mesh: Any, arguments: Any, results: Any) -> tuple[Any, ...]:
        shardings = [[shape.sharding for shape in shapes] for shapes in (results, arguments)]
        return mesh, part, *shardings

    def mapping(name: str, ndim: int, batch: int | None) -> ArrayMapping:
        return ArrayMapping(
            *("batch" if axis == batch else f"{name}x{axis}" for axis in range(ndim))
        )

    arguments = [
        mapping(f"a{i}", aval.ndim, dim)
        for i, (aval, dim) in enumerate(zip(kernel.in_avals, dims, strict=True))
    ]
    results = [
        mapping(f"r{i}", aval.ndim, aval.ndim - 1) for i, aval in enumerate(kernel.out_avals)
    ]
    # In the order in which they occur, as Shardy asks.
    axes = (axis for array in (*arguments, *results) for axis in array)
    whole = tuple(dict.fromkeys(axis for axis in axes if axis != "batch"))
    rule = SdyShardingRule(tuple(arguments), tuple(results), need_replication_factors=whole)

    def operation(*leaves: jax.Array) -> list[jax.Array]:
        return custom_partitioning_p.bind(
            *leaves,
            call=kernel,
            partition=partition,
            propagate_user_sharding=None,
            infer_sharding_from_operands=None,
            decode_shardings=True,
            sharding_rule=rule,
            in_tree=jax.tree.structure([0] * len(arguments)),
            out_tree=jax.tree.structure([0] * len(results)),
            static_args=(),
        )

    return jax.make_jaxpr(operation)(*kernel.in_avals)


def _batch_kernel(args, axes, *, jaxpr, divided):  # type: ignore[no-untyped-def]
    del divided  # a batch of batches is divided along the outer one
    # The batch is the last axis, so that each component of a vector is contiguous.
    element = _Element(jaxpr, tuple(axes))
    return _bind(element.batch(), args, element), [aval.ndim for aval in jaxpr.out_avals]


def _jvp_kernel(primals, tangents, *, jaxpr, divided):  # type: ignore[no-untyped-def]
    moves = [type(tangent) is not ad.Zero for tangent in tangents]
    directions = [tangent for tangent, is_moving in zip(tangents, moves, strict=True) if is_moving]

    def derivative(primals: Any, directions: Any) -> Any:
        def of_moving(*moving: Any) -> Any:
            moved_primals = iter(moving)
            return jaxpr_as_fun(jaxpr)(
                *(
                    next(moved_primals) if is_moving else primal
                    for is_moving, primal in zip(moves, primals, strict=True)
                )
            )

        moving = [primal for primal, is_moving in zip(primals, moves, strict=True) if is_moving]
        return jax.jvp(of_moving, moving, directions)[1]

    # Apart, since a batch of directions has one result.
    return _one_kernel_p.bind(*primals, jaxpr=jaxpr, divided=divided), derivative(
        list(primals), directions
    )


def _lower_kernel(ctx, *args, jaxpr, divided):  # type: ignore[no-untyped-def]
    if _is_partitioned(ctx):
        return _lower(jaxpr_as_fun(divided or jaxpr), ctx, *args)
    # XLA's compiler of such a call aborts on an argument that nothing reads, and simplifies reads
    # away that JAX sees; it does on some constants, too. So one more result reads something of each
    # argument, and what is small, as parameters are, is fenced.
    small = [i for i, aval in enumerate(ctx.avals_in) if 0 < aval.size <= MAX_FENCED]
    argument_at = dict(enumerate(args))
    if small:
        avals = [ctx.avals_in[i] for i in small]
        fenced = _lower(
            _fence, ctx.replace(avals_in=avals, avals_out=avals), *(argument_at[i] for i in small)
        )
        argument_at |= dict(zip(small, fenced, strict=True))

    def reading(*leaves: jax.Array) -> list[jax.Array]:
        read = [leaf.ravel()[0].astype(jnp.float32) for leaf in leaves if leaf.size]
        return [*jaxpr_as_fun(jaxpr)(*leaves), sum(read, jnp.float32(0.0))]

    calling = ctx.replace(avals_out=[*ctx.avals_out, core.ShapedArray((), jnp.float32)])
    *results, _ = _lower(jax.jit(reading), calling, *argument_at.values())
    call = results[0].owner
    call.attributes["mhlo.frontend_attributes"] = ir.DictAttr.get(
        {name: ir.StringAttr.get(value) for name, value in ATTRIBUTES.items()}
    )
    return results


def _infer_kernel(*avals, jaxpr, divided):  # type: ignore[no-untyped-def]
    del divided
    placed = [aval for aval in avals if aval.mat.varying]
    if not placed:
        return list(jaxpr.out_avals)
    # Within shard_map a result varies over the axes that any argument varies over.
    manual_axes = type(placed[0].mat)(
        varying=frozenset().union(*(aval.mat.varying for aval in placed))
    )
    mesh = placed[0].sharding.mesh

    def vary(aval: Any) -> Any:
        sharding = NamedSharding(mesh, PartitionSpec(*[None] * aval.ndim))
        return aval.update(sharding=sharding, manual_axis_type=manual_axes)

    return [vary(aval) for aval in jaxpr.out_avals]


def _inlined(ctx, *args, jaxpr, divided):  # type: ignore[no-untyped-def]
    return _lower(jaxpr_as_fun(jaxpr), ctx, *args)


_one_kernel_p.def_impl(lambda *leaves, jaxpr, divided: jax.jit(jaxpr_as_fun(jaxpr))(*leaves))
_one_kernel_p.def_abstract_eval(_infer_kernel)
batching.primitive_batchers[_one_kernel_p] = _batch_kernel
ad.primitive_jvps[_one_kernel_p] = _jvp_kernel
mlir.register_lowering(_one_kernel_p, _inlined)
mlir.register_lowering(_one_kernel_p, _lower_kernel, platform="cpu")
