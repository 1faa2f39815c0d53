"""Traced programs on the disk, so that the next process need not trace them again.

Tracing a program of all effects takes longer than loading its compiled form, and JAX finds compiled
programs by their code, which requires a trace. So the traced code is stored beside them
(``jax.export``). Its key is the sources of all code that may be traced, and the structure and
shapes of the arguments.
"""

import contextlib
import functools
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from flytrack_env import fusion
from flytrack_env.compile_cache import FOLDER
from flytrack_env.files import write_atomically
from flytrack_env.sources import digest_of_sources

# LLVM's first level compiles a replay in a sixth of the time that its third level takes, into a
# program that is as fast and computes the same bits.
fast_jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 1})
UNKEPT = "Law["  # in the structure of models with a law: each is traced for itself


def keep_trace(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``fast_jit`` of a function of trees of arrays, with traces stored on the disk.

    Traces are stored only where compiled programs are stored, too (``flytrack_env.compile_cache``).
    A stored trace can be called and jitted, but neither batched nor differentiated.
    """

    @functools.wraps(function)
    def stored(*args: Any) -> Any:
        folder = getattr(jax.config, FOLDER)
        leaves, structure = jax.tree.flatten(args)
        if folder is None or UNKEPT in str(structure):
            return function(*args)
        kinds = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        return _load(function, structure, kinds, Path(folder) / "traced").call(*leaves)

    return fast_jit(stored)


def _load(
    function: Callable[..., Any], structure: Any, kinds: tuple[Any, ...], folder: Path
) -> jax.export.Exported:
    """Return the program of leaves, loaded from the disk, or traced and stored there."""
    path = folder / _digest(function, str(structure), kinds)
    stored = _read(path)
    if stored is not None:
        return jax.export.deserialize(stored)

    def of_leaves(*leaves: Any) -> Any:
        return function(*jax.tree.unflatten(structure, leaves))

    of_leaves.__name__ = function.__name__
    shapes = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in kinds]
    exported = jax.export.export(fast_jit(of_leaves))(*shapes)
    content = exported.serialize()
    with contextlib.suppress(OSError):  # a full disk, or a folder that is being recreated
        write_atomically(path, hashlib.sha256(content).digest() + content)
    return exported


def _read(path: Path) -> bytearray | None:
    """Return a trace on the disk; None if it is missing or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    size = hashlib.sha256().digest_size
    is_whole = hashlib.sha256(content[size:]).digest() == content[:size]
    return bytearray(content[size:]) if is_whole else None


def _digest(function: Callable[..., Any], structure: str, kinds: tuple[Any, ...]) -> str:
    """Return the file name of a trace: a digest of everything that the code depends on."""
    settings = (
        jax.config.read("jax_enable_x64"),
        jax.default_backend(),
        os.environ.get(fusion.SWITCH),
    )
    dependencies = (
        jax.__version__,
        digest_of_sources("flytrack_env", "flytrack_sysid/inference"),
        function.__module__,
        function.__qualname__,
        structure,
        kinds,
        settings,
    )
    return hashlib.sha256("\n".join(map(str, dependencies)).encode()).hexdigest()
