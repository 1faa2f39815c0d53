"""Mapping files: what the columns of a CSV file are, which rows to use, and what is known of the craft.

TOML. Every table and field is described in docs/real_logs.md; ``rows`` and ``craft`` apply to logs of every
format.
"""

import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_env.toml_file import TomlError, parse_toml, read_text
from flytrack_sysid.importing.flight import Craft
from flytrack_sysid.importing.units import TURNED, UNITS, quaternion_from, vector_from
from flytrack_sysid.log import LogError
from flytrack_sysid.log_table import LARGEST_NORM_ERROR, Table

SHIPPED = Path(__file__).parent.parent / "mappings"
# Table of the file: channel of the log, dimension, frame of the axes.
VECTORS = {
    "position": ("p", "length", "world"),
    "velocity": ("v", "speed", "world"),
    "acceleration": ("a", "acceleration", "world"),
    "specific_force": ("f", "acceleration", "body"),
    "rates": ("w", "rate", "body"),
}
NUM_AXES, NUM_STICKS, NUM_QUATERNION = 3, 4, 4
DIRECTIONS = ("body_to_world", "world_to_body")
LARGEST_COUNT = 2**53
LARGEST_NUMBER = sys.float_info.max  # integers in TOML are unbounded
REQUIRED: Any = object()  # the default of a field that has none
T = TypeVar("T")


class Channel(NamedTuple):
    """A channel of the log in a CSV file: where it is from and how it is converted.

    table: of the mapping, for messages. name: of ``CHANNELS``, or t. columns: of the file. convert: from the
    file's table to the channel's columns, (num_rows, n), SI units and our frames.
    """

    table: str
    name: str
    columns: tuple[str, ...]
    convert: Callable[[Table], np.ndarray]


class Manifest(NamedTuple):
    """A CSV file beside the logs: its columns of file names and of how many rows to use."""

    file: str
    name_column: str
    count_column: str


class UsedRows(NamedTuple):
    """Which rows to use: every n-th from ``from_s`` to ``to_s`` after the first; a manifest limits them."""

    every: int = 1
    from_s: float = 0.0
    to_s: float | None = None
    manifest: Manifest | None = None


class Mapping(NamedTuple):
    """A mapping file: ``channels`` and ``delimiter`` are of its CSV tables; no channels if it has none."""

    source: str = "no mapping"
    rows: UsedRows = UsedRows()
    craft: Craft = Craft()
    channels: tuple[Channel, ...] = ()
    delimiter: str = ","


class Fields:
    """One table of a TOML file; fields are taken by name, and what is left at the end is refused."""

    def __init__(self, source: str, name: str, table: Any):
        self.source, self.name = source, name
        if not isinstance(table, dict):
            raise self.error("", f"found {quote_value(table)}, expected a table")
        self.left, self.known = dict(table), list[str]()

    def error(self, field: str, text: str) -> LogError:
        """Return the error about one field, or about the table itself."""
        where = ".".join(part for part in (self.name, field) if part)
        return LogError(f"{self.source}: {where}: {text}")

    def __contains__(self, field: str) -> bool:
        return field in self.left

    def take(
        self, field: str, is_valid: Callable[[Any], bool], expected: str, default: Any = REQUIRED
    ) -> Any:
        """Return the valid value of a field, or the default of an absent one."""
        self.known.append(field)
        if field not in self.left:
            if default is REQUIRED:
                raise self.error(field, f"missing, expected {expected}")
            return default
        value = self.left.pop(field)
        if not is_valid(value):
            raise self.error(field, f"found {quote_value(value)}, expected {expected}")
        return value

    def table(self, field: str, read: Callable[["Fields"], T]) -> T | None:
        """Return what a function reads from a sub-table, all of whose fields it must take; None if absent."""
        content = self.take(field, lambda value: True, "a table", None)
        if content is None:
            return None
        fields = Fields(self.source, f"{self.name}.{field}" if self.name else field, content)
        found = read(fields)
        fields.check_empty()
        return found

    def check_empty(self) -> None:
        """Raise LogError for a field that was not taken."""
        for field in self.left:
            raise self.error(quote_name(field), f"unknown; expected one of {', '.join(self.known)}")

    def text(self, field: str) -> str:
        """Return a text that is not empty."""
        return str(self.take(field, _is_text, "a text"))

    def choice(self, field: str, choices: Iterable[str], default: Any = REQUIRED) -> str:
        """Return one of several words."""
        words = tuple(choices)
        return str(self.take(field, words.__contains__, f"one of {', '.join(words)}", default))

    def number(self, field: str, default: Any = REQUIRED, above: float = -LARGEST_NUMBER) -> Any:
        """Return a finite number above a bound, as a float, or the default."""
        value = self.take(field, partial(_is_number, above=above), f"a number{_bound(above)}", default)
        return value if value is default else float(value)

    def numbers(self, field: str, size: int, default: Any = REQUIRED, above: float = -LARGEST_NUMBER) -> Any:
        """Return a tuple of finite numbers above a bound, or the default."""

        def is_valid(value: Any) -> bool:
            return isinstance(value, list) and len(value) == size and all(_is_number(n, above) for n in value)

        value = self.take(field, is_valid, f"{size} numbers{_bound(above)}", default)
        return value if value is default else tuple(map(float, value))

    def names(self, field: str, size: int) -> tuple[str, ...]:
        """Return a tuple of different names."""

        def is_valid(value: Any) -> bool:
            return isinstance(value, list) and all(map(_is_text, value)) and len(set(value)) == size

        return tuple(self.take(field, is_valid, f"{size} different names of columns"))


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _is_number(value: Any, above: float) -> bool:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_number and above < value <= LARGEST_NUMBER  # false for NaN too


