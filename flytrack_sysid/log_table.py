"""Checks of a file's columns that become a flight log; every error names the file and column."""

import difflib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from flytrack_env.messages import quote_value
from flytrack_sysid.log import (
    CHANNELS,
    COLUMNS,
    MEASURED,
    OF_MOTORS,
    ORIGINS,
    REQUIRED,
    STATED,
    STATED_MASS,
    STATED_VOLTAGES,
    FlightLog,
    LogError,
    Origin,
)

MAX_NORM_ERROR = 1e-2  # of quaternions: estimators drift a little; more is no unit quaternion
MIN_NORM_ERROR = 1e-12  # below, a norm is 1 up to rounding, and the values are not changed
COMMAND_MARGIN = 1e-6  # beyond [-1, 1]: rounding by the program that wrote the log
MAX_NAME_LENGTH = max(map(len, COLUMNS)) + 3  # longer names are similar to none
MAX_SEGMENT = 2**53  # float64 represents smaller whole numbers exactly


class Table(NamedTuple):
    """The columns of a file.

    Attributes:
        source: the file, for messages.
        columns: by name, (num_rows,) float64 each.
        lines: the line of each row in a text file, (num_rows,) int; None for other files.
    """

    source: str
    columns: dict[str, np.ndarray]
    lines: np.ndarray | None = None

    def error(self, row: int, column: str, text: str) -> LogError:
        """Return the error about one cell; rows count from 0, lines from 1."""
        line = "" if self.lines is None else f" (line {self.lines[row]})"
        return LogError(f"{self.source}: row {row}{line}, column {column}: {text}")

    def check(
        self, is_good: np.ndarray, column: str, expected: str, values: np.ndarray | None = None
    ) -> None:
        """Raise LogError about the first row that is not good.

        Args:
            is_good: (num_rows,) bool.
            column: name of the column, for the message.
            expected: expected value in words.
            values: found values; those of the column if None.
        """
        if not is_good.all():
            row = int(np.argmin(is_good))
            column_values = self.columns[column] if values is None else values
            raise self.error(row, column, f"found {float(column_values[row])}, expected {expected}")

    def select(self, rows: np.ndarray) -> "Table":
        """Return some of the rows, by mask."""
        lines = None if self.lines is None else self.lines[rows]
        return Table(
            self.source, {name: values[rows] for name, values in self.columns.items()}, lines
        )

    def matrix(self, columns: Sequence[str]) -> np.ndarray:
        """Return some of the columns side by side, (num_rows, len(columns))."""
        return np.stack([self.columns[column] for column in columns], axis=1)


