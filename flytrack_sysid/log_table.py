"""Checks of a file's columns on their way to a flight log; every refusal names the place."""

import csv
import difflib
import math
from array import array
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, TextIO

import numpy as np

from flytrack_env.messages import quote_value
from flytrack_sysid.log import CHANNELS, COLUMNS, REQUIRED, FlightLog, LogError

MOST_SEGMENTS = 100_000  # one for each flight
LARGEST_NORM_ERROR = 1e-2  # of quaternions: estimators drift a little; more is no unit quaternion
SMALLEST_NORM_ERROR = 1e-12  # below it a norm is 1 up to rounding, and the values stay as they are
LARGEST_VALUES = 56 * 2**20  # all columns at 1 kHz for half an hour; twice as many float64 are below 1 GiB
LONGEST_ROW = 2**16  # characters of a CSV file: thousands of columns
COMMAND_MARGIN = 1e-6  # beyond [-1, 1]: rounding by the program that wrote the log
LONGEST_NAME = max(map(len, COLUMNS)) + 3  # longer names are similar to none
LARGEST_SEGMENT = 2**53  # float64 is exact for whole numbers below it
PWM_LOW_US, PWM_HIGH_US = 800, 2200  # receivers' pulses: 1000 to 2000 us, and a little past the ends
PERCENT_LOW, PERCENT_HIGH = 10, 100  # a largest command in between looks like percent of full stick


class Table(NamedTuple):
    """The columns of a file, (num_rows,) float64 each, by name.

    source: the file, for messages. lines: (num_rows,) int, the line of each row in a text file, else None.
    """

    source: str
    columns: dict[str, np.ndarray]
    lines: np.ndarray | None = None

    def error(self, row: int, column: str, text: str) -> LogError:
        """Return the error about one cell; rows count from 0, lines from 1."""
        line = "" if self.lines is None else f" (line {self.lines[row]})"
        return LogError(f"{self.source}: row {row}{line}, column {column}: {text}")

    def matrix(self, columns: Sequence[str]) -> np.ndarray:
        """Return some of the columns side by side, (num_rows, len(columns))."""
        return np.stack([self.columns[column] for column in columns], axis=1)


class CsvRows:
    """The rows of a CSV file, lists of cells, limited in length: ``csv`` itself reads a whole row at once."""

    def __init__(self, text: TextIO, delimiter: str = ",", most_characters: float = math.inf):
        self._text, self._most_characters = text, most_characters
        self._num_characters = self._row_start = 0
        self._rows = csv.reader(self._lines(), delimiter=delimiter, strict=True)

    def _lines(self) -> Iterator[str]:
        """Yield the lines of the file; a row may have several."""
        while line := self._text.readline(LONGEST_ROW):
            self._num_characters += len(line)
            if self._num_characters - self._row_start >= LONGEST_ROW:
                raise csv.Error(f"found a row of {LONGEST_ROW} characters or more, expected fewer")
            if self._num_characters > self._most_characters:
                raise csv.Error(f"found more than {self._most_characters} characters, expected at most that")
            yield line

    def __iter__(self) -> "CsvRows":
        return self

    def __next__(self) -> list[str]:
        cells = next(self._rows)
        self._row_start = self._num_characters
        return cells

    @property
    def line_num(self) -> int:
        """Number of lines read."""
        return self._rows.line_num


class Rows:
    """Rows of numbers on their way to a table; columns of a text file are known only after its last row."""

    def __init__(self, source: str, names: Sequence[str]):
        self._source, self._names = source, names
        self._values, self._lines = array("d"), array("q")

    def __len__(self) -> int:
        return len(self._lines)

    def add(self, numbers: Iterable[float], line: int) -> None:
        """Add a row; raises LogError beyond LARGEST_VALUES numbers."""
        self._lines.append(line)
        self._values.extend(numbers)
        if len(self._values) > LARGEST_VALUES:
            raise LogError(f"{self._source}: found more than {LARGEST_VALUES} numbers, expected at most that")

    def table(self) -> Table:
        """Return the rows as a table."""
        columns = np.asarray(self._values).reshape(-1, len(self._names)).T
        return Table(self._source, dict(zip(self._names, columns, strict=True)), np.asarray(self._lines))


