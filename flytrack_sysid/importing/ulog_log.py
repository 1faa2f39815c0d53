"""PX4 logs (``.ulg``), read by pyulog, in our frames and on one time base.

NED and FRD are converted.

The rows are those of the body rates. Other sensors are interpolated between their samples, and
setpoints are held. There are no rows where a topic has a gap of more than three of its usual steps.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.effects import Motors
from flytrack_env.motors import NAMES
from flytrack_sysid.importing.commands import (
    LEFT_OUT,
    check_motors_of_autopilot,
    commands_of_motors,
)
from flytrack_sysid.importing.decoding import decode
from flytrack_sysid.importing.flight import (
    Craft,
    ImportedFlight,
    log_of_channels,
    not_a_quadcopter,
    read_log_file,
    saturation,
)
from flytrack_sysid.importing.mapping import Mapping
from flytrack_sysid.importing.units import PER_DEGREE, UNITS, quaternion_from, vector_from
from flytrack_sysid.log import LogError
from flytrack_sysid.log_table import COMMAND_MARGIN, MAX_NORM_ERROR, Table
from flytrack_sysid.resample import Samples, on_one_base, slow_channels
from flytrack_sysid.timestamps import (
    MAX_LATENCY_S,
    Clock,
    number_segments,
    put_on_one_line,
    read_clock,
)

MAX_BYTES = 2**29  # the decoder may take time and memory in proportion
FIRST_BYTES = b"ULog\x01\x12\x35"
MICROSECOND = UNITS["time"]["us"]
MAX_LOST = 0.01  # share of a flight's rows without setpoints, which begin later than the gyro
# Full stick in acro mode, and the limit of other modes, deg/s. Setpoints stay below the larger of
# both.
RATE_PARAMETERS = (
    ("MC_ACRO_R_MAX", "MC_ROLLRATE_MAX"),
    ("MC_ACRO_P_MAX", "MC_PITCHRATE_MAX"),
    ("MC_ACRO_Y_MAX", "MC_YAWRATE_MAX"),
)


# Values of MAVLink's MAV_TYPE, and PX4's airframes by thousands of SYS_AUTOSTART.
VTOL, HEXACOPTER, OCTOCOPTER = "a VTOL", "a hexacopter", "an octocopter"
OTHER_VEHICLES = {
    1: "a plane",
    7: "an airship",
    8: "a balloon",
    10: "a rover",
    11: "a boat",
    12: "a submarine",
}
AIRFRAMES = {4: "a helicopter", 13: HEXACOPTER, 14: OCTOCOPTER, 15: "a tricopter"}
AIRFRAMES |= dict.fromkeys(range(19, 26), VTOL)
FRAMES = {
    **dict.fromkeys((6, 7, 11), HEXACOPTER),
    **dict.fromkeys((8, 9, 12), OCTOCOPTER),
    13: VTOL,
}

Source = tuple[
    str, tuple[str, ...]
]  # a topic and its fields, in the order of the channel's columns


def _indexed(topic: str, field: str, size: int) -> Source:
    return topic, tuple(f"{field}[{axis}]" for axis in range(size))


BATTERY_FIELDS = ("voltage_v",)
# The first source that a log has is used; later ones are of older firmware.
SOURCES: dict[str, tuple[Source, ...]] = {
    "w": (
        _indexed("vehicle_angular_velocity", "xyz", 3),
        _indexed("sensor_combined", "gyro_rad", 3),
    ),
    "f": (
        _indexed("vehicle_acceleration", "xyz", 3),
        _indexed("sensor_combined", "accelerometer_m_s2", 3),
    ),
    "q": (_indexed("vehicle_attitude", "q", 4),),
    "p": (("vehicle_local_position", ("x", "y", "z")),),
    "v": (("vehicle_local_position", ("vx", "vy", "vz")),),
    "u": (
        ("vehicle_rates_setpoint", ("roll", "pitch", "yaw", "thrust_body[2]")),
        ("vehicle_rates_setpoint", ("roll", "pitch", "yaw", "thrust")),
    ),
    "v_bat": (("battery_status", BATTERY_FIELDS),),
    "landed": (("vehicle_land_detected", ("landed",)),),
    "motors": (_indexed("actuator_motors", "control", 4),),
}
# Rotors of PX4's quadcopter X, in our order, where CA_ROTORn_PX and _PY do not say it.
ROTORS_OF_X = (3, 0, 1, 2)
QUADRANTS = ((-1, 1), (1, 1), (-1, -1), (1, -1))  # ahead, right: of the motors in our order
TIMES = ("timestamp", "timestamp_sample")
EVENTS = ("vehicle_land_detected",)  # topics that are published when something changes


def read_ulog(path: Path, mapping: Mapping) -> ImportedFlight:
    """Return the flight in a PX4 log: commands, rates, attitude, and its other channels.

    docs/real_logs.md lists the topics of the channels.

    Raises:
        LogError: the file is no ULog, or at no time has rates, attitude and rate setpoints.
    """
    if mapping.rules.motors_as_thrust:
        raise LogError(f"{mapping.source}: motors.as_thrust: not read of PX4 logs, expected false")
    of_motors, craft = mapping.rules.motors_as_command, mapping.craft
    samples, clocks, parameters, remarks = _decode(path, of_motors)
    converted = {"q": _attitude(path, samples["q"])}
    if of_motors:
        converted["u"] = _motors_as_commands(path, samples["motors"], parameters, craft.motors)
        remarks.append(saturation(converted["u"].values.max(axis=1) >= 1.0))
    if "u" in samples:
        try:
            craft, sticks = _sticks(path, samples["u"], parameters, craft)
            converted["sticks" if of_motors else "u"] = sticks
        except LogError as error:
            if not of_motors:
                raise
            remarks.append(f"{LEFT_OUT}: {error}")
    base = samples["w"].times
    for name in ("w", "f", "p", "v"):
        if name in samples:
            converted[name] = samples[name]._replace(values=vector_from(samples[name].values, True))
    if "v_bat" in samples:
        converted["v_bat"] = samples["v_bat"]
    if "sticks" in converted:
        _, has_sticks = on_one_base({"sticks": converted["sticks"]}, base)
        without = {name: values for name, values in converted.items() if name != "sticks"}
        _, is_known = on_one_base(without, base)
        if np.sum(is_known & ~has_sticks) > MAX_LOST * is_known.sum():  # the body needs these rows
            converted = without
            count = f"found in {np.sum(is_known & has_sticks)} of {is_known.sum()} rows"
            remarks.append(f"{LEFT_OUT}: topic vehicle_rates_setpoint: {count}, expected all")
    channels, is_known = on_one_base(converted, base)
    if not is_known.any():
        raise LogError(
            f"{path}: found no time at which all of {', '.join(converted)} are known, expected some"
        )
    is_landed = None
    if "landed" in samples:
        times, landed = samples["landed"]
        last_event = np.maximum(np.searchsorted(times, base[is_known], side="right") - 1, 0)
        is_landed = landed[last_event, 0] != 0.0
    used_channels = {name: values[is_known] for name, values in channels.items()}
    times = base[is_known]
    segment = number_segments(times, clocks["w"].max_gap_s)
    table = Table(str(path), {})
    log = log_of_channels(table, times - times[0], segment, used_channels, of_motors)
    num_rows = len(clocks["w"].is_used)
    usage = f"{is_known.sum()} of {num_rows} samples of the rates have all other topics around them"
    notes = tuple(
        f"{path}: {text}"
        for text in [usage, *remarks, *_airframe(parameters), *slow_channels(converted)]
    )
    return ImportedFlight(log, craft, notes, is_landed)


def _airframe(parameters: dict[str, float]) -> list[str]:
    """Return a note if the log's parameters say that the craft is no quadcopter."""
    other = _other_craft(parameters)
    return [not_a_quadcopter(other)] if other else []


