"""Decoding PX4 and Betaflight logs with pyulog and orangebox, in a process with limits on time and memory."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env import sandbox
from flytrack_env.extras import check_installed
from flytrack_env.messages import error_text
from flytrack_env.npz_file import NpzError, load_npz
from flytrack_sysid.log import LogError

DECODERS = Path(__file__).with_name("decoders.py")
PACKAGES = {"ulog": "pyulog", "betaflight": "orangebox"}
# For every MiB of the file, beyond the usual limits: both decode about 1 MiB per second.
CPU_S_PER_MIB, BYTES_PER_BYTE = 4, 32


def limits_of(num_bytes: int) -> sandbox.ResourceLimits:
    """Return the limits for decoding a file of that size."""
    usual, more_s = sandbox.ResourceLimits(), CPU_S_PER_MIB * (num_bytes // 2**20)
    return sandbox.ResourceLimits(
        usual.cpu_s + more_s, usual.memory_bytes + BYTES_PER_BYTE * num_bytes, usual.wall_s + 4.0 * more_s
    )


def decode(source: str, format_name: str, path: Path, *rest: Any) -> tuple[Any, list[np.ndarray]]:
    """Return the notes and arrays that a format's decoder (``decoders.py``) finds in a file.

    source: the file, for messages. rest: the decoder's arguments after the path. Raises LogError if the
    package is not installed, or cannot decode the file.
    """
    try:
        check_installed("logs", f"{format_name} logs", PACKAGES[format_name])
    except ImportError as error:
        raise LogError(f"{source}: {error}") from error
    try:
        limits = limits_of(path.stat().st_size)
        packed = sandbox.run(DECODERS, f"decode_{format_name}", [str(path.absolute()), *rest], limits=limits)
        notes, *arrays = load_npz(io.BytesIO(packed), limits.memory_bytes).values()
        return json.loads(notes.tobytes()), arrays
    except (OSError, sandbox.SandboxError, NpzError) as error:
        kind = f"{error.kind}: " if isinstance(error, sandbox.SandboxError) and error.kind else ""
        raise LogError(f"{source}: damaged, cannot be decoded: {kind}{error_text(error)}") from error
