"""Programs in place of plants that are made to harm: endless, huge, deep, or not what they say."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from benchmarks.reliability.strangers.programs import (
    ACTION,
    FULL,
    Step,
    exported,
    fall,
    hostile_programs,
    serialized,
)

OPERATIONS, DEPTH = 3000, 60
Array = jax.Array


def _long(x: Array, u: Array) -> Array:
    """A loop that ends, in minutes."""
    return jax.lax.fori_loop(0, 2**31 - 1, lambda _, state: 0.999 * state + u.sum(), x)


def _nested(x: Array, u: Array) -> Array:
    """Loops in loops, each short."""

    def loop(depth: int, state: Array) -> Array:
        if depth == 0:
            return 0.999 * state
        return jax.lax.fori_loop(0, 4, lambda _, inner: loop(depth - 1, inner), state)

    return loop(16, x)


def _many(x: Array, u: Array) -> Array:
    """More operations than a plant has."""
    for number in range(OPERATIONS):
        x = jnp.sin(x) * (1.0 + number)
    return 0.0 * x


def _tangled(x: Array, u: Array) -> Array:
    """Few operations, each of both results of the one before: written out, 2^60 of them."""
    for _ in range(60):
        x = jnp.sin(x) + jnp.cos(x[::-1])
    return x * 0.0


def _deep(x: Array, u: Array) -> Array:
    """Conditions in conditions."""

    def choose(depth: int, state: Array) -> Array:
        if depth == 0:
            return state
        return jax.lax.cond(state[0] > depth, lambda one: choose(depth - 1, one), lambda one: one, state)

    return choose(DEPTH, x)


def _remembers(x: Array, u: Array) -> Array:
    """A constant of 8 MiB."""
    table = jnp.asarray(np.arange(2**21, dtype=np.float32))
    return x + 0.0 * table[jnp.int32(u[0])] + 0.0 * table.sum()


def _unfolded(x: Array, u: Array) -> Array:
    """A constant that the compiler could work out: of 64 GiB."""
    return x + 0.0 * jnp.sum(jnp.ones((2**17, 2**17)) * 2.0) + 0.0 * u.sum()


def _wide(x: Array, u: Array) -> Array:
    """An array of 16 GiB on the way."""
    wide = jnp.broadcast_to(x[:1], (2**16, 2**16)).cumsum(axis=0)
    return x + 0.0 * jnp.sort(wide, axis=1)[0, 0]


def _multiplies(x: Array, u: Array) -> Array:
    """A product of matrices of hours."""
    matrix = jnp.full((2**13, 2**13), x[2])
    return x + 0.0 * jax.lax.fori_loop(0, 1000, lambda _, state: state @ matrix, matrix)[0, 0]


def _convolves(x: Array, u: Array) -> Array:
    image = jnp.full((1, 1, 2**11, 2**11), x[2])
    kernel = jnp.full((1, 1, 2**10, 2**10), u[0])
    return x + 0.0 * jax.lax.conv(image, kernel, (1, 1), "SAME").sum()


def _sorts(x: Array, u: Array) -> Array:
    """Many equal numbers, sorted by two keys."""
    wide = jnp.broadcast_to(x, (2**12, len(x))).reshape(-1)
    return x + 0.0 * jax.lax.sort((wide, wide[::-1]), num_keys=2)[0][0]


def _gathers(x: Array, u: Array) -> Array:
    """Places far beyond an array, which nobody checks."""
    at = jnp.int32(u[0]) + jnp.array([2**30, -(2**30)])
    return x + 0.0 * x.at[at].get(mode="promise_in_bounds").sum()


def _scatters(x: Array, u: Array) -> Array:
    at = jnp.int32(u[0]) + jnp.array([2**30, -(2**30)])
    return x.at[at].set(0.0, mode="promise_in_bounds")


def _slices(x: Array, u: Array) -> Array:
    return jax.lax.dynamic_slice(x, (jnp.int32(2**31 - 1),), (FULL,))


def _divides(x: Array, u: Array) -> Array:
    """A division of whole numbers by 0, and of the least by -1, which end a process in C."""
    zero = jnp.int32(u[0])
    found = (
        jnp.int32(7) // zero + jnp.int32(-(2**31)) // (zero - 1) + jax.lax.rem(jnp.int32(-(2**31)), zero - 1)
    )
    return x + 0.0 * found


def called(depth: int) -> Step:
    """Return functions that call one another, which the compiler takes apart by calling itself."""

    def step(x: Array, u: Array) -> Array:
        return x

    def outer(inner: Step) -> Step:
        return jax.jit(lambda x, u: 1.0 * inner(x, u))

    for _ in range(depth):
        step = outer(step)
    return step


STEPS: tuple[Step, ...] = (
    *(_long, _nested, _many, _tangled, _deep, _remembers, _unfolded, _wide, _multiplies, _convolves, _sorts),
    *(_gathers, _scatters, _slices, _divides),
    *(called(20), called(90)),
)


def _changed(**fields: object) -> bytes:
    """Return a plant that says other things of itself."""
    return bytes(dataclasses.replace(exported(fall), **fields).serialize())  # type: ignore[arg-type]


def _nested_arguments(depth: int) -> bytes:
    """Return a plant whose arguments lie in lists in lists."""

    def step(x: list, u: Array) -> Array:  # type: ignore[type-arg]
        while isinstance(x, list):
            (x,) = x
        return x

    form = jax.ShapeDtypeStruct((FULL,), jnp.float32)
    for _ in range(depth):
        form = [form]  # type: ignore[assignment]
    return bytes(
        export.export(jax.jit(step), platforms=["cpu"])(
            form, jax.ShapeDtypeStruct((ACTION,), jnp.float32)
        ).serialize()
    )


def _otherwise() -> list[bytes]:
    """Return plants of another kind than they say, or of parts that nobody asks for."""
    several = [["cpu", "cuda"], ["cuda", "cpu"], ["cpu", "cuda", "rocm", "tpu"], ["tpu"]]
    found = [serialized(fall, platforms=platforms) for platforms in several]
    versions = [_changed(calling_convention_version=version) for version in (0, 8, 2**15 - 1)]
    changed = [
        _changed(nr_devices=2),
        _changed(fun_name="\x1b[31m" * 9000),
        _changed(platforms=("cpu",) * 5000),
        _changed(module_kept_var_idx=(0,)),
        _changed(module_kept_var_idx=(1, 0)),
        _changed(module_kept_var_idx=(0, 1, 2, 3)),
        _changed(uses_global_constants=True),
        _changed(mlir_module_serialized=b""),
        _changed(mlir_module_serialized=b"ML\xefR" + b"\xff" * 2**20),
        _changed(in_avals=()),
        _nested_arguments(50),
        bytes(
            export.export(jax.jit(fall))(
                *[jax.ShapeDtypeStruct((one,), jnp.float32) for one in (FULL, ACTION)]
            ).serialize(vjp_order=2)
        ),
    ]
    return [*found, *versions, *changed]


def on_purpose(contents: list[bytes]) -> list[bytes]:
    """Return programs that are made to harm, and bytes around a plant that lie."""
    content = contents[0]
    around = [content * 3, content + bytes(2**22), content[:64], bytes(2**16), b"\xff" * 2**16]
    around += [bytes(number) + content for number in (1, 4, 8)]
    around += [content[:4] + number + content[8:] for number in (b"\xff" * 4, bytes(4), b"\xff\xff\xff\x7f")]
    return [*hostile_programs(), *map(serialized, STEPS), *_otherwise(), *around]
