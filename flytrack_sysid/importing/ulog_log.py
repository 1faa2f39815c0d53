"""PX4 logs (``.ulg``), read by pyulog: NED and FRD turned into our frames, topics put on one time base.

Rows are the samples of the body rates; other sensors are interpolated in between their own, setpoints are
held. Where a topic misses more than three of its usual steps, or the craft has landed, there are no rows.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.files import open_file
from flytrack_env.messages import error_text
from flytrack_sysid.importing.craft import Craft
from flytrack_sysid.importing.decoding import decode
from flytrack_sysid.importing.flight import Flight
from flytrack_sysid.importing.mapping import Mapping
from flytrack_sysid.importing.resample import growing, hold, interpolate, interpolate_quaternions
from flytrack_sysid.importing.units import PER_DEGREE, UNITS, quaternion_from, vector_from
from flytrack_sysid.log import CHANNELS, LogError
from flytrack_sysid.log_table import LARGEST_NORM_ERROR, Table, log_of_table

LARGEST_BYTES = 2**29  # the decoder may take time and memory in proportion
FIRST_BYTES = b"ULog\x01\x12\x35"
MICROSECOND = UNITS["time"]["us"]
# Full stick in acro mode, and the limit of other modes, deg/s; a setpoint keeps below the larger of both.
RATE_PARAMETERS = (
    ("MC_ACRO_R_MAX", "MC_ROLLRATE_MAX"),
    ("MC_ACRO_P_MAX", "MC_PITCHRATE_MAX"),
    ("MC_ACRO_Y_MAX", "MC_YAWRATE_MAX"),
)
Series = tuple[np.ndarray, np.ndarray]


class Source(NamedTuple):
    """Where a channel is from: a topic and its fields, in the order of the channel's columns."""

    topic: str
    fields: tuple[str, ...]


def _indexed(name: str, size: int) -> tuple[str, ...]:
    return tuple(f"{name}[{axis}]" for axis in range(size))


# The first that is in the log; later ones are of older firmware.
RATES = (
    Source("vehicle_angular_velocity", _indexed("xyz", 3)),
    Source("sensor_combined", _indexed("gyro_rad", 3)),
)
FORCE = (
    Source("vehicle_acceleration", _indexed("xyz", 3)),
    Source("sensor_combined", _indexed("accelerometer_m_s2", 3)),
)
ATTITUDE = (Source("vehicle_attitude", _indexed("q", 4)),)
POSITION = (Source("vehicle_local_position", ("x", "y", "z")),)
VELOCITY = (Source("vehicle_local_position", ("vx", "vy", "vz")),)
SETPOINT = (
    Source("vehicle_rates_setpoint", ("roll", "pitch", "yaw", "thrust_body[2]")),
    Source("vehicle_rates_setpoint", ("roll", "pitch", "yaw", "thrust")),
)
BATTERY = (Source("battery_status", ("voltage_v",)),)
LANDED = (Source("vehicle_land_detected", ("landed",)),)
TIMES = ("timestamp", "timestamp_sample")
FIELDS: dict[str, list[str]] = {}  # of all of them, by topic
for _source in (*RATES, *FORCE, *ATTITUDE, *POSITION, *VELOCITY, *SETPOINT, *BATTERY, *LANDED):
    FIELDS[_source.topic] = [*FIELDS.get(_source.topic, TIMES), *_source.fields]


class _Topics:
    """The topics of one file, first instances only."""

    def __init__(self, path: Path):
        self.path = path
        try:
            with open_file(path, LARGEST_BYTES) as file:
                found = file.read(len(FIRST_BYTES))
        except OSError as error:
            raise LogError(f"{path}: cannot be read: {error_text(error)}") from error
        if found != FIRST_BYTES:
            raise LogError(f"{path}: found {found!r} first, expected {FIRST_BYTES!r}, as every ULog begins")
        notes, arrays = decode(str(path), "ulog", path, FIELDS)
        self.is_damaged: bool = notes["is_damaged"]
        self.parameters: dict[str, float] = notes["parameters"]
        self.data: dict[str, dict[str, np.ndarray]] = {}
        for (topic, field), values in zip(notes["fields"], arrays, strict=True):
            self.data.setdefault(topic, {})[field] = values

    def find(self, sources: tuple[Source, ...]) -> Series | None:
        """Return the times, us, and values (num_rows, n) of the first source there is, or None."""
        for topic, fields in sources:
            data = self.data.get(topic, {})
            if all(field in data for field in ("timestamp", *fields)) and len(data["timestamp"]):
                # The time a sensor was read, where the topic says it; else when it was published.
                stamp = data.get("timestamp_sample", data["timestamp"])
                times = stamp if np.all(stamp > 0) else data["timestamp"]
                values = np.stack([data[field] for field in fields], axis=1)
                is_used = np.isfinite(values).all(axis=1)
                times, values = times[is_used], values[is_used]
                is_used = growing(times)
                if is_used.any():
                    return times[is_used], values[is_used]
        return None

    def need(self, sources: tuple[Source, ...]) -> Series:
        """Return what ``find`` does.

        Raises:
            LogError: there is none.
        """
        found = self.find(sources)
        if found is None:
            wanted = " or ".join(f"{topic} ({', '.join(fields)})" for topic, fields in sources)
            there = ", ".join(sorted(self.data)) or "none of the topics that are read"
            raise LogError(f"{self.path}: topic {wanted}: missing or empty; found {there}")
        return found


