"""Tracks and their TOML files, checked before anything flies them.

A track file has a ``name``, a ``[start]`` (position, quaternion), ``[bounds]`` (low, high) and one
``[[gates]]`` table per gate, in flying order; ``flytrack.toml`` beside this file is the example.
"""

import dataclasses
import json
import math
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from flytrack_env.files import write_atomically
from flytrack_env.messages import error_text
from flytrack_env.toml_file import TomlError, parse_toml, read_text
from flytrack_env.validation import Fields, Finite, Text, convert

TRACK_FOLDER = Path(__file__).parent
DIRECTIONS = {"+y": 1.0, "-y": -1.0}
UNIT_NORM_TOLERANCE = 1e-3
ROUNDING = 1e-12  # of a norm: a quaternion that is this close to a unit was not rounded for a file
MAX_ID = 2**53  # float64 tells whole numbers apart below it
MAX_COORDINATE_M = 1e6  # m: beyond that, float32 positions are coarser than a drone


class TrackError(ValueError):
    """A track that cannot be flown; the message names file, field, what was found and expected."""


@dataclasses.dataclass(frozen=True)
class Gate:
    """One square gate; position in m, quaternion (w, x, y, z) gate to world, edges in m.

    Attributes:
        id: a number for people, any below 2^53 but another gate's.
        direction: +1 if flown towards the gate's local +y, -1 if towards -y.
        opening: inner edge.
        frame: outer edge.
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

    Attributes:
        name: as in its file.
        start_position: m.
        start_quaternion: (w, x, y, z), body to world.
        bounds_low, bounds_high: corners of the box that must not be left, m; the ground is the
            lower one's z.
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
        TrackError: unknown name, missing file, or a file that cannot be flown.
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
        TrackError: a path without ``.toml``, or a track that would not come back as it is: values
            that no track file may have, quaternions that are not units.
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
            f"{path}: {', '.join(changed)}: would not be read back as written, "
            "expected tuples of floats and unit quaternions"
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
        fields = (
            f"{field} = {list(x) if isinstance(x, tuple) else x}" for field, x in values.items()
        )
        lines += ["", "[[gates]]", *fields]
    return "\n".join(lines) + "\n"


def _parse(path: Path, text: str) -> Track:
    """Return the checked track of a file's text; raises TrackError."""
    try:
        data = parse_toml(text)
    except TomlError as error:
        raise TrackError(f"{path}: not a TOML file: {error_text(error)}") from error
    file = convert(str(path), data, _TrackFile, TrackError)
    gates = tuple(
        Gate(
            gate.id,
            gate.position,
            gate.unit(),
            DIRECTIONS[gate.direction],
            gate.opening,
            gate.frame,
        )
        for gate in file.gates
    )
    return Track(
        file.name, gates, file.start.position, file.start.unit(), file.bounds.low, file.bounds.high
    )


Coordinate = Annotated[float, Meta(gt=-MAX_COORDINATE_M, lt=MAX_COORDINATE_M)]
Position = tuple[Coordinate, Coordinate, Coordinate]


class _Pose(Fields):
    position: Position
    quaternion: tuple[Finite, Finite, Finite, Finite]

    def __post_init__(self) -> None:
        norm = math.hypot(*self.quaternion)
        if not abs(norm - 1.0) <= UNIT_NORM_TOLERANCE:
            raise ValueError(f"quaternion: found norm {norm:.6g}, expected 1")

    def unit(self) -> tuple[float, float, float, float]:
        """Return the quaternion, renormalised if its digits were rounded."""
        w, x, y, z = self.quaternion
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        return (
            self.quaternion
            if abs(norm - 1.0) <= ROUNDING
            else (w / norm, x / norm, y / norm, z / norm)
        )


class _Bounds(Fields):
    low: Position
    high: Position

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"high: found {self.high}, expected more than low, {self.low}")

    def check(self, field: str, position: Position) -> None:
        """Raise ValueError for a position that is not within the bounds."""
        ranges = zip(self.low, position, self.high, strict=True)
        if not all(low < value < high for low, value, high in ranges):
            raise ValueError(
                f"{field}: found {position}, expected inside the bounds {self.low} to {self.high}"
            )


class _GateFields(_Pose):
    id: Annotated[int, Meta(gt=-MAX_ID, lt=MAX_ID)]
    direction: Literal["+y", "-y"]
    opening: Annotated[float, Meta(gt=0.0, lt=MAX_COORDINATE_M)]
    frame: Coordinate

    def __post_init__(self) -> None:
        _Pose.__post_init__(self)
        if self.frame <= self.opening:
            raise ValueError(
                f"frame: found {self.frame}, expected more than the opening, {self.opening}"
            )


class _TrackFile(Fields):
    name: Text
    start: _Pose
    bounds: _Bounds
    gates: Annotated[tuple[_GateFields, ...], Meta(min_length=2)]

    def __post_init__(self) -> None:
        self.bounds.check("start.position", self.start.position)
        ids = [gate.id for gate in self.gates]
        for index, gate in enumerate(self.gates):
            self.bounds.check(f"gates[{index}].position", gate.position)
            if gate.id in ids[:index]:
                raise ValueError(
                    f"gates[{index}].id: found {gate.id} twice, expected another number"
                )
