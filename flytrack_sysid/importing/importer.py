"""From files of measured flights to one flight log."""

import csv
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.files import read_at_most, write_atomically
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_sysid.clocks import ClockOffset, align_clocks
from flytrack_sysid.importing.bag_log import read_bag
from flytrack_sysid.importing.betaflight_log import read_betaflight
from flytrack_sysid.importing.commands import LEFT_OUT
from flytrack_sysid.importing.dataflash_log import read_dataflash
from flytrack_sysid.importing.flight import Craft, ImportedFlight
from flytrack_sysid.importing.ground import find_ground
from flytrack_sysid.importing.mapping import Manifest, Mapping, load_mapping
from flytrack_sysid.importing.table_flight import read_csv
from flytrack_sysid.importing.ulog_log import read_ulog
from flytrack_sysid.importing.usd_log import read_usd
from flytrack_sysid.log import FlightLog, LogError, median_step
from flytrack_sysid.log_file import describe
from flytrack_sysid.plausibility import find_problems
from flytrack_sysid.resample import SLOW_STEP_S

READERS: dict[str, Callable[[Path, Mapping], Any]] = {  # flights of a file, or its only one
    "csv": read_csv,
    "ulog": read_ulog,
    "betaflight": read_betaflight,
    "dataflash": read_dataflash,
    "usd": read_usd,
    "bag": read_bag,
}
FORMATS = tuple(READERS)
FORMATS_OF_SEVERAL_LOGS = ("betaflight",)
MAX_MANIFEST_BYTES = 2**24
# Betaflight logs at up to 8 kHz. A diagnosis at 500 Hz takes minutes, and sees lags of 2 ms.
DENSE_FORMATS, DENSE_STEP_S = ("betaflight",), 0.002
MIN_THRUST = -0.9  # command: in flight it exceeds a twentieth of the thrust range at some time


@dataclass(frozen=True)
class Imported:
    """The result of an import.

    Attributes:
        log: a segment per flight, numbered from 0.
        sources: the file of each segment.
        craft: what files and mapping state.
        offsets: between the sensors' clocks.
        notes: what was left out.
    """

    log: FlightLog
    sources: tuple[str, ...]
    craft: Craft
    offsets: tuple[ClockOffset, ...]
    notes: tuple[str, ...]

    @cached_property
    def problems(self) -> tuple[str, ...]:
        """Reasons why no flight can have this log; ``fit`` would refuse it."""
        return tuple(find_problems(self.log))

    def nominal_model(self) -> ModelParameters:
        """Return the generic quadcopter scaled to this craft, as a start for fits.

        Raises:
            LogError: the full-stick rates, the mass or the voltage are unknown.
        """
        return self.craft.nominal_model(self.log.source)

    def describe(self) -> str:
        """Return the import in lines."""
        num_rows = np.bincount(self.log.segment)
        segments = [
            f"segment {number}: {source}, {num_rows[number]} rows"
            for number, source in enumerate(self.sources)
        ]
        clocks = [offset.describe() for offset in self.offsets]
        problems = [f"warning: {problem}" for problem in self.problems]
        lines = [
            *segments,
            *self.notes,
            describe(self.log),
            self.craft.describe(),
            *clocks,
            *problems,
        ]
        return "\n".join(lines)

    def save_details(self, path: str | Path) -> None:
        """Write what the log cannot hold as JSON: sources, craft, clocks, notes, problems."""
        document = {
            "sha256": self.log.sha256,
            "sources": self.sources,
            "craft": self.craft.as_json(),
            "clocks": [offset.as_json() for offset in self.offsets],
            "notes": self.notes,
            "problems": self.problems,
        }
        write_atomically(
            Path(path), (json.dumps(document, indent=2, allow_nan=False) + "\n").encode()
        )


