"""Mapping files: what the columns of a log are, which rows to use, and what is known of the craft.

TOML. Every table and field is described in docs/real_logs.md; ``rows``, ``craft`` and ``motors.as_thrust``
apply to logs of every format. Columns are those of a CSV file, variables of a Crazyflie's uSD log, fields of
topics.
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
from flytrack_sysid.importing.commands import CommandRules
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
    """A channel of the log in a table of columns: where it is from and how it is converted.

    table: of the mapping, for messages. name: of ``CHANNELS``, or t, or as in ``commands_of``. columns: of
    the file. convert: from the file's table to the channel's columns, (num_rows, n), SI units and our frames.
    is_optional: it is left out where the file has none of the columns.
    """

    table: str
    name: str
    columns: tuple[str, ...]
    convert: Callable[[Table], np.ndarray]
    is_optional: bool = False


class Manifest(NamedTuple):
    """A CSV file beside the logs: its columns of file names and of how many rows to use."""

    file: str
    name_column: str
    count_column: str


class UsedRows(NamedTuple):
    """Which rows to use: every n-th from ``from_s`` to ``to_s`` after the first; a manifest limits them.

    above_m: only the longest stretch of rows that are that much higher than the first. ranges_s: only what is
    in one of these, s after the first row; all if none. logs: numbers, from 1, of the logs in a file that
    holds several; all if none. keep_ground: rows on the ground are used, too.
    """

    every: int = 1
    above_m: float | None = None
    from_s: float = 0.0
    to_s: float | None = None
    manifest: Manifest | None = None
    ranges_s: tuple[tuple[float, float], ...] = ()
    logs: tuple[int, ...] = ()
    keep_ground: bool = False


class CsvFile(NamedTuple):
    """One of several CSV files of a log, with a clock of its own.

    pattern: of its name, in the folder of the log. time: the column of its times, which begin at ``offset_s``
    of the log's clock; scale: s per unit of it.
    """

    pattern: str
    time: str
    scale: float
    offset_s: float = 0.0


class Mapping(NamedTuple):
    """A mapping file: ``channels`` are of its tables of columns; none if it has none.

    files: of a log of several CSV files, by the names that columns begin with.
    """

    source: str = "no mapping"
    rows: UsedRows = UsedRows()
    craft: Craft = Craft()
    channels: tuple[Channel, ...] = ()
    rules: CommandRules = CommandRules()
    delimiter: str = ","
    files: dict[str, CsvFile] = {}  # noqa: RUF012, not written to


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
        is_valid = partial(_are_numbers, size=size, above=above)
        value = self.take(field, is_valid, f"{size} numbers{_bound(above)}", default)
        return value if value is default else tuple(map(float, value))

    def names(self, field: str, size: int, default: Any = REQUIRED) -> tuple[str, ...]:
        """Return a tuple of different names, or the default."""

        def is_valid(value: Any) -> bool:
            are_texts = isinstance(value, list) and all(map(_is_text, value))
            return are_texts and len(set(value)) == len(value) == size

        return tuple(self.take(field, is_valid, f"{size} different names of columns", default))

    def flag(self, field: str) -> bool:
        """Return true or false; an absent one is false."""
        return bool(self.take(field, lambda value: isinstance(value, bool), "true or false", False))


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _is_number(value: Any, above: float) -> bool:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_number and above < value <= LARGEST_NUMBER  # false for NaN too


def _are_numbers(value: Any, size: int, above: float = -LARGEST_NUMBER) -> bool:
    return isinstance(value, list) and len(value) == size and all(_is_number(one, above) for one in value)


def _bound(above: float) -> str:
    return f" above {above:g}" if above > -LARGEST_NUMBER else ""


def load_mapping(where: str | Path) -> Mapping:
    """Return the mapping in a TOML file, or the shipped one of that name (without ``.toml``).

    Raises LogError, whose message names file, table and field, found and expected.
    """
    path, shipped = Path(where), sorted(file.stem for file in SHIPPED.glob("*.toml"))
    if not path.exists():
        if str(where) not in shipped:
            names = ", ".join(shipped)
            raise LogError(f"{path}: found no such mapping file; shipped ones are {names}")
        path = SHIPPED / f"{where}.toml"
    content = _load(path)
    base = content.pop("extends", None)
    if base is not None:
        if base not in shipped:
            found = f"found {quote_value(base)}, expected one of {', '.join(shipped)}"
            raise LogError(f"{path}: extends: {found}")
        content = _merged(_load(SHIPPED / f"{base}.toml"), content)
    top = Fields(str(path), "", content)
    channels, rules = _channels(top)
    mapping = Mapping(
        source=str(path),
        rows=top.table("rows", _rows) or UsedRows(),
        craft=top.table("craft", _craft) or Craft(),
        channels=channels,
        rules=rules,
        files=top.table("files", _files) or {},
        delimiter=top.take(
            "delimiter", lambda value: _is_text(value) and len(value) == 1, "one character", ","
        ),
    )
    top.check_empty()
    return mapping


def _load(path: Path) -> dict[str, Any]:
    """Return the content of a mapping file."""
    try:
        return parse_toml(read_text(path))
    except (OSError, UnicodeDecodeError, TomlError) as error:
        raise LogError(f"{path}: not a readable TOML file: {error_text(error)}") from error


def _merged(base: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """Return a mapping's tables with the fields of another one in place of its own."""
    merged = dict(base)
    for name, value in change.items():
        old = merged.get(name)
        merged[name] = {**old, **value} if isinstance(old, dict) and isinstance(value, dict) else value
    return merged


