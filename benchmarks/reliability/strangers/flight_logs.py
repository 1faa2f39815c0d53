"""Damage to logs of PX4 and Betaflight, and small ones to damage."""

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reliability.strangers.log_writers import BLACKBOX_HEADERS, UlogWriter, blackbox
from benchmarks.reliability.strangers.noise import Rng, damage

NUM_ROWS = 30
STEP_US = 10_000
ULOG_START = 16  # bytes of the header
TOPICS: dict[str, tuple[list[tuple[str, str, int]], tuple[float, ...]]] = {
    "vehicle_angular_velocity": ([("float", "xyz", 3)], (0.1, 0.2, 0.3)),
    "vehicle_acceleration": ([("float", "xyz", 3)], (0.5, 0.25, -9.75)),
    "vehicle_attitude": ([("float", "q", 4)], (0.8, 0.0, 0.0, 0.6)),
    "vehicle_local_position": (
        [("float", name, 0) for name in ("x", "y", "z", "vx", "vy", "vz")],
        (1.0, 2.0, -3.0, 0.0, 0.0, 0.0),
    ),
    "vehicle_rates_setpoint": (
        [*(("float", name, 0) for name in ("roll", "pitch", "yaw")), ("float", "thrust_body", 3)],
        (0.5, 0.25, -0.25, 0.0, 0.0, -0.5),
    ),
    "battery_status": ([("float", "voltage_v", 0)], (16.25,)),
    "vehicle_land_detected": ([("bool", "landed", 0)], (False,)),
}
PARAMETERS = {"MC_ACRO_R_MAX": 720.0, "MC_ACRO_P_MAX": 360.0, "MC_ACRO_Y_MAX": 90.0}
FORMATS = (
    *("float[65535] q", "float[999999999] q", "float[-1] q", "vehicle_attitude[3] q", "vehicle_attitude q"),
    *("other[60000] q", "char[200] q", "uint8_t q", "double[4] q", "uint64_t[4] q", "float q", "float[4]"),
    *("bool q", "nothing q", "float[4] timestamp", "float[4] q;uint64_t timestamp", "float[4] _padding0"),
    *(";", "[] q"),
)
FLOATS = (np.nan, np.inf, -np.inf, 0.0, 1e30, -1e30, 1e-30, 1.0)
TIMES = (0, 1, 2**63, 2**64 - 1, 10**6, 10**15)
HEADERS = (
    *("0", "-1", "1", "99999999999", "1/0", "0/32", "1/32", "-1/-1", "nan", "inf", "1e999", "", ",", "a,b"),
    *("0x", "0x" + "f" * 20, "1,2,3,4,5", "1" * 5000, "0,0,0", "\xff", "-5,-5,-5", "255,255,255", "12"),
)
FIELD_NAMES = (
    *("time", "setpoint[0]", "setpoint[0],setpoint[0]", "x" * 3000, ",".join("abcdefgh" * 500), "", ",,"),
)
NUMBERS = (
    *("0", "1", "3", "6", "7", "8", "9", "10", "11", "77", "-1", "x", ",".join("9" * 4000), "9,9", ""),
)
BLACKBOX_NAMES = [
    *("loopIteration", "time", *(f"setpoint[{axis}]" for axis in range(4)), "vbatLatest"),
    *(f"{sensor}[{axis}]" for sensor in ("gyroADC", "accSmooth") for axis in range(3)),
]
BLACKBOX_ROW = (0, 0, 511, -333, 250, 0, 2410, 100, -50, 25, 1024, -512, 2048)


def write_ulog(path: Path, topics: tuple[str, ...] = tuple(TOPICS), parameters: Any = PARAMETERS) -> None:
    """Write a small PX4 log."""
    writer = UlogWriter(parameters)
    for name in topics:
        fields, values = TOPICS[name]
        writer.add(name, fields, [(10**6 + STEP_US * row, *values) for row in range(NUM_ROWS)])
    writer.write(path)


def write_blackbox(path: Path, num_logs: int = 1, **headers: str) -> None:
    """Write a small Betaflight log."""
    rows = np.tile(BLACKBOX_ROW, (NUM_ROWS, 1))
    rows[:, 0], rows[:, 1] = np.arange(NUM_ROWS), 5_000_000 + STEP_US * np.arange(NUM_ROWS)
    path.write_bytes(blackbox(rows, BLACKBOX_NAMES, {**BLACKBOX_HEADERS, **headers}) * num_logs)


def _messages(content: bytes) -> list[tuple[bytes, bytes]]:
    """Return the messages of a ULog: kind and content."""
    found, at = [], ULOG_START
    while at + 3 <= len(content):
        (size,) = struct.unpack_from("<H", content, at)
        found.append((content[at + 2 : at + 3], content[at + 3 : at + 3 + size]))
        at += 3 + size
    return found