def import_log(
    paths: str | Path | Iterable[str | Path],
    format: str,
    mapping: str | Path | None = None,
    align: bool = True,
) -> Imported:
    """Return measured flights as one flight log in SI units and our frames, a segment each.

    Where neither files nor mapping state the craft's voltages, they are taken from the log if all
    of its voltages are above 0.

    Args:
        paths: one file or several.
        format: one of ``FORMATS``.
        mapping: a mapping file, or the name of a shipped one; CSV, uSD logs and bags need it, other
            formats use its ``rows`` and ``craft``.
        align: correct significant offsets between the sensors' clocks (``flytrack_sysid.clocks``)
            instead of only reporting them.

    Raises:
        LogError: a file cannot be read or used; the message names file and field, what was found
            and what was expected.
    """
    files = [Path(path) for path in ([paths] if isinstance(paths, (str, Path)) else paths)]
    if format not in READERS:
        raise LogError(f"format: found {format!r}, expected one of {', '.join(FORMATS)}")
    if not files:
        raise LogError("found no files to import, expected at least one")
    loaded = Mapping() if mapping is None else load_mapping(mapping)
    if loaded.rows.logs and format not in FORMATS_OF_SEVERAL_LOGS:
        raise LogError(f"{loaded.source}: rows.logs: a file of format {format} holds one log")
    flights_read: list[tuple[Path, ImportedFlight]] = []
    for path in files:
        read = READERS[format](path, loaded)
        several = read if format in FORMATS_OF_SEVERAL_LOGS else [read]
        flights_read += [(path, flight) for flight in several]
    notes = (*loaded.notes, *(note for _, flight in flights_read for note in flight.notes))
    flights, ground_notes = _flights_in_the_air(flights_read, loaded, format in DENSE_FORMATS)
    notes += ground_notes
    flights, stick_notes = _with_common_sticks(flights)
    notes += stick_notes
    sources = [flight.log.source for flight in flights]
    log = _concatenate([flight.log for flight in flights], sources)
    log, offsets = align_clocks(log, align)
    craft = _common_craft(flights, sources)
    log = replace(
        log,
        origin="measured",
        stated_voltage_v=None if "v_bat" in log else craft.voltage_v,
        stated_mass_kg=craft.mass_kg,
    )
    if craft.voltage_v is None and "v_bat" in log and log["v_bat"].min() > 0.0:
        craft = craft._replace(voltage_v=(float(log["v_bat"].min()), float(log["v_bat"].max())))
    step_s = median_step(log)
    if "w" in log and step_s > SLOW_STEP_S:
        remark = f"body rates at {1.0 / step_s:.3g} Hz: too slow for a rate loop's lag or delay"
        notes += (f"{log.source}: {remark}",)
    return Imported(log, tuple(sources), craft, offsets, notes)


def _parts(flight: ImportedFlight) -> list[ImportedFlight]:
    """Return the segments of a flight as separate flights; the first one has the notes."""
    log = flight.log
    numbers = np.unique(log.segment)
    if len(numbers) == 1:
        return [flight]
    flights = []
    for count, number in enumerate(numbers, start=1):
        segment_log = replace(
            log.select(log.segment == number),
            source=f"{log.source}, part {count} of {len(numbers)}",
        )
        flights.append(flight._replace(log=segment_log, notes=flight.notes if count == 1 else ()))
    return flights


def _flights_in_the_air(
    flights_read: list[tuple[Path, ImportedFlight]], mapping: Mapping, is_dense: bool
) -> tuple[list[ImportedFlight], tuple[str, ...]]:
    """Return the flights with only the rows that are selected and in the air, and notes.

    Args:
        flights_read: the flights, each with its file.
        mapping: selects rows.
        is_dense: the format logs more rows than a diagnosis needs.

    Raises:
        LogError: nothing flies in any of them.
    """
    airborne, reasons, notes = list[ImportedFlight](), list[str](), list[str]()
    for (path, flight), is_ground in zip(
        flights_read, find_ground([flight.log for _, flight in flights_read]), strict=True
    ):
        log, source = flight.log, flight.log.source
        every = mapping.rows.every or (_usual_every(log) if is_dense else 1)
        if mapping.rows.every is None and every > 1:
            notes.append(f"{source}: one row of {every} is used; rows.every = 1 uses all")
        is_used = _is_selected(path, log, mapping, every)
        if flight.is_landed is not None:
            is_ground = is_ground | flight.is_landed
        num_used, num_ground = is_used.sum(), np.sum(is_used & is_ground)
        if mapping.rows.on_ground == "keep":
            is_kept = is_used
        elif num_ground == num_used:
            reasons.append(f"{source}: nothing flies: on the ground in all {num_used} rows")
            continue
        elif log.throttle[is_used].max() < MIN_THRUST:
            reasons.append(
                f"{source}: nothing flies: the thrust command never exceeds 5 % of its range"
            )
            continue
        else:
            is_kept = is_used & ~is_ground
            if num_ground:
                notes.append(f"{source}: {num_ground} of {num_used} rows left out: on the ground")
        log, voltage_notes = _with_measured_voltage(log.select(is_kept))
        notes += voltage_notes
        airborne += _parts(flight._replace(log=log, is_landed=None))
    if not airborne:
        raise LogError(f'{reasons[0]}; rows.on_ground = "keep" in a mapping uses them')
    return airborne, (*notes, *(f"left out: {reason}" for reason in reasons))


def _with_measured_voltage(log: FlightLog) -> tuple[FlightLog, list[str]]:
    """Return the log without voltages of 0, which are not measured, and a note if some are 0."""
    if "v_bat" not in log or log["v_bat"].min() > 0.0:
        return log, []
    is_measured = log["v_bat"][:, 0] > 0.0
    problem = f"{log.source}: v_bat: not above 0 V in {np.sum(~is_measured)} of {len(log)} rows"
    if not is_measured.any():
        return log.without("v_bat"), [f"{problem}: left out"]
    row = np.arange(len(log))
    volts = np.interp(row, row[is_measured], log["v_bat"][is_measured, 0])
    channels = {**log.channels, "v_bat": volts[:, None]}
    return replace(log, channels=channels), [f"{problem}: interpolated between the others"]


