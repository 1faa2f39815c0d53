"""What a part of the page is: a measurement, and its text."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple


class Section(NamedTuple):
    """A part of docs/results/reliability.md.

    name: in commands and file names. title: of the part. measure: (seed, share of the full measurement,
    folder to work in) -> JSON values. as_markdown: JSON values -> text below the title. is_held: whether all
    that was promised was found.
    """

    name: str
    title: str
    measure: Callable[[int, float, Path], dict[str, Any]]
    as_markdown: Callable[[dict[str, Any]], str]
    is_held: Callable[[dict[str, Any]], bool]