def _channels(top: Fields) -> tuple[tuple[Channel, ...], CommandRules]:
    """Return what the tables of columns say, nothing if there are none, and the rules of the commands."""
    found = [top.table("time", _time), top.table("command", _command)]
    for table, (name, dimension, frame) in VECTORS.items():
        found.append(top.table(table, partial(_vector, name=name, dimension=dimension, frame=frame)))
    found += [top.table("attitude", _attitude), top.table("battery", _battery)]
    found.append(top.table("thrust_command", _thrust_command))
    motors, rules = top.table("motors", _motors) or ((), CommandRules())
    attitudes, gain = top.table("attitude_command", _attitude_command) or ((), rules.attitude_gain)
    torques, rate_gain = top.table("torque_command", _torque_command) or ((), None)
    present = [channel for channel in found if channel is not None]
    if any(channel.name == "u" for channel in present) and (attitudes or torques):
        raise top.error("command", "found together with setpoints of attitude or torque, expected one kind")
    rules = rules._replace(attitude_gain=gain, rate_gain=rate_gain or rules.rate_gain)
    return (*present, *attitudes, *torques, *motors), rules


def _files(fields: Fields) -> dict[str, CsvFile]:
    """Return the files of a log of several, by name."""
    files = {}
    for name in list(fields.left):
        found = fields.table(name, _file)
        assert found is not None
        files[name] = found
    return files


def _file(fields: Fields) -> CsvFile:
    def is_pattern(value: Any) -> bool:
        return _is_text(value) and Path(value).name == value

    pattern = fields.take("file", is_pattern, "the name of a file in the log's folder, * for any text")
    scale = _scale(fields, "time")
    return CsvFile(str(pattern), fields.text("time"), scale, fields.number("offset_s", 0.0))


