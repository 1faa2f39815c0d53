"""Reading files of bounded size, and writing them atomically: a reader sees the old file or the new one."""

import io
import itertools
import os
import secrets
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

READ_BYTES = 2**20


class TooLargeError(OSError):
    """A file of more bytes than it may have; the message does not name it."""


def check_size(num_bytes: int, most_bytes: int) -> None:
    """Raise TooLargeError for more bytes than there may be."""
    if num_bytes > most_bytes:
        raise TooLargeError(f"found more than {most_bytes} bytes, expected at most that")


class AtMost(io.RawIOBase):
    """An open file that ends in a TooLargeError where more is read of it than it may have.

    Devices and what is unpacked announce no size, or any.
    """

    def __init__(self, file: BinaryIO, most_bytes: int):
        self._file, self._most_bytes, self._num_bytes = file, most_bytes, 0

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: "WriteableBuffer") -> int:
        """Read into a buffer and return how many bytes; 0 at the end."""
        view = memoryview(buffer)
        part = self._file.read(min(len(view), READ_BYTES))
        self._num_bytes += len(part)
        check_size(self._num_bytes, self._most_bytes)
        view[: len(part)] = part
        return len(part)


def open_file(path: Path) -> BinaryIO:
    """Return a file, opened to be read, unless it is one that may never begin.

    Devices never end: ``AtMost`` does.

    Raises:
        OSError: a pipe or a socket, or what the system says.
        ValueError: a NUL in the name.
    """
    mode = path.stat().st_mode
    if stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode):
        raise OSError(f"{path}: found a pipe or a socket, expected a file")
    return path.open("rb")


def read_at_most(path: Path, most_bytes: int) -> bytes:
    """Return the bytes of a file; never holds many more than it may have.

    Raises:
        TooLargeError: it has more; where it says so, it is not opened.
        OSError: what the system says, or a pipe or a socket.
    """
    try:
        check_size(path.stat().st_size, most_bytes)
        with open_file(path) as file:
            return AtMost(file, most_bytes).readall()
    except ValueError as error:  # a NUL in the name
        raise OSError(str(error)) from error


def write_atomically(path: str | Path, content: bytes) -> None:
    """Write a file under a temporary name beside it and rename it; makes missing folders.

    Raises:
        OSError: what the system says; nothing half-written is left.
    """
    write_together([(path, content)])


def write_together(files: Iterable[tuple[str | Path, bytes]]) -> None:
    """Write files as ``write_atomically``, and rename them one after the other when all are written.

    files: of path and content, read one by one.

    Raises:
        OSError: what the system says; of files that were not there before, none is left.
    """
    renames: list[tuple[Path, Path]] = []
    new: list[Path] = []
    try:
        for name, content in files:
            path = Path(os.path.realpath(name))  # a link stays one
            if path.exists() and not path.is_file():
                raise OSError(f"{path}: found a folder or a device, expected a regular file or a new path")
            path.parent.mkdir(parents=True, exist_ok=True)
            # Not tempfile: its files are private to the user, and these are ordinary ones.
            temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
            renames.append((temporary, path))
            with temporary.open("xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())  # else a loss of power can leave the new name with no content
        for temporary, path in renames:
            is_new = not path.exists()
            os.replace(temporary, path)
            new += [path] if is_new else []
    except BaseException:
        for path in (*new, *(temporary for temporary, _ in renames)):
            path.unlink(missing_ok=True)
        raise


def fresh_folder(path: Path) -> Path:
    """Return a folder that holds nothing yet: the path, else ``path_2``, ``path_3``, ...; it is not made."""
    names = itertools.chain(
        [path], (path.with_name(f"{path.name}_{number}") for number in itertools.count(2))
    )
    return next(name for name in names if not name.exists() or (name.is_dir() and not any(name.iterdir())))
