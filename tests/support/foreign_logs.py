"""Writers of small valid logs in the formats that are imported: PX4, Betaflight, uSD, MCAP, CSV."""

import json
import struct
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from tests.support.tables import table
from tests.support.written_logs import read_mapping

ULOG_TYPES = {"uint64_t": "Q", "float": "f", "bool": "?", "uint8_t": "B"}
NUM_ROWS = 30


class UlogWriter:
    """A ULog file by PX4's specification: header, definitions, subscriptions, data."""

    def __init__(self, parameters: dict[str, float]):
        self.definitions = self.message("B", bytes(40)) + b"".join(
            self.message("P", self.key(f"float {name}") + struct.pack("<f", value))
            for name, value in parameters.items()
        )
        self.data = b""
        self.num_topics = 0

    @staticmethod
    def message(kind: str, content: bytes) -> bytes:
        return struct.pack("<Hc", len(content), kind.encode()) + content

    @staticmethod
    def key(text: str) -> bytes:
        return struct.pack("<B", len(text)) + text.encode()

    def add(
        self,
        name: str,
        fields: list[tuple[str, str, int]],
        rows: list[tuple[Any, ...]],
        instance: int = 0,
    ) -> None:
        """Add a topic: fields are (type, name, array size or 0), rows flat, time in us first."""
        fields = [("uint64_t", "timestamp", 0), *fields]
        text = "".join(
            f"{kind}{f'[{size}]' if size else ''} {field};" for kind, field, size in fields
        )
        if not instance:
            self.definitions += self.message("F", f"{name}:{text}".encode())
        pattern = "<" + "".join(ULOG_TYPES[kind] * max(size, 1) for kind, _, size in fields)
        self.data += self.message(
            "A", struct.pack("<BH", instance, self.num_topics) + name.encode()
        )
        for row in rows:
            content = struct.pack("<H", self.num_topics) + struct.pack(pattern, *row)
            self.data += self.message("D", content)
        self.num_topics += 1

    def content(self) -> bytes:
        """Return the file."""
        return b"ULog\x01\x12\x35" + struct.pack("<BQ", 1, 0) + self.definitions + self.data


PARAMETERS = {"MC_ACRO_R_MAX": 720.0, "MC_ROLLRATE_MAX": 220.0, "MC_ACRO_P_MAX": 360.0}
PARAMETERS |= {"MC_ACRO_Y_MAX": 90.0, "MC_YAWRATE_MAX": 180.0}
STEP_US = 4000
TIMES_US = 1_000_000 + STEP_US * np.arange(200)
EAST = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # NED, FRD: nose east
XYZ = [("float", "x", 0), ("float", "y", 0), ("float", "z", 0)]
VXYZ = [("float", "vx", 0), ("float", "vy", 0), ("float", "vz", 0)]
SETPOINT = [("float", "roll", 0), ("float", "pitch", 0), ("float", "yaw", 0)]


def constant(values: tuple[float, ...], times: np.ndarray = TIMES_US) -> list[tuple[Any, ...]]:
    """Return rows of the same values."""
    return [(int(time), *values) for time in times]


def topics() -> dict[str, tuple[list, list]]:
    """Return fields and rows of the topics of a drone with its nose east, turning, pulling up."""
    slow = TIMES_US[::5]
    place = constant((1.0, 2.0, -3.0, 4.0, 5.0, -6.0), slow)
    setpoints = constant(
        (*np.deg2rad([360.0, 90.0, -45.0]), 0.0, 0.0, -0.75), slow
    )  # half of the full stick
    return {
        "vehicle_angular_velocity": ([("float", "xyz", 3)], constant((0.1, 0.2, 0.3))),
        "vehicle_acceleration": ([("float", "xyz", 3)], constant((0.5, 0.25, -9.75))),
        "vehicle_attitude": ([("float", "q", 4)], constant(EAST, slow)),
        "vehicle_local_position": ([*XYZ, *VXYZ], place),
        "vehicle_rates_setpoint": ([*SETPOINT, ("float", "thrust_body", 3)], setpoints),
        "battery_status": ([("float", "voltage_v", 0)], constant((16.25,), TIMES_US[::100])),
    }


def _variable_bytes(value: int, is_signed: bool) -> bytes:
    """Return a whole number as blackbox logs have it: zigzag if signed, seven bits a byte."""
    rest = (value << 1 if value >= 0 else (-value << 1) - 1) if is_signed else value
    found = bytearray()
    while rest > 0x7F:
        found.append(rest & 0x7F | 0x80)
        rest >>= 7
    return bytes([*found, rest])