def _usual_every(log: FlightLog) -> int:
    """Return which share of a log's rows leaves about 500 Hz: one of so many."""
    return max(1, round(DENSE_STEP_S / median_step(log)))


def _is_selected(path: Path, log: FlightLog, mapping: Mapping, every: int) -> np.ndarray:
    """Return which rows of a file's log the mapping selects, (num_rows,) bool."""
    rows = mapping.rows
    since_start = log.time - log.time[:1]
    is_used = since_start >= rows.from_s
    if rows.to_s is not None:
        is_used &= since_start <= rows.to_s
    if rows.ranges_s:
        is_used &= np.any(
            [(since_start >= low) & (since_start <= high) for low, high in rows.ranges_s], axis=0
        )
    index = np.arange(len(log))
    is_used &= index % every == 0
    if rows.above_m is not None:
        is_used &= _is_airborne(log, rows.above_m, mapping.source)
    if rows.manifest is not None:
        is_used &= index < _count_of(path, rows.manifest)
    if not is_used.any():
        raise LogError(f"{mapping.source}: rows: none of the {len(log)} rows of {path} is left")
    return is_used


def _is_airborne(log: FlightLog, above_m: float, source: str) -> np.ndarray:
    """Return the longest stretch of rows higher than the first by ``above_m``, (num_rows,) bool."""
    if "p" not in log:
        raise LogError(
            f"{source}: rows.above_m: found no position in {log.source}, expected one to tell "
            "heights"
        )
    is_high = log["p"][:, 2] - log["p"][0, 2] > above_m
    stretch = np.cumsum(np.diff(is_high, prepend=False))  # odd stretches are high
    longest_stretch = np.argmax(np.bincount(stretch[is_high])) if is_high.any() else -1
    return stretch == longest_stretch


def _count_of(path: Path, wanted: Manifest) -> int:
    """Return the number of rows of a file to use, as the manifest beside it says."""
    manifest = path.parent / wanted.file
    where = f"{path.parent}/{quote_name(wanted.file)}"
    if manifest.name != wanted.file:
        raise LogError(f"{where}: expected the name of a file beside the log, not a path")
    try:
        lines = read_at_most(manifest, MAX_MANIFEST_BYTES).decode("utf-8-sig").splitlines()
        rows = list(csv.DictReader(lines, strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise LogError(f"{where}: cannot be read as a manifest: {error_text(error)}") from error
    text = next((row.get(wanted.count) for row in rows if row.get(wanted.key) == path.name), None)
    if text is None:
        columns = f"columns {quote_name(wanted.key)} and {quote_name(wanted.count)}"
        raise LogError(f"{where}: {columns}: {path.name}: missing")
    try:
        return int(text)
    except ValueError as error:
        problem = f"found {quote_value(text)}, expected a whole number"
        raise LogError(f"{where}: {path.name}: {quote_name(wanted.count)}: {problem}") from error


def _with_common_sticks(
    flights: list[ImportedFlight],
) -> tuple[list[ImportedFlight], tuple[str, ...]]:
    """Return flights of motors without sticks if these differ in scale or one lacks them; a note.

    The body needs no sticks, so such flights are of one craft nevertheless.
    """
    kinds = {("sticks" in flight.log, flight.craft.max_rate_deg_s) for flight in flights}
    if len(kinds) == 1 or not flights[0].log.has_motors:
        return flights, ()
    unscaled = [
        flight._replace(
            log=flight.log.without("sticks"), craft=flight.craft._replace(max_rate_deg_s=None)
        )
        for flight in flights
    ]
    problem = "found files without them, or with other rates at full stick; expected the same"
    return unscaled, (f"{LEFT_OUT}: {problem}",)


def _concatenate(logs: list[FlightLog], sources: list[str]) -> FlightLog:
    """Return the logs as segments of one."""
    first = logs[0]
    for log, source in zip(logs, sources, strict=True):
        if set(log.channels) != set(first.channels):
            different = ", ".join(sorted(set(log.channels) ^ set(first.channels)))
            raise LogError(
                f"{source}: channels {different}: not in both this file and {sources[0]}"
            )
    return replace(
        first,
        time=np.concatenate([log.time for log in logs]),
        channels={name: np.concatenate([log[name] for log in logs]) for name in first.channels},
        segment=np.repeat(np.arange(len(logs)), [len(log) for log in logs]),
        source=sources[0] if len(logs) == 1 else f"{sources[0]} and {len(logs) - 1} more",
    )


def _common_craft(flights: list[ImportedFlight], sources: list[str]) -> Craft:
    """Return the craft of all flights; raises LogError if they differ."""
    first = flights[0].craft
    for flight, source in zip(flights, sources, strict=True):
        if flight.craft != first:
            crafts = f"{flight.craft.describe()}; {sources[0]}: {first.describe()}"
            raise LogError(f"{source}: {crafts}; expected flights of one craft in one log")
    return first
