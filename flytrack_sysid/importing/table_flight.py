"""Flights of tables of columns, by a mapping: CSV files, Crazyflie's uSD logs, bags of topics."""

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from flytrack_env.messages import quote_name
from flytrack_sysid.importing.commands import read_commands, read_sticks
from flytrack_sysid.importing.file_kinds import EMPTY, GZIP, UNKNOWN, check_kind
from flytrack_sysid.importing.flight import ImportedFlight, list_names, log_of_channels
from flytrack_sysid.importing.mapping import Channel, CsvFile, Mapping
from flytrack_sysid.log import LogError
from flytrack_sysid.log_file import open_csv, read_columns
from flytrack_sysid.log_table import Table
from flytrack_sysid.resample import Samples, on_one_base, slow_channels
from flytrack_sysid.timestamps import MAX_LATENCY_S, number_segments, put_on_one_line, read_clock

TIMESTAMP = "timestamp"  # column of a table's own times, s
RECORDED = "recorded"  # column of the times of recording, s, by one clock for all tables
BASES = ("w", "q", "p")  # the rows are those of the first one that a log has


def channels_in(
    source: str, headers: Sequence[Iterable[str]], mapping: Mapping
) -> list[tuple[Channel, int]]:
    """Return the channels that a log has, each with the number of its table.

    Args:
        source: the log, for messages.
        headers: column names of the tables.
        mapping: states the channels and their columns.

    Raises:
        LogError: no table has a column of the mapping, or a table has it several times.
    """
    if not mapping.channels:
        raise LogError(f"{source}: {mapping.source} names no columns; such a file needs [command]")
    column_names = [list(header) for header in headers]
    result = []
    for channel in mapping.channels:
        counts = [[header.count(column) for column in channel.columns] for header in column_names]
        fitting = [table for table, count in enumerate(counts) if all(n == 1 for n in count)]
        if fitting:
            result.append((channel, fitting[0]))
        elif not (channel.is_optional and not any(map(any, counts))):
            absent = [0] * len(channel.columns)
            count = max(counts, key=lambda found: sum(map(bool, found)), default=absent)
            column, times = next(
                (c, n) for c, n in zip(channel.columns, count, strict=True) if n != 1
            )
            listed = list_names(dict.fromkeys(itertools.chain(*column_names)))
            where = f"{source}: column {quote_name(column)}: found {times} times among {listed}"
            raise LogError(f"{where}; expected once by {mapping.source}: {channel.table}")
    return result


def read_csv(path: Path, mapping: Mapping) -> ImportedFlight:
    """Return the flight in a CSV file with a header, by a mapping; SI units and our frames.

    Args:
        path: of the file, or of a folder if the mapping has several files.
        mapping: states the columns.

    Raises:
        LogError: the file cannot be used; the message names file, row, line and column.
    """
    if mapping.files:
        return _read_files(path, mapping)
    if path.is_dir():
        raise LogError(
            f"{path}: found a folder, expected a file, or files.NAME in {mapping.source}"
        )
    check_kind(path, "csv", "text with commas, or such compressed by gzip", (EMPTY, GZIP, UNKNOWN))
    with open_csv(path, mapping.delimiter) as rows:
        header = [name.strip() for name in next(rows, [])]
        channels = channels_in(str(path), [header], mapping)
        wanted = dict.fromkeys(column for channel, _ in channels for column in channel.columns)
        table = read_columns(path, rows, header, wanted)
    if table.lines is None or not len(table.lines):
        raise LogError(f"{path}: found no rows, expected at least one")
    by_name = {channel.name: channel for channel, _ in channels}
    if "t" not in by_name:
        raise LogError(f"{mapping.source}: time: missing, expected a table: every log has it")
    clock = read_clock(str(path), "the rows", by_name.pop("t").convert(table)[:, 0])
    notes = tuple(f"{path}: {text}" for text in clock.describe("the rows"))
    times = put_on_one_line(str(path), {"rows": clock}, "rows")["rows"]
    table = table.select(clock.is_used)
    values = {name: channel.convert(table) for name, channel in by_name.items()}
    flight = _flight(table, times - times[0], clock.max_gap_s, values, mapping)
    return flight._replace(notes=notes + flight.notes)


def _read_files(folder: Path, mapping: Mapping) -> ImportedFlight:
    """Return the flight in a folder of CSV files, by a mapping of columns ``file:column``."""
    if not folder.is_dir():
        raise LogError(
            f"{folder}: found no folder, expected one with the files of {mapping.source}: files"
        )
    wanted: dict[str, dict[str, None]] = {}
    for channel in mapping.channels:
        for column in channel.columns:
            name, colon, field = column.partition(":")
            if name not in mapping.files or not colon:
                expected = f"expected file:column, where file is one of {', '.join(mapping.files)}"
                problem = f"{mapping.source}: {channel.table}: found {quote_name(column)}"
                raise LogError(f"{problem}, {expected}")
            wanted.setdefault(name, {})[field] = None
    tables = []
    for name, fields in wanted.items():
        file = mapping.files[name]
        paths = sorted(folder.glob(file.file))
        if len(paths) != 1:
            listed = list_names(path.name for path in sorted(folder.iterdir()))
            problem = f"found {len(paths)} files of the name {quote_name(file.file)} among {listed}"
            raise LogError(f"{folder}: {problem}; expected one by {mapping.source}: files.{name}")
        tables.append(_read_file(paths[0], name, file, list(fields), mapping))
    return build_flight(str(folder), tables, mapping)


