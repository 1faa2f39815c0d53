"""Tracks and their TOML files, checked before anything flies them.

A track file has a ``name``, a ``[start]`` (position, quaternion), ``[bounds]`` (low, high) and one
``[[gates]]`` table per gate, in flying order; ``flytrack.toml`` beside this file is the example.
"""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env.files import write_atomically
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_env.toml_file import TomlError, parse_toml, read_text

TRACK_FOLDER = Path(__file__).parent
DIRECTIONS = {"+y": 1.0, "-y": -1.0}
UNIT_NORM_TOLERANCE = 1e-3
ROUNDING = 1e-12  # of a norm: a quaternion that is this close to a unit was not rounded for a file
LARGEST_ID = 2**53  # float64 tells whole numbers apart below it
LARGEST = 1e6  # m: beyond that, float32 positions are coarser than a drone


class TrackError(ValueError):
    """A track that cannot be flown; the message names file, line, field and reason."""


@dataclasses.dataclass(frozen=True)
class Gate:
    """One square gate; position in m, quaternion (w, x, y, z) gate to world, edges in m.

    id: a number for people, any below 2^53 but another gate's. direction: +1 if flown towards the gate's
    local +y, -1 if towards -y. opening: inner edge. frame: outer edge.
    """

    id: int
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    direction: float
    opening: float
    frame: float


@dataclasses.dataclass(frozen=True)
class Track:
    """A course: gates in flying order (laps repeat), start pose and bounds; SI units, world frame.

    name: as in its file. start_position: m. start_quaternion: (w, x, y, z), body to world. bounds_low,
    bounds_high: corners of the box that must not be left, m; the ground is the lower one's z.
    """

    name: str
    gates: tuple[Gate, ...]
    start_position: tuple[float, float, float]
    start_quaternion: tuple[float, float, float, float]
    bounds_low: tuple[float, float, float]
    bounds_high: tuple[float, float, float]

    def rows(self) -> np.ndarray:
        """Return the gates in the handout's format, (N, 8): id, x, y, z, qw, qx, qy, qz."""
        return np.array([[gate.id, *gate.position, *gate.quaternion] for gate in self.gates])


def available_tracks() -> tuple[str, ...]:
    """Return the names of the shipped tracks."""
    return tuple(sorted(path.stem for path in TRACK_FOLDER.glob("*.toml")))


def load_track(name_or_path: str | Path) -> Track:
    """Return a shipped track by name, or the track in a ``.toml`` file by path.

    Raises:
        TrackError: unknown name, missing file, or a file that cannot be flown (with line, field
            and reason).
    """
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = TRACK_FOLDER / f"{name_or_path}.toml"
        if str(name_or_path) not in available_tracks():
            raise TrackError(
                f"track: found {str(name_or_path)!r}, expected one of "
                f"{', '.join(available_tracks())} or the path of a .toml file"
            )
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise TrackError(f"{path}: cannot be read: {error_text(error)}") from error
    return _parse(path, text)


def save_track(path: str | Path, track: Track) -> None:
    """Write a track as a ``.toml`` file from which ``load_track`` returns an equal track.

    Raises:
        TrackError: a path without ``.toml``, or a track that would not come back as it is: values that no
            track file may have, quaternions that are not units.
        OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".toml":
        raise TrackError(f"path: found {str(path)!r}, expected one that ends in .toml")
    try:
        text = _write(track)
        content = text.encode()
    except (AttributeError, KeyError, TypeError, UnicodeEncodeError) as error:
        raise TrackError(f"{path}: the track cannot be written: {error!r}") from error
    read = _parse(path, text)
    names = [field.name for field in dataclasses.fields(Track)]
    changed = [name for name in names if getattr(read, name) != getattr(track, name)]
    if changed:
        raise TrackError(
            f"{path}: {', '.join(changed)}: would not be read back as written, expected tuples of floats "
            "and unit quaternions"
        )
    write_atomically(path, content)


def _write(track: Track) -> str:
    """Return the text of a track file."""
    signs = {sign: name for name, sign in DIRECTIONS.items()}
    # JSON strings are TOML's basic strings, but for the one control character that JSON lets stand.
    name = json.dumps(track.name, ensure_ascii=False).replace("\x7f", "\\u007f")
    lines = [
        f"name = {name}",
        "",
        "[start]",
        f"position = {list(track.start_position)}",
        f"quaternion = {list(track.start_quaternion)}",
        "",
        "[bounds]",
        f"low = {list(track.bounds_low)}",
        f"high = {list(track.bounds_high)}",
    ]
    for gate in track.gates:
        values = {**vars(gate), "direction": f'"{signs[gate.direction]}"'}
        fields = (f"{field} = {list(x) if isinstance(x, tuple) else x}" for field, x in values.items())
        lines += ["", "[[gates]]", *fields]
    return "\n".join(lines) + "\n"


def _parse(path: Path, text: str) -> Track:
    """Return the checked track of a file's text; raises TrackError."""
    try:
        data = parse_toml(text)
    except TomlError as error:
        raise TrackError(f"{path}: not a TOML file: {error_text(error)}") from error
    file = _Table(path, text.splitlines(), data, "", {"name", "start", "bounds", "gates"})
    if not isinstance(data["name"], str) or not data["name"]:
        raise file.error("name", f"found {quote_value(data['name'])}, expected a non-empty string")
    if not isinstance(data["gates"], list) or len(data["gates"]) < 2:
        raise file.error("gates", "expected at least two [[gates]] tables")
    start = file.inner(data["start"], "[start]", {"position", "quaternion"})
    bounds = file.inner(data["bounds"], "[bounds]", {"low", "high"})
    low, high = bounds.numbers("low", 3), bounds.numbers("high", 3)
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise bounds.error("high", f"found {high}, expected more than low, {low}")

    def position(table: _Table) -> tuple[Any, ...]:
        found = table.numbers("position", 3)
        if not all(a < p < b for a, p, b in zip(low, found, high, strict=True)):
            raise table.error("position", f"found {found}, expected inside the bounds {low} to {high}")
        return found

    fields = {field.name for field in dataclasses.fields(Gate)}
    tables = [file.inner(gate, "[[gates]]", fields, index) for index, gate in enumerate(data["gates"])]
    gates = tuple(_gate(table, position(table)) for table in tables)
    for index, table in enumerate(tables):
        if gates[index].id in {gate.id for gate in gates[:index]}:
            raise table.error("id", f"{gates[index].id} is used twice")
    return Track(data["name"], gates, position(start), start.quaternion(), low, high)


