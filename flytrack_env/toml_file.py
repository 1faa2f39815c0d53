"""Reading TOML files of limited size."""

import tomllib
from pathlib import Path
from typing import Any

from flytrack_env.files import read_at_most

MAX_BYTES = 2**18  # a track of a thousand gates fits
MAX_DOTS = 1000  # on one line; tomllib's time grows with the square of a dotted key's length


class TomlError(ValueError):
    """A text that is not TOML; the message does not name the file."""


def read_text(path: Path) -> str:
    """Return the text of a file, with line feeds as line ends.

    Raises:
        OSError: an error of the operating system, or more than MAX_BYTES.
        UnicodeDecodeError: not UTF-8.
    """
    return read_at_most(path, MAX_BYTES).decode().replace("\r\n", "\n").replace("\r", "\n")


def parse_toml(text: str) -> dict[str, Any]:
    """Return the content of a TOML text.

    Raises:
        TomlError: not TOML, or lines with very many dots.
    """
    if sum(line.count(".") ** 2 for line in text.split("\n")) > MAX_DOTS**2:
        raise TomlError(f"found lines of very many dots, expected at most {MAX_DOTS} on one line")
    try:
        return tomllib.loads(text)
    except (
        ValueError,
        RecursionError,
    ) as error:  # TOMLDecodeError, too many digits, too deeply nested
        raise TomlError(str(error)) from error
