"""Files of arrays, ``.npz``, read without unpickling and only after their sizes are checked."""

import io
import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np

from flytrack_env.files import open_file
from flytrack_env.messages import error_text


class NpzError(ValueError):
    """An archive, or an array in one, that cannot be read; the message does not name the file."""


def load_npz(source: Path | BinaryIO, most_bytes: int) -> dict[str, np.ndarray]:
    """Return the arrays in an ``.npz`` file.

    Args:
        source: the file.
        most_bytes: allowed in the file, and for all arrays, unpacked and as float64.

    Raises:
        NpzError: damaged, too large, or pickled objects.
        OSError: the file cannot be opened, or is larger than ``most_bytes``.
    """
    if isinstance(source, Path):
        with open_file(source, most_bytes) as file:
            return load_npz(file, most_bytes)
    try:
        with zipfile.ZipFile(source) as archive:
            num_bytes = sum(member.file_size for member in archive.infolist())
        if num_bytes > most_bytes:
            raise NpzError(f"found arrays of {num_bytes} bytes, expected at most {most_bytes}")
        source.seek(0)
        arrays = dict(np.load(source, allow_pickle=False))
        for array in arrays.values():
            if array.dtype.kind == "U":
                array.tolist()  # raises for numbers that are no characters
    except NpzError:
        raise
    except Exception as error:  # damaged archives raise anything from struct.error to MemoryError
        raise NpzError(
            f"not an .npz file, or damaged: {type(error).__name__}: {error_text(error)}"
        ) from error
    num_bytes = 8 * sum(array.size for array in arrays.values())
    if num_bytes > most_bytes:
        raise NpzError(f"found {num_bytes} bytes as float64, expected at most {most_bytes}")
    return arrays


def npz_of(arrays: dict[str, np.ndarray]) -> bytes:
    """Return an ``.npz`` file; numpy dates its members 1980, and stored bytes depend on no zlib."""
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    return content.getvalue()