def check_names(source: str, names: Sequence[str]) -> None:
    """Raise LogError unless the names are those of a flight log.

    Each must be known and occur once, and vectors must be complete.
    """
    for name in names:
        if name not in COLUMNS:
            near = difflib.get_close_matches(name[:MAX_NAME_LENGTH].lower(), COLUMNS, n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise LogError(
                f"{source}: column {quote_value(name)}: unknown{hint} (known: {', '.join(COLUMNS)})"
            )
        if names.count(name) > 1:
            raise LogError(
                f"{source}: column {name}: found {names.count(name)} times, expected once"
            )
    for name in REQUIRED:
        if name not in names:
            raise LogError(
                f"{source}: column {name}: missing; found {', '.join(names) or 'no column'}"
            )
    for columns in (*CHANNELS.values(), STATED_VOLTAGES):
        present = [column for column in columns if column in names]
        for column in columns:
            if present and column not in present:
                raise LogError(
                    f"{source}: column {column}: missing; found only {', '.join(present)} of it"
                )


def columns_of(time: np.ndarray, channels: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the columns of time and channels, (num_rows, n), in the order of ``CHANNELS``."""
    columns = {"t": time}
    for name, names in CHANNELS.items():
        if name in channels:
            columns |= dict(zip(names, channels[name].T, strict=True))
    return columns


def stated_columns(log: FlightLog) -> dict[str, np.ndarray]:
    """Return the columns of ``STATED`` of a log, each with the same number in every row."""
    stated = dict(zip(STATED_VOLTAGES, log.stated_voltage_v or (), strict=False))
    if log.origin is not None:
        stated[MEASURED] = next(
            number for number, origin in ORIGINS.items() if origin == log.origin
        )
    if log.has_motors:
        stated[OF_MOTORS] = 1.0
    if log.stated_mass_kg is not None:
        stated[STATED_MASS] = log.stated_mass_kg
    return {name: np.full(len(log), stated[name]) for name in STATED if name in stated}


def log_of_table(table: Table) -> FlightLog:
    """Return the log in a table, with unit quaternions; a table without segments is one segment.

    The names must have passed ``check_names``. Columns are removed from the table as they are
    copied, so that a large log is not in memory twice.

    Raises:
        LogError: no log can have one of the values; the message names row and column.
    """
    num_rows = len(table.columns["t"])
    for column, values in table.columns.items():
        if len(values) != num_rows:
            problem = f"found {len(values)} rows, expected {num_rows} as in t"
            raise LogError(f"{table.source}: column {column}: {problem}")
    if num_rows == 0:
        raise LogError(f"{table.source}: found no rows, expected at least one")
    hint = "leave out the row of a lost sample, or all columns of what was not measured"
    for column, values in table.columns.items():
        table.check(np.isfinite(values), column, f"a finite number; {hint}")
    segment = _segments(table)
    is_later = (np.diff(table.columns["t"]) > 0.0) | (segment[1:] != segment[:-1])
    expected = "a later time than in the row before, or a new segment"
    table.check(np.concatenate([[True], is_later]), "t", expected)
    held = [*CHANNELS["u"], *(name for name in CHANNELS["sticks"] if name in table.columns)]
    for column in held:
        is_command = np.abs(table.columns[column]) <= 1.0 + COMMAND_MARGIN
        table.check(is_command, column, "a command in [-1, 1]")
    origin, stated_voltage_v = _origin(table), _stated_voltages(table)
    has_motors, stated_mass_kg = _has_motors(table), _stated_mass(table)
    channels = {}
    for name, columns in CHANNELS.items():
        if columns[0] in table.columns:
            channels[name] = table.matrix(columns)
            for column in columns:
                del table.columns[column]
    if "q" in channels:
        norm = np.linalg.norm(channels["q"], axis=1)
        error = np.abs(norm - 1.0)
        expected = f"a quaternion of norm 1 within {MAX_NORM_ERROR:g}"
        table.check(error <= MAX_NORM_ERROR, ", ".join(CHANNELS["q"]), expected, norm)
        channels["q"] *= np.where(error > MIN_NORM_ERROR, 1.0 / norm, 1.0)[:, None]
    return FlightLog(
        time=table.columns["t"],
        channels=channels,
        segment=segment,
        source=table.source,
        origin=origin,
        stated_voltage_v=stated_voltage_v,
        has_motors=has_motors,
        stated_mass_kg=stated_mass_kg,
    )


def _stated(table: Table, name: str) -> float | None:
    """Return the number that a column of ``STATED`` holds in every row; None if it is absent."""
    values = table.columns.pop(name, None)
    if values is None:
        return None
    table.check(
        values == values[0], name, f"{values[0]:g} as in row 0: all rows are of one craft", values
    )
    return float(values[0])


def _origin(table: Table) -> Origin | None:
    """Return the origin that the column ``measured`` states."""
    value = _stated(table, MEASURED)
    if value is not None and value not in ORIGINS:
        raise table.error(
            0, MEASURED, f"found {value}, expected 1 (a real drone) or 0 (a simulator)"
        )
    return None if value is None else ORIGINS[value]


def _has_motors(table: Table) -> bool:
    """Return whether the commands are those of motors, as the column ``motors`` states."""
    value = _stated(table, OF_MOTORS)
    if value not in (None, 0.0, 1.0):
        expected = "expected 1 (commands of four motors) or 0 (of sticks)"
        raise table.error(0, OF_MOTORS, f"found {value}, {expected}")
    return value == 1.0


def _stated_mass(table: Table) -> float | None:
    """Return the mass that is stated for the craft, kg."""
    mass_kg = _stated(table, STATED_MASS)
    if mass_kg is not None and mass_kg <= 0.0:
        raise table.error(0, STATED_MASS, f"found {mass_kg:g} kg, expected a mass above 0")
    return mass_kg


def _stated_voltages(table: Table) -> tuple[float, float] | None:
    """Return the lowest and the highest voltage that are stated for the pack."""
    low, high = (_stated(table, name) for name in STATED_VOLTAGES)
    if low is None or high is None:  # both are None, by ``check_names``
        return None
    if not 0.0 < low < high:
        problem = (
            f"found {low:g} to {high:g} V, expected a lowest voltage above 0 and a highest above "
            "that"
        )
        raise table.error(0, ", ".join(STATED_VOLTAGES), problem)
    return low, high


def _segments(table: Table) -> np.ndarray:
    """Return the segment of each row, (num_rows,) int."""
    values = table.columns.get("segment", np.zeros(len(table.columns["t"])))
    is_whole = (values == np.round(values)) & (np.abs(values) < MAX_SEGMENT)
    table.check(is_whole, "segment", "a whole number below 2^53")
    segment = values.astype(np.int64)
    starts = np.flatnonzero(np.concatenate([[True], segment[1:] != segment[:-1]]))
    is_first = np.ones(len(values), bool)
    is_first[starts] = np.isin(
        np.arange(len(starts)), np.unique(segment[starts], return_index=True)[1]
    )
    table.check(is_first, "segment", "each number in one piece")
    return segment
