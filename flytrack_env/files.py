"""Writing files so that nothing is lost: a reader sees the old file or the whole new one."""

import itertools
import os
import secrets
from pathlib import Path


def write_atomically(path: str | Path, content: bytes) -> None:
    """Write a file under a temporary name beside it and rename it; makes missing folders.

    Raises:
        OSError: what the system says; nothing half-written is left.
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
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def fresh_folder(path: Path) -> Path:
    """Return a folder that holds nothing yet: the path, else ``path_2``, ``path_3``, ...; it is not made."""
    names = itertools.chain(
        [path], (path.with_name(f"{path.name}_{number}") for number in itertools.count(2))
    )
    return next(name for name in names if not name.exists() or (name.is_dir() and not any(name.iterdir())))
