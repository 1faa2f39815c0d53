"""Writers of small valid logs in the formats that are imported: PX4, Betaflight, uSD, MCAP, CSV."""

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

ULOG_TYPES = {"uint64_t": "Q", "float": "f", "bool": "?", "uint8_t": "B"}
NUM_ROWS, STEP_US = 30, 10_000
FLOAT = "float"
ULOG_TOPICS: dict[str, tuple[list[tuple[str, str, int]], tuple[float, ...]]] = {
    "vehicle_angular_velocity": ([(FLOAT, "xyz", 3)], (0.1, 0.2, 0.3)),
    "vehicle_attitude": ([(FLOAT, "q", 4)], (0.8, 0.0, 0.0, 0.6)),
    "vehicle_rates_setpoint": (
        [(FLOAT, "roll", 0), (FLOAT, "pitch", 0), (FLOAT, "yaw", 0), (FLOAT, "thrust_body", 3)],
        (0.5, 0.25, -0.25, 0.0, 0.0, -0.5),
    ),
}
ULOG_PARAMETERS = {"MC_ACRO_R_MAX": 720.0, "MC_ACRO_P_MAX": 360.0, "MC_ACRO_Y_MAX": 90.0}


class UlogWriter:
    """A ULog file by PX4's specification of the format: header, definitions, subscriptions, data."""

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

    def add(self, name: str, fields: list[tuple[str, str, int]], rows: list[tuple[Any, ...]]) -> None:
        """Add a topic: fields are (type, name, array size or 0), rows flat with the time in us first."""
        fields = [("uint64_t", "timestamp", 0), *fields]
        text = "".join(f"{kind}{f'[{size}]' if size else ''} {field};" for kind, field, size in fields)
        self.definitions += self.message("F", f"{name}:{text}".encode())
        pattern = "<" + "".join(ULOG_TYPES[kind] * max(size, 1) for kind, _, size in fields)
        self.data += self.message("A", struct.pack("<BH", 0, self.num_topics) + name.encode())
        for row in rows:
            content = struct.pack("<H", self.num_topics) + struct.pack(pattern, *row)
            self.data += self.message("D", content)
        self.num_topics += 1

    def content(self) -> bytes:
        """Return the file."""
        return b"ULog\x01\x12\x35" + struct.pack("<BQ", 1, 0) + self.definitions + self.data

    def write(self, path: Path) -> Path:
        """Write the file and return its path."""
        path.write_bytes(self.content())
        return path


def _variable_bytes(value: int, is_signed: bool) -> bytes:
    """Return a whole number as blackbox logs have it: zigzag if signed, seven bits a byte."""
    rest = (value << 1 if value >= 0 else (-value << 1) - 1) if is_signed else value
    found = bytearray()
    while rest > 0x7F:
        found.append(rest & 0x7F | 0x80)
        rest >>= 7
    return bytes([*found, rest])


BLACKBOX_HEADERS = {
    "Firmware type": "Cleanflight",
    "Firmware revision": "Betaflight 4.5.1 (77d01ba3b) STM32F405",
    "looptime": "125",
    "acc_1G": "2048",
    "vbatref": "2485",
    "vbatcellvoltage": "330,360,430",
    "rc_rates": "220,100,50",
    "rc_expo": "10,0,0",
    "rates": "0,70,80",
    "rate_limits": "1998,1998,1998",
    "rates_type": "0",
}


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
        + b"".join(_variable_bytes(int(value), bool(sign)) for value, sign in zip(row, signed, strict=True))
        for row in rows
    )
    return text + frames + b"E\xffEnd of log\x00"


def usd_log(events: dict[str, tuple[dict[str, str], np.ndarray]], version: int = 2) -> bytes:
    """Return a Crazyflie's uSD log: of each event its variables, and rows with the time in s first."""
    stamp, per_s = {1: ("I", 1e3), 2: ("Q", 1e6)}[version]
    header, records = struct.pack("<BHH", 0xBC, version, len(events)), []
    for number, (name, (variables, rows)) in enumerate(events.items()):
        header += struct.pack("<H", number) + name.encode() + b"\0" + struct.pack("<H", len(variables))
        header += b"".join(f"{variable}({kind})".encode() + b"\0" for variable, kind in variables.items())
        for time, *row in rows:
            values = [v if kind in "efd" else int(v) for kind, v in zip(variables.values(), row, strict=True)]
            content = struct.pack(
                f"<H{stamp}{''.join(variables.values())}", number, round(time * per_s), *values
            )
            records.append((time, content))
    content = header + b"".join(content for _, content in sorted(records, key=lambda record: record[0]))
    return content + struct.pack("<I", zlib.crc32(content))


def usd() -> bytes:
    """Return a small uSD log that the mapping "usd" fits."""
    variables = dict.fromkeys(("roll", "pitch", "yaw", "thrust", "gyro.x", "gyro.y"), "f") | {"gyro.z": "h"}
    rows = np.tile((0.0, 0.5, -0.25, 0.1, 0.3, 10.0, -20.0, 30.0), (NUM_ROWS, 1))
    rows[:, 0] = 1.0 + 0.01 * np.arange(NUM_ROWS)
    slow = np.array([[0.9, 3900.0], [1.4, 3800.0]])
    return usd_log({"fixedFrequency": (variables, rows), "battery": ({"pm.vbat": "H"}, slow)})


def save_bag(path: Path) -> None:
    """Write a small MCAP file of JSON messages that the mapping "bag" fits."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel(
            "/flight", "json", writer.register_schema("any", "jsonschema", b"{}")
        )
        for row in range(NUM_ROWS):
            content = {"u": [0.5, -0.25, 0.1, 0.3], "w": {"x": 0.1 * row, "y": 0.0, "z": -0.1}}
            writer.add_message(channel, row * 10**7, json.dumps(content).encode(), row * 10**7)
        writer.finish()


def ulog() -> bytes:
    """Return a small PX4 log."""
    writer = UlogWriter(ULOG_PARAMETERS)
    for name, (fields, values) in ULOG_TOPICS.items():
        writer.add(name, fields, [(10**6 + STEP_US * row, *values) for row in range(NUM_ROWS)])
    return writer.content()


def betaflight() -> bytes:
    """Return a small Betaflight log."""
    sensors = [f"{sensor}[{axis}]" for sensor in ("gyroADC", "accSmooth") for axis in range(3)]
    names = ["loopIteration", "time", *(f"setpoint[{axis}]" for axis in range(4)), "vbatLatest", *sensors]
    rows = np.tile((0, 0, 511, -333, 250, 300, 2410, 100, -50, 25, 1024, -512, 2048), (NUM_ROWS, 1))
    rows[:, 0], rows[:, 1] = np.arange(NUM_ROWS), 5_000_000 + STEP_US * np.arange(NUM_ROWS)
    return blackbox(rows, names, BLACKBOX_HEADERS)


def foreign_csv() -> bytes:
    """Return a small CSV log that the mapping "csv" fits."""
    names = ["ms", "ail", "ele", "rud", "thr", "p", "q", "r", "mv"]
    rows = np.random.default_rng(3).normal(size=(NUM_ROWS, len(names)))
    rows[:, 0], rows[:, 1:5], rows[:, -1] = 10.0 * np.arange(NUM_ROWS), 1500.0, 16_000.0
    lines = [",".join(names), *(",".join(f"{value:.6g}" for value in row) for row in rows)]
    return ("\n".join(lines) + "\n").encode()