def _damage_message(rng: Rng, kind: bytes, content: bytes) -> bytes:
    """Return another content of a message."""
    way = rng.random()
    if kind == b"F" and way < 0.8:
        name = content.split(b":")[0].decode(errors="replace") if way < 0.6 else "other"
        field = str(rng.choice(FORMATS))
        return f"{name}:uint64_t timestamp;{field};".encode()
    if kind == b"P" and way < 0.8 and content:
        value = struct.pack("<f", float(rng.choice(FLOATS)))
        key = content[1 : 1 + content[0]] if way < 0.6 else b"char[4] MC_ACRO_R_MAX"
        return bytes([len(key) % 256]) + key + value
    if kind == b"D" and way < 0.8 and len(content) > 10:
        found = bytearray(content)
        if way < 0.3:
            found[2:10] = struct.pack("<Q", int(rng.choice(np.array(TIMES, np.uint64))))
        else:
            at = 10 + 4 * int(rng.integers(max((len(content) - 10) // 4, 1)))
            found[at : at + 4] = struct.pack("<f", float(rng.choice(FLOATS)))
        return bytes(found)
    return damage(rng, [content])


def damage_ulog(rng: Rng, contents: list[bytes]) -> bytes:
    """Return one of some ULogs with messages changed, left out, twice or in another order."""
    content = contents[int(rng.integers(len(contents)))]
    messages = _messages(content)
    kinds = sorted({kind for kind, _ in messages})
    for _ in range(int(rng.integers(1, 6))):
        wanted = kinds[int(rng.integers(len(kinds)))]
        at = int(rng.choice([at for at, (kind, _) in enumerate(messages) if kind == wanted] or [0]))
        kind, inner = messages[at]
        way = rng.random()
        if way < 0.7:
            count = 1 if rng.random() < 0.7 else 40  # some damage shows only where much of a topic has it
            same = [one for one in range(at, len(messages)) if messages[one][0] == kind][:count]
            for one in same:
                messages[one] = kind, _damage_message(rng, kind, messages[one][1])
        elif way < 0.8 and len(messages) > 1:
            del messages[at]
        elif way < 0.9:
            messages[at:at] = [messages[at]] * int(rng.choice([1, 3, 300]))
        else:
            messages[at] = bytes([int(rng.integers(256))]), inner
    return content[:ULOG_START] + b"".join(
        struct.pack("<H", len(inner) % 2**16) + kind + inner for kind, inner in messages
    )


def hostile_ulogs(content: bytes) -> list[bytes]:
    """Return small logs that say they hold much: fields of arrays of arrays, subscriptions without end."""
    start, attitude = content[:ULOG_START], b"vehicle_attitude"

    def formats(*texts: str) -> bytes:
        return start + b"".join(UlogWriter.message("F", text.encode()) for text in texts)

    def subscriptions(count: int) -> bytes:
        parts = (UlogWriter.message("A", struct.pack("<BH", 0, one) + attitude) for one in range(count))
        return b"".join(parts)

    nested = [
        f"{name}:{inner}[60000] q;" for name, inner in (("vehicle_attitude", "b"), ("b", "c"), ("c", "float"))
    ]
    return [
        formats(*nested) + subscriptions(1),
        formats("vehicle_attitude:vehicle_attitude[2] q;") + subscriptions(1),
        formats("vehicle_attitude:uint64_t timestamp;float[65535] q;") + subscriptions(3000),
        start + (b"\x00\xff\x00" * 2**17),  # each a message of 65280 bytes of no kind
    ]


LINE = re.compile(rb"^H ([^:\n]*):(.*)$", re.MULTILINE)


def damage_blackbox(rng: Rng, contents: list[bytes]) -> bytes:
    """Return one of some Betaflight logs with other values in its header, or damaged anyhow."""
    content = contents[int(rng.integers(len(contents)))]
    for _ in range(int(rng.integers(1, 4))):
        lines = list(LINE.finditer(content))
        if not lines:
            break
        line = lines[int(rng.integers(len(lines)))]
        name = line[1]
        values = NUMBERS if name.startswith(b"Field") else HEADERS
        values = FIELD_NAMES if name.endswith(b" name") else values
        text = str(values[int(rng.integers(len(values)))]).encode("latin-1")
        content = content[: line.start(2)] + text + content[line.end(2) :]
    if rng.random() < 0.2:
        extra = [
            b"H I interval:",
            b"H P interval:",
            b"H P ratio:",
            b"H Data version:",
            b"H Field P predictor:",
        ]
        text = str(rng.choice(HEADERS)).encode("latin-1")
        at = content.find(b"H Field I name")
        content = content[:at] + extra[int(rng.integers(len(extra)))] + text + b"\n" + content[at:]
    return damage(rng, [content]) if rng.random() < 0.3 else content


def hostile_blackboxes(content: bytes) -> list[bytes]:
    """Return small logs that take for ever to decode where nothing bounds it."""
    names = [*BLACKBOX_NAMES, *(f"x{number}" for number in range(4000))]
    headers = {
        **BLACKBOX_HEADERS,
        **{f"Field I {name}": ",".join(["0"] * len(names)) for name in ("signed", "predictor")},
        "Field I encoding": ",".join(["9"] * len(names)),  # which takes no bytes
    }
    wide = blackbox(np.zeros((0, len(names)), int), names, headers).removesuffix(b"E\xffEnd of log\x00")
    waiting = {"Field I predictor": ",".join(["6"] * len(BLACKBOX_NAMES)), "P interval": "0/32"}
    rows = np.tile(BLACKBOX_ROW, (NUM_ROWS, 1))
    return [
        wide + b"I" * 2**18 + b"E\xffEnd of log\x00",
        blackbox(rows, BLACKBOX_NAMES, {**BLACKBOX_HEADERS, **waiting}),
        content * 700,
    ]
