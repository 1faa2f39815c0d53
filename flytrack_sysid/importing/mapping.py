"""Mapping files: what the columns of a log are, which rows to use, and what is known of the craft.

Mapping files are TOML. docs/real_logs.md describes every table and field. ``rows``, ``craft`` and
``motors.as_thrust`` apply to logs of every format. A column is a column of a CSV file, a variable
of a Crazyflie's uSD log, or a field of a topic.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from flytrack_env.effects import BY_NAME, Motors
from flytrack_env.messages import quote_name, quote_value
from flytrack_env.motors import NAMES
from flytrack_env.validation import (
    Fields,
    Finite,
    Positive,
    Text,
    check_different,
    choose,
    convert,
    join_text,
)
from flytrack_sysid.importing.commands import CommandRules
from flytrack_sysid.importing.flight import Craft
from flytrack_sysid.importing.units import TURNED, UNITS, quaternion_from, vector_from
from flytrack_sysid.log import LogError
from flytrack_sysid.log_file import load_toml
from flytrack_sysid.log_table import MAX_NORM_ERROR, Table

SHIPPED = Path(__file__).parent.parent / "mappings"
FRAMES = Path(__file__).parent.parent / "frames.toml"
NUM_AXES = 3
LAG_S = (0.03, 0.03)  # of a motor, up and down, where neither mapping nor known craft says it
UNSIGNED = (1.0, 1.0, 1.0)
Count = Annotated[int, Meta(ge=1, le=10**9)]
ThreeNumbers = tuple[Finite, Finite, Finite]
ThreePositive = tuple[Positive, Positive, Positive]
FourNumbers = tuple[Finite, Finite, Finite, Finite]
ThreeNames = tuple[Text, Text, Text]
FourNames = tuple[Text, Text, Text, Text]
NineNames = tuple[Text, Text, Text, Text, Text, Text, Text, Text, Text]


class Channel(NamedTuple):
    """A channel of the log in a table of columns: where it is from and how it is converted.

    Attributes:
        table: table of the mapping, for messages.
        name: one of ``CHANNELS``, ``t``, or a name as in ``read_commands``.
        columns: columns of the file.
        convert: returns the channel's columns from the file's table, (num_rows, n), in SI units and
            our frames.
        is_optional: the channel is left out where the file has none of the columns.
    """

    table: str
    name: str
    columns: tuple[str, ...]
    convert: Callable[[Table], np.ndarray]
    is_optional: bool = False


class Manifest(Fields):
    """A CSV file beside the logs that says how many rows of each to use.

    Attributes:
        file: name of the CSV file.
        key: its column of file names.
        count: its column of numbers of rows.
    """

    file: Text
    key: Text
    count: Text


class UsedRows(Fields):
    """Which rows to use.

    Attributes:
        every: only each n-th row is used; None: all, but of a Betaflight log above 500 Hz as many
            as leave about 500 Hz.
        above_m: only the longest stretch of rows that are this much higher than the first is used.
        from_s: first time that is used, after the first row.
        to_s: last time that is used, after the first row.
        manifest: file that limits the number of rows.
        ranges_s: only rows in one of these ranges are used (s after the first row); all if None.
        logs: numbers, from 1, of the logs to use in a file that holds several; all if None.
        on_ground: whether rows on the ground are used, too.
    """

    every: Count | None = None
    above_m: Positive | None = None
    from_s: Finite = 0.0
    to_s: Positive | None = None
    manifest: Manifest | None = None
    ranges_s: Annotated[tuple[tuple[Finite, Finite], ...], Meta(min_length=1)] | None = None
    logs: Annotated[tuple[Count, ...], Meta(min_length=1)] | None = None
    on_ground: Literal["drop", "keep"] = "drop"

    def __post_init__(self) -> None:
        if any(low >= high for low, high in self.ranges_s or ()):
            raise ValueError(
                f"ranges_s: found {quote_value(self.ranges_s)}, expected the lower one first"
            )
        check_different("logs", self.logs or ())


class CraftFields(Fields):
    """What is known of the craft; ``Craft`` describes the fields."""

    max_rate_deg_s: ThreePositive | None = None
    mass_kg: Positive | None = None
    voltage_v: tuple[Positive, Positive] | None = None

    def __post_init__(self) -> None:
        if self.voltage_v is not None and self.voltage_v[0] >= self.voltage_v[1]:
            raise ValueError(
                f"voltage_v: found {list(self.voltage_v)}, expected the lower one first"
            )


class ScaledFields(Fields, kw_only=True):
    """A table of columns with a unit: the unit's name, or its size in SI units."""

    unit: str | None = None
    scale: Positive | None = None

    def si_per_unit(self, dimension: str) -> float:
        """Return how many SI units the columns' unit is; raises ValueError."""
        if self.scale is not None:
            if self.unit is not None:
                raise ValueError("scale: found together with unit, expected one of them")
            return self.scale
        return UNITS[dimension][choose("unit", self.unit, UNITS[dimension])]


