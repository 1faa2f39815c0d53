"""Compiled programs on the disk: shared by the workers of a test run, their subprocesses and later runs."""

import os
import shutil
from pathlib import Path

import jax

FOLDER = Path(__file__).parents[2] / ".jax_cache"
LARGEST_BYTES = 2**30  # every change of the code leaves its programs behind
LEAST_SECONDS = 0.3  # of compiling: reading what takes less would gain nothing
SETTINGS = {
    "jax_compilation_cache_dir": str(FOLDER),
    "jax_persistent_cache_min_compile_time_secs": LEAST_SECONDS,
}


def share_compiled_programs() -> None:
    """Let JAX keep what it compiles, here and in processes of tests; begin afresh where it is too much.

    What JAX is told by the environment stands. The key of a program is its code, JAX's version and its flags.
    """
    is_worker = "PYTEST_XDIST_WORKER" in os.environ
    if not is_worker and sum(path.stat().st_size for path in FOLDER.glob("*")) > LARGEST_BYTES:
        shutil.rmtree(FOLDER, ignore_errors=True)
    for name, value in SETTINGS.items():
        if name.upper() not in os.environ:
            os.environ[name.upper()] = str(value)
            jax.config.update(name, value)