BLACKBOX_HEADERS = table("blackbox_headers")


def blackbox(rows: np.ndarray, names: list[str], headers: dict[str, str]) -> bytes:
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
    text = "".join(f"H {name}:{value}\n" for name, value in lines.items()).encode()
    frames = b"".join(
        b"I"
        + b"".join(
            _variable_bytes(int(value), bool(sign)) for value, sign in zip(row, signed, strict=True)
        )
        for row in rows
    )
    return text + frames + b"E\xffEnd of log\x00"


BLACKBOX_NAMES = [
    "loopIteration",
    "time",
    *(f"setpoint[{axis}]" for axis in range(4)),
    "vbatLatest",
]
BLACKBOX_NAMES += [f"{sensor}[{axis}]" for sensor in ("gyroADC", "accSmooth") for axis in range(3)]


def blackbox_frames(num_rows: int = 200) -> np.ndarray:
    """Return frames of a steady turn, the throttle rising, at 2 kHz."""
    row = [0, 0, 511, -333, 250, 0, 2410, 100, -50, 25, 1024, -512, 2048]
    found, count = np.tile(row, (num_rows, 1)), np.arange(num_rows)
    found[:, 0], found[:, 1], found[:, 5] = (
        count,
        5_000_000 + 500 * count,
        np.linspace(0, 1000, num_rows),
    )
    return found


def usd_log(
    events: dict[str, tuple[dict[str, str], np.ndarray]], version: int = 2, in_order: bool = True
) -> bytes:
    """Return a Crazyflie's uSD log; each event has variables, and rows with the time in s first."""
    stamp, per_s = {1: ("I", 1e3), 2: ("Q", 1e6)}[version]
    header, records = struct.pack("<BHH", 0xBC, version, len(events)), []
    for number, (name, (variables, rows)) in enumerate(events.items()):
        header += (
            struct.pack("<H", number) + name.encode() + b"\0" + struct.pack("<H", len(variables))
        )
        header += b"".join(
            f"{variable}({kind})".encode() + b"\0" for variable, kind in variables.items()
        )
        for time, *row in rows:
            values = [
                v if kind in "efd" else int(v)
                for kind, v in zip(variables.values(), row, strict=True)
            ]
            content = struct.pack(
                f"<H{stamp}{''.join(variables.values())}", number, round(time * per_s), *values
            )
            records.append((time, content))
    records = sorted(records, key=lambda record: record[0]) if in_order else records
    content = header + b"".join(content for _, content in records)
    return content + struct.pack("<I", zlib.crc32(content))


def usd() -> bytes:
    """Return a small uSD log that the mapping "usd" fits."""
    variables = dict.fromkeys(("roll", "pitch", "yaw", "thrust", "gyro.x", "gyro.y"), "f") | {
        "gyro.z": "h"
    }
    rows = np.tile((0.0, 0.5, -0.25, 0.1, 0.3, 10.0, -20.0, 30.0), (NUM_ROWS, 1))
    rows[:, 0] = 1.0 + 0.01 * np.arange(NUM_ROWS)
    slow = np.array([[0.9, 3900.0], [1.4, 3800.0]])
    return usd_log({"fixedFrequency": (variables, rows), "battery": ({"pm.vbat": "H"}, slow)})


def save_messages(path: Path, messages: Iterable[tuple[str, int, Any]]) -> None:
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


def save_bag(path: Path) -> None:
    """Write a small MCAP file that the mapping "bag" fits."""
    rates = ({"x": 0.1 * row, "y": 0.0, "z": -0.1} for row in range(NUM_ROWS))
    contents = ({"u": [0.5, -0.25, 0.1, 0.3], "w": rate} for rate in rates)
    save_messages(path, (("/flight", row * 10**7, content) for row, content in enumerate(contents)))


def ulog(tables: dict[str, tuple[list, list]] | None = None, parameters: Any = PARAMETERS) -> bytes:
    """Return a PX4 log of topics: of a small one unless they are given."""
    writer = UlogWriter(parameters)
    for name, (fields, rows) in (topics() if tables is None else tables).items():
        writer.add(name, fields, rows)
    return writer.content()


def betaflight() -> bytes:
    """Return a small Betaflight log."""
    return blackbox(blackbox_frames(NUM_ROWS), BLACKBOX_NAMES, BLACKBOX_HEADERS)


def foreign_csv() -> bytes:
    """Return a small CSV log that the mapping "csv" fits."""
    names = ["ms", "ail", "ele", "rud", "thr", "p", "q", "r", "mv"]
    rows = np.random.default_rng(3).normal(size=(NUM_ROWS, len(names)))
    rows[:, 0], rows[:, 1:5], rows[:, -1] = 10.0 * np.arange(NUM_ROWS), 1500.0, 16_000.0
    lines = [",".join(names), *(",".join(f"{value:.6g}" for value in row) for row in rows)]
    return ("\n".join(lines) + "\n").encode()