class SignedFields(ScaledFields, kw_only=True):
    """A table of columns of three axes, some of which may point the other way."""

    signs: ThreeNumbers = UNSIGNED

    def signed_scales(self, dimension: str) -> np.ndarray:
        """Return SI units per unit of each axis; raises ValueError."""
        signs = np.array(self.signs)
        if np.any(np.abs(signs) != 1.0):
            raise ValueError(f"signs: found {signs.tolist()}, expected 1 or -1 each")
        return self.si_per_unit(dimension) * signs


class CsvFile(ScaledFields):
    """One of several CSV files of a log, with a clock of its own.

    Attributes:
        file: pattern of its name, in the folder of the log.
        time: column of its times.
        offset_s: time of the log's clock at which those times begin.
    """

    file: Text
    time: Text
    offset_s: Finite = 0.0

    def __post_init__(self) -> None:
        if Path(self.file).name != self.file:
            expected = "the name of a file in the log's folder, * for any text"
            raise ValueError(f"file: found {quote_value(self.file)}, expected {expected}")
        self.si_per_unit("time")


class Time(ScaledFields):
    """Times: a column of stamps, or rows that are ``step_s`` apart."""

    column: Text | None = None
    step_s: Positive | None = None

    def channels(self, table: str) -> list[Channel]:
        """Return the channel of times, s."""
        column, step_s = self.column, self.step_s
        if column is not None and step_s is None:
            return [_scaled(table, "t", (column,), self.si_per_unit("time"))]
        if column is not None or step_s is None or self.unit is not None or self.scale is not None:
            raise ValueError("expected either column, with its unit, or step_s, of one row")

        def by_row(rows: Table) -> np.ndarray:
            num_rows = len(next(iter(rows.columns.values())))
            return np.arange(num_rows)[:, None] * step_s

        return [Channel(table, "t", (), by_row)]


class Battery(ScaledFields):
    """The battery's voltage."""

    column: Text

    def channels(self, table: str) -> list[Channel]:
        """Return the channel of voltages."""
        return [_scaled(table, "v_bat", (self.column,), self.si_per_unit("voltage"))]


class Command(Fields):
    """Commands; ``low`` and ``high`` are the values that mean -1 and 1."""

    columns: FourNames
    low: FourNumbers = (-1.0, -1.0, -1.0, -1.0)
    high: FourNumbers = (1.0, 1.0, 1.0, 1.0)
    clip: bool = False

    def channels(self, table: str) -> list[Channel]:
        """Return the channel of commands."""
        check_different("columns", self.columns)
        low, high = np.array(self.low), np.array(self.high)
        if np.any(low == high):
            raise ValueError(f"high: found {high.tolist()}, expected other values than low")
        lowest, highest = np.minimum(low, high), np.maximum(low, high)

        def scale(rows: Table) -> np.ndarray:
            values = rows.matrix(self.columns)
            is_past = ((values < lowest) | (values > highest)) & (
                not self.clip
            )  # else ``read_commands`` clips
            for row, stick in np.argwhere(is_past)[:1]:
                text = (
                    f"found {values[row, stick]:g}, expected {low[stick]:g} to {high[stick]:g} by "
                )
                text += "command.low and command.high; clip = true limits it"
                raise rows.error(row, quote_name(self.columns[stick]), text)
            return 2.0 * (values - low) / (high - low) - 1.0

        return [Channel(table, "u", self.columns, scale)]


class Vector(SignedFields):
    """A measured vector."""

    columns: ThreeNames
    frame: str
    optional: bool = False

    def channels(self, table: str) -> list[Channel]:
        """Return the channel that the table describes."""
        name, dimension, frames = VECTORS[table]
        check_different("columns", self.columns)
        scales = self.signed_scales(dimension)
        is_turned = TURNED[frames][choose("frame", self.frame, TURNED[frames])]

        def turn(rows: Table) -> np.ndarray:
            return vector_from(rows.matrix(self.columns) * scales, is_turned)

        return [Channel(table, name, self.columns, turn, self.optional)]


