"""Writers of flights in the formats that are imported, each by its specification.

What is written of a log is command, rates, specific force and voltage, and where the format has
them, position, velocity and attitude.
"""

import json
import re
import struct
import zlib

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_sysid import FlightLog
from tests.support.handout_plant import GRAVITY
from tests.support.tables import table
from tests.support.written_logs import read_mapping

FLIP = np.array([1.0, -1.0, -1.0])  # FLU to FRD; north, west, up to NED


def flying(num_rows=30, step_s=0.01, start_s=1.0):
    """Return a steady turn with the throttle rising."""
    time = start_s + step_s * np.arange(num_rows)
    channels = {
        "u": np.column_stack([np.tile([0.5, -0.25, 0.25], (num_rows, 1)), 2 * time / time[-1] - 1]),
        "w": np.tile(np.deg2rad([100.0, -50.0, 25.0]), (num_rows, 1)),
        "f": np.tile(GRAVITY * np.array([0.5, -0.25, 1.0]), (num_rows, 1)),
        "v_bat": np.full((num_rows, 1), 24.1),
    }
    return FlightLog(time, channels, np.zeros(num_rows, int))


def _rows(stamps, *columns):
    """Return rows of a stamp and numbers."""
    values = np.column_stack(columns).tolist()
    return [(int(stamp), *row) for stamp, row in zip(stamps, values, strict=True)]


# --- PX4 ------------------------------------------------------------------------------------------

ULOG_TYPES = {"uint64_t": "Q", "float": "f", "bool": "?"}
PX4_FULL_STICK_DEG_S = (720.0, 360.0, 180.0)
PX4_PARAMETERS = {
    "MC_ACRO_R_MAX": 720.0,
    "MC_ROLLRATE_MAX": 220.0,
    "MC_ACRO_P_MAX": 360.0,
    "MC_ACRO_Y_MAX": 90.0,
    "MC_YAWRATE_MAX": 180.0,
}


def ulog_message(kind, content):
    """Return a message of a ULog file."""
    return struct.pack("<Hc", len(content), kind.encode()) + content


def ulog(topics, parameters=PX4_PARAMETERS):
    """Return a PX4 log of topics: their fields but the time, and the rows of each instance."""
    definitions, data, number = ulog_message("B", bytes(40)), b"", 0
    for name, value in parameters.items():
        key = f"float {name}".encode()
        definitions += ulog_message("P", bytes([len(key)]) + key + struct.pack("<f", value))
    for name, (fields, *instances) in topics.items():
        fields = f"uint64_t timestamp;{fields};"
        definitions += ulog_message("F", f"{name}:{fields}".encode())
        types = re.findall(r"(\w+)(?:\[(\d+)\])? \w+;", fields)
        pattern = "<H" + "".join(ULOG_TYPES[kind] * int(size or 1) for kind, size in types)
        for instance, rows in enumerate(instances):
            subscription = struct.pack("<BH", instance, number) + name.encode()
            data += ulog_message("A", subscription)
            data += b"".join(ulog_message("D", struct.pack(pattern, number, *row)) for row in rows)
            number += 1
    return b"ULog\x01\x12\x35" + struct.pack("<BQ", 1, 0) + definitions + data


def ulog_topics(log):
    """Return the topics of a flight: FRD and NED, all at the same times."""
    stamps, level = np.round(1e6 * log.time), np.tile([1.0, 0.0, 0.0, 0.0], (len(log), 1))
    attitude = log["q"] * [1.0, 1.0, -1.0, -1.0] if "q" in log else level
    setpoints = log["u"][:, :3] * np.deg2rad(PX4_FULL_STICK_DEG_S) * FLIP
    thrust_b = np.outer(-0.5 * (log["u"][:, 3] + 1.0), [0.0, 0.0, 1.0])
    topics = {
        "battery_status": ("float voltage_v", _rows(stamps, log["v_bat"])),
        "vehicle_angular_velocity": ("float[3] xyz", _rows(stamps, log["w"] * FLIP)),
        "vehicle_acceleration": ("float[3] xyz", _rows(stamps, log["f"] * FLIP)),
        "vehicle_attitude": ("float[4] q", _rows(stamps, attitude)),
    }
    if "p" in log:
        fields = "float x;float y;float z;float vx;float vy;float vz"
        rows = _rows(stamps, log["p"] * FLIP, log["v"] * FLIP)
        topics["vehicle_local_position"] = (fields, rows)
    fields = "float roll;float pitch;float yaw;float[3] thrust_body"
    topics["vehicle_rates_setpoint"] = (fields, _rows(stamps, setpoints, thrust_b))
    return topics


