"""Files of flight logs: ``.npz`` and ``.csv``, checked when read, and the same bytes for the same log.

Columns are those of ``flytrack_sysid.log``. An ``.npz`` holds one array of numbers per column; a ``.csv`` has
a header of column names, then one row of numbers, separated by commas, per sample; blank lines are skipped.
"""

import csv
import io
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import numpy as np

from flytrack_env.files import AtMost, TooLargeError, check_size, open_file, write_atomically
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_env.npz_file import Header, NpzError, NpzFile, open_npz
from flytrack_sysid.log import CHANNELS, GAP_STEPS, FlightLog, LogError, usual_step
from flytrack_sysid.log_table import Rows, Table, check_names, check_number, log_of_table

if TYPE_CHECKING:
    import _csv

Reader = Callable[[Path], Table]
Writer = Callable[[dict[str, np.ndarray]], bytes]

LONGEST_LINE = 2**16  # characters of a CSV file: some hundred times a row of all columns
LARGEST_BYTES = 512 * 2**20  # as they are in the file, unpacked


def load_log(path: str | Path) -> FlightLog:
    """Return the log in an ``.npz`` or ``.csv`` file; the suffix says which.

    Columns, units and frames: ``flytrack_sysid.log``. Without a column ``segment``, all rows are one.
    Quaternions come back with norm 1. Nothing is ever unpickled.

    Raises:
        LogError: a file that cannot be read, or is no log; the message names file, row and column. Rows
            count from 0, lines of a CSV file from 1.
    """
    path = Path(path)
    read, _ = _format_of(path)
    try:
        check_size(path.stat().st_size, LARGEST_BYTES)
        table = read(path)
    except LogError:
        raise
    except TooLargeError as error:
        raise LogError(f"{path}: {error}") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise LogError(f"{path}: cannot be read: {error_text(error)}") from error
    return log_of_table(table)


def save_log(path: str | Path, log: FlightLog) -> None:
    """Write a log to an ``.npz`` or ``.csv`` file; the suffix says which.

    Every float64 comes back the same, and the same log gives the same bytes. The column ``segment`` is
    there only if there is more than one. Written under a temporary name and renamed.

    Raises:
        LogError: another suffix, or a log that ``load_log`` would refuse.
        OSError: what the system says.
    """
    path = Path(path)
    _, write = _format_of(path)
    columns = {"t": np.asarray(log.time, float)}
    if len(log) and np.any(log.segment != log.segment[0]):
        columns["segment"] = log.segment
    for name in CHANNELS:
        if name in log:
            columns |= dict(zip(CHANNELS[name], np.asarray(log[name], float).T, strict=True))
    check_names(str(path), list(columns))
    log_of_table(Table(str(path), {name: values.astype(float) for name, values in columns.items()}))
    write_atomically(path, write(columns))


def check_name(path: str | Path) -> None:
    """Raise LogError for a file that ``save_log`` would refuse by its name, before there is a log."""
    _format_of(Path(path))


def gaps_of(log: FlightLog) -> np.ndarray:
    """Return the rows after which samples are missing, (num_gaps,) int.

    There the time step is longer than 1.5 times the median step of its segment.
    """
    is_inside = log.segment[1:] == log.segment[:-1]
    return np.flatnonzero(is_inside & (np.diff(log.time) > GAP_STEPS * usual_step(log)[:-1]))


def describe(log: FlightLog) -> str:
    """Return a few lines on a log: where from, how long, how often, what was measured, what is missing."""
    inside = ~log.is_start()[1:]
    steps = np.diff(log.time)
    absent = [name for name in CHANNELS if name not in log]
    lines = [
        f"{log.source}: {len(log)} rows, {log.is_start().sum()} segments, {steps[inside].sum():.2f} s",
        f"channels: {', '.join(log.channels)}; absent: {', '.join(absent) or 'none'}",
    ]
    if inside.any():
        median, gaps = np.median(steps[inside]), gaps_of(log)
        lines[1:1] = [f"sample interval: {median:.4g} s (median), {1.0 / median:.4g} Hz", "gaps: none"]
        if len(gaps):
            longest = gaps[np.argmax(steps[gaps])]
            lines[2] = f"gaps: {len(gaps)}, longest {steps[longest]:.4g} s, after row {longest}"
    return "\n".join([*lines, *_ranges(log)])


def _ranges(log: FlightLog) -> list[str]:
    """Return lines on what was covered: commands, and speeds, heights, tilts, voltages where measured."""
    commands = [
        f"{column} {values.min():.3g} to {values.max():.3g}"
        for column, values in zip(CHANNELS["u"], log["u"].T, strict=True)
    ]
    ranges = []
    if "v" in log:
        ranges.append(f"speed up to {np.linalg.norm(log['v'], axis=1).max():.3g} m/s")
    if "q" in log:
        upright = 1.0 - 2.0 * (log["q"][:, 1] ** 2 + log["q"][:, 2] ** 2)  # cosine of the tilt
        ranges.append(f"tilt up to {np.rad2deg(np.arccos(np.clip(upright.min(), -1.0, 1.0))):.0f} deg")
    for name, label, unit in (("p", "height", "m"), ("v_bat", "voltage", "V")):
        if name in log:
            values = log[name][:, -1]  # p_z, or the only column
            ranges.append(f"{label} {values.min():.4g} to {values.max():.4g} {unit}")
    return [f"commands: {'; '.join(commands)}", *(["; ".join(ranges)] if ranges else [])]