# Table of the file: channel of the log, dimension, frame of the axes.
VECTORS = {
    "position": ("p", "length", "world"),
    "velocity": ("v", "speed", "world"),
    "acceleration": ("a", "acceleration", "world"),
    "specific_force": ("f", "acceleration", "body"),
    "rates": ("w", "rate", "body"),
}


class Attitude(SignedFields):
    """Measured attitude; Euler angles rotate by yaw, then pitch, then roll, about moving axes."""

    body: str
    world: str
    quaternion: FourNames | None = None
    euler: ThreeNames | None = None
    matrix: NineNames | None = None
    order: str | None = None
    direction: Literal["body_to_world", "world_to_body"] = "body_to_world"

    def channels(self, table: str) -> list[Channel]:
        """Return the channel of quaternions."""
        given = [
            columns for columns in (self.quaternion, self.euler, self.matrix) if columns is not None
        ]
        is_scaled = (self.unit, self.scale, self.signs) != (None, None, UNSIGNED)
        if len(given) != 1 or (self.euler is None and is_scaled):
            raise ValueError(
                "expected quaternion, with its order, or euler, with its unit, or matrix"
            )
        check_different("euler, matrix or quaternion", given[0])
        rotate = self._rotate()
        is_body_turned = TURNED["body"][choose("body", self.body, TURNED["body"])]
        is_world_turned = TURNED["world"][choose("world", self.world, TURNED["world"])]

        def turn(rows: Table) -> np.ndarray:
            rotation = rotate(rows)
            rotation = rotation.inv() if self.direction == "world_to_body" else rotation
            return quaternion_from(rotation, is_body_turned, is_world_turned)

        return [Channel(table, "q", given[0], turn)]

    def _rotate(self) -> Callable[[Table], Rotation]:
        """Return a function from the file's table to rotations, in the axes of the file."""
        euler, matrix, quaternion = self.euler, self.matrix, self.quaternion
        if euler is not None:
            if self.order is not None:
                raise ValueError("order: found together with euler, expected none")
            scales = self.signed_scales("angle")
            return lambda rows: Rotation.from_euler("ZYX", (rows.matrix(euler) * scales)[:, ::-1])
        if matrix is not None:
            is_transposed = choose("order", self.order, ("by_rows", "by_columns")) == "by_columns"

            def from_matrix(rows: Table) -> Rotation:
                matrices = rows.matrix(matrix).reshape(-1, NUM_AXES, NUM_AXES)
                _check_one(rows, matrix[:1], "matrix of determinant", np.linalg.det(matrices))
                rotation = Rotation.from_matrix(matrices)
                return rotation.inv() if is_transposed else rotation

            return from_matrix
        assert quaternion is not None
        is_scalar_first = choose("order", self.order, ("wxyz", "xyzw")) == "wxyz"

        def from_quaternion(rows: Table) -> Rotation:
            values = rows.matrix(quaternion)
            _check_one(rows, quaternion, "quaternion of norm", np.linalg.norm(values, axis=1))
            return Rotation.from_quat(values, scalar_first=is_scalar_first)

        return from_quaternion


def _check_one(table: Table, columns: tuple[str, ...], what: str, sizes: np.ndarray) -> None:
    for row in np.flatnonzero(np.abs(sizes - 1.0) > MAX_NORM_ERROR)[:1]:
        text = f"found a {what} {sizes[row]:.4g}, expected 1"
        raise table.error(row, ", ".join(map(quote_name, columns)), text)


class ThrustCommand(Fields):
    """The thrust command; ``low`` and ``high`` are the values that mean -1 and 1."""

    column: Text
    low: Finite
    high: Finite

    def channels(self, table: str) -> list[Channel]:
        """Return the channel of the thrust command."""
        low, high = self.low, self.high
        if low == high:
            raise ValueError(f"high: found {high:g}, expected another value than low")

        def scale(rows: Table) -> np.ndarray:
            return 2.0 * (rows.matrix([self.column]) - low) / (high - low) - 1.0

        return [Channel(table, "thrust_command", (self.column,), scale)]