def _read_file(path: Path, name: str, file: CsvFile, fields: list[str], mapping: Mapping) -> Table:
    """Return the wanted columns of one of several files, ``file:column``, and its times, s."""
    with open_csv(path, mapping.delimiter) as rows:
        header = [column.strip() for column in next(rows, [])]
        for column in (file.time, *fields):
            if header.count(column) != 1:
                listed = list_names(header)
                problem = (
                    f"{path}: column {quote_name(column)}: found {header.count(column)} times "
                    f"among {listed}"
                )
                raise LogError(f"{problem}; expected once by {mapping.source}: files.{name}")
        table = read_columns(path, rows, header, dict.fromkeys((file.time, *fields)))
    columns = {f"{name}:{field}": table.columns[field] for field in fields}
    times = table.columns[file.time] * file.si_per_unit("time") + file.offset_s
    return Table(str(path), {TIMESTAMP: times, **columns}, table.lines)


def build_flight(source: str, topics: Sequence[Table], mapping: Mapping) -> ImportedFlight:
    """Return the flight in tables that each have a clock and a time column.

    The rows are those of the body rates, else of the attitude or the position. Other sensors are
    interpolated, and commands are held. There are no rows where a channel has a gap of more than
    three of its usual steps.
    """
    samples, clocks, latencies_s, remarks = {}, {}, {}, list[str]()
    for channel, number in channels_in(source, [topic.columns for topic in topics], mapping):
        topic = topics[number]
        if channel.name == "t":
            raise LogError(
                f"{mapping.source}: time: found a table, expected none: the log has its own times"
            )
        is_finite = np.isfinite(topic.matrix(channel.columns)).all(axis=1)
        if not is_finite.any():
            raise LogError(
                f"{source}: {channel.table}: found no row of finite numbers, expected some"
            )
        clock = read_clock(
            source, channel.table, np.where(is_finite, topic.columns[TIMESTAMP], np.nan)
        )
        remarks += [text for text in clock.describe(channel.table) if text not in remarks]
        kept = topic.select(clock.is_used)
        clocks[channel.name], samples[channel.name] = (
            clock,
            Samples(clock.times, channel.convert(kept)),
        )
        if RECORDED in topic.columns:
            latencies_s[channel.name] = float(np.median(kept.columns[RECORDED] - clock.times))
    base_name = next((name for name in BASES if name in samples), None)
    if base_name is None:
        raise LogError(
            f"{source}: {mapping.source}: rates: missing; attitude or position may replace them"
        )
    for name, latency_s in latencies_s.items():
        early_s = latency_s - latencies_s.get(base_name, latency_s)
        if abs(early_s) > MAX_LATENCY_S:
            clocks[name] = clocks[name]._replace(times=clocks[name].times + early_s)
            shift = (
                f"stamps of {name} are {early_s:+.6g} s before those of {base_name}, by their "
                "recording"
            )
            remarks.append(f"{shift}: moved by this, so that {name} is as late as recorded")
    times = put_on_one_line(source, clocks, base_name)
    samples = {name: Samples(times[name], values) for name, (_, values) in samples.items()}
    base = times[base_name]
    values, is_known = on_one_base(samples, base)
    if not is_known.any():
        raise LogError(f"{source}: found no time at which all channels are known, expected some")
    values = {name: rows[is_known] for name, rows in values.items()}
    since_start = base[is_known] - base[is_known][0]
    flight = _flight(Table(source, {}), since_start, clocks[base_name].max_gap_s, values, mapping)
    remarks += slow_channels(samples)
    if not is_known.all():
        count = f"{np.sum(~is_known)} of {len(clocks[base_name].is_used)} rows"
        remarks.append(f"{count} left out: not all channels are known there")
    return flight._replace(notes=(*(f"{source}: {text}" for text in remarks), *flight.notes))


def _flight(
    table: Table,
    time: np.ndarray,
    max_gap_s: float,
    values: dict[str, np.ndarray],
    mapping: Mapping,
) -> ImportedFlight:
    """Return the flight of converted channels; steps above ``max_gap_s`` begin a new segment."""
    max_rate_deg_s = mapping.craft.max_rate_deg_s
    commands, notes = read_commands(table.source, time, values, mapping.rules, max_rate_deg_s)
    channels = {**values, "u": commands}
    segment, of_motors = number_segments(time, max_gap_s), mapping.rules.motors_as_command
    if of_motors:
        sticks, stick_notes = read_sticks(table.source, values, max_rate_deg_s)
        notes += stick_notes
        if sticks is not None:
            channels["sticks"] = sticks
    log = log_of_channels(table, time, segment, channels, of_motors)
    return ImportedFlight(log, mapping.craft, notes)
