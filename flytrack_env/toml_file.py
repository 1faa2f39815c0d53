"""Reading TOML files of others."""

import tomllib
from pathlib import Path
from typing import Any

from flytrack_env.files import read_at_most

LARGEST_BYTES = 2**18  # a track of a thousand gates fits
MOST_DOTS = 1000  # in a line: tomllib takes the square of a dotted key's length


class TomlError(ValueError):
    """A text that is not TOML; the message does not name the file."""


def read_text(path: Path) -> str:
    """Return the text of a file, its lines ending in line feeds.

    Raises:
        OSError: what the system says, or more bytes than such a file has.
        UnicodeDecodeError: it is no text.
    """
    return read_at_most(path, LARGEST_BYTES).decode().replace("\r\n", "\n").replace("\r", "\n")


def parse_toml(text: str) -> dict[str, Any]:
    """Return what a TOML text holds.

    Raises:
        TomlError: it is not TOML, or a line of it, or all together, have very many dots.
    """
    dots = [line.count(".") for line in text.split("\n")]
    if max(dots) > MOST_DOTS:
        number = dots.index(max(dots)) + 1
        raise TomlError(f"line {number}: found {max(dots)} dots, expected at most {MOST_DOTS}")
    if sum(number * number for number in dots) > MOST_DOTS**2:
        raise TomlError("found very many lines of many dots, expected names of few parts")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, endless digits, endless nesting
        raise TomlError(str(error)) from error