class AttitudeCommand(SignedFields):
    """Setpoints of roll, pitch and yaw, the autopilot's estimate of them, and its gains.

    Attributes:
        columns: setpoints of roll, pitch and yaw.
        own: the autopilot's estimate of these angles.
        gain: gains of the attitude loop; 0 to identify one.
    """

    columns: ThreeNames
    own: ThreeNames | None = None
    gain: ThreeNumbers = (0.0, 0.0, 0.0)

    def channels(self, table: str) -> list[Channel]:
        """Return the channels of setpoints and estimate."""
        if min(self.gain) < 0.0:
            raise ValueError(f"gain: found {list(self.gain)}, expected 0, to identify it, or more")
        scales = self.signed_scales("angle")
        result = [_scaled(table, "attitude_command", self.columns, scales)]
        return result + ([_scaled(table, "own_attitude", self.own, scales)] if self.own else [])


class RateGainFields(Fields, kw_only=True):
    """The gains of the rate loop: stated (N m per rad/s), or inertia over lag."""

    rate_gain: ThreePositive | None = None
    inertia_kg_m2: ThreePositive | None = None
    lag_s: ThreePositive | None = None

    def __post_init__(self) -> None:
        has_inertia, has_lag = self.inertia_kg_m2 is not None, self.lag_s is not None
        if has_inertia != has_lag or (self.rate_gain is not None and has_inertia):
            raise ValueError("expected rate_gain, or inertia_kg_m2 with lag_s, or none of them")

    @property
    def stated_gain(self) -> tuple[float, ...] | None:
        """The gains, N m per rad/s; None if nothing states them."""
        if self.inertia_kg_m2 is None:
            return self.rate_gain
        return tuple(np.array(self.inertia_kg_m2) / np.array(self.lag_s))


class TorqueCommand(RateGainFields):
    """Torque setpoints about the body's axes (FLU), and the reference rates of the controller."""

    columns: ThreeNames
    reference_rates: ThreeNames | None = None

    def channels(self, table: str) -> list[Channel]:
        """Return the channels of setpoints and rates."""
        result = [_scaled(table, "torque_command", self.columns, 1.0)]
        rates = self.reference_rates
        return result + ([_scaled(table, "reference_rates", rates, 1.0)] if rates else [])


class MotorFields(RateGainFields):
    """The motors' outputs, and what follows from them; ``CommandRules`` describes the fields."""

    columns: tuple[Text, ...] = ()
    low: Finite | None = None
    high: Finite | None = None
    as_thrust: bool = False
    as_command: bool = False
    torque_n_m: tuple[tuple[Finite, ...], tuple[Finite, ...], tuple[Finite, ...]] | None = None

    def channels(self, table: str) -> list[Channel]:
        """Return the channel of outputs, 0 to 1, if there are columns."""
        low, high = self.low, self.high
        if self.as_thrust and self.as_command:
            raise ValueError("as_thrust: found together with as_command, expected one of them")
        if self.as_command and self.columns and len(self.columns) != len(NAMES):
            raise ValueError(
                f"columns: found {len(self.columns)} motors, expected the 4 of a quadcopter with "
                f"as_command, in the order {', '.join(NAMES)}"
            )
        if self.torque_n_m is not None and {len(row) for row in self.torque_n_m} != {
            len(self.columns)
        }:
            raise ValueError(
                f"torque_n_m: found {quote_value(self.torque_n_m)}, expected a row an axis"
            )
        if not self.columns:
            return []
        check_different("columns", self.columns)
        if low is None or high is None:
            raise ValueError("expected low and high with columns")
        if low >= high:
            raise ValueError(f"high: found {high:g}, expected more than low")

        def scale(rows: Table) -> np.ndarray:
            return np.clip((rows.matrix(self.columns) - low) / (high - low), 0.0, 1.0)

        return [Channel(table, "motors", self.columns, scale)]


