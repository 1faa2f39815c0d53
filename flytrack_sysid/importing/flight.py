"""What a reader returns of one file, and which of its rows are used."""

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flytrack_sysid.importing.craft import Craft
from flytrack_sysid.importing.mapping import Manifest, Mapping
from flytrack_sysid.log import FlightLog, LogError


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


def _count_of(path: Path, said: Manifest) -> int:
    """Return how many rows of a file the manifest beside it says to use."""
    manifest = path.parent / said.file
    try:
        with manifest.open(encoding="utf-8-sig", newline="") as file:
            table = csv.DictReader(file, strict=True)
            entries, names = list(table), table.fieldnames or []
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise LogError(f"{manifest}: cannot be read as a manifest: {error}") from error
    for name in (said.key, said.count):
        if name not in names:
            raise LogError(f"{manifest}: column {name}: missing; found {', '.join(names)}")
    for entry in entries:
        if entry[said.key] == path.name:
            text = entry[said.count]
            if not (text or "").strip().isdecimal():
                raise LogError(
                    f"{manifest}: {path.name}: {said.count}: found {text!r}, expected a whole number"
                )
            return int(text)
    raise LogError(f"{manifest}: column {said.key}: {path.name}: missing")
