"""Compiled programs on the disk, so that the next process need not compile them again."""

import hashlib
import os
import platform
import shutil
from pathlib import Path

import jax

from flytrack_env.files import user_cache_folder

SWITCH = "FLYTRACK_COMPILE_CACHE"  # environment variable: 0 keeps nothing
MAX_BYTES = 2**30  # every change of a program leaves its predecessor behind
FOLDER, MIN_S = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"


def keep_compiled_programs() -> None:
    """Let JAX keep what took 0.3 s or more to compile in the user's cache folder.

    Does nothing where JAX has a folder already, where ``FLYTRACK_COMPILE_CACHE`` is 0, or where the
    folder cannot be written. There is one folder per kind of processor, since a program uses what
    its processor has; one that has grown beyond 1 GiB is begun afresh. JAX's key of a program is
    its code, JAX's version and its flags.
    """
    if os.environ.get(SWITCH, "1") == "0" or getattr(jax.config, FOLDER) is not None:
        return
    try:
        folder = user_cache_folder() / "compiled" / _processor()
        folder.mkdir(parents=True, exist_ok=True)
        if sum(path.stat().st_size for path in folder.glob("*")) > MAX_BYTES:
            shutil.rmtree(folder, ignore_errors=True)
    except (OSError, RuntimeError):  # no home, or a file that another process removes
        return
    if os.access(folder.parent, os.W_OK):
        jax.config.update(FOLDER, str(folder))
        if MIN_S.upper() not in os.environ:
            jax.config.update(MIN_S, 0.3)


def _processor() -> str:
    """Return a name for this kind of processor.

    It is a digest of what Linux reports about it, or else of what Python knows.
    """
    known = [platform.machine(), platform.processor()]
    about = Path("/proc/cpuinfo")
    if about.exists():
        lines = about.read_text().splitlines()
        known += sorted(
            {line for line in lines if line.startswith(("model name", "flags", "Features"))}
        )
    return hashlib.sha256("\n".join(known).encode()).hexdigest()[:16]
