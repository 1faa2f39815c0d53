"""Mapping files: what the columns of a CSV file are, which rows to use, and what is known of the craft.

TOML. Every table and field is in docs/real_logs.md; ``rows`` and ``craft`` serve logs of every format.
"""

from pathlib import Path
from typing import NamedTuple

from flytrack_env.messages import quote_value
from flytrack_sysid.importing.craft import Craft
from flytrack_sysid.importing.fields import Fields, read_toml
from flytrack_sysid.importing.units import TURNED, UNITS
from flytrack_sysid.log import LogError

SHIPPED = Path(__file__).parent.parent / "mappings"
# Table of the file: channel of the log, dimension, what the axes belong to.
VECTORS = {
    "position": ("p", "length", "world"),
    "velocity": ("v", "speed", "world"),
    "acceleration": ("a", "acceleration", "world"),
    "specific_force": ("f", "acceleration", "body"),
    "rates": ("w", "rate", "body"),
}
CSV_ONLY = ("delimiter", "time", "command", "attitude", "battery", *VECTORS)
NUM_AXES, NUM_STICKS, NUM_QUATERNION = 3, 4, 4


class TimeColumn(NamedTuple):
    """Where time is from: a column and s per unit of it; or, without a column, s per row."""

    column: str | None
    scale: float


class Command(NamedTuple):
    """Columns of roll, pitch, yaw, thrust; the values that mean -1 and 1; whether to clip what is beyond."""

    columns: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    clip: bool


class Vector(NamedTuple):
    """Columns of x, y, z; SI units per unit of each, with its sign; whether the axes are FRD or NED."""

    columns: tuple[str, ...]
    scales: tuple[float, ...]
    is_turned: bool


class Attitude(NamedTuple):
    """Columns of a quaternion (order ``wxyz`` or ``xyzw``), or of roll, pitch, yaw (order ``euler``)."""

    columns: tuple[str, ...]
    order: str
    scales: tuple[float, ...]
    is_inverted: bool
    is_body_turned: bool
    is_world_turned: bool


class Battery(NamedTuple):
    """A column of voltages and V per unit of it."""

    column: str
    scale: float


class Manifest(NamedTuple):
    """A CSV file beside the logs with, per file name (``key``), how many rows to use (``count``)."""

    file: str
    key: str
    count: str  # type: ignore[assignment]  # hides tuple.count


class Rows(NamedTuple):
    """Which rows to use: ``count`` from ``first`` on, of those from ``from_s`` to ``to_s``, every n-th.

    Seconds count from the first row of the file, rows from 0. None: to the end.
    """

    first: int = 0
    count: int | None = None  # type: ignore[assignment]  # hides tuple.count
    every: int = 1
    from_s: float = 0.0
    to_s: float | None = None
    manifest: Manifest | None = None


class Columns(NamedTuple):
    """What the columns of a CSV file are; channels that are not named are not there."""

    delimiter: str
    time: TimeColumn
    command: Command
    vectors: dict[str, Vector]
    attitude: Attitude | None
    battery: Battery | None


class Mapping(NamedTuple):
    """A mapping file: ``columns`` is None in one that has no CSV tables."""

    source: str = "no mapping"
    rows: Rows = Rows()
    craft: Craft = Craft()
    columns: Columns | None = None


def load_mapping(where: str | Path) -> Mapping:
    """Return the mapping in a TOML file, or the shipped one of that name (without ``.toml``).

    Raises:
        LogError: a file that cannot be read, or a field that is missing, unknown or out of range; the
            message names file, table and field, found and expected.
    """
    path, shipped = Path(where), SHIPPED / f"{where}.toml"
    if not path.exists() and path.name == str(where) and shipped.is_file():
        path = shipped
    if not path.exists():
        names = ", ".join(sorted(file.stem for file in SHIPPED.glob("*.toml")))
        raise LogError(f"{path}: no such mapping file, nor one that is shipped ({names})")
    top = Fields(str(path), "", read_toml(path))
    has_csv = any(name in top for name in CSV_ONLY)
    rows, craft = _rows(top.table("rows")), _craft(top.table("craft"))
    columns = _columns(top) if has_csv else None
    top.known += [name for name in CSV_ONLY if name not in top.known]
    top.done()
    return Mapping(str(path), rows, craft, columns)


def _rows(fields: Fields | None) -> Rows:
    if fields is None:
        return Rows()
    manifest = fields.table("manifest")
    found = Rows(
        first=fields.count("first", 0, 0),
        count=fields.count("count", None, 1),
        every=fields.count("every", 1, 1),
        from_s=fields.number("from_s", 0.0),
        to_s=fields.number("to_s", None, above=0.0),
        manifest=None if manifest is None else _manifest(manifest),
    )
    if found.count is not None and manifest is not None:
        raise fields.error("count", "found together with manifest, expected one of them")
    fields.done()
    return found


