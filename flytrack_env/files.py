"""Read files of bounded size, and write files atomically: readers see the old or the new one."""

import contextlib
import itertools
import os
import secrets
import stat
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

_held: set[Path] = set()  # lock files of this process


def user_cache_folder() -> Path:
    """Return FlyTrack's folder for what can be made again.

    Raises:
        RuntimeError: the user has no home.
    """
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "flytrack"


def open_file(path: Path, most_bytes: int) -> BinaryIO:
    """Return a file opened for reading.

    Raises:
        OSError: not a regular file (a pipe may never begin, a device never end), larger than
            ``most_bytes``, or an error of the operating system.
    """
    try:
        status = path.stat()
    except ValueError as error:  # a NUL in the name
        raise OSError(str(error)) from error
    if not stat.S_ISREG(status.st_mode):
        raise OSError("found a folder, pipe or device, expected a regular file")
    if status.st_size > most_bytes:
        raise OSError(f"found {status.st_size} bytes, expected at most {most_bytes}")
    return path.open("rb")


def read_at_most(path: Path, most_bytes: int) -> bytes:
    """Return the content of a file; raises OSError as ``open_file`` does."""
    with open_file(path, most_bytes) as file:
        return file.read(most_bytes)


def write_atomically(path: str | Path, content: bytes) -> None:
    """Write a file under a temporary name beside it and rename it; makes missing folders.

    Raises:
        OSError: the path is a folder or a device, or an error of the operating system; nothing is
            left then.
    """
    path = Path(os.path.realpath(path))  # a link stays one
    if path.exists() and not path.is_file():
        raise OSError(f"{path}: found a folder or a device, expected a regular file or a new path")
    path.parent.mkdir(parents=True, exist_ok=True)
    # Not tempfile: its files are private to the user, and these are ordinary ones.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())  # else a loss of power can leave the new name with no content
        os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and not error.filename:  # as of a full disk
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def fresh_folder(path: Path) -> Path:
    """Make and return a new folder: the path, else ``path_2``, ``path_3``, ...

    No two callers are given the same folder, even if they run at the same time.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    names = (path.with_name(f"{path.name}_{number}") for number in itertools.count(2))
    for folder in itertools.chain([path], names):
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            continue
    raise AssertionError("there is always another number")


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Hold a folder for one process, so that no two write into it at once.

    An advisory lock of the operating system on a file beside the folder, which ends with the
    process. Where there is none (Windows, some network file systems), a warning says so. A process
    that holds the folder already goes on: a command holds what its training writes into.

    Raises:
        OSError: another process holds the folder; it names the folder, the process and its command.
            Or the folder would lie in a file.
    """
    folder = Path(os.path.realpath(folder))
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise OSError(f"{folder}: found a file at {folder.parent}, expected a folder") from error
    path = folder.with_name(f".{folder.name}.lock")
    if path in _held:
        yield
        return
    try:
        import fcntl
    except ImportError:
        warnings.warn(f"{folder}: not locked, as this system has no flock", stacklevel=3)
        yield
        return
    with contextlib.ExitStack() as stack:
        while True:
            file = stack.enter_context(path.open("a+"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                holder = file.read().strip() or "another process"
                raise OSError(
                    f"{folder}: found in use by {holder}, expected a folder of its own"
                ) from None
            except OSError as error:
                warnings.warn(
                    f"{folder}: not locked, as its file system refuses: {error}", stacklevel=3
                )
                yield
                return
            if path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
                break  # else it was removed by the process that held it before
        file.truncate(0)
        file.write(f"process {os.getpid()}: {' '.join(sys.argv)}")
        file.flush()
        _held.add(path)
        try:
            yield
        finally:
            _held.remove(path)
            path.unlink(missing_ok=True)