def write_ulog(folder, log):
    """Write a PX4 log."""
    (folder / "a.ulg").write_bytes(ulog(ulog_topics(log)))
    return folder / "a.ulg", None


# --- Betaflight -----------------------------------------------------------------------------------

BLACKBOX_HEADERS = table("blackbox_headers")
# Of these headers: 5.108 x 200; 200 / (1 - 0.7); 100 / (1 - 0.8).
BLACKBOX_FULL_STICK_DEG_S = (1021.6, 200.0 / 0.3, 500.0)
BLACKBOX_NAMES = [
    "loopIteration",
    "time",
    *(f"setpoint[{axis}]" for axis in range(4)),
    "vbatLatest",
    *(f"gyroADC[{axis}]" for axis in range(3)),
    *(f"accSmooth[{axis}]" for axis in range(3)),
]


def _variable_bytes(value, is_signed):
    """Return a whole number as blackbox logs have it: zigzag if signed, seven bits a byte."""
    if is_signed:
        value = 2 * value if value >= 0 else -2 * value - 1
    content = bytearray()
    while value > 0x7F:
        content.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*content, value])


def blackbox(rows, names=BLACKBOX_NAMES, headers=BLACKBOX_HEADERS):
    """Return a blackbox log of full frames only: rows (num_rows, len(names)) of whole numbers."""
    signed = [int(name not in ("loopIteration", "time")) for name in names]
    lines = {
        "Product": "Blackbox flight data recorder by Nicholas Sherlock",
        "Data version": "2",
        "Field I name": ",".join(names),
        "Field I signed": ",".join(map(str, signed)),
        "Field I predictor": ",".join("0" * len(names)),
        "Field I encoding": ",".join(str(1 - sign) for sign in signed),
        **headers,
    }
    content = "".join(f"H {name}:{value}\n" for name, value in lines.items()).encode()
    for row in rows.astype(int).tolist():
        content += b"I"
        content += b"".join(map(_variable_bytes, row, signed))
    return content + b"E\xffEnd of log\x00"


def blackbox_frames(log):
    """Return frames: setpoints and gyro in deg/s, accelerometer in 1/2048 g, in whole numbers."""
    columns = [
        np.arange(len(log)),
        1e6 * log.time,
        log["u"][:, :3] * BLACKBOX_FULL_STICK_DEG_S,
        500.0 * (log["u"][:, 3] + 1.0),
        100.0 * log["v_bat"],
        np.rad2deg(log["w"]),
        2048.0 / GRAVITY * log["f"],
    ]
    return np.round(np.column_stack(columns)).astype(int)


def write_betaflight(folder, log):
    """Write a blackbox log."""
    (folder / "a.bbl").write_bytes(blackbox(blackbox_frames(log)))
    return folder / "a.bbl", None


# --- ArduPilot ------------------------------------------------------------------------------------

DATAFLASH_HEAD, DATAFLASH_FORMAT = b"\xa3\x95", 128
# Types of values by their letter, as ``struct`` has them.
DATAFLASH_TYPES = {"Q": "Q", "f": "f", "B": "B", "H": "H", "N": "16s", "Z": "64s", "n": "4s"}
COPTER_PARAMETERS = {
    "ACRO_RP_RATE": 360.0,
    "ACRO_Y_RATE": 180.0,
    "ATC_RATE_R_MAX": 500.0,
    "FRAME_CLASS": 1.0,
}
COPTER_FULL_STICK_DEG_S = (500.0, 360.0, 180.0)