def _manifest(fields: Fields) -> Manifest:
    found = Manifest(fields.text("file"), fields.text("key"), fields.text("count"))
    fields.done()
    return found


def _craft(fields: Fields | None) -> Craft:
    if fields is None:
        return Craft()
    found = Craft(
        max_rate_deg_s=fields.numbers("max_rate_deg_s", NUM_AXES, None, above=0.0),
        mass_kg=fields.number("mass_kg", None, above=0.0),
        voltage_v=fields.numbers("voltage_v", 2, None, above=0.0),
    )
    if found.voltage_v is not None and found.voltage_v[0] >= found.voltage_v[1]:
        raise fields.error("voltage_v", f"found {list(found.voltage_v)}, expected the lower one first")
    fields.done()
    return found


def _columns(top: Fields) -> Columns:
    time, command = top.table("time"), top.table("command")
    if time is None or command is None:
        name = "time" if time is None else "command"
        raise top.error(name, "missing, expected a table: every log has it")
    tables = {name: top.table(name) for name in VECTORS}
    attitude, battery = top.table("attitude"), top.table("battery")
    delimiter = top.text("delimiter", ",")
    if len(delimiter) != 1:
        raise top.error("delimiter", f"found {quote_value(delimiter)}, expected one character")
    return Columns(
        delimiter=delimiter,
        time=_time(time),
        command=_command(command),
        vectors={VECTORS[name][0]: _vector(name, fields) for name, fields in tables.items() if fields},
        attitude=None if attitude is None else _attitude(attitude),
        battery=None if battery is None else _battery(battery),
    )


def _scale(fields: Fields, dimension: str) -> float:
    """Return SI units per unit, of ``unit`` (a known one) or ``scale`` (a number), of which one is there."""
    if "scale" in fields and "unit" in fields:
        raise fields.error("scale", "found together with unit, expected one of them")
    if "scale" in fields:
        return fields.number("scale", above=0.0)
    return UNITS[dimension][fields.choice("unit", tuple(UNITS[dimension]))]


def _signs(fields: Fields) -> tuple[float, ...]:
    signs = fields.numbers("signs", NUM_AXES, (1.0,) * NUM_AXES)
    if any(abs(sign) != 1.0 for sign in signs):
        raise fields.error("signs", f"found {list(signs)}, expected 1 or -1 each")
    return signs


def _time(fields: Fields) -> TimeColumn:
    if ("column" in fields) == ("step_s" in fields):
        raise fields.error("", "expected either column, with its unit, or step_s, of one row")
    if "step_s" in fields:
        found = TimeColumn(None, fields.number("step_s", above=0.0))
    else:
        found = TimeColumn(fields.text("column"), _scale(fields, "time"))
    fields.done()
    return found


def _command(fields: Fields) -> Command:
    found = Command(
        columns=fields.names("columns", NUM_STICKS),
        low=fields.numbers("low", NUM_STICKS, (-1.0,) * NUM_STICKS),
        high=fields.numbers("high", NUM_STICKS, (1.0,) * NUM_STICKS),
        clip=fields.flag("clip"),
    )
    if any(low == high for low, high in zip(found.low, found.high, strict=True)):
        raise fields.error("high", f"found {list(found.high)}, expected other values than low")
    fields.done()
    return found


def _vector(name: str, fields: Fields) -> Vector:
    _, dimension, axes = VECTORS[name]
    scale = _scale(fields, dimension)
    found = Vector(
        columns=fields.names("columns", NUM_AXES),
        scales=tuple(scale * sign for sign in _signs(fields)),
        is_turned=TURNED[axes][fields.choice("frame", tuple(TURNED[axes]))],
    )
    fields.done()
    return found


def _attitude(fields: Fields) -> Attitude:
    if ("quaternion" in fields) == ("euler" in fields):
        raise fields.error("", "expected either quaternion, with its order, or euler, with its unit")
    if "euler" in fields:
        scale = _scale(fields, "angle")
        columns, order = fields.names("euler", NUM_AXES), "euler"
        scales = tuple(scale * sign for sign in _signs(fields))
    else:
        columns, scales = fields.names("quaternion", NUM_QUATERNION), (1.0,) * NUM_QUATERNION
        order = fields.choice("order", ("wxyz", "xyzw"))
    directions = ("body_to_world", "world_to_body")
    found = Attitude(
        columns,
        order,
        scales,
        is_inverted=fields.choice("direction", directions, directions[0]) == directions[1],
        is_body_turned=TURNED["body"][fields.choice("body", tuple(TURNED["body"]))],
        is_world_turned=TURNED["world"][fields.choice("world", tuple(TURNED["world"]))],
    )
    fields.done()
    return found


def _battery(fields: Fields) -> Battery:
    found = Battery(fields.text("column"), _scale(fields, "voltage"))
    fields.done()
    return found
