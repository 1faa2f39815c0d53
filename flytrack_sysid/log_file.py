"""Files of flight logs, ``.npz`` and ``.csv``, checked when read.

The same log gives the same bytes. The columns are those of ``flytrack_sysid.log``. An ``.npz``
holds one array of numbers per column. A ``.csv`` has a header of column names, then one row of
numbers per sample, separated by commas; blank lines are skipped.

``open_csv`` and ``read_columns`` read numbers from CSV files of any source, also gzip-compressed.
Every error names the file, row and column.
"""

import contextlib
import csv
import gzip
import io
import math
import zlib
from array import array
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env import motors
from flytrack_env.files import open_file, write_atomically
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_env.npz_file import NpzError, load_npz, npz_of
from flytrack_env.toml_file import TomlError, parse_toml, read_text
from flytrack_sysid.log import CHANNELS, GAP_STEPS, FlightLog, LogError, usual_step
from flytrack_sysid.log_table import Table, check_names, columns_of, log_of_table, stated_columns

SUFFIXES = (".npz", ".csv")
MAX_BYTES = 512 * 2**20
PACKED_BYTES, MAX_RATIO = (
    2**24,
    32,
)  # most characters of a compressed file: that many, or that many times its bytes if more
MAX_VALUES = (
    56 * 2**20
)  # all columns at 1 kHz for half an hour; twice as many float64 take less than 1 GiB
MAX_ROW_LENGTH = 2**16  # characters: thousands of columns


def load_log(path: str | Path) -> FlightLog:
    """Return the log in an ``.npz`` or ``.csv`` file; the suffix says which. Nothing is unpickled.

    Without a column ``segment``, all rows are one segment. Quaternions are normalised.

    Raises:
        LogError: the file is no valid log; the message names file, row and column. Rows count from
            0, lines of a CSV file from 1.
    """
    path = Path(path)
    check_name(path)
    try:
        return log_of_table(_read_npz(path) if path.suffix.lower() == ".npz" else _read_csv(path))
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error_text(error)}") from error


def save_log(path: str | Path, log: FlightLog) -> None:
    """Write a log to an ``.npz`` or ``.csv`` file, atomically; the suffix says which.

    Reading restores every float64 exactly, and the same log gives the same bytes.

    Raises:
        LogError: ``load_log`` would refuse the log.
        OSError: the file cannot be written.
    """
    path = Path(path)
    check_name(path)
    columns = {"t": np.asarray(log.time, float)}
    if len(log) and np.any(log.segment != log.segment[0]):
        columns["segment"] = log.segment
    channels = {name: np.asarray(values, float) for name, values in log.channels.items()}
    columns |= columns_of(columns["t"], channels) | stated_columns(log)
    check_names(str(path), list(columns))
    log_of_table(Table(str(path), {name: values.astype(float) for name, values in columns.items()}))
    write_atomically(path, npz_of(columns) if path.suffix.lower() == ".npz" else _csv_of(columns))


def check_name(path: str | Path) -> None:
    """Raise LogError for a file name that ``save_log`` would refuse, before there is a log."""
    if Path(path).suffix.lower() not in SUFFIXES:
        raise LogError(
            f"{path}: found suffix {Path(path).suffix!r}, expected {' or '.join(SUFFIXES)}"
        )