class Frame(Fields):
    """The frame of a craft whose commands are those of motors, and what turns it.

    Attributes:
        craft: name of a known craft, whose numbers the other fields replace.
        mass_kg: of the craft.
        front_m: how far the front motors are ahead and aside of the middle.
        rear_m: how far the rear motors are behind and aside of it.
        inertia_kg_m2: about the body's axes.
        yaw_arm_m: torque of a propeller over its thrust.
        propellers: "in", as Betaflight's default and here, or "out".
        lag_s: of a motor that speeds up, and of one that slows down; ``LAG_S`` if nothing says it.
        rotor_momentum: of a rotor at full command, kg m^2/s; 0 if nothing says it.
    """

    craft: Text | None = None
    mass_kg: Positive | None = None
    front_m: tuple[Positive, Positive] | None = None
    rear_m: tuple[Positive, Positive] | None = None
    inertia_kg_m2: ThreePositive | None = None
    yaw_arm_m: Positive | None = None
    propellers: Literal["in", "out"] | None = None
    lag_s: tuple[Positive, Positive] | None = None
    rotor_momentum: Annotated[float, Meta(ge=0.0)] | None = None

    def known(self) -> "Frame":
        """Return the frame with the numbers of its known craft; raises ValueError."""
        if self.craft is None:
            return self
        crafts = load_toml(FRAMES)
        values = crafts[choose("craft", self.craft, crafts)]
        return msgspec.convert({**values, **self._stated()}, Frame)

    def _stated(self) -> dict[str, Any]:
        """Return the fields that the mapping states."""
        fields = {name: getattr(self, name) for name in Frame.__struct_fields__}
        return {name: value for name, value in fields.items() if value is not None}

    def changes(self, mass_kg: float | None) -> str:
        """Return what mass and inertia the mapping states instead of its known craft's; else "".

        Args:
            mass_kg: of the craft, by any table of the mapping; None if none states it.
        """
        if self.craft is None:
            return ""
        known = Frame(craft=self.craft).known()
        changes = []
        for name, value in (("mass_kg", mass_kg), ("inertia_kg_m2", self.inertia_kg_m2)):
            usual = getattr(known, name)
            if value is not None and not np.allclose(value, usual):
                changes.append(f"{name}: found {quote_value(value)}, {self.craft} has {usual}")
        if len(changes) == 1:
            changes.append(f"the rest is that of {self.craft}")
        return "; ".join(changes)

    def motors(self, mass_kg: float | None) -> Motors:
        """Return the parameters of the effect; raises ValueError.

        Args:
            mass_kg: of the craft.
        """
        for name in ("front_m", "rear_m", "inertia_kg_m2", "yaw_arm_m"):
            if getattr(self, name) is None:
                raise ValueError(f"{name}: missing; a craft of [frame] has it")
        if mass_kg is None:
            raise ValueError("mass_kg: missing in [frame] and [craft]; its inertia is over it")
        assert self.front_m and self.rear_m and self.inertia_kg_m2 and self.yaw_arm_m
        radii = np.sqrt(np.array(self.inertia_kg_m2) / mass_kg).tolist()
        turn = -1.0 if self.propellers == "out" else 1.0
        up_s, down_s = self.lag_s or LAG_S
        motors = Motors(
            *self.front_m,
            *self.rear_m,
            radius_x=radii[0],
            radius_y=radii[1],
            radius_z=radii[2],
            yaw_arm=turn * self.yaw_arm_m,
            rotor_momentum=turn * (self.rotor_momentum or 0.0) / mass_kg,
            up_s=up_s,
            down_s=down_s,
        )
        for name, bounds in BY_NAME["motors"].ranges.items():
            value = getattr(motors, name)
            if not bounds.low <= value <= bounds.high:
                expected = f"{bounds.low:g} to {bounds.high:g} {bounds.unit}"
                raise ValueError(f"{name}: found {value:.4g}, expected {expected}")
        return motors


class MappingFile(Fields):
    """A mapping file; the tables from ``time`` to ``motors`` describe columns."""

    time: Time | None = None
    command: Command | None = None
    position: Vector | None = None
    velocity: Vector | None = None
    acceleration: Vector | None = None
    specific_force: Vector | None = None
    rates: Vector | None = None
    attitude: Attitude | None = None
    battery: Battery | None = None
    thrust_command: ThrustCommand | None = None
    attitude_command: AttitudeCommand | None = None
    torque_command: TorqueCommand | None = None
    motors: MotorFields | None = None
    rows: UsedRows = msgspec.field(default_factory=UsedRows)
    craft: CraftFields = msgspec.field(default_factory=CraftFields)
    frame: Frame | None = None
    files: dict[str, dict[str, Any]] = msgspec.field(default_factory=dict)
    delimiter: Annotated[str, Meta(min_length=1, max_length=1)] = ","

    def rules(self) -> CommandRules:
        """Return how commands follow from setpoints and motors."""
        motors, torque = self.motors or MotorFields(), self.torque_command
        rate_gain = torque.stated_gain if torque else None
        return CommandRules(
            attitude_gain=self.attitude_command.gain if self.attitude_command else (0.0, 0.0, 0.0),
            rate_gain=rate_gain or motors.stated_gain,
            motors_as_thrust=motors.as_thrust,
            motors_as_command=motors.as_command,
            motor_torque=motors.torque_n_m,
        )