def check_names(source: str, names: Sequence[str]) -> None:
    """Raise LogError unless the names make up a flight log: each known, once, none missing of a vector."""
    for name in names:
        if name not in COLUMNS:
            near = difflib.get_close_matches(name[:LONGEST_NAME].lower(), COLUMNS, n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise LogError(
                f"{source}: column {quote_value(name)}: unknown{hint} (known: {', '.join(COLUMNS)})"
            )
        if names.count(name) > 1:
            raise LogError(f"{source}: column {name}: found {names.count(name)} times, expected once")
    for name in REQUIRED:
        if name not in names:
            raise LogError(f"{source}: column {name}: missing; found {', '.join(names) or 'no column'}")
    for columns in CHANNELS.values():
        present = [column for column in columns if column in names]
        for column in columns:
            if present and column not in present:
                raise LogError(f"{source}: column {column}: missing; found only {', '.join(present)} of it")


def log_of_table(table: Table) -> FlightLog:
    """Return the log that a table holds; a table without segments is one.

    Quaternions are normalised. The names must have passed ``check_names``. Columns are removed from the table
    as they are copied, so that a large log is not in memory twice.

    Raises:
        LogError: no rows, columns of different lengths, or a value that no log can have, with its place.
    """
    _check_lengths(table)
    for column, values in table.columns.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            hint = "leave out the row of a lost sample, or all columns of what was not measured"
            text = f"found {values[bad[0]]}, expected a finite number; {hint}"
            raise table.error(bad[0], column, text)
    segment = _segments(table)
    _check_time(table, segment)
    _check_commands(table)
    channels = {}
    for name, columns in CHANNELS.items():
        if columns[0] in table.columns:
            channels[name] = table.matrix(columns)
            for column in columns:
                del table.columns[column]
    if "q" in channels:
        channels["q"] = _normalised(table, channels["q"])
    return FlightLog(table.columns["t"], channels, segment, table.source)


def _check_lengths(table: Table) -> None:
    expected = len(table.columns["t"])
    for column, values in table.columns.items():
        if len(values) != expected:
            raise LogError(
                f"{table.source}: column {column}: found {len(values)} rows, expected {expected} as in t"
            )
    if expected == 0:
        raise LogError(f"{table.source}: found no rows, expected at least one")


def _segments(table: Table) -> np.ndarray:
    """Return the segment of each row, (num_rows,) int."""
    values = table.columns.get("segment", np.zeros(len(table.columns["t"])))
    bad = np.flatnonzero((values != np.round(values)) | (np.abs(values) >= LARGEST_SEGMENT))
    if len(bad):
        raise table.error(bad[0], "segment", f"found {values[bad[0]]}, expected a whole number below 2^53")
    segment = values.astype(np.int64)
    starts = np.flatnonzero(np.concatenate([[True], segment[1:] != segment[:-1]]))
    if len(starts) > MOST_SEGMENTS:
        text = f"found {len(starts)} segments, expected at most {MOST_SEGMENTS}, one for each flight"
        raise table.error(starts[MOST_SEGMENTS], "segment", text)
    first_of = np.unique(segment[starts], return_index=True)[1]
    again = np.setdiff1d(np.arange(len(starts)), first_of)
    if len(again):
        row = starts[again[0]]
        text = f"found {segment[row]} again after other segments, expected each number in one piece"
        raise table.error(row, "segment", text)
    return segment


def _check_time(table: Table, segment: np.ndarray) -> None:
    time = table.columns["t"]
    bad = np.flatnonzero((np.diff(time) <= 0.0) & (segment[1:] == segment[:-1])) + 1
    if not len(bad):
        return
    row = bad[0]
    hint = "a duplicate row" if time[row] == time[row - 1] else "rows out of order, or a new segment"
    text = f"found {time[row]} after {time[row - 1]}, expected a later time within a segment ({hint})"
    raise table.error(row, "t", text)


def _check_commands(table: Table) -> None:
    for column in CHANNELS["u"]:
        values = table.columns[column]
        bad = np.flatnonzero(np.abs(values) > 1.0 + COMMAND_MARGIN)
        if len(bad):
            text = f"found {values[bad[0]]:g}, expected a command in [-1, 1]{_command_hint(values)}"
            raise table.error(bad[0], column, text)


def _command_hint(values: np.ndarray) -> str:
    """Return what unit a column of commands seems to have, as the end of a message."""
    if values.min() >= PWM_LOW_US and values.max() <= PWM_HIGH_US:
        return "; these look like PWM pulses in us, of which 1000 to 2000 should become -1 to 1"
    if PERCENT_LOW <= np.abs(values).max() <= PERCENT_HIGH:
        return "; these look like percent, of which full stick should become 1"
    return ""


def _normalised(table: Table, quat: np.ndarray) -> np.ndarray:
    """Return the quaternions, (num_rows, 4), with norm 1."""
    norm = np.linalg.norm(quat, axis=1)
    error = np.abs(norm - 1.0)
    bad = np.flatnonzero(error > LARGEST_NORM_ERROR)
    if len(bad):
        text = f"found a quaternion of norm {norm[bad[0]]:.4g}, expected 1 within {LARGEST_NORM_ERROR:g}"
        raise table.error(bad[0], "q_w, q_x, q_y, q_z", text)
    return np.where(error > SMALLEST_NORM_ERROR, 1.0 / norm, 1.0)[:, None] * quat