def _bound(above: float) -> str:
    return f" above {above:g}" if above > -LARGEST_NUMBER else ""


def load_mapping(where: str | Path) -> Mapping:
    """Return the mapping in a TOML file, or the shipped one of that name (without ``.toml``).

    Raises LogError, whose message names file, table and field, found and expected.
    """
    path, shipped = Path(where), SHIPPED / f"{where}.toml"
    if not path.exists() and path.name == str(where) and shipped.is_file():
        path = shipped
    if not path.exists():
        names = ", ".join(sorted(file.stem for file in SHIPPED.glob("*.toml")))
        raise LogError(f"{path}: found no such mapping file; shipped ones are {names}")
    try:
        content = parse_toml(read_text(path))
    except (OSError, UnicodeDecodeError, TomlError) as error:
        raise LogError(f"{path}: not a readable TOML file: {error_text(error)}") from error
    top = Fields(str(path), "", content)
    mapping = Mapping(
        source=str(path),
        rows=top.table("rows", _rows) or UsedRows(),
        craft=top.table("craft", _craft) or Craft(),
        channels=_channels(top),
        delimiter=top.take(
            "delimiter", lambda value: _is_text(value) and len(value) == 1, "one character", ","
        ),
    )
    top.check_empty()
    return mapping


def _channels(top: Fields) -> tuple[Channel, ...]:
    """Return what the CSV tables say, nothing if there are none."""
    found = [top.table("time", _time), top.table("command", _command)]
    for table, (name, dimension, frame) in VECTORS.items():
        found.append(top.table(table, partial(_vector, name=name, dimension=dimension, frame=frame)))
    found += [top.table("attitude", _attitude), top.table("battery", _battery)]
    channels = tuple(channel for channel in found if channel is not None)
    for table, channel in zip(("time", "command"), found, strict=False):
        if channels and channel is None:
            raise top.error(table, "missing, expected a table: every log has it")
    return channels


def _rows(fields: Fields) -> UsedRows:
    def is_step(value: Any) -> bool:
        return isinstance(value, int) and not isinstance(value, bool) and 1 <= value < LARGEST_COUNT

    return UsedRows(
        every=fields.take("every", is_step, "a whole number of at least 1, below 2^53", 1),
        from_s=fields.number("from_s", 0.0),
        to_s=fields.number("to_s", None, above=0.0),
        manifest=fields.table(
            "manifest", lambda table: Manifest(table.text("file"), table.text("key"), table.text("count"))
        ),
    )


def _craft(fields: Fields) -> Craft:
    found = Craft(
        max_rate_deg_s=fields.numbers("max_rate_deg_s", NUM_AXES, None, above=0.0),
        mass_kg=fields.number("mass_kg", None, above=0.0),
        voltage_v=fields.numbers("voltage_v", 2, None, above=0.0),
    )
    if found.voltage_v is not None and found.voltage_v[0] >= found.voltage_v[1]:
        raise fields.error("voltage_v", f"found {list(found.voltage_v)}, expected the lower one first")
    return found


def _scale(fields: Fields, dimension: str) -> float:
    """Return SI units per unit, by ``unit`` (a known one) or ``scale`` (a number)."""
    if "scale" in fields and "unit" in fields:
        raise fields.error("scale", "found together with unit, expected one of them")
    if "scale" in fields:
        return float(fields.number("scale", above=0.0))
    return UNITS[dimension][fields.choice("unit", UNITS[dimension])]


