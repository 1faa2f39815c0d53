"""What is in the file of a black box: an artifact of ``jax.export``, read, checked, and run once.

Imports JAX and nothing of this package, because the file is read alone where black boxes are tried out
(``flytrack_env.apart``).
"""

import importlib
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax import export
from jax.extend import mlir
from jax.extend.mlir import ir
from jax.interpreters.mlir import make_ir_context

# Of those that XLA knows: they mark values and are gone when it has compiled.
HARMLESS_CALLS = ("Sharding", "SPMDFullToShardShape", "SPMDShardToFullShape", "annotate_device_placement")
TALK = ("stablehlo.infeed", "stablehlo.outfeed", "stablehlo.send", "stablehlo.recv")
LONGEST_TEXT = 500  # characters of what others say of a file, which the file has a say in
MOST_NAMED = 5
# Of loops in loops, and functions that call one another, which count twice. The compiler calls itself for
# each, and crashes from 180 on; a little sooner where a step is part of a larger program than in its trial.
MOST_DEPTH = 64
CALLS = {"func.call": "callee", "stablehlo.composite": "decomposition"}


class ArtifactError(ValueError):
    """A file that is no plant; the message says what was found and expected, and does not name the file."""


def said(error: BaseException) -> str:
    """Return an exception in one line that is not too long, whatever the file made it say."""
    return _printable(" ".join(f"{type(error).__name__}: {error}".split()))


def _printable(text: str) -> str:
    text = text[:LONGEST_TEXT]
    return text if text.isprintable() else ascii(text)[1:-1]


def deserialize(content: bytes) -> export.Exported:
    """Return the artifact in a file's bytes.

    Raises:
        ArtifactError: damaged, or no artifact.
    """
    try:
        return export.deserialize(bytearray(content))
    # Damaged bytes come back as almost any exception: struct.error, IndexError, MLIRError, ...
    except Exception as error:
        raise ArtifactError(_cannot(content, error)) from error


def _cannot(content: bytes, error: Exception) -> str:
    found = f"{len(content)} bytes that cannot be deserialised ({said(error)})"
    return f"found {found}, expected a jax.export artifact"


def check_signature(exported: export.Exported, sizes: Sequence[int], num_actions: int) -> int:
    """Return the number of components of an artifact's state, one of ``sizes``.

    Raises:
        ArtifactError: for another platform, or of another signature.
    """
    if "cpu" not in exported.platforms:
        found = str(exported.platforms)[:LONGEST_TEXT]
        raise ArtifactError(f"platforms: found {found}, expected ('cpu',)")
    if exported.nr_devices != 1:
        raise ArtifactError(f"devices: found {exported.nr_devices}, expected 1")
    inputs = [(aval.shape, aval.dtype) for aval in exported.in_avals]
    outputs = [(aval.shape, aval.dtype) for aval in exported.out_avals]
    for size in sizes:
        state = ((size,), np.dtype(np.float32))
        action = ((num_actions,), np.dtype(np.float32))
        if inputs == [state, action] and outputs == [state]:
            return size
    found = f"({', '.join(map(str, exported.in_avals))}) -> ({', '.join(map(str, exported.out_avals))})"
    raise ArtifactError(
        f"signature: found {_printable(found)}, expected (float32[n], float32[{num_actions}]) -> "
        f"(float32[n]) with n = {' or '.join(map(str, sizes))}"
    )


def _operations(operation: Any) -> Iterator[tuple[Any, int]]:
    """Yield an operation and all within it, each with how deep it lies there."""
    open_operations = [(operation, 0)]
    while open_operations:
        one, depth = open_operations.pop()
        yield one, depth
        for region in one.regions:
            for block in region:
                open_operations += [(inner.operation, depth + 1) for inner in block]