def _read_npz(path: Path) -> Table:
    """Return the arrays of an .npz file, once the archive's list of them is that of a log."""
    try:
        with open_npz(path) as archive:
            check_names(str(path), archive.names)
            check_size(archive.num_bytes, LARGEST_BYTES)
            num_values = sum(_header(path, archive, name).num_values for name in archive.names)
            check_number(str(path), num_values)
            return Table(str(path), {name: _read_array(path, archive, name) for name in archive.names})
    except NpzError as error:
        raise LogError(f"{path}: {error}") from error


def _header(path: Path, archive: NpzFile, name: str) -> Header:
    """Return what the array of a column announces; what is no row of numbers is refused."""
    try:
        header = archive.header(name)
    except NpzError as error:
        raise LogError(f"{path}: column {name}: {error}") from error
    if header.dtype.kind not in "iuf":
        raise LogError(
            f"{path}: column {name}: found an array of {quote_name(header.dtype)}, expected numbers"
        )
    if len(header.shape) != 1:
        raise LogError(
            f"{path}: column {name}: found an array of shape {quote_value(header.shape)}, "
            "expected one dimension"
        )
    return header


def _read_array(path: Path, archive: NpzFile, name: str) -> np.ndarray:
    """Return the array of a column, (num_rows,) float64."""
    try:
        return archive.read(name).astype(float)
    except NpzError as error:
        raise LogError(f"{path}: column {name}: {error}") from error


def _read_csv(path: Path) -> Table:
    """Return the columns of a CSV file."""
    with open_file(path) as file:
        content = io.BufferedReader(AtMost(file, LARGEST_BYTES))
        text = io.TextIOWrapper(content, encoding="utf-8-sig", newline="")
        rows = csv.reader(_lines(text), strict=True)
        try:
            return _table(str(path), rows)
        except (UnicodeDecodeError, csv.Error) as error:
            raise LogError(
                f"{path}: near line {rows.line_num + 1}: not a CSV file: {error_text(error)}"
            ) from error


def _lines(text: TextIO) -> Iterator[str]:
    """Yield the lines of a CSV file, of which a row has one: csv would read all of an endless one first."""
    while line := text.readline(LONGEST_LINE):
        if len(line) == LONGEST_LINE:
            raise csv.Error(f"found a line of {LONGEST_LINE} characters or more, expected fewer")
        if line.count('"') % 2:
            raise csv.Error("found a quotation mark that the line does not close")
        yield line


def _table(source: str, rows: "_csv.Reader") -> Table:
    """Return the columns of the rows of a CSV file, the first of which has their names."""
    header = [name.strip() for name in next(rows, [])]
    if len(header) == 1 and any(mark in header[0] for mark in ";\t"):
        found = f"no comma in {quote_value(header[0])}"
        raise LogError(f"{source}: line 1: found {found}, expected names with commas")
    check_names(source, header)
    table_rows = Rows(source, header)
    for cells in rows:
        if cells:
            table_rows.add(_numbers(source, header, cells, len(table_rows), rows.line_num), rows.line_num)
    return table_rows.table()


def _numbers(source: str, header: list[str], cells: list[str], row: int, line: int) -> list[float]:
    """Return the numbers in one row of a CSV file."""
    place = f"{source}: row {row} (line {line})"
    if len(cells) != len(header):
        column = f", column {header[len(cells)]}" if len(cells) < len(header) else ""
        raise LogError(f"{place}{column}: found {len(cells)} cells, expected {len(header)} as in the header")
    try:
        return [_number(cell) for cell in cells]
    except ValueError:
        column, cell = next(pair for pair in zip(header, cells, strict=True) if not _is_number(pair[1]))
    found = quote_value(cell) if cell.strip() else "an empty cell"
    raise LogError(f"{place}, column {column}: found {found}, expected a number")


def _number(cell: str) -> float:
    if "_" in cell:  # Python reads 1_000 as a number; nobody else does
        raise ValueError(cell)
    return float(cell)


def _is_number(cell: str) -> bool:
    try:
        _number(cell)
    except ValueError:
        return False
    return True


def _write_npz(columns: dict[str, np.ndarray]) -> bytes:
    """Return an .npz file; numpy dates its members 1980, and stored bytes depend on no zlib."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **columns)
    return buffer.getvalue()


def _write_csv(columns: dict[str, np.ndarray]) -> bytes:
    """Return a CSV file with the shortest digits that give each float64 back."""
    rows: Iterable[tuple[float, ...]] = zip(*(values.tolist() for values in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
    return ("\n".join(lines) + "\n").encode()


_FORMATS: dict[str, tuple[Reader, Writer]] = {
    ".npz": (_read_npz, _write_npz),
    ".csv": (_read_csv, _write_csv),
}


def _format_of(path: Path) -> tuple[Reader, Writer]:
    """Return the reader and the writer of a file's format."""
    if path.suffix.lower() not in _FORMATS:
        raise LogError(f"{path}: found suffix {path.suffix!r}, expected {' or '.join(_FORMATS)}")
    return _FORMATS[path.suffix.lower()]
