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
import numpy as np

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

    Traces are stored only where compiled programs are stored, too (``flytrack_env.compile_cache``),
    and only for calls that are not traced themselves.
    """
    program = fast_jit(function)
    programs: dict[Any, Callable[..., Any]] = {}

    @functools.wraps(function)
    def call(*args: Any) -> Any:
        leaves, structure = jax.tree.flatten(args)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return function(*args)
        folder = getattr(jax.config, FOLDER)
        if folder is None:
            return program(*args)
        kinds = tuple(map(_kind, leaves))
        key = structure, kinds, jax.config.read("jax_enable_x64")
        if key not in programs:
            programs[key] = _load(function, structure, kinds, Path(folder) / "traced")
        return programs[key](*leaves)

    return call


def _kind(leaf: Any) -> tuple[tuple[int, ...], Any]:
    """Return the shape and the type of a leaf."""
    # Types of JAX take as long as a step of a replay.
    typed = leaf if isinstance(leaf, np.ndarray | jax.Array) else jax.typeof(leaf)
    return typed.shape, jax.dtypes.canonicalize_dtype(typed.dtype)


def _load(
    function: Callable[..., Any], structure: Any, kinds: tuple[Any, ...], folder: Path
) -> Callable[..., Any]:
    """Return the program of leaves, loaded from the disk, or traced and stored there."""

    def of_leaves(*leaves: Any) -> Any:
        return function(*jax.tree.unflatten(structure, leaves))

    of_leaves.__name__ = function.__name__
    program, text = fast_jit(of_leaves), str(structure)
    if UNKEPT in text:
        return program
    path = folder / _digest(function, text, kinds)
    stored = _read(path)
    if stored is not None:
        exported = jax.export.deserialize(stored)
    else:
        shapes = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in kinds]
        exported = jax.export.export(program)(*shapes)
        content = exported.serialize()
        with contextlib.suppress(OSError):  # a full disk, or a folder that is being recreated
            write_atomically(path, hashlib.sha256(content).digest() + content)
    return fast_jit(exported.call)


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
        _sources(),
        function.__module__,
        function.__qualname__,
        structure,
        kinds,
        settings,
    )
    return hashlib.sha256("\n".join(map(str, dependencies)).encode()).hexdigest()


def _sources() -> str:
    """Return JAX's version and a digest of all modules that may be traced."""
    return f"{jax.__version__} {digest_of_sources('flytrack_env', 'flytrack_sysid/inference')}"
