"""Files of arrays, ``.npz``: nothing is unpickled, and sizes are checked before memory is allocated."""

import io
import math
import sys
import zipfile
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from flytrack_env.files import open_file
from flytrack_env.messages import error_text, quote_name, quote_value

BOUNDED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # zipfile unpacks these in bounded steps, others at once
LARGEST_DIRECTORY_BYTES = 2**16  # of an archive's list of members, which zipfile reads at once
PLAIN_KINDS = "biufU"  # of NumPy's types: booleans, numbers, text
HEADER_READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class NpzError(ValueError):
    """An archive, or an array in one, that cannot be read; the message does not name the file."""


class Header(NamedTuple):
    """What an ``.npy`` file declares about its array."""

    shape: tuple[int, ...]
    is_fortran: bool
    dtype: np.dtype


def read_header(file: BinaryIO) -> Header:
    """Return the header of an ``.npy`` file, and leave the file at the array's data.

    Raises:
        ValueError: damaged, or no such file.
    """
    version = np.lib.format.read_magic(file)
    if version not in HEADER_READERS:
        raise NpzError(f"found version {version}, expected {' or '.join(map(str, HEADER_READERS))}")
    header = Header(*HEADER_READERS[version](file))
    if not all(type(size) is int and size >= 0 for size in header.shape):
        raise NpzError(f"found shape {quote_value(header.shape)}, expected whole numbers")
    return header


def load_npz(source: Path | BinaryIO, most_bytes: int) -> dict[str, np.ndarray]:
    """Return the arrays in an ``.npz`` file, read-only.

    most_bytes: allowed in the file, and for all arrays, unpacked and as float64.

    Raises:
        NpzError: damaged, too large, pickled objects, or a name that occurs twice.
        OSError: the file cannot be opened, or is larger than ``most_bytes``.
    """
    if isinstance(source, Path):
        with open_file(source, most_bytes) as file:
            return load_npz(file, most_bytes)
    try:
        # The private function is how zipfile itself finds the directory; None: there is none.
        end = zipfile._EndRecData(source)  # type: ignore[attr-defined]
        if end is not None and end[zipfile._ECD_SIZE] > LARGEST_DIRECTORY_BYTES:  # type: ignore[attr-defined]
            raise NpzError("found very many members, expected a few arrays")
        with zipfile.ZipFile(source) as archive:
            return _read_arrays(archive, most_bytes)
    except (NpzError, MemoryError):
        raise
    except Exception as error:  # damaged archives raise anything from struct.error to RuntimeError
        raise NpzError(
            f"not an .npz file, or damaged: {type(error).__name__}: {error_text(error)}"
        ) from error


def npz_of(arrays: dict[str, np.ndarray]) -> bytes:
    """Return an ``.npz`` file; numpy dates its members 1980, and stored bytes depend on no zlib."""
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    return content.getvalue()


def _read_arrays(archive: zipfile.ZipFile, most_bytes: int) -> dict[str, np.ndarray]:
    headers: dict[str, Header] = {}
    num_bytes = 0
    for member in archive.infolist():
        name = member.filename.removesuffix(".npy")
        if name in headers:
            raise NpzError(f"{quote_name(name)}: found twice, expected once")
        if member.compress_type not in BOUNDED:
            raise NpzError(f"{quote_name(name)}: found compression {member.compress_type}, expected deflate")
        with archive.open(member) as file:
            headers[name] = _check(name, file, member.file_size)  # type: ignore[arg-type]
        num_bytes += max(member.file_size, 8 * math.prod(headers[name].shape))
        if num_bytes > most_bytes:
            raise NpzError(f"found arrays of {num_bytes} bytes or more, expected at most {most_bytes}")
    arrays = {}
    for (name, header), member in zip(headers.items(), archive.infolist(), strict=True):
        with archive.open(member) as file:  # reads no more than asked for, unlike archive.read
            arrays[name] = _array(name, file.read(member.file_size), header)
    return arrays


def _check(name: str, file: BinaryIO, num_bytes: int) -> Header:
    """Return the header of an array that declares plain values, as many as there are bytes for."""
    header = read_header(file)
    if header.dtype.kind not in PLAIN_KINDS:
        found = "pickled objects" if header.dtype.hasobject else quote_name(header.dtype)
        raise NpzError(f"{quote_name(name)}: found {found}, expected plain values; nothing is unpickled")
    expected = math.prod(header.shape) * header.dtype.itemsize
    if expected != num_bytes - file.tell() or not header.dtype.itemsize:
        found, shape = f"{num_bytes - file.tell()} bytes", quote_value(header.shape)
        raise NpzError(f"{quote_name(name)}: found {found}, expected {expected} for shape {shape}")
    return header


def _array(name: str, content: bytes, header: Header) -> np.ndarray:
    offset = len(content) - math.prod(header.shape) * header.dtype.itemsize
    if header.dtype.kind == "U":  # NumPy fails with a SystemError on numbers that are no characters
        codes = np.frombuffer(
            content, np.dtype(np.uint32).newbyteorder(header.dtype.byteorder), offset=offset
        )
        if codes.max(initial=0) > sys.maxunicode:
            raise NpzError(f"{quote_name(name)}: found text with numbers that are no characters")
    values = np.frombuffer(content, header.dtype, offset=offset)
    return values.reshape(header.shape, order="F" if header.is_fortran else "C")