class _Depths:
    """How deep the functions of a program are: what lies within, and what is called there."""

    def __init__(self, module: Any):
        self._functions = {
            ir.StringAttr(one.operation.attributes["sym_name"]).value: one.operation for one in module.body
        }
        self._found: dict[str, int] = {}

    def check(self) -> None:
        """Raise ArtifactError for a program that is too deep, or without a bottom."""
        for name in self._functions:
            self._depth_of(name, MOST_DEPTH)

    def _depth_of(self, name: str, most: int) -> int:
        if most >= 0 and name not in self._found:
            self._found[name] = max(
                depth if callee is None else depth + 1 + self._depth_of(callee, most - depth - 1)
                for depth, callee in self._calls(name)
            )
        if most < 0 or self._found[name] > most:
            expected = f"at most {MOST_DEPTH} deep"
            raise ArtifactError(f"found functions and loops that are nested deeper, expected {expected}")
        return self._found[name]

    def _calls(self, name: str) -> Iterator[tuple[int, str | None]]:
        """Yield how deep each operation of a function lies in it, and which function it calls, if any."""
        for one, depth in _operations(self._functions[name]):
            attribute = CALLS.get(one.name)
            callee = None if attribute is None else ir.FlatSymbolRefAttr(one.attributes[attribute]).value
            yield depth, callee


def _reaches_out(operation: Any, is_trusted: bool) -> str | None:
    """Return what of an operation is more than arithmetic on its inputs, None if nothing is."""
    if operation.name in TALK:
        return str(operation.name)
    if operation.name != "stablehlo.custom_call":
        return None
    target = ir.StringAttr(operation.attributes["call_target_name"]).value
    is_fine = "callback" not in target if is_trusted else target in HARMLESS_CALLS
    return None if is_fine else f"a call of {target}"


def check_closed(content: bytes, exported: export.Exported, is_trusted: bool) -> None:
    """Raise ArtifactError if an artifact has side effects, calls what it cannot be let call, or is very deep.

    That is any code beside its own, of which there are LAPACK's functions in a process: they take what
    they are given. is_trusted: let it call those.
    """
    effects = [str(effect) for effect in exported.ordered_effects + exported.unordered_effects]
    try:
        with make_ir_context():
            module = mlir.deserialize_portable_artifact(exported.mlir_module_serialized)
            found = [_reaches_out(operation, is_trusted) for operation, _ in _operations(module.operation)]
            if not is_trusted:
                _Depths(module).check()
    except ArtifactError:
        raise
    except Exception as error:  # as above: the program is read here for the first time
        raise ArtifactError(_cannot(content, error)) from error
    names = list(dict.fromkeys([*effects, *(name for name in found if name is not None)]))
    if names:
        listed = _printable(", ".join(names[:MOST_NAMED]))
        raise ArtifactError(f"found {listed}, expected a pure function that calls nothing")


def call(exported: export.Exported, state: jax.Array, action: jax.Array) -> jax.Array:
    """Return an artifact's next state, (n,), of its state (n,) and an action."""
    arguments, keywords = jax.tree.unflatten(exported.in_tree, (state, action))
    return jax.tree.leaves(exported.call(*arguments, **keywords))[0]


def check_runs(exported: export.Exported, start: Sequence[float], num_actions: int) -> None:
    """Compile an artifact and run it once, because a damaged body shows only then.

    Raises:
        ArtifactError: it does not run, or a number is not finite after one step from the start.
    """
    state, action = np.asarray(start, np.float32), np.zeros(num_actions, np.float32)
    try:
        with jax.default_device(jax.devices("cpu")[0]):
            after = np.asarray(jax.jit(lambda *row: call(exported, *row))(state, action))
    except MemoryError:
        raise
    except Exception as error:
        raise ArtifactError(
            f"found a body that does not run on the CPU ({said(error)}), expected one step from the start "
            "state"
        ) from error
    bad = np.flatnonzero(~np.isfinite(after))
    if bad.size:
        raise ArtifactError(
            f"components {bad.tolist()} after one step from the start state: found {after[bad].tolist()}, "
            "expected finite numbers"
        )


def check(content: bytes, starts: Sequence[Sequence[float]], num_actions: int, is_trusted: bool) -> None:
    """Raise ArtifactError unless a file's bytes are a plant: see the functions above.

    starts: a start state of every size that an artifact's state may have. is_trusted: ``check_closed``.
    """
    exported = deserialize(content)
    size = check_signature(exported, [len(start) for start in starts], num_actions)
    check_closed(content, exported, is_trusted)
    check_runs(exported, next(start for start in starts if len(start) == size), num_actions)


def prepare() -> None:
    """Import what JAX else imports in every child anew, where it first lowers a program."""
    importlib.import_module("scipy.linalg")


def try_out(argument: Any, content: bytes) -> bytes:
    """Check a stranger's bytes, as ``apart`` calls it: argument is [starts, num_actions]; returns nothing."""
    starts, num_actions = argument
    check(content, starts, num_actions, is_trusted=False)
    return b""
