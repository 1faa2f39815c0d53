"""Track files: what a course is, read from TOML and checked before anything flies it.

A track file has a ``name``, a ``[start]`` (position, quaternion), ``[bounds]`` (low, high) and one
``[[gates]]`` table per gate, in flying order; ``flytrack.toml`` beside this file is the example.
"""

import dataclasses
import json
import math
import re
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
        OSError: what the system says.
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
        lines += [
            "",
            "[[gates]]",
            f"id = {gate.id}",
            f"position = {list(gate.position)}",
            f"quaternion = {list(gate.quaternion)}",
            f'direction = "{signs[gate.direction]}"',
            f"opening = {gate.opening}",
            f"frame = {gate.frame}",
        ]
    return "\n".join(lines) + "\n"


def _parse(path: Path, text: str) -> Track:
    """Return the checked track of a file's text; raises TrackError."""
    try:
        data = parse_toml(text)
    except TomlError as error:
        raise TrackError(f"{path}: not a TOML file: {error_text(error)}") from error
    return _Reader(path, text).track(data)


class _Reader:
    """Checks one parsed file and knows where in the text each field stands."""

    def __init__(self, path: Path, text: str):
        self.path = path
        self.lines = text.splitlines()

    def line_of(self, header: str, index: int, field: str) -> int:
        """Return the 1-based line of a field in the index-th table of that header, else its header."""
        pattern = re.compile(r"^\s*" + re.escape(header))
        starts = [n for n, line in enumerate(self.lines) if pattern.match(line)] if header else [-1]
        start = starts[index] if index < len(starts) else 0
        for number in range(start + 1, len(self.lines)):
            if self.lines[number].lstrip().startswith("["):
                break
            line = self.lines[number].lstrip()
            if line.startswith(field) and line[len(field) :].lstrip().startswith("="):
                return number + 1
        return max(start, 0) + 1

    def fail(self, header: str, index: int, field: str, reason: str) -> TrackError:
        where = f"{header}[{index}] " if header == "[[gates]]" else f"{header} " if header else ""
        line = self.line_of(header, index, field)
        return TrackError(f"{self.path}, line {line}: {where}{quote_name(field)}: {reason}")

    def table(self, data: dict[str, Any], header: str, index: int, fields: set[str]) -> None:
        """Check that a table has these fields and no others."""
        if not isinstance(data, dict):
            raise self.fail(header, index, header.strip("[]"), "expected a table")
        for field in sorted(fields - set(data)):
            raise self.fail(header, index, field, "missing")
        for field in sorted(set(data) - fields):
            raise self.fail(header, index, field, f"unknown; expected {', '.join(sorted(fields))}")

    def numbers(
        self, data: dict[str, Any], header: str, index: int, field: str, size: int
    ) -> tuple[Any, ...]:
        """Return a list of that many finite numbers."""
        value = data[field]
        if not isinstance(value, list) or len(value) != size:
            raise self.fail(header, index, field, f"found {quote_value(value)}, expected {size} numbers")
        for number in value:
            if isinstance(number, bool) or not isinstance(number, (int, float)):
                raise self.fail(header, index, field, f"found {quote_value(number)}, expected a number")
            if not -LARGEST < number < LARGEST:  # false for NaN too
                found = number if isinstance(number, float) else f"an integer of {number.bit_length()} bits"
                reason = f"found {found}, expected a finite number within +-{LARGEST:g}"
                raise self.fail(header, index, field, reason)
        return tuple(float(number) for number in value)

    def quaternion(self, data: dict[str, Any], header: str, index: int) -> tuple[Any, ...]:
        """Return a unit quaternion, renormalised if its digits were rounded."""
        value = self.numbers(data, header, index, "quaternion", 4)
        norm = math.sqrt(sum(q * q for q in value))
        if abs(norm - 1.0) > UNIT_NORM_TOLERANCE:
            raise self.fail(header, index, "quaternion", f"found norm {norm:.6g}, expected 1")
        return value if abs(norm - 1.0) <= ROUNDING else tuple(q / norm for q in value)

    def gate(self, data: dict[str, Any], index: int) -> Gate:
        """Return one checked gate."""
        header = "[[gates]]"
        fields = {"id", "position", "quaternion", "direction", "opening", "frame"}
        self.table(data, header, index, fields)
        if isinstance(data["id"], bool) or not isinstance(data["id"], int):
            raise self.fail(header, index, "id", f"found {quote_value(data['id'])}, expected an integer")
        if not -LARGEST_ID < data["id"] < LARGEST_ID:
            raise self.fail(header, index, "id", f"found {quote_value(data['id'])}, expected less than 2^53")
        if not isinstance(data["direction"], str) or data["direction"] not in DIRECTIONS:
            reason = f"found {quote_value(data['direction'])}, expected one of {', '.join(DIRECTIONS)}"
            raise self.fail(header, index, "direction", reason)
        for field in ("opening", "frame"):
            data = {**data, field: self.numbers({field: [data[field]]}, header, index, field, 1)[0]}
        if data["opening"] <= 0.0:
            raise self.fail(header, index, "opening", f"found {data['opening']}, expected > 0")
        if data["frame"] <= data["opening"]:
            reason = f"found {data['frame']}, expected more than the opening, {data['opening']}"
            raise self.fail(header, index, "frame", reason)
        return Gate(
            id=data["id"],
            position=self.numbers(data, header, index, "position", 3),
            quaternion=self.quaternion(data, header, index),
            direction=DIRECTIONS[data["direction"]],
            opening=data["opening"],
            frame=data["frame"],
        )

    def track(self, data: dict[str, Any]) -> Track:
        """Return the checked track."""
        self.table(data, "", 0, {"name", "start", "bounds", "gates"})
        if not isinstance(data["name"], str) or not data["name"]:
            raise self.fail("", 0, "name", f"found {quote_value(data['name'])}, expected a non-empty string")
        self.table(data["start"], "[start]", 0, {"position", "quaternion"})
        self.table(data["bounds"], "[bounds]", 0, {"low", "high"})
        if not isinstance(data["gates"], list) or len(data["gates"]) < 2:
            raise self.fail("", 0, "gates", "expected at least two [[gates]] tables")
        gates = tuple(self.gate(gate, index) for index, gate in enumerate(data["gates"]))
        ids: set[int] = set()
        for index, gate in enumerate(gates):
            if gate.id in ids:
                raise self.fail("[[gates]]", index, "id", f"{gate.id} is used twice")
            ids.add(gate.id)
        low = self.numbers(data["bounds"], "[bounds]", 0, "low", 3)
        high = self.numbers(data["bounds"], "[bounds]", 0, "high", 3)
        if not all(a < b for a, b in zip(low, high, strict=True)):
            raise self.fail("[bounds]", 0, "high", f"found {high}, expected more than low, {low}")

        def is_inside(position: tuple[float, ...]) -> bool:
            return all(a < p < b for a, p, b in zip(low, position, high, strict=True))

        for index, gate in enumerate(gates):
            if not is_inside(gate.position):
                reason = f"found {gate.position}, expected inside the bounds {low} to {high}"
                raise self.fail("[[gates]]", index, "position", reason)
        start = self.numbers(data["start"], "[start]", 0, "position", 3)
        if not is_inside(start):
            reason = f"found {start}, expected inside the bounds {low} to {high}"
            raise self.fail("[start]", 0, "position", reason)
        return Track(
            name=data["name"],
            gates=gates,
            start_position=start,
            start_quaternion=self.quaternion(data["start"], "[start]", 0),
            bounds_low=low,
            bounds_high=high,
        )
