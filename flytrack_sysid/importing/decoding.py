"""Other people's decoders at work on other people's files: in a process of their own, with bounds."""

import contextlib
import io
import json
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env.apart import Apart, ApartError, ResourceLimits, is_possible
from flytrack_env.messages import error_text
from flytrack_env.npz_file import NpzError, NpzFile
from flytrack_sysid.importing.extra import needed_module
from flytrack_sysid.log import LogError

PACKAGES = {"ulog": "pyulog", "betaflight": "orangebox"}
# Beside what any file may use, for every MiB of a large one: both decode about 1 MiB in a second.
CPU_S_PER_MIB, BYTES_PER_BYTE = 4, 32

_DECODERS = Apart(Path(__file__).with_name("decoders.py"), "decode", {})


def limits_of(num_bytes: int) -> ResourceLimits:
    """Return what decoding a file of that size may use."""
    usual, more_s = ResourceLimits(), CPU_S_PER_MIB * (num_bytes // 2**20)
    return ResourceLimits(
        usual.cpu_s + more_s, usual.memory_bytes + BYTES_PER_BYTE * num_bytes, usual.wall_s + 4.0 * more_s
    )


def decode(source: str, format_name: str, path: Path, *rest: Any) -> tuple[Any, list[np.ndarray]]:
    """Return the notes and arrays that a format's decoder (``decoders.py``) finds in a file.

    source: the file, for messages. rest: what the decoder takes beside the path. Without ``os.fork``
    (Windows) it works in this process, without bounds.

    Raises:
        LogError: its package is not installed, or it cannot decode the file; the message says why.
    """
    needed_module(PACKAGES[format_name], "logs", path)
    argument = [format_name, str(path.absolute()), *rest]
    try:
        found = _ask(argument, path.stat().st_size)
        with zipfile.ZipFile(io.BytesIO(found)) as archive:
            arrays = NpzFile(archive)
            notes, *values = [arrays.read(name) for name in arrays.names]
            return json.loads(notes.tobytes()), values
    except OSError as error:
        raise LogError(f"{source}: cannot be read: {error_text(error)}") from error
    except (ApartError, NpzError, zipfile.BadZipFile) as error:
        kind = f"{error.kind}: " if isinstance(error, ApartError) and error.kind else ""
        raise LogError(f"{source}: damaged, cannot be decoded: {kind}{error_text(error)}") from error


def _ask(argument: list[Any], num_bytes: int) -> bytes:
    if is_possible():
        return _DECODERS(argument, b"", limits_of(num_bytes))
    from flytrack_sysid.importing import decoders

    try:
        with contextlib.redirect_stdout(sys.stderr):  # what they print is no part of what a command answers
            return decoders.decode(argument, b"")
    except Exception as error:  # whatever they raise on damaged bytes
        raise ApartError(str(error), type(error).__name__) from error
