"""ArduPilot's DataFlash logs (``.bin``), decoded by pymavlink: NED and FRD converted to our frames.

Source of messages, fields and units: ardupilot.org/copter/docs/logmessages.html. Messages of
several sensors are numbered by an instance.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.effects import Motors
from flytrack_env.messages import quote_name
from flytrack_sysid.importing.commands import LEFT_OUT, check_motors_of_autopilot
from flytrack_sysid.importing.decoding import decode
from flytrack_sysid.importing.flight import (
    ImportedFlight,
    list_names,
    not_a_quadcopter,
    read_log_file,
)
from flytrack_sysid.importing.mapping import Channel, Mapping
from flytrack_sysid.importing.table_flight import TIMESTAMP, build_flight
from flytrack_sysid.importing.units import PER_DEGREE, UNITS, quaternion_from, vector_from
from flytrack_sysid.log import LogError
from flytrack_sysid.log_table import Table

MAX_BYTES = 2**29  # the decoder may take time and memory in proportion
FIRST_BYTES = b"\xa3\x95"
VEHICLE = "ArduCopter"
OTHER_VEHICLES = ("ArduPlane", "ArduRover", "ArduSub", "AntennaTracker", "Blimp", "Rover")
TIME = "TimeUS"
GYROSCOPE, ACCELEROMETER = ("GyrX", "GyrY", "GyrZ"), ("AccX", "AccY", "AccZ")
RATES, SETPOINTS, THROTTLE = ("R", "P", "Y"), ("RDes", "PDes", "YDes"), "AOut"
QUATERNION, EULER_DEG = ("Q1", "Q2", "Q3", "Q4"), ("Roll", "Pitch", "Yaw")
VELOCITY, POSITION = ("VN", "VE", "VD"), ("PN", "PE", "PD")
HEALTH = ("GH", "AH")  # 1: the gyroscope or accelerometer of this instance is healthy
NUM_OUTPUTS = 14  # C1 to C14 of RCOU
FIELDS: dict[str, tuple[str, ...]] = {
    "RATE": (*RATES, *SETPOINTS, THROTTLE),
    "IMU": (*GYROSCOPE, *ACCELEROMETER, *HEALTH),
    "XKQ": QUATERNION,
    "ATT": EULER_DEG,
    "XKF1": (*VELOCITY, *POSITION),
    "BAT": ("Volt",),
    "RCOU": tuple(f"C{number}" for number in range(1, NUM_OUTPUTS + 1)),
}
# Full stick of roll, pitch, yaw, deg/s, is the larger of two: the rate of acro mode (before 4.1: a
# gain, with the degrees of the firmware's full stick), and the limit of other modes, 0 for none.
ACRO_RATES = (
    ("ACRO_RP_RATE", "ACRO_RP_P"),
    ("ACRO_RP_RATE", "ACRO_RP_P"),
    ("ACRO_Y_RATE", "ACRO_YAW_P"),
)
RATE_LIMITS = ("ATC_RATE_R_MAX", "ATC_RATE_P_MAX", "ATC_RATE_Y_MAX")
FULL_STICK_DEG = 45.0
# Values of FRAME_CLASS that mean no quadcopter; of SERVOn_FUNCTION for motors 1 to 8, and 9 to 12.
FRAMES = {
    2: "a hexacopter",
    3: "an octocopter",
    4: "an octaquad",
    5: "a Y6",
    6: "a helicopter",
    7: "a tricopter",
}
MOTOR_FUNCTIONS = (*range(33, 41), *range(82, 86))
NUM_MOTORS = 4
# Defaults of the firmware: MOT_PWM_MIN and MOT_PWM_MAX in us, MOT_SPIN_MIN and MOT_SPIN_MAX as
# fractions between them.
MOTOR_DEFAULTS = {
    "MOT_PWM_MIN": 1000.0,
    "MOT_PWM_MAX": 2000.0,
    "MOT_SPIN_MIN": 0.15,
    "MOT_SPIN_MAX": 0.95,
}
# Values of FRAME_TYPE: numbers of the motors in our order; those whose propellers turn the other
# way than Betaflight's default (AP_MotorsMatrix.cpp).
ORDERS = {
    1: (4, 1, 2, 3),  # X
    3: (4, 1, 2, 3),  # H
    12: (1, 2, 3, 4),  # Betaflight X
    13: (4, 1, 3, 2),  # DJI X
    14: (2, 1, 3, 4),  # clockwise X
    18: (1, 2, 3, 4),  # Betaflight X, reversed
}
TURN_OUT, DEFAULT_FRAME_TYPE = (3, 18), 1
MIN_HEALTHY_FRACTION = 0.5  # of an instance's rows: the sensor is healthy for most of the flight


def read_dataflash(path: Path, mapping: Mapping) -> ImportedFlight:
    """Return the flight in a DataFlash log: commands, rates, attitude, and its other channels.

    docs/real_logs.md lists the messages of the channels.

    Raises:
        LogError: the file is no such log, is not of a copter, or lacks rates and their setpoints.
    """
    read_log_file(path, MAX_BYTES, FIRST_BYTES, "an ArduPilot log (DataFlash)", is_whole=False)
    notes, arrays = decode(
        path, "dataflash", {name: [TIME, *names] for name, names in FIELDS.items()}
    )
    _check_vehicle(path, notes["texts"], notes["parameters"])
    messages: dict[str, dict[int, dict[str, np.ndarray]]] = {}  # fields by name and instance
    for found, rows in zip(notes["found"], arrays, strict=True):
        fields = dict(zip(found["fields"], rows.T, strict=True))
        messages.setdefault(found["name"], {})[found["instance"]] = fields
    parameters: dict[str, float] = notes["parameters"]
    remarks = _airframe(parameters)
    if notes["is_cut_off"]:
        remarks.append("cut off: used up to the last whole message")
    chosen = {name: _choose(name, instances, remarks) for name, instances in messages.items()}
    if any(field not in chosen.get("RATE", ()) for field in (TIME, *FIELDS["RATE"])):
        listed = list_names(sorted(chosen)) or "none of the messages that are read"
        raise LogError(
            f"{path}: message RATE: missing or without {', '.join(FIELDS['RATE'])}; found {listed}"
        )
    craft, of_motors = mapping.craft, mapping.rules.motors_as_command
    if craft.max_rate_deg_s is None:
        try:
            full_deg_s = _full_stick_deg_s(path, parameters, chosen["RATE"], remarks)
            craft = craft._replace(max_rate_deg_s=full_deg_s)
        except LogError as error:
            if not of_motors:  # which need no full stick
                raise
            remarks.append(f"{LEFT_OUT}: {error}")
    channels = _channels(chosen, parameters, craft.max_rate_deg_s, remarks)
    if of_motors:
        unused = ("motors",) if craft.max_rate_deg_s else ("u", "motors")
        channels = [channel for channel in channels if channel.name not in unused]
        channels.append(_motors_as_commands(path, chosen, parameters, craft.motors))
    topics = [
        Table(
            str(path),
            {
                TIMESTAMP: fields[TIME] * UNITS["time"]["us"],
                **{f"{name}.{field}": values for field, values in fields.items()},
            },
        )
        for name, fields in chosen.items()
        if TIME in fields
    ]
    flight = build_flight(
        str(path), topics, mapping._replace(channels=tuple(channels), craft=craft)
    )
    return flight._replace(notes=(*(f"{path}: {text}" for text in remarks), *flight.notes))


def _check_vehicle(path: Path, texts: list[str], parameters: dict[str, float]) -> None:
    """Raise LogError for the log of another vehicle; its text messages name the firmware."""
    for text in texts:
        for vehicle in OTHER_VEHICLES:
            if text.startswith(vehicle):
                raise LogError(
                    f"{path}: found a log of {quote_name(text)}, expected one of {VEHICLE}"
                )
    if parameters.get("Q_ENABLE", 0.0) > 0.0:
        raise LogError(f"{path}: found a log of a quadplane (Q_ENABLE), expected one of {VEHICLE}")


def _airframe(parameters: dict[str, float]) -> list[str]:
    """Return a note if the log's parameters say that the craft is no quadcopter."""
    frame = FRAMES.get(int(parameters.get("FRAME_CLASS", 0)))
    num_motors = sum(
        _function(parameters, number) in MOTOR_FUNCTIONS for number in range(1, NUM_OUTPUTS + 1)
    )
    if frame:
        return [not_a_quadcopter(f"{frame} (FRAME_CLASS {parameters['FRAME_CLASS']:.0f})")]
    return [not_a_quadcopter(f"{num_motors} motors")] if num_motors not in (0, NUM_MOTORS) else []