def _rows(fields: Fields) -> UsedRows:
    def is_step(value: Any) -> bool:
        return isinstance(value, int) and not isinstance(value, bool) and 1 <= value < LARGEST_COUNT

    def is_range(value: Any) -> bool:
        return _are_numbers(value, 2) and bool(value[0] < value[1])

    def are_ranges(value: Any) -> bool:
        return isinstance(value, list) and bool(value) and all(map(is_range, value))

    def are_log_numbers(value: Any) -> bool:
        numbers = value if isinstance(value, list) and value else [None]
        return all(map(is_step, numbers)) and len(set(numbers)) == len(numbers)

    ranges = fields.take("ranges_s", are_ranges, "a list of [from, to] in s, the lower one first", ())
    return UsedRows(
        ranges_s=tuple((float(low), float(high)) for low, high in ranges),
        logs=tuple(fields.take("logs", are_log_numbers, "different whole numbers of at least 1", ())),
        keep_ground=fields.choice("on_ground", ("drop", "keep"), "drop") == "keep",
        every=fields.take("every", is_step, "a whole number of at least 1, below 2^53", 1),
        above_m=fields.number("above_m", None, above=0.0),
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
    """Return the channel of times, s, as they are stamped."""
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
        return table.matrix([column]) * scale

    return Channel(fields.name, "t", (column,), convert)


def _battery(fields: Fields) -> Channel:
    column, scale = fields.text("column"), _scale(fields, "voltage")
    return Channel(fields.name, "v_bat", (column,), lambda table: table.matrix([column]) * scale)


def _command(fields: Fields) -> Channel:
    """Return the commands, scaled so that ``low`` and ``high`` are -1 and 1."""
    columns = fields.names("columns", NUM_STICKS)
    low = np.array(fields.numbers("low", NUM_STICKS, (-1.0,) * NUM_STICKS))
    high = np.array(fields.numbers("high", NUM_STICKS, (1.0,) * NUM_STICKS))
    is_clipped = fields.flag("clip")
    if np.any(low == high):
        raise fields.error("high", f"found {high.tolist()}, expected other values than low")
    least, most = np.minimum(low, high), np.maximum(low, high)

    def convert(table: Table) -> np.ndarray:
        values = table.matrix(columns)
        is_past = ((values < least) | (values > most)) & (not is_clipped)  # else ``commands_of`` clips them
        for row, stick in np.argwhere(is_past)[:1]:
            text = f"found {values[row, stick]:g}, expected {low[stick]:g} to {high[stick]:g} by command.low"
            text += " and command.high; clip = true limits it"
            raise table.error(row, quote_name(columns[stick]), text)
        return 2.0 * (values - low) / (high - low) - 1.0

    return Channel(fields.name, "u", columns, convert)


def _vector(fields: Fields, name: str, dimension: str, frame: str) -> Channel:
    columns = fields.names("columns", NUM_AXES)
    scales = _signed_scales(fields, dimension)
    is_turned = TURNED[frame][fields.choice("frame", TURNED[frame])]
    is_optional = fields.flag("optional")

    def convert(table: Table) -> np.ndarray:
        return vector_from(table.matrix(columns) * scales, is_turned)

    return Channel(fields.name, name, columns, convert, is_optional)


def _scaled(table: str, name: str, columns: tuple[str, ...], scales: np.ndarray | float) -> Channel:
    return Channel(table, name, columns, lambda found: found.matrix(columns) * scales)


def _attitude_command(fields: Fields) -> tuple[tuple[Channel, ...], tuple[float, ...]]:
    """Return setpoints of roll, pitch, yaw, the autopilot's own estimate of them, and its gains."""
    columns, own = fields.names("columns", NUM_AXES), fields.names("own", NUM_AXES, ())
    scales = _signed_scales(fields, "angle")
    found = [_scaled(fields.name, "attitude_command", columns, scales)]
    if own:
        found.append(_scaled(fields.name, "own_attitude", own, scales))
    gain = fields.numbers("gain", NUM_AXES, (0.0,) * NUM_AXES)
    if min(gain) < 0.0:
        raise fields.error("gain", f"found {list(gain)}, expected 0, to identify it, or more")
    return tuple(found), gain


def _torque_command(fields: Fields) -> tuple[tuple[Channel, ...], tuple[float, ...] | None]:
    """Return torque setpoints about the body's axes (FLU), the rates they are to reach, and the gains."""
    columns, reference = fields.names("columns", NUM_AXES), fields.names("reference_rates", NUM_AXES, ())
    found = [_scaled(fields.name, "torque_command", columns, 1.0)]
    if reference:
        found.append(_scaled(fields.name, "reference_rates", reference, 1.0))
    return tuple(found), _rate_gain(fields)


def _rate_gain(fields: Fields) -> tuple[float, ...] | None:
    """Return the gains of the rate loop, N m per rad/s: stated, or of inertia and lag; None if neither."""
    gain = fields.numbers("rate_gain", NUM_AXES, None, above=0.0)
    inertia = fields.numbers("inertia_kg_m2", NUM_AXES, None, above=0.0)
    lag_s = fields.numbers("lag_s", NUM_AXES, None, above=0.0)
    if (inertia is None) != (lag_s is None) or (gain is not None and inertia is not None):
        raise fields.error("", "expected rate_gain, or inertia_kg_m2 with lag_s, or none of them")
    return gain if inertia is None else tuple(np.array(inertia) / np.array(lag_s))


def _thrust_command(fields: Fields) -> Channel:
    """Return the thrust command, scaled so that ``low`` and ``high`` are -1 and 1."""
    column, low, high = fields.text("column"), fields.number("low"), fields.number("high")
    if low == high:
        raise fields.error("high", f"found {high:g}, expected another value than low")
    convert = lambda table: 2 * (table.matrix([column]) - low) / (high - low) - 1  # noqa: E731
    return Channel(fields.name, "thrust_command", (column,), convert)


def _motors(fields: Fields) -> tuple[tuple[Channel, ...], CommandRules]:
    """Return the motors' outputs, 0 to 1, and what follows from them."""
    listed = fields.left.get("columns")
    num_motors = len(listed) if isinstance(listed, list) else 0
    columns = fields.names("columns", num_motors, ())

    def is_matrix(value: Any) -> bool:
        rows = value if isinstance(value, list) else []
        return len(rows) == NUM_AXES and all(_are_numbers(row, num_motors) for row in rows)

    rows = fields.take("torque_n_m", is_matrix, "a row an axis", None)
    rules = CommandRules(
        motors_as_thrust=fields.flag("as_thrust"),
        motor_torque=None if rows is None else tuple(tuple(map(float, row)) for row in rows),
        rate_gain=_rate_gain(fields),
    )
    if not columns:
        return (), rules
    low, high = fields.number("low"), fields.number("high")
    if low >= high:
        raise fields.error("high", f"found {high:g}, expected more than low")
    convert = lambda table: np.clip((table.matrix(columns) - low) / (high - low), 0.0, 1.0)  # noqa: E731
    return (Channel(fields.name, "motors", columns, convert),), rules


def _attitude(fields: Fields) -> Channel:
    """Return the quaternions; Euler angles turn by yaw, then pitch, then roll, about moving axes."""
    if sum(name in fields for name in ("quaternion", "euler", "matrix")) != 1:
        raise fields.error("", "expected quaternion, with its order, or euler, with its unit, or matrix")
    if "euler" in fields:
        columns, order = fields.names("euler", NUM_AXES), "euler"
        scales = _signed_scales(fields, "angle")
    elif "matrix" in fields:
        columns, scales = fields.names("matrix", NUM_AXES**2), np.ones(NUM_AXES**2)
        order = fields.choice("order", ("by_rows", "by_columns"))
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
        elif order.startswith("by_"):
            matrices = values.reshape(-1, NUM_AXES, NUM_AXES)
            size = np.linalg.det(matrices)
            for row in np.flatnonzero(np.abs(size - 1.0) > LARGEST_NORM_ERROR)[:1]:
                text = f"found a matrix of determinant {size[row]:.4g}, expected 1"
                raise table.error(row, quote_name(columns[0]), text)
            rotation = Rotation.from_matrix(matrices)
            rotation = rotation.inv() if order == "by_columns" else rotation
        else:
            norm = np.linalg.norm(values, axis=1)
            for row in np.flatnonzero(np.abs(norm - 1.0) > LARGEST_NORM_ERROR)[:1]:
                text = f"found a quaternion of norm {norm[row]:.4g}, expected 1"
                raise table.error(row, ", ".join(map(quote_name, columns)), text)
            rotation = Rotation.from_quat(values, scalar_first=order == "wxyz")
        rotation = rotation.inv() if is_inverted else rotation
        return quaternion_from(rotation, is_body_turned, is_world_turned)

    return Channel(fields.name, "q", columns, convert)