DATAFLASH_HEAD, DATAFLASH_FORMAT = b"\xa3\x95", 128
# Of a type of value by its letter: that of ``struct``, and the factor of what is written.
DATAFLASH_TYPES = {
    "Q": ("Q", 1),
    "f": ("f", 1),
    "B": ("B", 1),
    "H": ("H", 1),
    "c": ("h", 100),
    "N": ("16s", 1),
}
DATAFLASH_TYPES |= {"Z": ("64s", 1), "n": ("4s", 1), "b": ("b", 1)}
COPTER_PARAMETERS = {
    "ACRO_RP_RATE": 360.0,
    "ACRO_Y_RATE": 180.0,
    "ATC_RATE_R_MAX": 500.0,
    "FRAME_CLASS": 1.0,
}


def dataflash(
    messages: dict[str, tuple[str, str, list[tuple[Any, ...]]]],
    parameters: dict[str, float] = COPTER_PARAMETERS,
    text: str = "ArduCopter V4.5.1 (d4a1b2c3)",
) -> bytes:
    """Return an ArduPilot log by its specification.

    Each message has types, names of fields, and rows.

    The first value of a row is the time, us; messages are written one kind after the other.
    """
    known = {
        "FMT": ("BBnNZ", "Type,Length,Name,Format,Columns", []),
        "PARM": (
            "QNf",
            "TimeUS,Name,Value",
            [(0, name, value) for name, value in parameters.items()],
        ),
        "MSG": ("QZ", "TimeUS,Message", [(0, text)]),
        **messages,
    }

    def packed(number: int, types: str, row: tuple[Any, ...]) -> bytes:
        pattern = "<" + "".join(DATAFLASH_TYPES[kind][0] for kind in types)
        values = [
            value.encode()
            if isinstance(value, str)
            else value * factor
            if kind == "f"
            else round(value * factor)
            for kind, value, factor in zip(
                types, row, (DATAFLASH_TYPES[kind][1] for kind in types), strict=True
            )
        ]
        return DATAFLASH_HEAD + bytes([number]) + struct.pack(pattern, *values)

    content, rows = b"", list[bytes]()
    for number, (name, (types, columns, values)) in enumerate(
        known.items(), start=DATAFLASH_FORMAT
    ):
        size = 3 + struct.calcsize("<" + "".join(DATAFLASH_TYPES[kind][0] for kind in types))
        content += packed(DATAFLASH_FORMAT, "BBnNZ", (number, size, name, types, columns))
        rows += [packed(number, types, row) for row in values]
    return content + b"".join(rows)


RATE_COLUMNS = "TimeUS,RDes,R,ROut,PDes,P,POut,YDes,Y,YOut,ADes,A,AOut"


def small_dataflash(stamps_s: np.ndarray) -> bytes:
    """Return an ArduPilot log of rates alone, with these stamps."""
    rows = [
        (round(1e6 * stamp_s), 180.0, 0.0, 0, 90.0, 0.0, 0, -45.0, float(row), 0, 0, 0, 0.6)
        for row, stamp_s in enumerate(stamps_s)
    ]
    return dataflash({"RATE": ("Qffffffffffff", RATE_COLUMNS, rows)})


def dataflash_with_clock(folder: Path, stamps_s: np.ndarray) -> tuple[Path, None]:
    """Write an ArduPilot log whose messages have these stamps."""
    (folder / "a.bin").write_bytes(small_dataflash(stamps_s))
    return folder / "a.bin", None


# Logs of a drone that turns about z at as many deg/s as rows are before, so that rows can be told
# apart.
CLOCK_STICKS = (0.5, -0.25, 0.1, 0.3)


def ulog_with_clock(folder: Path, stamps_s: np.ndarray) -> tuple[Path, None]:
    """Write a PX4 log whose topics all have these stamps."""
    stamps_us = np.round(1e6 * stamps_s).astype(int)
    turn = [(int(time), 0.0, 0.0, np.deg2rad(row)) for row, time in enumerate(stamps_us)]
    setpoints = constant((*np.deg2rad([360.0, 90.0, -45.0]), 0.0, 0.0, -0.75), stamps_us)
    tables = {
        "vehicle_angular_velocity": ([("float", "xyz", 3)], turn),
        "vehicle_attitude": ([("float", "q", 4)], constant(EAST, stamps_us)),
        "vehicle_rates_setpoint": ([*SETPOINT, ("float", "thrust_body", 3)], setpoints),
    }
    (folder / "a.ulg").write_bytes(ulog(tables))
    return folder / "a.ulg", None