def load_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file that describes logs; raises LogError."""
    try:
        return parse_toml(read_text(path))
    except (OSError, UnicodeDecodeError, TomlError) as error:
        raise LogError(f"{path}: not a readable TOML file: {error_text(error)}") from error


def gaps_of(log: FlightLog) -> np.ndarray:
    """Return the rows after which samples are missing, (num_gaps,) int.

    After these rows, the time step exceeds 1.5 times the median step of the segment.
    """
    return np.flatnonzero(
        ~log.is_start()[1:] & (np.diff(log.time) > GAP_STEPS * usual_step(log)[:-1])
    )


def describe(log: FlightLog) -> str:
    """Return a few lines on a log: origin, duration, sample interval, gaps, channels, ranges."""
    is_inside = ~log.is_start()[1:]
    steps = np.diff(log.time)
    kinds = CHANNELS if log.has_motors else CHANNELS.keys() - {"sticks"}  # "u" holds them
    absent = [name for name in CHANNELS if name in kinds and name not in log]
    lines = [
        f"{log.source}: {len(log)} rows, {log.is_start().sum()} segments, "
        f"{steps[is_inside].sum():.2f} s",
        f"origin: {log.origin or 'not marked'}",
        f"channels: {', '.join(log.channels)}; absent: {', '.join(absent) or 'none'}",
    ]
    if is_inside.any():
        median, gaps = np.median(steps[is_inside]), gaps_of(log)
        lines[1:1] = [
            f"sample interval: {median:.4g} s (median), {1.0 / median:.4g} Hz",
            "gaps: none",
        ]
        if len(gaps):
            gap_row = gaps[np.argmax(steps[gaps])]
            lines[2] = f"gaps: {len(gaps)}, longest {steps[gap_row]:.4g} s, after row {gap_row}"
    return "\n".join([*lines, *_ranges(log)])


def _ranges(log: FlightLog) -> list[str]:
    """Return lines on the ranges of commands and of measured speed, tilt, height and voltage."""
    names = motors.NAMES if log.has_motors else CHANNELS["u"]
    commands = [
        f"{column} {values.min():.3g} to {values.max():.3g}"
        for column, values in zip(names, log["u"].T, strict=True)
    ]
    ranges = []
    if "v" in log:
        ranges.append(f"speed up to {np.linalg.norm(log['v'], axis=1).max():.3g} m/s")
    if "q" in log:
        upright = 1.0 - 2.0 * (log["q"][:, 1] ** 2 + log["q"][:, 2] ** 2)  # cosine of the tilt
        ranges.append(
            f"tilt up to {np.rad2deg(np.arccos(np.clip(upright.min(), -1.0, 1.0))):.0f} deg"
        )
    for name, label, unit in (("p", "height", "m"), ("v_bat", "voltage", "V")):
        if name in log:
            values = log[name][:, -1]  # p_z, or the only column
            ranges.append(f"{label} {values.min():.4g} to {values.max():.4g} {unit}")
    return [f"commands: {'; '.join(commands)}", *(["; ".join(ranges)] if ranges else [])]


def _read_npz(path: Path) -> Table:
    """Return the arrays of an .npz file as columns."""
    try:
        arrays = load_npz(path, MAX_BYTES)
    except NpzError as error:
        raise LogError(f"{path}: {error}") from error
    check_names(str(path), list(arrays))
    for name, values in arrays.items():
        if values.dtype.kind not in "iuf" or values.ndim != 1:
            description = f"an array of {values.dtype}, shape {values.shape}"
            raise LogError(f"{path}: column {name}: found {description}, expected a row of numbers")
    return Table(str(path), {name: np.asarray(values, float) for name, values in arrays.items()})


def _read_csv(path: Path) -> Table:
    """Return the columns of a CSV file."""
    with open_csv(path) as rows:
        header = [name.strip() for name in next(rows, [])]
        check_names(str(path), header)
        return read_columns(path, rows, header, header)


def _csv_of(columns: dict[str, np.ndarray]) -> bytes:
    """Return a CSV file with the shortest digits that restore each float64."""
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
    return ("\n".join(lines) + "\n").encode()


@contextlib.contextmanager
def open_csv(path: Path, delimiter: str = ",") -> Iterator[Any]:
    """Yield the ``csv.reader`` of a file, unpacked if its name ends in .gz.

    Raises:
        LogError: the file cannot be read, or is no CSV file.
    """
    rows = None
    try:
        with open_file(path, MAX_BYTES) as file:
            stream: Any = file
            max_characters = MAX_BYTES
            if path.suffix == ".gz":
                max_characters = min(MAX_BYTES, max(PACKED_BYTES, MAX_RATIO * path.stat().st_size))
                stream = gzip.GzipFile(fileobj=file)
            with io.TextIOWrapper(stream, encoding="utf-8-sig", newline="") as text:
                rows = csv.reader(_lines(text, max_characters), delimiter=delimiter, strict=True)
                yield rows
    except (csv.Error, UnicodeDecodeError) as error:
        where = f"{path}: near line {rows.line_num + 1 if rows else 1}"
        raise LogError(f"{where}: not a CSV file: {error_text(error)}") from error
    except (OSError, EOFError, zlib.error) as error:
        raise LogError(f"{path}: cannot be read: {error_text(error)}") from error


def _lines(text: io.TextIOWrapper, max_characters: int) -> Iterator[str]:
    """Yield the lines of a file; no row may have several, so ``csv`` never reads much at once."""
    num_characters = 0
    while line := text.readline(MAX_ROW_LENGTH):
        num_characters += len(line)
        if len(line) == MAX_ROW_LENGTH:
            raise csv.Error(f"found a row of {MAX_ROW_LENGTH} characters or more, expected fewer")
        if num_characters > max_characters:
            raise csv.Error(f"found more than {max_characters} characters, expected at most that")
        if line.count('"') % 2:
            raise csv.Error("found a quote that does not end on its line")
        yield line


def read_columns(path: Path, rows: Any, header: list[str], wanted: Iterable[str]) -> Table:
    """Return the wanted columns of the rows after the header; blank rows are skipped.

    Args:
        path: the file, for messages.
        rows: the ``csv.reader`` after its header.
        header: all columns of the file.
        wanted: the columns to return; the header has each of them.

    Raises:
        LogError: a row has another length, a cell is no finite number, or there are more than
            ``MAX_VALUES`` numbers.
    """
    indices = {name: header.index(name) for name in wanted}
    values, lines = array("d"), array("q")
    for cells in filter(None, rows):
        where = f"{path}: row {len(lines)} (line {rows.line_num})"
        if len(cells) != len(header):
            raise LogError(
                f"{where}: found {len(cells)} cells, expected {len(header)} as in the header"
            )
        values.extend(_number(where, name, cells[index]) for name, index in indices.items())
        lines.append(rows.line_num)
        if len(values) > MAX_VALUES:
            raise LogError(f"{path}: found more than {MAX_VALUES} numbers, expected at most that")
    columns = np.asarray(values).reshape(-1, len(indices)).T
    return Table(str(path), dict(zip(indices, columns, strict=True)), np.asarray(lines))


def _number(where: str, column: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if (
        not math.isfinite(value) or "_" in cell
    ):  # Python reads 1_000 as a number; other programs do not
        description = quote_value(cell) if cell.strip() else "an empty cell"
        raise LogError(
            f"{where}, column {quote_name(column)}: found {description}, expected a finite number"
        )
    return value
