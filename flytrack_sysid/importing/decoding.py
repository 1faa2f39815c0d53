"""Decoding of logs by third-party packages, in a process with limits on time and memory."""

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
# By format: the extra, the kind of logs in words, and the packages.
PACKAGES = {
    "ulog": ("logs", "ulog logs", "pyulog"),
    "betaflight": ("logs", "betaflight logs", "orangebox"),
    "dataflash": ("logs", "dataflash logs", "pymavlink"),
    "bag": ("bags", "bags", "mcap", "rosbags"),
}
# Kinds of errors that do not show a damaged file: the decoder does not support it, or its process
# has no access.
NO_DAMAGE = ("UnsupportedError", "FileNotFoundError", "PermissionError", "OSError")
# Per MiB and per byte of the file, beyond the default limits. Orangebox, the slowest decoder, takes
# 3 s of processor time for a MiB on a free machine, 5 s on a busy one.
CPU_S_PER_MIB, BYTES_PER_BYTE = 15, 32


def limits_of(num_bytes: int) -> sandbox.ResourceLimits:
    """Return the limits for decoding a file of a size."""
    default, more_s = sandbox.ResourceLimits(), CPU_S_PER_MIB * (num_bytes // 2**20)
    return sandbox.ResourceLimits(
        default.cpu_s + more_s,
        default.memory_bytes + BYTES_PER_BYTE * num_bytes,
        default.wall_s + 4.0 * more_s,
    )


def decode(path: Path, format_name: str, *arguments: Any) -> tuple[Any, list[np.ndarray]]:
    """Return the notes and arrays that a format's decoder (``decoders.py``) reads from a file.

    Args:
        path: of the file or folder.
        format_name: key of ``PACKAGES``.
        arguments: arguments of the decoder after the path.

    Raises:
        LogError: the package is not installed, or cannot decode the file.
    """
    try:
        check_installed(*PACKAGES[format_name])
    except ImportError as error:
        raise LogError(f"{path}: {error}") from error
    try:
        files = [path, *path.glob("*")] if path.is_dir() else [path]
        limits = limits_of(sum(file.stat().st_size for file in files))
        packed = sandbox.run(
            DECODERS, f"decode_{format_name}", [str(path.absolute()), *arguments], limits=limits
        )
        notes, *arrays = load_npz(io.BytesIO(packed), limits.memory_bytes).values()
        return json.loads(notes.tobytes()), arrays
    except (OSError, sandbox.SandboxError, NpzError) as error:
        kind = error.kind if isinstance(error, sandbox.SandboxError) else ""
        damaged = "damaged, " if kind and kind not in NO_DAMAGE else ""
        error_kind = f"{kind}: " if kind and kind != NO_DAMAGE[0] else ""
        text = "" if kind == NO_DAMAGE[0] else f"{damaged}cannot be decoded: {error_kind}"
        raise LogError(f"{path}: {text}{error_text(error)}") from error