def dataflash(
    messages,
    parameters=COPTER_PARAMETERS,
    text="ArduCopter V4.5.1 (d4a1b2c3)",
):
    """Return an ArduPilot log; messages are written one kind after the other.

    Args:
        messages: for each message name, the types of its fields, their names and its rows. The
            first field is the time (us).
    """
    stored = [(0, name, value) for name, value in parameters.items()]
    messages = {
        "FMT": ("BBnNZ", "Type,Length,Name,Format,Columns", []),
        "PARM": ("QNf", "TimeUS,Name,Value", stored),
        "MSG": ("QZ", "TimeUS,Message", [(0, text)]),
        **messages,
    }

    def pattern(types):
        return "<" + "".join(DATAFLASH_TYPES[kind] for kind in types)

    def pack_value(kind, value):
        if isinstance(value, str):
            return value.encode()
        return value if kind == "f" else round(value)

    def packed(number, types, row):
        values = map(pack_value, types, row)
        return DATAFLASH_HEAD + bytes([number]) + struct.pack(pattern(types), *values)

    formats, rows = b"", b""
    for number, (name, (types, columns, values)) in enumerate(messages.items(), DATAFLASH_FORMAT):
        size = 3 + struct.calcsize(pattern(types))
        formats += packed(DATAFLASH_FORMAT, "BBnNZ", (number, size, name, types, columns))
        rows += b"".join(packed(number, types, row) for row in values)
    return formats + rows


def dataflash_messages(log):
    """Return the messages of a flight: FRD and NED, degrees, all at the same times."""
    stamps, zero = np.round(1e6 * log.time), np.zeros(len(log))
    setpoints = log["u"][:, :3] * COPTER_FULL_STICK_DEG_S * FLIP
    rates = np.rad2deg(log["w"] * FLIP)
    outputs = np.zeros_like(rates)
    axes = np.stack([setpoints, rates, outputs], axis=2).reshape(len(log), 9)
    throttle = 0.5 * (log["u"][:, 3] + 1.0)
    messages = {
        "BAT": ("QBf", "TimeUS,Instance,Volt", _rows(stamps, zero, log["v_bat"])),
        "IMU": (
            "QBffffffBB",
            "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,GH,AH",
            _rows(stamps, zero, log["w"] * FLIP, log["f"] * FLIP, zero + 1.0, zero + 1.0),
        ),
    }
    if "q" in log:
        quat = log["q"] * [1.0, 1.0, -1.0, -1.0]
        euler = Rotation.from_quat(quat, scalar_first=True).as_euler("ZYX", degrees=True)[:, ::-1]
        messages["ATT"] = ("Qfff", "TimeUS,Roll,Pitch,Yaw", _rows(stamps, euler))
        messages["XKQ"] = ("QBffff", "TimeUS,C,Q1,Q2,Q3,Q4", _rows(stamps, zero, quat))
    if "p" in log:
        rows = _rows(stamps, zero, log["v"] * FLIP, log["p"] * FLIP)
        messages["XKF1"] = ("QBffffff", "TimeUS,C,VN,VE,VD,PN,PE,PD", rows)
    columns = "TimeUS,RDes,R,ROut,PDes,P,POut,YDes,Y,YOut,ADes,A,AOut"
    rows = _rows(stamps, axes, zero, zero, throttle)
    messages["RATE"] = ("Qffffffffffff", columns, rows)
    return messages


def write_dataflash(folder, log):
    """Write an ArduPilot log."""
    (folder / "a.bin").write_bytes(dataflash(dataflash_messages(log)))
    return folder / "a.bin", None


# --- Formats whose columns a mapping names --------------------------------------------------------

STICK_NAMES, SENSOR_NAMES = ("roll", "pitch", "yaw", "thrust"), ("p", "q", "r", "ax", "ay", "az")
NAMES = (*STICK_NAMES, *SENSOR_NAMES, "volts")


def _values(log):
    """Return columns of the names above, (num_rows, 11); rates in deg/s."""
    return np.column_stack([log["u"], np.rad2deg(log["w"]), log["f"], log["v_bat"]])


