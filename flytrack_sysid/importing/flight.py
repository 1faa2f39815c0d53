"""What a reader returns of one file, and which of its rows are used."""

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flytrack_env.files import open_file
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_sysid.importing.craft import Craft
from flytrack_sysid.importing.mapping import Manifest, Mapping
from flytrack_sysid.log import FlightLog, LogError

LARGEST_MANIFEST_BYTES = 2**24
MOST_DIGITS = 15
LONGEST_LIST = 1000  # characters of a header


class Flight(NamedTuple):
    """One file's flight: its log, what the file states of the craft, and what a reader should know of it."""

    log: FlightLog
    craft: Craft = Craft()
    notes: tuple[str, ...] = ()


def used_rows(path: Path, log: FlightLog, mapping: Mapping) -> FlightLog:
    """Return the rows of a file's log that the mapping wants.

    Raises:
        LogError: none are left, or the manifest does not say how many.
    """
    rows = mapping.rows
    count = rows.count if rows.manifest is None else _count_of(path, rows.manifest)
    since_start = log.time - log.time[:1]
    is_used = since_start >= rows.from_s
    if rows.to_s is not None:
        is_used &= since_start <= rows.to_s
    index = np.arange(len(log))
    is_used &= (index >= rows.first) & ((index - rows.first) % rows.every == 0)
    if count is not None:
        is_used &= index < rows.first + count
    if not is_used.any():
        raise LogError(f"{mapping.source}: rows: none of the {len(log)} rows of {path} is left")
    return log.select(is_used)


def _count_of(path: Path, asked: Manifest) -> int:
    """Return how many rows of a file the manifest beside it says to use."""
    manifest = path.parent / asked.file
    where = f"{path.parent}/{quote_name(asked.file)}"
    if manifest.name != asked.file:
        raise LogError(f"{where}: expected the name of a file beside the log, not a path")
    try:
        with open_file(manifest, LARGEST_MANIFEST_BYTES) as file:
            text = io.TextIOWrapper(file, encoding="utf-8-sig", newline="")
            count = _find_count(where, csv.reader(text, strict=True), asked, path.name)
    except (OSError, ValueError, csv.Error) as error:  # ValueError: no text, or a NUL in the name
        if isinstance(error, LogError):
            raise
        raise LogError(f"{where}: cannot be read as a manifest: {error_text(error)}") from error
    if count is None:
        raise LogError(f"{where}: column {quote_name(asked.key)}: {path.name}: missing")
    return count


def _find_count(where: str, table: Iterator[list[str]], asked: Manifest, file: str) -> int | None:
    """Return what a manifest's row of a file says, None where there is no such row."""
    names = next(table, [])
    for name in (asked.key, asked.count):
        if name not in names:
            listed = ", ".join(map(quote_name, names))[:LONGEST_LIST]
            raise LogError(f"{where}: column {quote_name(name)}: missing; found {listed}")
    key, count = names.index(asked.key), names.index(asked.count)
    for entry in table:
        if entry[key : key + 1] == [file]:
            text = "".join(entry[count : count + 1]).strip()
            if not text.isdecimal() or len(text) > MOST_DIGITS:
                found, expected = quote_value(text), f"a whole number of at most {MOST_DIGITS} digits"
                raise LogError(
                    f"{where}: {file}: {quote_name(asked.count)}: found {found}, expected {expected}"
                )
            return int(text)
    return None
