"""What a kind of file is."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.reliability.strangers.noise import Rng

Mutator = Callable[[Rng, list[bytes]], bytes]
Hostile = Callable[[list[bytes]], list[bytes]]  # of files that are well, makes files that are meant to harm


def _no_files(_: list[bytes]) -> list[bytes]:
    return []


class Kind(NamedTuple):
    """A kind of file.

    suffix: of its files. write: writes files that are well into a folder. load: of a path. error: the only
    one that it may raise. check: raises AssertionError for what no such file may load as. mutate: damages one
    of the files that are well. hostile: of those, makes files that are meant to harm.
    """

    suffix: str
    write: Callable[[Path], None]
    load: Callable[[Path], Any]
    error: type[Exception]
    check: Callable[[Any], None]
    mutate: Mutator
    hostile: Hostile = _no_files