def write_mapping(folder, clock="", sticks="", sensors=""):
    """Write a mapping of the columns, which have names with something before them."""
    columns = read_mapping("columns").format(sticks=sticks, sensors=sensors)
    (folder / "map.toml").write_text(clock + columns)
    return folder / "map.toml"


def usd_log(events, version=2):
    """Return a Crazyflie's uSD log; each event has variables, and rows with the time in s first."""
    stamp, per_s = {1: ("I", 1e3), 2: ("Q", 1e6)}[version]
    content, records = struct.pack("<BHH", 0xBC, version, len(events)), b""
    for number, (name, (variables, rows)) in enumerate(events.items()):
        content += struct.pack("<H", number) + name.encode() + b"\0"
        content += struct.pack("<H", len(variables))
        content += b"".join(f"{name}({kind})\0".encode() for name, kind in variables.items())
        pattern = f"<H{stamp}{''.join(variables.values())}"
        for time, *row in rows.tolist():
            kinds = zip(variables.values(), row, strict=True)
            values = [value if kind in "fd" else int(value) for kind, value in kinds]
            records += struct.pack(pattern, number, round(time * per_s), *values)
    content += records
    return content + struct.pack("<I", zlib.crc32(content))


def write_usd(folder, log):
    """Write a uSD log."""
    rows = np.column_stack([log.time, _values(log)])
    (folder / "log00").write_bytes(usd_log({"fixedFrequency": (dict.fromkeys(NAMES, "f"), rows)}))
    return folder / "log00", write_mapping(folder)


def save_messages(path, messages):
    """Write an MCAP file of JSON messages: topic, time in ns, and content."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer, topics = Writer(file), {}
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        for topic, time_ns, content in messages:
            if topic not in topics:
                topics[topic] = writer.register_channel(topic, "json", schema)
            data = json.dumps(content, default=np.ndarray.tolist).encode()
            writer.add_message(topics[topic], time_ns, data, time_ns)
        writer.finish()


def write_bag(folder, log):
    """Write an MCAP file of messages with stamps, recorded at a steady rate."""
    messages, step_ns = [], round(1e9 * np.median(np.diff(log.time)))
    for row, (stamp_s, values) in enumerate(zip(log.time, _values(log), strict=True)):
        sec, nanosec = divmod(round(1e9 * stamp_s), 10**9)
        content = {"header": {"stamp": {"sec": sec, "nanosec": nanosec}}}
        content |= dict(zip(NAMES, values.tolist(), strict=True))
        messages.append(("/flight", row * step_ns, content))
    save_messages(folder / "a.mcap", messages)
    return folder / "a.mcap", write_mapping(folder, "", "/flight:", "/flight:")


def _save_csv(path, names, *columns):
    np.savetxt(path, np.column_stack(columns), "%.9f", ",", header=",".join(names), comments="")


def write_csv(folder, log):
    """Write a CSV file."""
    _save_csv(folder / "a.csv", ["t", *NAMES], log.time, _values(log))
    return folder / "a.csv", write_mapping(folder, '[time]\ncolumn = "t"\nunit = "s"\n')


def write_csv_files(folder, log):
    """Write two CSV files, that of the sticks 0.5 ms earlier, in ms from 50 s on."""
    flight, values = folder / "flight", _values(log)
    flight.mkdir()
    _save_csv(flight / "x_gyro_0.csv", ["t", *NAMES[4:]], log.time, values[:, 4:])
    sticks_ms = 1e3 * (log.time - 50.0005)
    _save_csv(flight / "x_rc_0.csv", ["ms", *NAMES[:4]], sticks_ms, values[:, :4])
    return flight, write_mapping(folder, read_mapping("files"), "rc:", "gyro:")


# Of each kind of log: its format, and what writes a flight to a folder and returns the log and the
# mapping to read it with.
WRITERS = {
    "ULog": ("ulog", write_ulog),
    "blackbox": ("betaflight", write_betaflight),
    "DataFlash": ("dataflash", write_dataflash),
    "uSD": ("usd", write_usd),
    "bag": ("bag", write_bag),
    "CSV": ("csv", write_csv),
    "CSV files": ("csv", write_csv_files),
}
