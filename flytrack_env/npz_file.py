"""Reading ``.npz`` files: nothing is unpickled, and sizes are checked before memory is allocated."""

import contextlib
import io
import math
import re
import struct
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from flytrack_env.files import open_file
from flytrack_env.messages import error_text, quote_value

UNPACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # whose unpacking zipfile bounds, as it does no other's
# By version: in how many bytes a header's length stands, and what reads from there on.
HEADERS = {
    (1, 0): (2, np.lib.format.read_array_header_1_0),
    (2, 0): (4, np.lib.format.read_array_header_2_0),
}
LARGEST_HEADER_BYTES = 2**16
SUFFIX = ".npy"
LONGEST_TEXT = 200
FIRST_SURROGATE, LAST_SURROGATE = 0xD800, 0xDFFF  # halves of characters
LARGEST_LIST_BYTES = 2**16  # of the archive's list of its files: hundreds of them
# End of an archive, and what points to a list of more than 4 GiB or 65,535 files.
END, END_BYTES, LIST_BYTES_AT, LARGE_END = b"PK\x05\x06", 22, 12, b"PK\x06\x07"
LONGEST_TAIL = 2**16 + END_BYTES + 20  # a comment, the end, and what points


class NpzError(ValueError):
    """An archive, or an array of one, that cannot be read; the message does not name the file."""


class Header(NamedTuple):
    """What an array announces; ``num_values`` is the product of the shape."""

    shape: tuple[int, ...]
    is_fortran: bool
    dtype: np.dtype

    @property
    def num_values(self) -> int:
        """Number of values."""
        return math.prod(self.shape)


def read_header(file: BinaryIO) -> Header:
    """Return the header of an array's file, which is read as far as that.

    Raises:
        ValueError: no such file, or damaged.
    """
    version = np.lib.format.read_magic(file)
    if version not in HEADERS:
        raise NpzError(f"found version {version}, expected {' or '.join(map(str, HEADERS))}")
    length_bytes, read = HEADERS[version]
    announced = file.read(length_bytes)
    length = int.from_bytes(announced, "little")
    if length > LARGEST_HEADER_BYTES:  # it would be made room for
        raise NpzError(f"found a header of {length} bytes, expected at most {LARGEST_HEADER_BYTES}")
    return Header(*read(io.BytesIO(announced + file.read(length))))


class NpzFile:
    """The arrays of an archive; ``names``: in their order, one that is there twice twice."""

    def __init__(self, archive: zipfile.ZipFile):
        self._archive = archive
        self._members = archive.infolist()
        self.names = [member.filename.removesuffix(SUFFIX) for member in self._members]

    @property
    def num_bytes(self) -> int:
        """Size of all arrays unpacked, with their headers, as the archive announces it."""
        return sum(member.file_size for member in self._members)

    def header(self, name: str) -> Header:
        """Return what an array announces.

        Raises:
            NpzError: damaged, pickled, or of another size than the archive announces.
        """
        with self._opened(name) as (_, header):
            return header

    def read(self, name: str) -> np.ndarray:
        """Return an array; it cannot be written to.

        Raises:
            NpzError: as ``header`` does, or its data are damaged.
        """
        with self._opened(name) as (file, header):
            data = file.read(header.num_values * header.dtype.itemsize)
            _check_text(header.dtype, data)
            values = np.frombuffer(data, header.dtype)
            return values.reshape(header.shape, order="F" if header.is_fortran else "C")

    @contextlib.contextmanager
    def _opened(self, name: str) -> Iterator[tuple[BinaryIO, Header]]:
        """Yield an array's file after its header, and the header; whatever is raised becomes an NpzError."""
        try:
            member = self._members[self.names.index(name)]
            if member.compress_type not in UNPACKED:
                found = f"compression {member.compress_type}"
                raise NpzError(f"found {found}, expected none or deflate, as numpy writes")
            with self._archive.open(member) as file:
                header = read_header(file)  # type: ignore[arg-type]  # as good as binary
                _check(header, member.file_size - file.tell())
                yield file, header  # type: ignore[misc]
        except NpzError:
            raise
        except Exception as error:  # damaged archives raise anything from struct.error to RuntimeError
            raise NpzError(f"damaged, cannot be read: {type(error).__name__}: {error_text(error)}") from error


def _named(dtype: np.dtype) -> str:
    return str(dtype)[:LONGEST_TEXT]  # of a structured one, the file writes it


def _check(header: Header, num_bytes: int) -> None:
    """Raise NpzError unless a header announces plain values, as many as there are bytes for."""
    shape, _, dtype = header
    if dtype.hasobject:
        raise NpzError(f"found an array of {_named(dtype)}, expected plain values: pickles are never read")
    if not all(type(size) is int and size >= 0 for size in shape) or dtype.itemsize == 0:
        found = f"an array of {_named(dtype)}, shape {quote_value(shape)}"
        raise NpzError(f"found {found}, expected one of values that take room")
    if header.num_values * dtype.itemsize != num_bytes:
        numbers = "numbers" if dtype.kind in "iuf" else "values"
        expected = f"{header.num_values} {numbers} of {dtype.itemsize} bytes"
        raise NpzError(f"found {num_bytes} bytes, expected {expected}")


def _check_text(dtype: np.dtype, data: bytes) -> None:
    """Raise NpzError for text of numbers that are no characters: NumPy is not prepared for it."""
    if dtype.kind != "U":
        return
    codes = np.frombuffer(data, np.dtype(np.uint32).newbyteorder(dtype.byteorder))
    is_surrogate = (codes >= FIRST_SURROGATE) & (codes <= LAST_SURROGATE)
    if (is_surrogate | (codes > sys.maxunicode)).any():
        raise NpzError("found text of numbers that are no characters")


@contextlib.contextmanager
def open_npz(path: Path) -> Iterator[NpzFile]:
    """Yield the arrays of a file.

    Raises:
        NpzError: no archive, or one whose list of files is too long.
        OSError: what the system says.
    """
    with open_file(path) as file:
        try:
            _check_list(file)
            archive = zipfile.ZipFile(file)
        except NpzError:
            raise
        except Exception as error:  # as above
            raise NpzError(f"not an .npz file, or cut off: {error_text(error)}") from error
        with archive:
            yield NpzFile(archive)


def _check_list(file: BinaryIO) -> None:
    """Raise NpzError for nothing, and for an archive that lists more files than any of ours.

    The list is read at once.
    """
    size = file.seek(0, io.SEEK_END)
    if size == 0:  # so says a device, too, whose end zipfile would look for
        raise NpzError("not an .npz file, or cut off: found no bytes")
    file.seek(max(size - LONGEST_TAIL, 0))
    tail = file.read(LONGEST_TAIL)
    file.seek(0)
    # Whichever of them zipfile takes for the archive's end.
    ends = [match.start() for match in re.finditer(END, tail) if match.start() + END_BYTES <= len(tail)]
    longest = max((struct.unpack_from("<I", tail, at + LIST_BYTES_AT)[0] for at in ends), default=0)
    if longest > LARGEST_LIST_BYTES or LARGE_END in tail:
        raise NpzError(f"found a list of more than {LARGEST_LIST_BYTES} bytes, expected a few arrays")
