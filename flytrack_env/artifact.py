"""Checks of a black box's file: an artifact of ``jax.export`` is read, inspected, and run once.

Imports JAX and nothing of this package: ``flytrack_env.sandbox`` runs this file alone.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.extend import mlir
from jax.extend.mlir import ir
from jax.interpreters.mlir import make_ir_context

# Custom calls that XLA knows: they annotate values and are gone after compilation.
HARMLESS_CALLS = (
    "Sharding",
    "SPMDFullToShardShape",
    "SPMDShardToFullShape",
    "annotate_device_placement",
)
# characters quoted from a file, or from an error message that it may have written
MAX_TEXT_LENGTH = 500
MAX_NAMED = 5
# The compiler recurses into nested loops and calls, and overflows its stack at some depth. A file
# is tried inside this many loops, so that one that only just compiles is refused rather than crash
# a larger program.
TRIAL_LOOPS = 16


class ArtifactError(ValueError):
    """A file that is not a plant.

    The message says what was found and what was expected, and does not name the file.
    """


def _printable(text: str) -> str:
    text = " ".join(text.split())[:MAX_TEXT_LENGTH]
    return text if text.isprintable() else ascii(text)[1:-1]


def _not_readable(content: bytes, error: Exception) -> ArtifactError:
    reason = _printable(f"{type(error).__name__}: {error}")
    return ArtifactError(
        f"found {len(content)} bytes that cannot be deserialised ({reason}), "
        "expected a jax.export artifact"
    )


def deserialize(content: bytes) -> export.Exported:
    """Return the artifact in a file's bytes.

    Raises:
        ArtifactError: damaged, or no artifact.
    """
    try:
        return export.deserialize(bytearray(content))
    except (
        Exception
    ) as error:  # damaged bytes raise almost anything: struct.error, IndexError, MLIRError
        raise _not_readable(content, error) from error


def check_signature(exported: export.Exported, sizes: Sequence[int], num_actions: int) -> int:
    """Return the number of components of an artifact's state, one of ``sizes``.

    Raises:
        ArtifactError: of another signature.
    """
    inputs = [(aval.shape, aval.dtype) for aval in exported.in_avals]
    outputs = [(aval.shape, aval.dtype) for aval in exported.out_avals]
    for size in sizes:
        state, action = ((size,), np.dtype(np.float32)), ((num_actions,), np.dtype(np.float32))
        if inputs == [state, action] and outputs == [state]:
            return size
    found = (
        f"({', '.join(map(str, exported.in_avals))}) -> ({', '.join(map(str, exported.out_avals))})"
    )
    raise ArtifactError(
        f"signature: found {_printable(found)}, expected (float32[n], float32[{num_actions}]) -> "
        f"(float32[n]) with n = {' or '.join(map(str, sizes))}"
    )


def _operations(operation: Any) -> Iterator[Any]:
    """Yield an operation and all operations inside it."""
    pending = [operation]
    while pending:
        current = pending.pop()
        yield current
        pending += [
            inner.operation for region in current.regions for block in region for inner in block
        ]


def check_pure(content: bytes, exported: export.Exported, is_trusted: bool) -> None:
    """Raise ArtifactError if an artifact calls native code other than its own.

    Args:
        is_trusted: allow native calls, such as those of LAPACK, but no callbacks into Python.
    """
    try:
        with make_ir_context():
            module = mlir.deserialize_portable_artifact(exported.mlir_module_serialized)
            targets = dict.fromkeys(
                ir.StringAttr(operation.attributes["call_target_name"]).value
                for operation in _operations(module.operation)
                if operation.name == "stablehlo.custom_call"
            )
    except Exception as error:  # the program is parsed here for the first time
        raise _not_readable(content, error) from error
    refused = [
        name for name in targets if "callback" in name or not (is_trusted or name in HARMLESS_CALLS)
    ]
    if refused:
        listed = _printable(", ".join(refused[:MAX_NAMED]))
        raise ArtifactError(
            f"found a call of {listed}, expected a pure function that calls nothing"
        )


def call(exported: export.Exported, state: jax.Array, action: jax.Array) -> jax.Array:
    """Return an artifact's next state, (n,), from its state (n,) and an action."""
    arguments, keywords = jax.tree.unflatten(exported.in_tree, (state, action))
    return jax.tree.leaves(exported.call(*arguments, **keywords))[0]


def check_runs(exported: export.Exported, start: Sequence[float], num_actions: int) -> None:
    """Compile an artifact and run it for one step, because a damaged body shows only then.

    Raises:
        ArtifactError: it does not run, or a number is not finite after one step from the start.
    """

    def step(state: jax.Array, loops: int = TRIAL_LOOPS) -> jax.Array:
        if loops == 0:
            return call(exported, state, jnp.zeros(num_actions, jnp.float32))
        return jax.lax.fori_loop(0, 1, lambda _, inner: step(inner, loops - 1), state)

    try:
        with jax.default_device(jax.devices("cpu")[0]):
            after = np.asarray(jax.jit(step)(np.asarray(start, np.float32)))
    except MemoryError:
        raise
    except Exception as error:
        reason = _printable(f"{type(error).__name__}: {error}")
        raise ArtifactError(
            f"found a body that does not run on the CPU ({reason}), "
            "expected one step from the start state"
        ) from error
    bad = np.flatnonzero(~np.isfinite(after))
    if bad.size:
        raise ArtifactError(
            f"components {bad.tolist()} after one step from the start state: "
            f"found {after[bad].tolist()}, expected finite numbers"
        )


def check(
    content: bytes, starts: Sequence[Sequence[float]], num_actions: int, is_trusted: bool
) -> None:
    """Raise ArtifactError unless a file's bytes are a plant: see the functions above.

    Args:
        starts: a start state of every size that an artifact's state may have.
        is_trusted: see ``check_pure``.
    """
    exported = deserialize(content)
    size = check_signature(exported, [len(start) for start in starts], num_actions)
    check_pure(content, exported, is_trusted)
    check_runs(exported, next(start for start in starts if len(start) == size), num_actions)


def check_untrusted(argument: Any, content: bytes) -> bytes:
    """Check a file's bytes in the sandbox; argument is [starts, num_actions]; returns nothing."""
    starts, num_actions = argument
    check(content, starts, num_actions, is_trusted=False)
    return b""
