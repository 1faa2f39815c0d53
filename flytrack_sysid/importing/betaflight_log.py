"""Betaflight blackbox logs (``.bbl``, ``.bfl``), decoded by orangebox.

Betaflight's body frame is ours: x forward, y left, z up. Its accelerometer's sign is ours, too (+1
g at rest), and positive yaw is to the left. docs/real_logs.md says how a real log confirmed this.
Logs have the attitude since Betaflight 2025.12, and no velocity.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env.effects import effect_of
from flytrack_env.messages import quote_name, quote_value
from flytrack_env.motors import NAMES
from flytrack_sysid.importing.betaflight_settings import RATES_TYPES, full_stick_rate, stick_curve
from flytrack_sysid.importing.commands import LEFT_OUT, commands_of_motors
from flytrack_sysid.importing.decoding import decode
from flytrack_sysid.importing.flight import (
    ImportedFlight,
    list_names,
    log_of_channels,
    not_a_quadcopter,
    read_log_file,
    saturation,
)
from flytrack_sysid.importing.mapping import Mapping
from flytrack_sysid.importing.units import PER_DEGREE, UNITS
from flytrack_sysid.kinematics import GRAVITY
from flytrack_sysid.log import LogError
from flytrack_sysid.log_table import COMMAND_MARGIN, Table
from flytrack_sysid.timestamps import number_segments, put_on_one_line, read_clock

FIRMWARE = "Betaflight"
MAX_BYTES = 2**29  # size of a flash chip
FIRST_BYTES = b"H Product:Blackbox"
END_OF_LOG = b"E\xffEnd of log\0"  # last event that a logger writes
STICKS = tuple(f"setpoint[{axis}]" for axis in range(4))
GYRO = tuple(f"gyroADC[{axis}]" for axis in range(3))
ACCELEROMETER = tuple(f"accSmooth[{axis}]" for axis in range(3))
ATTITUDE = tuple(f"imuQuaternion[{axis}]" for axis in range(3))
# Scale of x, y, z of a quaternion whose w is at least 0 (Betaflight's blackbox.c).
UNIT_QUATERNION = 32767.0
BATTERY = "vbatLatest"
FULL_THROTTLE = 1000.0  # setpoint[3] at full throttle; 0 at none
FINE = 10.0  # units in one deg/s where blackbox_high_resolution is set
MICROSECOND = UNITS["time"]["us"]
MAX_SETTING = 1e9
PERCENT = 100.0
# Past full stick: smoothing by a Butterworth filter overshoots a step by 4.3 %.
MAX_OVERSHOOT = 0.05
FEATURE_3D = 1 << 12  # of the header's features (Betaflight's config/feature.h)
DSHOT, PWM = (48.0, 2047.0), (1000.0, 2000.0)  # outputs of a motor that is off, and full
# Settings that change how thrust follows from throttle and voltage: name, neutral values, effect.
THRUST_SETTINGS = (
    ("vbat_sag_compensation", (0,), "motors get more at a low voltage"),
    ("thrust_linear", (0,), "motors get less at low throttle"),
    ("motor_output_limit", (0, 100), "motors get that percentage of full output at most"),
)


def read_betaflight(path: Path, mapping: Mapping) -> list[ImportedFlight]:
    """Return the flights in a blackbox file, one for each log in it.

    Their channels are commands, rates, specific force and voltage; docs/real_logs.md describes
    them. A log that cannot be used is left out, and a note says why.

    Raises:
        LogError: the file is no blackbox file of Betaflight 4, or has no log that can be used.
    """
    content = read_log_file(path, MAX_BYTES, FIRST_BYTES, "a Betaflight blackbox log")
    is_cut_off = [END_OF_LOG not in log for log in content.split(FIRST_BYTES)[1:]]
    numbers = _chosen_logs(path, len(is_cut_off), mapping)
    cut_off = [number for number in numbers if is_cut_off[number - 1]]
    decoded, frames = decode(path, "betaflight", numbers, cut_off)
    flights, left_out = [], list[LogError]()
    for number, log_notes, rows in zip(numbers, decoded, frames, strict=True):
        source = str(path) if len(is_cut_off) == 1 else f"{path}, log {number}"
        try:
            flights.append(_read_log(source, log_notes, rows, mapping))
        except LogError as error:
            left_out.append(error)
    if not flights:
        raise left_out[0]
    notes = tuple(f"left out: {error}" for error in left_out)
    return [flights[0]._replace(notes=notes + flights[0].notes), *flights[1:]]


def _read_log(
    source: str, notes: dict[str, Any], frames: np.ndarray, mapping: Mapping
) -> ImportedFlight:
    """Return the flight in one log.

    Args:
        source: the log, for messages.
        notes: of the log, as ``decoders.decode_betaflight`` returns them.
        frames: (num_frames, num_fields).
        mapping: selects rows and states the craft.
    """
    headers, names = _Headers(source, notes["headers"]), notes["names"]
    cut_off = "cut off: found no end-of-log event"
    if not len(frames):
        problem = f"{cut_off}, and no whole frame" if notes["num_bytes_left"] else "found no frames"
        raise LogError(f"{source}: {problem}, expected at least one")
    revision = str(headers.values.get("Firmware revision", "none"))
    if not revision.startswith(FIRMWARE):
        raise headers.error(
            "Firmware revision", f"found {quote_value(revision)}, expected {FIRMWARE} 4"
        )
    for name in ("time", *STICKS, *GYRO):
        if name not in names:
            raise LogError(f"{source}: field {name}: missing; found {list_names(names)}")
    remarks = [f"{quote_name(revision)}, {len(frames)} frames"]
    if notes["num_bytes_left"]:
        remainder = f"the last {notes['num_bytes_left']} bytes"
        remarks.append(f"{cut_off}; {len(frames)} whole frames used, {remainder} are none")
    if notes["num_undecoded"]:
        remarks.append(f"{notes['num_undecoded']} frames before the first full one left out")
    columns = dict(zip(names, frames.T, strict=True))
    clock = read_clock(source, "the frames", columns["time"] * MICROSECOND)
    remarks += clock.describe("the frames")
    times = put_on_one_line(source, {"frames": clock}, "frames")["frames"]
    table = Table(source, columns).select(clock.is_used)
    craft, of_motors = mapping.craft, mapping.rules.motors_as_command
    if craft.max_rate_deg_s is None:
        craft = craft._replace(max_rate_deg_s=headers.full_stick_deg_s())
    full = np.array([*(craft.max_rate_deg_s or ()), FULL_THROTTLE])
    channels = _channels(table, headers)
    sticks, clipped = _commands(table, headers, full)
    if of_motors:
        channels["u"] = _motors_as_commands(source, table, headers)
        largest = float(np.abs(sticks).max())
        if largest <= 1.0 + COMMAND_MARGIN:
            channels["sticks"] = sticks
        else:
            clipped = [f"{LEFT_OUT}: found setpoints of {largest:.3g} times full stick"]
    else:
        channels["u"] = sticks
    if mapping.rules.motors_as_thrust:
        channels["u"][:, 3] = _thrust_of_motors(table, headers)
        clipped.append("thrust command: the mean of the motors")
    remarks += [*clipped, *_motors(table, headers)]
    if "f" not in channels:
        remarks.append("no accelerometer in the log: nothing is asked of the specific force")
    remarks += [*([] if of_motors else headers.stick_curve()), *headers.thrust_settings()]
    segment = number_segments(times, clock.max_gap_s)
    log = log_of_channels(table, times - times[0], segment, channels, of_motors)
    return ImportedFlight(log, craft, tuple(f"{source}: {text}" for text in remarks))


class _Headers:
    """The header of one log: its settings by name."""

    def __init__(self, source: str, values: dict[str, Any]):
        self.source, self.values = source, values

    def error(self, name: str, text: str) -> LogError:
        """Return the error about one setting."""
        return LogError(f"{self.source}: header {name}: {text}")

    def numbers(self, name: str, size: int, default: list[float] | None = None) -> list[float]:
        """Return the numbers of a setting, each 0 or more; the default of an absent setting."""
        value: Any = self.values.get(name, default)
        values = value if isinstance(value, list) else [value]
        is_valid = all(
            isinstance(number, (int, float)) and 0 <= number < MAX_SETTING for number in values
        )
        if len(values) != size or not is_valid:
            raise self.error(
                name, f"found {quote_value(value)}, expected {size} numbers of at least 0"
            )
        return [float(number) for number in values]

    def rate_unit_deg_s(self) -> float:
        """Return the rate that one unit of setpoints and gyroscope means, deg/s."""
        return 1.0 / FINE if self.numbers("blackbox_high_resolution", 1, [0])[0] > 0 else 1.0

    def full_stick_deg_s(self) -> tuple[float, float, float]:
        """Return the rates at full stick of roll, pitch, yaw, deg/s."""
        if "rc_rates" not in self.values:
            hint = "a mapping can state craft.max_rate_deg_s"
            raise self.error("rc_rates", f"missing, so full stick is unknown; {hint}")
        settings = [self.numbers(name, 3) for name in ("rc_rates", "rates", "rate_limits")]
        axes, rates_type = zip(*settings, strict=True), self.rates_type()
        roll, pitch, yaw = rates = tuple(full_stick_rate(rates_type, *axis) for axis in axes)
        if min(rates) <= 0.0:
            raise self.error("rc_rates, rates, rate_limits", f"found full stick at {rates} deg/s")
        return roll, pitch, yaw

    def rates_type(self) -> str:
        """Return the type of the sticks' rates."""
        number = int(self.numbers("rates_type", 1)[0])
        if number >= len(RATES_TYPES):
            raise self.error("rates_type", f"found {number}, expected below {len(RATES_TYPES)}")
        return RATES_TYPES[number]

    def stick_curve(self) -> list[str]:
        """Return a note on the curve from a pilot's sticks to the setpoints (our commands)."""
        if not {"rc_rates", "rc_expo"} <= self.values.keys():
            return []
        settings = [self.numbers(name, 3) for name in ("rc_rates", "rates", "rc_expo")]
        curve = stick_curve(self.rates_type(), list(zip(*settings, strict=True)))
        if curve is None:
            return []
        numbers = json.dumps(
            {name: round(value, 4) for name, value in curve._asdict().items() if value}
        )
        name = effect_of(curve).name
        return [
            "commands are rate setpoints; a model that is flown with sticks needs the pilot's "
            f"rates, the effect {name}: {numbers}"
        ]

    def thrust_settings(self) -> list[str]:
        """Return notes on settings that change the thrust at a throttle."""
        notes = []
        for name, neutral, effect in THRUST_SETTINGS:
            value = self.numbers(name, 1, [0.0])[0]
            if value not in neutral:
                notes.append(f"{name} {value:g}: {effect}; the thrust curve has it in it")
        kind, percent = (
            self.numbers(f"throttle_limit_{part}", 1, [default])[0]
            for part, default in (("type", 0.0), ("percent", PERCENT))
        )
        if kind and percent != PERCENT:
            limited = {1.0: "scaled to", 2.0: "clipped at"}.get(kind, "limited to")
            notes.append(
                f"throttle_limit: the throttle is {limited} {percent:g} %, and a command of 1 is "
                "more"
            )
        return notes


