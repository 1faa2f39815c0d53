"""CSV logs of anybody, by a mapping file; gzip-compressed ones too."""

import contextlib
import csv
import gzip
import io
import math
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.files import open_file
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_sysid.importing.flight import Flight
from flytrack_sysid.importing.mapping import Attitude, Columns, Command, Mapping, Vector
from flytrack_sysid.importing.units import quaternion_from, vector_from
from flytrack_sysid.log import CHANNELS, LogError
from flytrack_sysid.log_file import LARGEST_BYTES
from flytrack_sysid.log_table import LARGEST_NORM_ERROR, CsvRows, Rows, Table, log_of_table

PACKED_BYTES, LARGEST_RATIO = 2**24, 32  # characters in a compressed file: that, or as many times its size
LONGEST_LIST = 1000  # characters of a header


def read_csv(path: Path, mapping: Mapping) -> Flight:
    """Return the flight in a CSV file with a header, by a mapping; SI units and our frames.

    Raises:
        LogError: a mapping without columns; a file that cannot be read; a column that it lacks; a cell that
            is no number, or a value that no log can have. The message names file, row, line and column.
    """
    if mapping.columns is None:
        raise LogError(f"{path}: {mapping.source} names no columns; a CSV file needs [time] and [command]")
    columns = mapping.columns
    table = _read(path, columns, mapping.source)
    values = {"t": _time(table, columns)}
    for name, part in (("u", _commands(table, columns.command)), *_measured(table, columns)):
        values |= dict(zip(CHANNELS[name], part.T, strict=True))
    return Flight(log_of_table(table._replace(columns=values)), mapping.craft)


def _wanted(columns: Columns) -> dict[str, str]:
    """Return the columns that are read, each with the table of the mapping that wants it."""
    wanted = {columns.time.column: "time"} if columns.time.column else {}
    wanted |= dict.fromkeys(columns.command.columns, "command")
    for channel, vector in columns.vectors.items():
        wanted |= dict.fromkeys(vector.columns, channel)
    if columns.attitude:
        wanted |= dict.fromkeys(columns.attitude.columns, "attitude")
    if columns.battery:
        wanted[columns.battery.column] = "battery"
    return wanted


@contextlib.contextmanager
def _opened(path: Path, delimiter: str) -> Iterator[CsvRows]:
    """Yield the rows of a file, perhaps compressed; errors while reading become LogErrors."""
    try:
        with open_file(path, LARGEST_BYTES) as file, contextlib.ExitStack() as stack:
            most, stream = LARGEST_BYTES, file
            if path.suffix == ".gz":
                most = min(most, max(PACKED_BYTES, LARGEST_RATIO * path.stat().st_size))
                stream = cast(BinaryIO, stack.enter_context(gzip.GzipFile(fileobj=file)))
            yield CsvRows(io.TextIOWrapper(stream, encoding="utf-8-sig", newline=""), delimiter, most)
    # ValueError: UnicodeDecodeError, or a NUL in the name.
    except (OSError, EOFError, zlib.error, ValueError) as error:
        if isinstance(error, LogError):
            raise
        raise LogError(f"{path}: cannot be read as text: {error_text(error)}") from error


def _read(path: Path, columns: Columns, mapping: str) -> Table:
    """Return the columns that the mapping names, as they are in the file."""
    with _opened(path, columns.delimiter) as rows:
        try:
            return _table(path, rows, columns, mapping)
        except csv.Error as error:
            raise LogError(
                f"{path}: near line {rows.line_num + 1}: not a CSV file: {error_text(error)}"
            ) from error