TABLES = MappingFile.__struct_fields__[: MappingFile.__struct_fields__.index("motors") + 1]


class Mapping(NamedTuple):
    """A mapping.

    Attributes:
        source: the mapping file, for messages.
        rows: which rows are used.
        craft: what the mapping states of the craft.
        channels: channels of its tables of columns; empty if it has none.
        rules: how commands follow from setpoints and motors.
        delimiter: separator of a CSV file's cells.
        notes: for the user.
        files: the CSV files of a log of several, by the names that columns begin with.
    """

    source: str = "no mapping"
    rows: UsedRows = UsedRows()
    craft: Craft = Craft()
    channels: tuple[Channel, ...] = ()
    rules: CommandRules = CommandRules()
    delimiter: str = ","
    notes: tuple[str, ...] = ()
    files: dict[str, CsvFile] = {}  # noqa: RUF012, not written to


def load_mapping(where: str | Path) -> Mapping:
    """Return the mapping in a TOML file, or the shipped one of that name (without ``.toml``).

    Raises:
        LogError: the mapping cannot be used; the message names file, table and field, what was
            found and what was expected.
    """
    path, shipped = Path(where), sorted(file.stem for file in SHIPPED.glob("*.toml"))
    if not path.exists():
        if str(where) not in shipped:
            names = ", ".join(shipped)
            raise LogError(f"{path}: found no such mapping file; shipped ones are {names}")
        path = SHIPPED / f"{where}.toml"
    content, source = load_toml(path), str(path)
    base = content.pop("extends", None)
    if base is not None:
        try:
            content = _merged(
                load_toml(SHIPPED / f"{choose('extends', base, shipped)}.toml"), content
            )
        except ValueError as error:
            raise LogError(f"{source}: {error}") from error
    file = convert(source, content, MappingFile, LogError)
    if file.command is not None and (file.attitude_command or file.torque_command):
        text = "found together with setpoints of attitude or torque, expected one kind"
        raise LogError(f"{source}: command: {text}")
    channels: list[Channel] = []
    for name in TABLES:
        table = getattr(file, name)
        try:
            channels += table.channels(name) if table is not None else []
        except ValueError as error:
            raise LogError(f"{source}: {join_text(name, str(error))}") from error
    craft = _craft(source, file)
    changes = file.frame.changes(file.craft.mass_kg or file.frame.mass_kg) if file.frame else ""
    return Mapping(
        source=source,
        rows=file.rows,
        craft=craft,
        channels=tuple(channels),
        rules=file.rules(),
        files={
            name: convert(source, table, CsvFile, LogError, f"files.{name}")
            for name, table in file.files.items()
        },
        delimiter=file.delimiter,
        notes=(f"warning: {source}: frame: {changes}",) if changes else (),
    )


def _craft(source: str, file: MappingFile) -> Craft:
    """Return what a mapping states of the craft."""
    craft = Craft(file.craft.max_rate_deg_s, file.craft.mass_kg, file.craft.voltage_v)
    if file.frame is None:
        return craft
    try:
        if file.motors is None or not file.motors.as_command:
            raise ValueError("expected motors.as_command = true with such a table")
        stated_kg = file.frame.mass_kg
        if None not in (stated_kg, craft.mass_kg) and stated_kg != craft.mass_kg:
            raise ValueError(
                f"mass_kg: found {stated_kg:g}, and {craft.mass_kg:g} in [craft], expected one mass"
            )
        frame = file.frame.known()
        mass_kg = craft.mass_kg or frame.mass_kg
        return craft._replace(mass_kg=mass_kg, motors=frame.motors(mass_kg))
    except ValueError as error:
        raise LogError(f"{source}: {join_text('frame', str(error))}") from error


def _merged(base: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """Return the tables of a base mapping, with the fields that another mapping changes."""
    merged = dict(base)
    for name, value in change.items():
        base_value = merged.get(name)
        merged[name] = (
            {**base_value, **value}
            if isinstance(base_value, dict) and isinstance(value, dict)
            else value
        )
    return merged


def _scaled(table: str, name: str, columns: tuple[str, ...], scales: np.ndarray | float) -> Channel:
    check_different("columns", columns)
    return Channel(table, name, columns, lambda rows: rows.matrix(columns) * scales)