def _signed_scales(fields: Fields, dimension: str) -> np.ndarray:
    scale, signs = _scale(fields, dimension), np.array(fields.numbers("signs", NUM_AXES, (1.0,) * NUM_AXES))
    if np.any(np.abs(signs) != 1.0):
        raise fields.error("signs", f"found {signs.tolist()}, expected 1 or -1 each")
    return scale * signs


def _time(fields: Fields) -> Channel:
    """Return time from 0 on: large numbers of us would cost digits."""
    if ("column" in fields) == ("step_s" in fields):
        raise fields.error("", "expected either column, with its unit, or step_s, of one row")
    if "step_s" in fields:
        step_s = fields.number("step_s", above=0.0)

        def by_row(table: Table) -> np.ndarray:
            num_rows = len(next(iter(table.columns.values())))
            return np.arange(num_rows)[:, None] * step_s

        return Channel(fields.name, "t", (), by_row)
    column, scale = fields.text("column"), _scale(fields, "time")

    def convert(table: Table) -> np.ndarray:
        values = table.matrix([column])
        return (values - values[0]) * scale

    return Channel(fields.name, "t", (column,), convert)


def _battery(fields: Fields) -> Channel:
    column, scale = fields.text("column"), _scale(fields, "voltage")
    return Channel(fields.name, "v_bat", (column,), lambda table: table.matrix([column]) * scale)


def _command(fields: Fields) -> Channel:
    """Return the commands, scaled so that ``low`` and ``high`` are -1 and 1."""
    columns = fields.names("columns", NUM_STICKS)
    low = np.array(fields.numbers("low", NUM_STICKS, (-1.0,) * NUM_STICKS))
    high = np.array(fields.numbers("high", NUM_STICKS, (1.0,) * NUM_STICKS))
    is_clipped = fields.take("clip", lambda value: isinstance(value, bool), "true or false", False)
    if np.any(low == high):
        raise fields.error("high", f"found {high.tolist()}, expected other values than low")
    least, most = np.minimum(low, high), np.maximum(low, high)

    def convert(table: Table) -> np.ndarray:
        values = table.matrix(columns)
        if is_clipped:
            values = np.clip(values, least, most)
        for row, stick in np.argwhere((values < least) | (values > most))[:1]:
            text = f"found {values[row, stick]:g}, expected {low[stick]:g} to {high[stick]:g} by command.low"
            text += " and command.high; clip = true limits it"
            raise table.error(row, quote_name(columns[stick]), text)
        return 2.0 * (values - low) / (high - low) - 1.0

    return Channel(fields.name, "u", columns, convert)


def _vector(fields: Fields, name: str, dimension: str, frame: str) -> Channel:
    columns = fields.names("columns", NUM_AXES)
    scales = _signed_scales(fields, dimension)
    is_turned = TURNED[frame][fields.choice("frame", TURNED[frame])]
    return Channel(
        fields.name, name, columns, lambda table: vector_from(table.matrix(columns) * scales, is_turned)
    )


def _attitude(fields: Fields) -> Channel:
    """Return the quaternions; Euler angles turn by yaw, then pitch, then roll, about moving axes."""
    if ("quaternion" in fields) == ("euler" in fields):
        raise fields.error("", "expected either quaternion, with its order, or euler, with its unit")
    if "euler" in fields:
        columns, order = fields.names("euler", NUM_AXES), "euler"
        scales = _signed_scales(fields, "angle")
    else:
        columns, scales = fields.names("quaternion", NUM_QUATERNION), np.ones(NUM_QUATERNION)
        order = fields.choice("order", ("wxyz", "xyzw"))
    is_inverted = fields.choice("direction", DIRECTIONS, DIRECTIONS[0]) == DIRECTIONS[1]
    is_body_turned = TURNED["body"][fields.choice("body", TURNED["body"])]
    is_world_turned = TURNED["world"][fields.choice("world", TURNED["world"])]

    def convert(table: Table) -> np.ndarray:
        values = table.matrix(columns) * scales
        if order == "euler":
            rotation = Rotation.from_euler("ZYX", values[:, ::-1])
        else:
            norm = np.linalg.norm(values, axis=1)
            for row in np.flatnonzero(np.abs(norm - 1.0) > LARGEST_NORM_ERROR)[:1]:
                text = f"found a quaternion of norm {norm[row]:.4g}, expected 1"
                raise table.error(row, ", ".join(map(quote_name, columns)), text)
            rotation = Rotation.from_quat(values, scalar_first=order == "wxyz")
        rotation = rotation.inv() if is_inverted else rotation
        return quaternion_from(rotation, is_body_turned, is_world_turned)

    return Channel(fields.name, "q", columns, convert)