def _table(path: Path, rows: CsvRows, columns: Columns, mapping: str) -> Table:
    """Return the columns that the mapping names, of the rows of a file, the first of which has the names."""
    wanted = _wanted(columns)
    header = [name.strip() for name in next(rows, [])]
    for name, table in wanted.items():
        if header.count(name) != 1:
            found = (
                f"found {header.count(name)} times among {', '.join(map(quote_name, header))[:LONGEST_LIST]}"
            )
            raise LogError(f"{path}: column {quote_name(name)}: {found}; expected once by {mapping}: {table}")
    places = [header.index(name) for name in wanted]
    found_rows = Rows(str(path), list(wanted))
    for cells in rows:
        if cells:
            where = f"{path}: row {len(found_rows)} (line {rows.line_num})"
            if len(cells) != len(header):
                raise LogError(f"{where}: found {len(cells)} cells, expected {len(header)} as in the header")
            found_rows.add([_number(where, header[place], cells[place]) for place in places], rows.line_num)
    if not len(found_rows):
        raise LogError(f"{path}: found no rows, expected at least one")
    return found_rows.table()


def _number(where: str, column: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        found = quote_value(cell) if cell.strip() else "an empty cell"
        raise LogError(f"{where}, column {quote_name(column)}: found {found}, expected a number") from None
    if not math.isfinite(value):
        raise LogError(
            f"{where}, column {quote_name(column)}: "
            f"found {quote_name(cell.strip())}, expected a finite number"
        )
    return value


def _time(table: Table, columns: Columns) -> np.ndarray:
    """Return time from 0 on, s: large numbers of us would cost digits."""
    time = columns.time
    if time.column is None:
        num_rows = len(next(iter(table.columns.values())))
        return np.arange(num_rows) * time.scale
    values = table.columns[time.column]
    return (values - values[0]) * time.scale


def _commands(table: Table, command: Command) -> np.ndarray:
    """Return the commands (num_rows, 4) with what means -1 and 1 there."""
    low, high = np.array(command.low), np.array(command.high)
    values = table.matrix(command.columns)
    if command.clip:
        values = np.clip(values, np.minimum(low, high), np.maximum(low, high))
    bad = np.argwhere((values < np.minimum(low, high)) | (values > np.maximum(low, high)))
    if len(bad):
        row, stick = bad[0]
        text = (
            f"found {values[row, stick]:g}, expected {low[stick]:g} to {high[stick]:g} by command.low, high"
        )
        raise table.error(row, quote_name(command.columns[stick]), f"{text}; clip = true cuts it")
    return 2.0 * (values - low) / (high - low) - 1.0


def _measured(table: Table, columns: Columns) -> list[tuple[str, np.ndarray]]:
    """Return the channels that the mapping names, in SI units and our frames."""
    found = [(name, _vector(table, vector)) for name, vector in columns.vectors.items()]
    if columns.attitude is not None:
        found.append(("q", _quaternions(table, columns.attitude)))
    if columns.battery is not None:
        found.append(("v_bat", table.matrix([columns.battery.column]) * columns.battery.scale))
    return found


def _vector(table: Table, vector: Vector) -> np.ndarray:
    return vector_from(table.matrix(vector.columns) * np.array(vector.scales), vector.is_turned)


def _quaternions(table: Table, attitude: Attitude) -> np.ndarray:
    """Return the quaternions (num_rows, 4); Euler angles turn by yaw, then pitch, then roll, moving axes."""
    values = table.matrix(attitude.columns) * np.array(attitude.scales)
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise table.error(bad[0], ", ".join(map(quote_name, attitude.columns)), "found no finite numbers")
    if attitude.order == "euler":
        rotation = Rotation.from_euler("ZYX", values[:, ::-1])
    else:
        norm = np.linalg.norm(values, axis=1)
        bad = np.flatnonzero(np.abs(norm - 1.0) > LARGEST_NORM_ERROR)
        if len(bad):
            text = f"found a quaternion of norm {norm[bad[0]]:.4g}, expected 1"
            raise table.error(bad[0], ", ".join(map(quote_name, attitude.columns)), text)
        rotation = Rotation.from_quat(values, scalar_first=attitude.order == "wxyz")
    if attitude.is_inverted:
        rotation = rotation.inv()
    return quaternion_from(rotation, attitude.is_body_turned, attitude.is_world_turned)