def _commands(table: Table, headers: _Headers, full: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return commands, (num_rows, 4), and a note if some are clipped.

    Setpoints that exceed full stick by more than the overshoot of smoothing are not clipped, so
    that ``log_of_table`` refuses them.

    Args:
        full: the setpoints at full stick, (4,).
    """
    per_unit = headers.rate_unit_deg_s()
    units = np.array([per_unit, per_unit, per_unit, 1.0])
    commands = table.matrix(STICKS) * units / full
    commands[:, 3] = 2.0 * commands[:, 3] - 1.0
    size = np.abs(commands)
    # Setpoints are whole numbers: half of one past full stick is rounding.
    is_past = size > 1.0 + units / 2 / full
    is_overshoot = size <= np.maximum(1.0 + MAX_OVERSHOOT, 1.0 + units / 2 / full)
    clipped = np.where(is_overshoot, np.clip(commands, -1.0, 1.0), commands)
    num_past = np.count_nonzero(is_past.any(axis=1))
    if not num_past:
        return clipped, []
    largest = f"at most {PERCENT * (size[is_past].max() - 1.0):.2g} % past it"
    return clipped, [
        f"{num_past} rows clipped to full stick: smoothed setpoints overshoot, {largest}"
    ]


def _channels(table: Table, headers: _Headers) -> dict[str, np.ndarray]:
    """Return the sensors' channels of the log."""
    channels = {"w": table.matrix(GYRO) * headers.rate_unit_deg_s() * PER_DEGREE}
    if all(name in table.columns and np.any(table.columns[name]) for name in ACCELEROMETER):
        g_unit = headers.numbers("acc_1G", 1)[0]
        if g_unit == 0.0:
            raise headers.error("acc_1G", "found 0, expected what the accelerometer shows at 1 g")
        channels["f"] = table.matrix(ACCELEROMETER) * GRAVITY / g_unit
    if BATTERY in table.columns:
        channels["v_bat"] = table.matrix([BATTERY]) * UNITS["voltage"]["cV"]
    if not table.columns.keys() >= set(ATTITUDE):
        return channels
    vector = table.matrix(ATTITUDE) / UNIT_QUATERNION
    if not np.any(vector):
        return channels
    size = np.linalg.norm(vector, axis=1, keepdims=True)
    channels["q"] = np.column_stack(
        [np.sqrt(np.maximum(1.0 - size**2, 0.0)), vector / np.maximum(size, 1.0)]
    )
    return channels


def _motor_names(table: Table) -> list[str]:
    return [name for name in table.columns if name.startswith("motor[")]


def _motors(table: Table, headers: _Headers) -> list[str]:
    """Return notes on the number of motors, and on how often one is at its upper end."""
    names = _motor_names(table)
    if not names:
        return []
    notes = [not_a_quadcopter(f"{len(names)} motors")] if len(names) != len(NAMES) else []
    if "motorOutput" in headers.values:
        highest = headers.numbers("motorOutput", 2)[1]
        notes.append(saturation(np.max(table.matrix(names), axis=1) >= highest))
    return notes


def _motors_as_commands(source: str, table: Table, headers: _Headers) -> np.ndarray:
    """Return the outputs of the motors as commands, (num_rows, 4); -1 is off, not idle."""
    if int(headers.numbers("features", 1, [0.0])[0]) & FEATURE_3D:
        raise headers.error(
            "features",
            "found motors in 3D mode, which turn both ways, expected motors of one direction with "
            "motors.as_command",
        )
    names = _motor_names(table)
    # The low end tells protocols apart: motor_output_limit lowers the upper one.
    lowest, _ = headers.numbers("motorOutput", 2)
    low, high = DSHOT if lowest < PWM[0] else PWM
    shares = np.clip((table.matrix(names) - low) / (high - low), 0.0, 1.0) if names else None
    return commands_of_motors(source, shares)


def _thrust_of_motors(table: Table, headers: _Headers) -> np.ndarray:
    """Return thrust commands, (num_rows,): -1 and 1 are the ends of the motors' mean output."""
    low, high = headers.numbers("motorOutput", 2)
    names = _motor_names(table)
    if not names or high <= low:
        raise headers.error(
            "motorOutput", f"found {low:g}, {high:g} and {len(names)} motors: no outputs to use"
        )
    return np.clip(2.0 * (table.matrix(names).mean(axis=1) - low) / (high - low) - 1.0, -1.0, 1.0)


def _chosen_logs(path: Path, num_logs: int, mapping: Mapping) -> list[int]:
    """Return the numbers of a file's logs that the mapping selects, from 1."""
    numbers = list(mapping.rows.logs or ()) or list(range(1, num_logs + 1))
    for number in numbers:
        if number > num_logs:
            raise LogError(
                f"{mapping.source}: rows.logs: found {number}, expected 1 to {num_logs} of {path}"
            )
    return sorted(numbers)