def _function(parameters: dict[str, float], output: int) -> int:
    """Return the number of the function that an output has; 0 for none."""
    return int(parameters.get(f"SERVO{output}_FUNCTION", 0))


def _choose(
    name: str, instances: dict[int, dict[str, np.ndarray]], remarks: list[str]
) -> dict[str, np.ndarray]:
    """Return the fields of the first healthy instance of a message; append remarks on others."""
    numbers = sorted(instances)
    if name == "BAT":
        instances = {
            number: _without_zeros(number, instances[number], remarks) for number in numbers
        }
    healthy = [number for number in numbers if _is_healthy(name, instances[number])]
    best = (healthy or numbers)[0]
    if len(numbers) > 1:
        others = [
            f"{number}{'' if number in healthy else ' (not healthy)'}"
            for number in numbers
            if number != best
        ]
        remarks.append(f"instance {best} of {name} is used, not {', '.join(others)}")
    if not healthy:
        remarks.append(f"no instance of {name} says that it is healthy")
    return instances[best]


def _without_zeros(
    number: int, fields: dict[str, np.ndarray], remarks: list[str]
) -> dict[str, np.ndarray]:
    """Return a battery's rows with NaN for voltages of 0 or less, which are not measured."""
    volts = fields.get("Volt", np.zeros(0))
    is_measured = volts > 0.0
    if not is_measured.all():
        count = f"{np.sum(~is_measured)} of {len(volts)} voltages of battery {number}"
        remarks.append(f"{count} are not above 0: not measured")
    return {**fields, "Volt": np.where(is_measured, volts, np.nan)}


