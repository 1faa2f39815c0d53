"""Black boxes to damage: small plants as artifacts, and programs that mean no good."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import export

from benchmarks.reliability.strangers.noise import Rng, damage

Step = Callable[..., Any]

CALLBACK = "xla_ffi_python_cpu_callback"
FULL, REDUCED, ACTION = 21, 18, 4
HEAD_SHARE = 0.3  # of damage that goes to what stands around the program


def exported(
    step: Step, sizes: tuple[int, ...] = (FULL, ACTION), dtype: Any = jnp.float32, **options: Any
) -> export.Exported:
    """Return a function as an artifact."""
    options.setdefault("platforms", ["cpu"])
    forms = [jax.ShapeDtypeStruct((size,), dtype) for size in sizes]
    return export.export(jax.jit(step), **options)(*forms)


def serialized(step: Step, *arguments: Any, **options: Any) -> bytes:
    """Return a function as an artifact's bytes; arguments and options: of ``exported``."""
    return bytes(exported(step, *arguments, **options).serialize())


def fall(x: jax.Array, u: jax.Array) -> jax.Array:
    """Return the state of what falls, pushed about by the sticks."""
    velocity = x[3:6] + 0.01 * jnp.array([u[0], u[1], u[3] - 9.81])
    return x.at[0:3].add(0.01 * velocity).at[3:6].set(velocity).at[-1].add(-1e-4)


def _turn(x: jax.Array, u: jax.Array) -> jax.Array:
    quat = x[9:13] + 0.005 * jnp.roll(x[9:13], 1) * jnp.sin(u[0])
    return jnp.where(jnp.arange(len(x)) < 9, x, x + 0.0).at[9:13].set(quat / jnp.linalg.norm(quat))


def _substeps(x: jax.Array, u: jax.Array) -> jax.Array:
    return jax.lax.fori_loop(0, 4, lambda _, state: 0.999 * state, x) + 0.0 * u.sum()


def write_plants(folder: Path) -> None:
    """Write small plants: a few operations, a loop, and one of the reduced state."""
    contents = [
        serialized(fall),
        serialized(_substeps),
        serialized(_turn),
        serialized(fall, (REDUCED, ACTION)),
    ]
    for number, content in enumerate(contents):
        (folder / f"plant{number}.bin").write_bytes(content)


def _forever(x: jax.Array, u: jax.Array) -> jax.Array:
    return jax.lax.while_loop(lambda state: state[0] >= 0.0, lambda state: 0.5 * state + 1.0, x)


def _hungry(x: jax.Array, u: jax.Array) -> jax.Array:
    grid = jnp.sin(jnp.arange(2**20, dtype=jnp.float32)[:, None] * jnp.arange(2**10) * x[9])
    return x + jnp.sum(jnp.sort(grid, axis=0)[::2])


def _calling(target: str) -> Step:
    def step(x: jax.Array, u: jax.Array) -> jax.Array:
        return jax.ffi.ffi_call(target, jax.ShapeDtypeStruct(x.shape, x.dtype))(x)

    return step


def hostile_programs() -> list[bytes]:
    """Return programs that hang, eat memory, call Python, LAPACK or nothing there is, or are no plant."""
    trusted = {name: [export.DisabledSafetyCheck.custom_call(name)] for name in (CALLBACK, "no_such_target")}
    return [
        serialized(_forever),
        serialized(_hungry),
        *(serialized(_calling(name), disabled_checks=checks) for name, checks in trusted.items()),
        serialized(lambda x, u: x.at[:4].set(jnp.linalg.svd(jnp.eye(4) + u, compute_uv=False))),
        serialized(lambda x, u: x.at[8].set(x[8] / x[0])),
        serialized(fall, platforms=["cuda"]),
        serialized(lambda x, u: x, (20, ACTION)),
        serialized(lambda x, u: (x, u)),
        serialized(lambda x, u: x, dtype=jnp.float16),
        serialized(lambda x: x, (FULL,)),
    ]


def damage_program(rng: Rng, contents: list[bytes]) -> bytes:
    """Return one of some artifacts, with damage to its program or to what stands around it."""
    content = contents[int(rng.integers(len(contents)))]
    start = content.find(b"ML\xefR")  # of MLIR's bytecode
    if start < 0 or rng.random() < 0.2:
        return damage(rng, contents)
    end = len(content) - 200 if len(content) - start > 400 else len(content)
    if rng.random() < HEAD_SHARE:
        head = bytearray(content)
        for _ in range(int(rng.integers(1, 4))):
            at = int(rng.choice([*range(start), *range(end, len(content))]))
            head[at] = int(rng.choice([0, 1, 2, 255, int(rng.integers(256))]))
        return bytes(head)
    program = bytearray(content[start:end])
    for _ in range(int(rng.integers(1, 4))):
        program[int(rng.integers(len(program)))] = int(rng.integers(256))
    return content[:start] + bytes(program) + content[end:]
