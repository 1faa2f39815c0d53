"""From files of other people's flights to one flight log."""

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.files import write_atomically
from flytrack_sysid.importing.betaflight_log import read_betaflight
from flytrack_sysid.importing.clocks import ClockOffset, align_clocks
from flytrack_sysid.importing.craft import Craft, nominal_model
from flytrack_sysid.importing.csv_log import read_csv
from flytrack_sysid.importing.flight import Flight, used_rows
from flytrack_sysid.importing.mapping import Mapping, load_mapping
from flytrack_sysid.importing.ulog_log import read_ulog
from flytrack_sysid.log import FlightLog, LogError
from flytrack_sysid.log_file import describe
from flytrack_sysid.plausibility import find_problems

READERS = {
    "csv": lambda path, mapping: [read_csv(path, mapping)],
    "ulog": lambda path, mapping: [read_ulog(path, mapping)],
    "betaflight": read_betaflight,
}
FORMATS = tuple(READERS)


class Imported(NamedTuple):
    """What an import found.

    log: a segment per flight, numbered from 0. sources: the file of each segment. craft: what files and
    mapping state. offsets: between the sensors' clocks. notes: what was left out. problems: what in the
    log cannot be true of a flight, as ``fit`` would say it.
    """

    log: FlightLog
    sources: tuple[str, ...]
    craft: Craft
    offsets: tuple[ClockOffset, ...]
    notes: tuple[str, ...]
    problems: tuple[str, ...]

    def nominal_model(self) -> ModelParameters:
        """Return the generic quadcopter scaled to this craft: where a fit may begin.

        Raises:
            LogError: full-stick rates, mass or voltage are unknown.
        """
        return nominal_model(self.craft, self.log.source)

    def describe(self) -> str:
        """Return the import in lines."""
        log = self.log
        segments = [
            f"segment {number}: {source}, {np.count_nonzero(log.segment == number)} rows"
            for number, source in enumerate(self.sources)
        ]
        clocks = [offset.describe() for offset in self.offsets]
        problems = [f"warning: {problem}" for problem in self.problems]
        lines = [*segments, *self.notes, describe(log), self.craft.describe(), *clocks, *problems]
        return "\n".join(lines)

    def save_details(self, path: str | Path) -> None:
        """Write what the log itself cannot hold as JSON: sources, craft, clocks, notes, problems.

        Raises:
            OSError: what the system says.
        """
        offsets = [
            {name: _json(value) for name, value in offset._asdict().items()} for offset in self.offsets
        ]
        document = {
            "sha256": self.log.sha256,
            "sources": self.sources,
            "craft": self.craft._asdict(),
            "clocks": offsets,
            "notes": self.notes,
            "problems": self.problems,
        }
        write_atomically(Path(path), (json.dumps(document, indent=2, allow_nan=False) + "\n").encode())


def import_log(
    paths: str | Path | Iterable[str | Path],
    format: str,
    mapping: str | Path | Mapping | None = None,
    align: bool = True,
) -> Imported:
    """Return measured flights as one flight log in SI units and our frames, a segment each.

    paths: one file or several. format: of ``FORMATS``. mapping: a mapping file, or the name of a shipped
    one; CSV needs it, and other formats take its ``rows`` and ``craft``. align: correct the offsets between
    sensors' clocks that are significant (``flytrack_sysid.importing.clocks``); else only report them.
    Voltages that nobody states are those of the log, where all are above 0.

    Raises:
        LogError: what cannot be read or meant; the message names file and field, found and expected.
    """
    files = [Path(path) for path in ([paths] if isinstance(paths, (str, Path)) else paths)]
    if format not in READERS:
        raise LogError(f"format: found {format!r}, expected one of {', '.join(FORMATS)}")
    if not files:
        raise LogError("found no files to import, expected at least one")
    if not isinstance(mapping, Mapping):
        mapping = Mapping() if mapping is None else load_mapping(mapping)
    flights, sources = [], []
    for path in files:
        for flight in READERS[format](path, mapping):
            flights.append(flight._replace(log=used_rows(path, flight.log, mapping)))
            sources.append(flight.log.source)
    log = _joined([flight.log for flight in flights], sources)
    aligned, offsets = align_clocks(log)
    if align:
        log = aligned
    else:
        offsets = tuple(offset.left() for offset in offsets)
    craft = _agreed(flights, sources)
    if craft.voltage_v is None and "v_bat" in log and log["v_bat"].min() > 0.0:
        craft = craft._replace(voltage_v=(float(log["v_bat"].min()), float(log["v_bat"].max())))
    notes = tuple(note for flight in flights for note in flight.notes)
    return Imported(log, tuple(sources), craft, offsets, notes, tuple(find_problems(log)))


def _joined(logs: list[FlightLog], sources: list[str]) -> FlightLog:
    """Return the logs as segments of one, with the channels that all of them have."""
    first = logs[0]
    for log, source in zip(logs, sources, strict=True):
        if set(log.channels) != set(first.channels):
            different = ", ".join(sorted(set(log.channels) ^ set(first.channels)))
            raise LogError(f"{source}: channels {different}: not in both this file and {sources[0]}")
    return replace(
        first,
        time=np.concatenate([log.time for log in logs]),
        channels={name: np.concatenate([log[name] for log in logs]) for name in first.channels},
        segment=np.repeat(np.arange(len(logs)), [len(log) for log in logs]),
        source=sources[0] if len(logs) == 1 else f"{sources[0]} and {len(logs) - 1} more",
    )


def _agreed(flights: list[Flight], sources: list[str]) -> Craft:
    """Return the craft that all files are of."""
    first = flights[0].craft
    for flight, source in zip(flights, sources, strict=True):
        if flight.craft != first:
            what = f"{source}: {flight.craft.describe()}"
            raise LogError(
                f"{what}; {sources[0]}: {first.describe()}; expected flights of one craft in one log"
            )
    return first


def _json(value: float | str) -> float | str | None:
    """Return a value as JSON has it: what is unknown is null."""
    return None if isinstance(value, float) and np.isnan(value) else value