def _is_healthy(name: str, fields: dict[str, np.ndarray]) -> bool:
    if name == "BAT":
        return bool(np.any(np.isfinite(fields["Volt"])))
    return all(
        np.mean(fields[health]) > MIN_HEALTHY_FRACTION for health in HEALTH if health in fields
    )


def _full_stick_deg_s(
    path: Path, parameters: dict[str, float], rate: dict[str, np.ndarray], remarks: list[str]
) -> tuple[float, float, float]:
    """Return the rates of roll, pitch and yaw at a command of 1, deg/s, at least any setpoint."""
    full_stick = []
    for (acro, gain), limit, setpoint in zip(ACRO_RATES, RATE_LIMITS, SETPOINTS, strict=True):
        acro_rate = parameters.get(acro, FULL_STICK_DEG * parameters.get(gain, 0.0))
        stated_limit = max(acro_rate, parameters.get(limit, 0.0))
        if stated_limit <= 0.0:
            missing = (
                f"{path}: parameters {acro}, {gain} and {limit}: missing, so full stick is unknown"
            )
            raise LogError(f"{missing}; a mapping can state craft.max_rate_deg_s")
        largest = float(
            np.max(np.abs(rate[setpoint]), initial=0.0, where=np.isfinite(rate[setpoint]))
        )
        if largest > stated_limit:
            remarks.append(
                f"{setpoint} reaches {largest:.4g} deg/s: full stick is that, not "
                f"{stated_limit:.4g} deg/s"
            )
        full_stick.append(max(stated_limit, largest))
    roll, pitch, yaw = full_stick
    return roll, pitch, yaw


def _channels(
    messages: dict[str, dict[str, np.ndarray]],
    parameters: dict[str, float],
    full_deg_s: tuple[float, ...] | None,
    remarks: list[str],
) -> list[Channel]:
    """Return the channels of the messages that a log has; commands need a known full stick."""

    def columns_of(message: str, fields: tuple[str, ...]) -> tuple[str, ...]:
        """Return the columns of a message; none if the log lacks one of them."""
        fields_logged = messages.get(message, {})
        return (
            tuple(f"{message}.{field}" for field in fields)
            if {TIME, *fields} <= fields_logged.keys()
            else ()
        )

    def vector(
        name: str, message: str, fields: tuple[str, ...], scale: float = 1.0
    ) -> list[Channel]:
        columns = columns_of(message, fields)
        convert = lambda table: vector_from(table.matrix(columns) * scale, True)  # noqa: E731
        return [Channel(message, name, columns, convert)] if columns else []

    def commands(table: Table) -> np.ndarray:
        full_stick = np.array(full_deg_s)
        rates = vector_from(table.matrix(columns_of("RATE", SETPOINTS)), True) / full_stick
        return np.column_stack([rates, 2.0 * table.matrix(columns_of("RATE", (THROTTLE,))) - 1.0])

    gyroscope = vector("w", "IMU", GYROSCOPE)
    is_fast = len(messages["RATE"][TIME]) >= len(messages.get("IMU", {}).get(TIME, ()))
    rates = vector("w", "RATE", RATES, PER_DEGREE) if is_fast or not gyroscope else gyroscope
    reason = "which has the most samples" if gyroscope else "the only message with rates"
    remarks.append(f"rates of {rates[0].table}, {reason}")
    channels = [Channel("RATE", "u", columns_of("RATE", (*SETPOINTS, THROTTLE)), commands), *rates]
    channels += vector("f", "IMU", ACCELEROMETER)
    channels += vector("v", "XKF1", VELOCITY) + vector("p", "XKF1", POSITION)
    channels += _attitude(columns_of("XKQ", QUATERNION), columns_of("ATT", EULER_DEG))
    volts = columns_of("BAT", ("Volt",))
    if volts and np.any(np.isfinite(messages["BAT"]["Volt"])):
        channels.append(Channel("BAT", "v_bat", volts, lambda table: table.matrix(volts)))
    outputs = [
        number
        for number in range(1, NUM_OUTPUTS + 1)
        if _function(parameters, number) in MOTOR_FUNCTIONS
    ]
    motors = columns_of(
        "RCOU", tuple(f"C{number}" for number in outputs or range(1, NUM_MOTORS + 1))
    )
    return [*channels, *_motors(motors, parameters)]