def _other_craft(parameters: dict[str, float]) -> str | None:
    """Return what a log's parameters say the craft is, if that is no quadcopter."""
    for kinds, name, divisor in ((AIRFRAMES, "MAV_TYPE", 1), (FRAMES, "SYS_AUTOSTART", 1000)):
        vehicle = kinds.get(int(parameters.get(name, 0)) // divisor)
        if vehicle:
            return f"{vehicle} ({name} {parameters[name]:.0f})"
    num_rotors = int(parameters.get("CA_ROTOR_COUNT", 0))
    return f"{num_rotors} rotors (CA_ROTOR_COUNT)" if num_rotors not in (0, len(NAMES)) else None


def _motors_as_commands(
    path: Path, outputs: Samples, parameters: dict[str, float], motors: Motors | None
) -> Samples:
    """Return the controls of four motors as commands, in our order."""
    topic = f"{path}: topic actuator_motors"
    other = _other_craft(parameters)
    if other:
        raise LogError(f"{topic}: found {other}, expected a quadcopter")
    places = [
        tuple(np.sign(parameters.get(f"CA_ROTOR{number}_P{axis}", 0.0)) for axis in "XY")
        for number in range(len(NAMES))
    ]
    is_placed = sorted(places) == sorted(QUADRANTS)
    if any(map(any, places)) and not is_placed:
        raise LogError(
            f"{topic}: CA_ROTORn_PX, CA_ROTORn_PY: found no rotor in each quadrant, expected an X"
        )
    order = [places.index(quadrant) for quadrant in QUADRANTS] if is_placed else [*ROTORS_OF_X]
    turns_out = parameters.get(f"CA_ROTOR{order[1]}_KM", 0.0) < 0.0  # clockwise at the front right
    check_motors_of_autopilot(topic, np.diff(outputs.times), motors, turns_out)
    controls = np.clip(outputs.values[:, order], 0.0, 1.0)
    return outputs._replace(values=commands_of_motors(str(path), controls))


def _decode(
    path: Path, of_motors: bool
) -> tuple[dict[str, Samples], dict[str, Clock], dict[str, float], list[str]]:
    """Read the topics of a log.

    Args:
        path: of the log.
        of_motors: read the motors' controls; rate setpoints may be missing then.

    Returns:
        samples: by channel, on one time line.
        clocks: by channel.
        parameters: of the log.
        remarks: what is wrong with the log.
    """
    read_log_file(path, MAX_BYTES, FIRST_BYTES, "a PX4 log (ULog)", is_whole=False)
    used = {name: sources for name, sources in SOURCES.items() if of_motors or name != "motors"}
    required = ("w", "q", "motors") if of_motors else ("w", "q", "u")
    fields: dict[str, list[str]] = {}
    for topic, names in (source for sources in used.values() for source in sources):
        fields[topic] = [*fields.get(topic, TIMES), *names]
    notes, arrays = decode(path, "ulog", fields)
    vehicle = OTHER_VEHICLES.get(int(notes["parameters"].get("MAV_TYPE", 0)))
    if vehicle:
        raise LogError(
            f"{path}: found a log of {vehicle} (MAV_TYPE), expected one of a multicopter"
        )
    topics: dict[str, dict[int, dict[str, np.ndarray]]] = {}
    for (topic, instance, field), values in zip(notes["fields"], arrays, strict=True):
        topics.setdefault(topic, {}).setdefault(instance, {})[field] = values
    samples, clocks = {}, {}
    remarks = ["damaged in places; what could be read is used"] if notes["is_damaged"] else []
    if notes["is_cut_off"] and not remarks:  # a damaged log may end within a message, too
        remarks.append("cut off: used up to the last whole message")
    for channel, sources in used.items():
        for topic, names in sources:
            best = _best_instance(path, topic, topics.get(topic, {}), names)
            if best is not None:
                samples[channel], clocks[channel], faults = best
                remarks += [text for text in faults if text not in remarks]  # channels share topics
                break
        if channel not in samples and channel in required:
            wanted = " or ".join(f"{topic} ({', '.join(names)})" for topic, names in sources)
            available = ", ".join(sorted(topics)) or "none of the topics that are read"
            raise LogError(f"{path}: topic {wanted}: missing or empty; found {available}")
    times = put_on_one_line(str(path), clocks, "w")
    samples = {channel: Samples(times[channel], values) for channel, (_, values) in samples.items()}
    return samples, clocks, notes["parameters"], remarks


def _best_instance(
    path: Path, name: str, instances: dict[int, dict[str, np.ndarray]], fields: tuple[str, ...]
) -> tuple[Samples, Clock, list[str]] | None:
    """Return ``_samples_of`` the topic instance with most valid samples; the first if equal."""
    candidates = {
        number: candidate
        for number, topic in instances.items()
        if (candidate := _samples_of(path, name, topic, fields)) is not None
    }
    if not candidates:
        return None
    best = max(candidates, key=lambda number: len(candidates[number][0].times))
    samples, clock, faults = candidates[best]
    others = ", ".join(str(number) for number in candidates if number != best)
    if others:
        faults = [*faults, f"instance {best} of {name} is used, not {others}"]
    return samples, clock, faults


def _samples_of(
    path: Path, name: str, topic: dict[str, np.ndarray], fields: tuple[str, ...]
) -> tuple[Samples, Clock, list[str]] | None:
    """Return the samples of a topic's fields, their clock, and its faults; None without samples.

    The times are those at which a sensor was read, if the topic has them, else those of publishing.
    """
    if any(field not in topic for field in ("timestamp", *fields)):
        return None
    values = np.stack([topic[field] for field in fields], axis=1)
    if fields == BATTERY_FIELDS:  # PX4 reports 0 V of a battery that it does not measure
        topic = {field: column[values[:, 0] > 0.0] for field, column in topic.items()}
        values = values[values[:, 0] > 0.0]
    is_finite = np.isfinite(values).all(axis=1)
    if not is_finite.any():
        return None
    times, faults = topic["timestamp"] * MICROSECOND, list[str]()
    if "timestamp_sample" in topic:
        sampled = topic["timestamp_sample"] * MICROSECOND
        latency_s = float(np.median(times - sampled))
        if np.median(sampled) > 0.0 and abs(latency_s) <= MAX_LATENCY_S:
            times = sampled
        elif np.any(sampled > 0.0):
            problem = f"timestamp_sample of {name} is {latency_s:.6g} s before timestamp"
            faults.append(f"{problem}, more than {MAX_LATENCY_S:g} s: its rows are at timestamp")
    clock = read_clock(str(path), name, np.where(is_finite, times, np.nan), name in EVENTS)
    faults += clock.describe(name)
    return Samples(clock.times, values[clock.is_used]), clock, faults


def _attitude(path: Path, samples: Samples) -> Samples:
    """Return the attitude in our frames, without the samples before the estimator ran."""
    times, quat = samples
    is_unit = abs(np.linalg.norm(quat, axis=1) - 1.0) <= MAX_NORM_ERROR
    if not is_unit.any():
        raise LogError(
            f"{path}: topic vehicle_attitude: q: found no unit quaternion, expected norm 1"
        )
    attitude = Rotation.from_quat(quat[is_unit], scalar_first=True)
    return Samples(
        times[is_unit], quaternion_from(attitude, is_body_turned=True, is_world_turned=True)
    )


def _commands(setpoints: np.ndarray, full_stick: np.ndarray) -> np.ndarray:
    """Return the commands of setpoints, (num_rows, 4).

    Args:
        setpoints: rates in FRD, rad/s, and thrust, 0 to 1 with either sign, (num_rows, 4).
        full_stick: rates at a command of 1, (3,) rad/s.
    """
    rates = vector_from(setpoints[:, :3], True) / full_stick
    return np.column_stack([rates, 2.0 * np.abs(setpoints[:, 3]) - 1.0])


def _sticks(
    path: Path, setpoints: Samples, parameters: dict[str, float], craft: Craft
) -> tuple[Craft, Samples]:
    """Return the craft with its rates at full stick, and the commands of rate setpoints."""
    if craft.max_rate_deg_s is None:
        craft = craft._replace(max_rate_deg_s=_full_stick_deg_s(path, parameters))
    full_stick = np.array(craft.max_rate_deg_s)
    values = _commands(setpoints.values, full_stick * PER_DEGREE)
    _check_full_stick(path, values, full_stick)
    return craft, setpoints._replace(values=values)


def _check_full_stick(path: Path, commands: np.ndarray, full_stick: np.ndarray) -> None:
    """Raise LogError for setpoints past full stick; the message says how to raise full stick."""
    largest = np.abs(commands[:, :3]).max(axis=0)
    if largest.max() > 1.0 + COMMAND_MARGIN:
        reached = ", ".join(f"{value:.4g}" for value in largest * full_stick)
        limits = ", ".join(f"{value:.4g}" for value in full_stick)
        advised = ", ".join(
            f"{value:.0f}" for value in np.ceil(np.maximum(largest, 1.0) * full_stick)
        )
        problem = f"roll, pitch, yaw: found setpoints of up to {reached} deg/s"
        expected = f"expected at most full stick, {limits} deg/s"
        advice = f"in a mapping, craft.max_rate_deg_s = [{advised}] raises it"
        raise LogError(f"{path}: topic vehicle_rates_setpoint: {problem}, {expected}; {advice}")


def _full_stick_deg_s(path: Path, parameters: dict[str, float]) -> tuple[float, float, float]:
    """Return the rates of roll, pitch and yaw at a command of 1, deg/s."""
    rates = []
    for names in RATE_PARAMETERS:
        limits = [parameters[name] for name in names if name in parameters]
        if not limits or max(limits) <= 0.0:
            missing = f"{path}: parameter {' or '.join(names)}: missing, so full stick is unknown"
            missing = "; ".join([missing, *_airframe(parameters)])
            raise LogError(f"{missing}; a mapping can state craft.max_rate_deg_s")
        rates.append(float(max(limits)))
    roll, pitch, yaw = rates
    return roll, pitch, yaw