class _Table:
    """A table of a parsed file, checked to have its fields and no others; header: as in the file."""

    def __init__(
        self, path: Path, lines: list[str], data: Any, header: str, fields: set[str], index: int = 0
    ):
        self.path, self.lines, self.data, self.header, self.index = path, lines, data, header, index
        if not isinstance(data, dict):
            raise self.error(header.strip("[]"), "expected a table")
        for field in sorted(fields - set(data)):
            raise self.error(field, "missing")
        for field in sorted(set(data) - fields):
            raise self.error(field, f"unknown; expected {', '.join(sorted(fields))}")

    def inner(self, data: Any, header: str, fields: set[str], index: int = 0) -> "_Table":
        """Return the index-th table of a header of the same file."""
        return _Table(self.path, self.lines, data, header, fields, index)

    def _line_of(self, field: str) -> int:
        """Return the 1-based line of a field, else that of the table's header."""
        starts = [n for n, line in enumerate(self.lines) if line.lstrip().startswith(self.header)]
        start = (starts[self.index] if self.index < len(starts) else 0) if self.header else -1
        for number in range(start + 1, len(self.lines)):
            line = self.lines[number].lstrip()
            if line.startswith("["):
                break
            if line.startswith(field) and line[len(field) :].lstrip().startswith("="):
                return number + 1
        return max(start, 0) + 1

    def error(self, field: str, reason: str) -> TrackError:
        """Return the error that names file, line, table and field."""
        number = f"[{self.index}]" if self.header == "[[gates]]" else ""
        where = f"{self.header}{number} " if self.header else ""
        return TrackError(f"{self.path}, line {self._line_of(field)}: {where}{quote_name(field)}: {reason}")

    def numbers(self, field: str, size: int) -> tuple[Any, ...]:
        """Return a list of that many finite numbers."""
        value = self.data[field]
        if not isinstance(value, list) or len(value) != size:
            raise self.error(field, f"found {quote_value(value)}, expected {size} numbers")
        return tuple(self._finite(field, number) for number in value)

    def number(self, field: str) -> float:
        """Return a finite number."""
        return self._finite(field, self.data[field])

    def _finite(self, field: str, number: Any) -> float:
        if isinstance(number, bool) or not isinstance(number, (int, float)):
            raise self.error(field, f"found {quote_value(number)}, expected a number")
        if not -LARGEST < number < LARGEST:  # false for NaN too
            found = number if isinstance(number, float) else f"an integer of {number.bit_length()} bits"
            raise self.error(field, f"found {found}, expected a finite number within +-{LARGEST:g}")
        return float(number)

    def quaternion(self) -> tuple[Any, ...]:
        """Return a unit quaternion, renormalised if its digits were rounded."""
        value = self.numbers("quaternion", 4)
        norm = math.sqrt(sum(q * q for q in value))
        if abs(norm - 1.0) > UNIT_NORM_TOLERANCE:
            raise self.error("quaternion", f"found norm {norm:.6g}, expected 1")
        return value if abs(norm - 1.0) <= ROUNDING else tuple(q / norm for q in value)


def _gate(table: _Table, position: tuple[Any, ...]) -> Gate:
    """Return the gate of a table; raises TrackError."""
    gate_id, direction = table.data["id"], table.data["direction"]
    if isinstance(gate_id, bool) or not isinstance(gate_id, int):
        raise table.error("id", f"found {quote_value(gate_id)}, expected an integer")
    if not -LARGEST_ID < gate_id < LARGEST_ID:
        raise table.error("id", f"found {quote_value(gate_id)}, expected less than 2^53")
    if not isinstance(direction, str) or direction not in DIRECTIONS:
        raise table.error(
            "direction", f"found {quote_value(direction)}, expected one of {', '.join(DIRECTIONS)}"
        )
    opening, frame = table.number("opening"), table.number("frame")
    if opening <= 0.0:
        raise table.error("opening", f"found {opening}, expected > 0")
    if frame <= opening:
        raise table.error("frame", f"found {frame}, expected more than the opening, {opening}")
    return Gate(gate_id, position, table.quaternion(), DIRECTIONS[direction], opening, frame)