def read_ulog(path: Path, mapping: Mapping) -> Flight:
    """Return the flight in a PX4 log: commands, rates, attitude, and what else of our channels it has.

    Commands are the rate setpoints over the rates at full stick (by the mapping's ``craft.max_rate_deg_s``,
    else by the log's parameters), and the collective thrust setpoint from 0 to 1 as -1 to 1. Quaternions
    of ``vehicle_attitude`` lead from FRD to NED.

    Raises:
        LogError: pyulog is not installed; no ULog, or damaged; no rates, attitude or rate setpoints in it;
            no time at which all are known. The message names file and topic.
    """
    topics = _Topics(path)
    base, rates = topics.need(RATES)
    craft = mapping.craft
    if craft.max_rate_deg_s is None:
        craft = craft._replace(max_rate_deg_s=_full_stick(path, topics.parameters))
    setpoint_times, setpoints = topics.need(SETPOINT)
    commands, is_known = hold(setpoint_times, _commands(setpoints, craft), base)
    attitude_times, quat = topics.need(ATTITUDE)
    is_attitude = abs(np.linalg.norm(quat, axis=1) - 1.0) <= LARGEST_NORM_ERROR  # none before its filter runs
    if not is_attitude.any():
        raise LogError(f"{path}: topic vehicle_attitude: q: found no unit quaternion, expected norm 1")
    attitude_times, quat = attitude_times[is_attitude], quat[is_attitude]
    quat = quaternion_from(Rotation.from_quat(quat, scalar_first=True), True, True)
    quat, is_attitude_known = interpolate_quaternions(attitude_times, quat, base)
    channels = {"u": commands, "w": vector_from(rates, True), "q": quat}
    is_known &= is_attitude_known
    for name, sources in (("f", FORCE), ("p", POSITION), ("v", VELOCITY)):
        found = topics.find(sources)
        if found is not None:
            channels[name], is_there = interpolate(found[0], vector_from(found[1], True), base)
            is_known &= is_there
    battery = topics.find(BATTERY)
    if battery is not None:  # changes slowly: its ends are held, and no gap matters
        channels["v_bat"] = np.interp(base, battery[0], battery[1][:, 0])[:, None]
    landed = topics.find(LANDED)
    is_flying = np.ones(len(base), bool) if landed is None else _is_flying(*landed, base)
    flight = _flight(path, craft, base, channels, is_known, is_flying)
    damage = (f"{path}: damaged in places; what could be read is used",) if topics.is_damaged else ()
    return flight._replace(notes=flight.notes + damage)


def _is_flying(times: np.ndarray, landed: np.ndarray, base: np.ndarray) -> np.ndarray:
    last = np.maximum(np.searchsorted(times, base, side="right") - 1, 0)
    return landed[last, 0] == 0.0


def _flight(
    path: Path,
    craft: Craft,
    base: np.ndarray,
    channels: dict[str, np.ndarray],
    is_known: np.ndarray,
    is_flying: np.ndarray,
) -> Flight:
    """Return the rows in flight at which all channels are known."""
    is_used = is_known & is_flying
    if not is_used.any():
        found = f"{is_known.sum()} of {len(base)} samples of the rates with all other topics around them"
        raise LogError(f"{path}: found {found}, {is_flying.sum()} in flight, expected some that are both")
    columns = {"t": (base[is_used] - base[is_used][0]) * MICROSECOND}
    for name, values in channels.items():
        columns |= dict(zip(CHANNELS[name], values[is_used].T, strict=True))
    log = log_of_table(Table(str(path), columns))
    notes = (
        f"{path}: {is_used.sum()} of {len(base)} samples of the rates used, {is_flying.sum()} in flight",
    )
    return Flight(log, craft, notes)


def _commands(setpoints: np.ndarray, craft: Craft) -> np.ndarray:
    """Return commands (num_rows, 4) of setpoints: rates in FRD, rad/s; thrust, 0 to 1, either sign."""
    full_stick = np.array(craft.max_rate_deg_s) * PER_DEGREE
    rates = vector_from(setpoints[:, :3], True) / full_stick
    return np.column_stack([rates, 2.0 * np.abs(setpoints[:, 3]) - 1.0])


def _full_stick(path: Path, parameters: dict[str, Any]) -> tuple[float, float, float]:
    """Return the rates of roll, pitch and yaw that a command of 1 means, deg/s."""
    rates = []
    for names in RATE_PARAMETERS:
        known = [float(parameters[name]) for name in names if name in parameters]
        if not known or max(known) <= 0.0:
            hint = "a mapping can state craft.max_rate_deg_s"
            raise LogError(
                f"{path}: parameter {' or '.join(names)}: missing, so full stick is unknown; {hint}"
            )
        rates.append(max(known))
    roll, pitch, yaw = rates
    return roll, pitch, yaw