def _attitude(quaternion: tuple[str, ...], euler: tuple[str, ...]) -> list[Channel]:
    """Return the channel of the attitude, from the estimator's quaternion or Euler angles, deg."""

    def convert(table: Table) -> np.ndarray:
        if quaternion:
            attitude = Rotation.from_quat(table.matrix(quaternion), scalar_first=True)
        else:
            attitude = Rotation.from_euler("ZYX", table.matrix(euler)[:, ::-1], degrees=True)
        return quaternion_from(attitude, is_body_turned=True, is_world_turned=True)

    columns = quaternion or euler
    return [Channel("XKQ" if quaternion else "ATT", "q", columns, convert)] if columns else []


def _motors_as_commands(
    path: Path,
    messages: dict[str, dict[str, np.ndarray]],
    parameters: dict[str, float],
    motors: Motors | None,
) -> Channel:
    """Return the channel of four motors' outputs in our order, 0 (off) to 1 (full)."""
    source = f"{path}: message RCOU"
    frame_class = int(parameters.get("FRAME_CLASS", 0))
    if frame_class in FRAMES:
        raise LogError(
            f"{source}: FRAME_CLASS: found {frame_class} ({FRAMES[frame_class]}), expected 1 (quad)"
        )
    frame_type = int(parameters.get("FRAME_TYPE", DEFAULT_FRAME_TYPE))
    if frame_type not in ORDERS:
        expected = ", ".join(map(str, ORDERS))
        raise LogError(f"{source}: FRAME_TYPE: found {frame_type}, expected an X: {expected}")
    outputs = {
        function: number
        for number in range(NUM_OUTPUTS, 0, -1)
        if (function := _function(parameters, number)) in MOTOR_FUNCTIONS
    }
    if outputs and sorted(outputs) != [*MOTOR_FUNCTIONS[:NUM_MOTORS]]:
        raise LogError(
            f"{source}: SERVOn_FUNCTION: found {len(outputs)} motors, expected motors 1 to 4"
        )
    columns = [f"C{outputs.get(MOTOR_FUNCTIONS[motor - 1], motor)}" for motor in ORDERS[frame_type]]
    rows = messages.get("RCOU", {})
    if any(name not in rows for name in (TIME, *columns)):
        raise LogError(f"{source}: missing or without {', '.join(columns)}; expected the outputs")
    steps_s = np.diff(rows[TIME]) * UNITS["time"]["us"]
    check_motors_of_autopilot(source, steps_s, motors, frame_type in TURN_OUT)
    low, high = (
        parameters.get(name) or MOTOR_DEFAULTS[name] for name in ("MOT_PWM_MIN", "MOT_PWM_MAX")
    )
    if low >= high:
        raise LogError(
            f"{source}: MOT_PWM_MIN, MOT_PWM_MAX: found {low:g} and {high:g}, expected a range"
        )
    named = tuple(f"RCOU.{column}" for column in columns)
    convert = lambda table: np.clip((table.matrix(named) - low) / (high - low), 0.0, 1.0)  # noqa: E731
    return Channel("RCOU", "motors", named, convert)


def _motors(columns: tuple[str, ...], parameters: dict[str, float]) -> list[Channel]:
    """Return the channel of motor outputs, 0 to 1 between the firmware's ends in flight."""
    settings: dict[str, Any] = {
        name: parameters.get(name) or default for name, default in MOTOR_DEFAULTS.items()
    }
    low_us, high_us = settings["MOT_PWM_MIN"], settings["MOT_PWM_MAX"]
    low, high = (
        low_us + settings[name] * (high_us - low_us) for name in ("MOT_SPIN_MIN", "MOT_SPIN_MAX")
    )
    if not columns or high <= low:
        return []
    convert = lambda table: np.clip((table.matrix(columns) - low) / (high - low), 0.0, 1.0)  # noqa: E731
    return [Channel("RCOU", "motors", columns, convert)]