def betaflight_with_clock(folder: Path, stamps_s: np.ndarray) -> tuple[Path, None]:
    """Write a blackbox log with these stamps."""
    rows = blackbox_frames(len(stamps_s))
    rows[:, 1], rows[:, 9] = np.round(1e6 * stamps_s), np.arange(len(stamps_s))
    rows[:, 5] = 500
    (folder / "a.bbl").write_bytes(blackbox(rows, BLACKBOX_NAMES, BLACKBOX_HEADERS))
    return folder / "a.bbl", None


def _sticks_and_turn(stamps_s: np.ndarray) -> np.ndarray:
    """Return rows of stamps, sticks and rates in deg/s, (num_rows, 8)."""
    num_rows = len(stamps_s)
    still, count = np.zeros(num_rows), np.arange(num_rows)
    return np.column_stack([stamps_s, np.tile(CLOCK_STICKS, (num_rows, 1)), still, still, count])


USD_NAMES = ("roll", "pitch", "yaw", "thrust", "gyro.x", "gyro.y", "gyro.z", "pm.vbat")


def usd_with_clock(folder: Path, stamps_s: np.ndarray) -> tuple[Path, Path]:
    """Write a uSD log with these stamps."""
    rows = np.column_stack([_sticks_and_turn(stamps_s), np.full(len(stamps_s), 3900.0)])
    events = {"fixedFrequency": (dict.fromkeys(USD_NAMES, "f"), rows)}
    (folder / "log00").write_bytes(usd_log(events, in_order=False))
    return folder / "log00", _with_mapping(folder, "usd")


def bag_with_clock(folder: Path, stamps_s: np.ndarray) -> tuple[Path, Path]:
    """Write an MCAP file of messages with these stamps, recorded at a steady rate."""
    messages = []
    for row, stamp_s in enumerate(stamps_s):
        sec, nanosec = divmod(round(1e9 * stamp_s), 10**9)
        header = {"stamp": {"sec": sec, "nanosec": nanosec}}
        rates = {"x": 0.0, "y": 0.0, "z": np.deg2rad(row)}
        messages.append(
            ("/flight", row * 4_000_000, {"header": header, "u": CLOCK_STICKS, "w": rates})
        )
    save_messages(folder / "a.mcap", messages)
    return folder / "a.mcap", _with_mapping(folder, "bag")


def csv_with_clock(folder: Path, stamps_s: np.ndarray) -> tuple[Path, Path]:
    """Write a CSV file with these stamps."""
    rows = _sticks_and_turn(stamps_s)
    np.savetxt(
        folder / "a.csv", rows, "%.9f", ",", header="t,roll,pitch,yaw,thrust,p,q,r", comments=""
    )
    return folder / "a.csv", _with_mapping(folder, "clock")


def csv_files_with_clock(folder: Path, stamps_s: np.ndarray) -> tuple[Path, Path]:
    """Write two CSV files with these stamps, the second 0.5 ms earlier, in ms from 50 s on."""
    rows, flight = _sticks_and_turn(stamps_s), folder / "flight"
    flight.mkdir()
    sticks = np.column_stack([1e3 * (rows[:, 0] - 50.0005), rows[:, 1:5]])
    np.savetxt(
        flight / "x_gyro_0.csv", rows[:, [0, 5, 6, 7]], "%.9f", ",", header="t,p,q,r", comments=""
    )
    np.savetxt(
        flight / "x_rc_0.csv", sticks, "%.9f", ",", header="ms,roll,pitch,yaw,thrust", comments=""
    )
    return flight, _with_mapping(folder, "files")


def _with_mapping(folder: Path, name: str) -> Path:
    """Copy a mapping of the tests into a folder."""
    (folder / "map.toml").write_text(read_mapping(name))
    return folder / "map.toml"


# Of each kind of log: its format, and what writes it with given stamps.
CLOCK_WRITERS: dict[str, tuple[str, Callable[[Path, np.ndarray], tuple[Path, Path | None]]]] = {
    "ULog": ("ulog", ulog_with_clock),
    "blackbox": ("betaflight", betaflight_with_clock),
    "DataFlash": ("dataflash", dataflash_with_clock),
    "uSD": ("usd", usd_with_clock),
    "bag": ("bag", bag_with_clock),
    "CSV": ("csv", csv_with_clock),
    "CSV files": ("csv", csv_files_with_clock),
}
