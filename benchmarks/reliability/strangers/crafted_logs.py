"""Logs of others that are made to harm: compressed CSV, PX4's, Betaflight's."""

import gzip
import struct
from collections.abc import Iterable

import numpy as np

from benchmarks.reliability.strangers.flight_logs import (
    BLACKBOX_NAMES,
    BLACKBOX_ROW,
    ULOG_START,
    hostile_blackboxes,
    hostile_ulogs,
)
from benchmarks.reliability.strangers.log_writers import BLACKBOX_HEADERS, UlogWriter, blackbox

GZIP = (
    b"\x1f\x8b\x08%c" + bytes(5) + b"\xff"
)  # its flags: 2 checksum of the head, 4 extra, 8 name, 16 comment
EMPTY = gzip.compress(b"", mtime=0)
END_OF_LOG = b"E\xffEnd of log\x00"
LONG, MANY = 2**18, 2**14
DAY_US = 86_400_000_000
message = UlogWriter.message


def packed_csvs(contents: list[bytes]) -> list[bytes]:
    """Return compressed files of very many members, of long heads, and of sizes and sums that lie."""
    whole, text = contents[0], gzip.decompress(contents[0])
    header = text.split(b"\n")[0] + b"\n"
    row = b",".join([b"0"] * (header.count(b",") + 1)) + b"\n"
    texts = [header + b"\n" * 2**26, header + row * 2**22, b"x" * 2**26, header + b'"' + b"\n" * 2**24]
    texts += [header + b'"1\n",' * 2**21, header + b"\r" * 2**24, b"\x00" * 2**24]
    bytewise = [b"\n".join(text.split(b"\n")[:number]) for number in range(3)]
    return [
        *(gzip.compress(one, 6, mtime=0) for one in (*texts, *bytewise)),
        EMPTY * 500_000 + whole,
        whole + EMPTY * 500_000,
        b"".join(gzip.compress(bytes([one]), mtime=0) for one in text * 40),
        *(GZIP % flags + b"x" * 2**23 for flags in (8, 16, 24)),
        *(GZIP % flags + b"x" * 2**23 + b"\0" + whole[10:] for flags in (8, 16)),
        GZIP % 4 + b"\xff\xff" + bytes(2**16 - 1) + whole[10:],
        GZIP % 2 + b"\0\0" + whole[10:],
        GZIP % 224 + whole[10:],
        whole + bytes(2**23),
        whole + bytes(2**23) + b"x",
        bytes(2**23) + whole,
        whole[:-4] + b"\xff" * 4,
        whole[:-8] + bytes(8),
        GZIP % 0 + b"\x00\x00\x00\xff\xff" * 2**20,  # blocks of nothing
        GZIP % 0 + b"\x02\x00" * 2**20,
        gzip.compress(gzip.compress(bytes(2**26), 9, mtime=0), 9, mtime=0),
        text,
    ]


def _flags(compatible: int = 0, incompatible: int = 0, offsets: Iterable[int] = (0, 0, 0)) -> bytes:
    return message(
        "B", bytes([compatible]) + bytes(7) + bytes([incompatible]) + bytes(7) + struct.pack("<3Q", *offsets)
    )


def _subscribed(name: bytes, number: int = 0, instance: int = 0) -> bytes:
    return message("A", struct.pack("<BH", instance, number) + name)


def _info(kind: str, key: str, value: bytes, *before: int) -> bytes:
    return message(kind, bytes(before) + UlogWriter.key(key) + value)


def _data(form: str, *values: float, number: int = 0) -> bytes:
    return message("D", struct.pack("<H", number) + struct.pack("<" + form, *values))


def _odd_messages() -> list[bytes]:
    """Return messages that are odd by their number, size or kind."""
    return [
        b"".join(message("F", f"f{one}:uint64_t timestamp;f{one + 1} x;".encode()) for one in range(3000)),
        b"".join(message("F", f"f{one}:f{one + 1}[99] x;f{one + 1}[99] y;".encode()) for one in range(30))
        + _subscribed(b"f0"),
        b"".join(message("F", b"vehicle_attitude:" + b"uint8_t a%d;" % one) for one in range(MANY)),
        message(
            "F",
            b"vehicle_attitude:uint64_t timestamp;" + b"".join(b"float x%d;" % one for one in range(5000)),
        )
        + _subscribed(b"vehicle_attitude"),
        message("F", b"a:a a;") + _subscribed(b"a"),
        message("F", b"a:b x;") + message("F", b"b:a x;") + _subscribed(b"a"),
        b"".join(_subscribed(b"vehicle_attitude", one, one % 256) for one in range(MANY)),
        b"".join(_subscribed(b"vehicle_attitude", 0, one % 256) for one in range(MANY)),
        b"\x00\x00D" * MANY,
        b"\xff\xffD" + bytes(2**16 - 1),
        b"\x00\x00\x00" * MANY,
        (b"\xff\xff\xfe" + b"\x00") * MANY,
        b"\x2f\x73\x13\x20\x25\x0c\xbb\x12" * MANY,
        message("S", b"\x2f\x73\x13\x20\x25\x0c\xbb\x12") * MANY,
        message("O", b"\xff\xff") * LONG,
        message("L", b"7" + bytes(8) + b"x" * 9000) * 90,
        b"".join(_info("P", f"float P{one}", bytes(4)) for one in range(MANY)),
        _info("P", "char[60000] MC_ACRO_R_MAX", b"x" * 60_000) * 15,
        _info("I", "char[65000] sys", b"x" * 65_000) * 15,
        b"".join(_info("M", "char[60] m", b"x" * 60, one % 2) for one in range(MANY)),
        _info("Q", "float MC_ACRO_R_MAX", bytes(4), 255) * MANY,
        _info("P", "float MC_ACRO_R_MAX", struct.pack("<f", 1e-45)),
        _info("P", "int32_t MC_ACRO_R_MAX", b"\xff" * 4),
        message("X", bytes(9)) * MANY,
        message("I", b"\xff" + b"\xff" * 255),
    ]


def _attitudes(rows: list[tuple[int, tuple[float, ...]]]) -> bytes:
    return b"".join(_data("Q4f", at, *quat, number=2) for at, quat in rows)


def ulogs(contents: list[bytes]) -> list[bytes]:
    """Return PX4 logs of odd messages before and behind what is well, and of flags that lie."""
    content = contents[-1]  # whose topics are rates, attitudes (their numbers: 0, 1) and setpoints
    start, body = content[:ULOG_START], content[ULOG_START:]
    rest = body[3 + struct.unpack_from("<H", body)[0] :]
    found = hostile_ulogs(contents[0])
    for odd in _odd_messages():
        found += [start + odd + body, content + odd]
    here = len(content)
    circles = [
        (0, 0, 0),
        (16, 16, 16),
        (here, here, here),
        (here - 20, 16, 2**63),
        (2**64 - 1,) * 3,
        (1, 2, 3),
    ]
    found += [start + _flags(0, 1, offsets) + rest for offsets in circles]
    found += [start + _flags(1, one) + rest for one in (0, 2, 255)]
    instance = body.replace(b"A\x00\x00\x00", b"A\x07\x00\x00", 1)
    found += [start + instance, content + body * 20, content[:-1], start, start + rest, start[:8]]
    return [*found, *_odd_times(content)]


def _odd_times(content: bytes) -> list[bytes]:
    """Return a log with more rates and attitudes: days apart, of zero, of no number, all at once."""
    quats = {"days": (1.0, 0.0, 0.0, 0.0), "zero": (0.0,) * 4, "none": (np.nan,) * 4, "large": (1e38,) * 4}
    later = [(one + 1) * DAY_US for one in range(300)]
    found = []
    for quat in quats.values():
        rows = b"".join(_data("Q3f", at, 0.1, 0.2, 0.3) + _data("Q4f", at, *quat, number=1) for at in later)
        found.append(content + rows)
    ends = [2**63, 2**64 - 1, 0]
    return [
        *found,
        *(content + _data("Q3f", at, 0.1, 0.2, 0.3) + _data("Q4f", at, 1, 0, 0, 0, number=1) for at in ends),
    ]


HEADERS: tuple[dict[str, str], ...] = (
    {"Field I predictor": ",".join(["99"] * len(BLACKBOX_NAMES))},
    *({"Field I predictor": ",".join([str(one)] * len(BLACKBOX_NAMES))} for one in range(12)),
    *({"Field I encoding": ",".join([str(one)] * len(BLACKBOX_NAMES))} for one in (2, 3, 4, 6, 7, 8, 9, 999)),
    {"Field I encoding": "9"},
    {"Field I encoding": "a,b"},
    {"Field I signed": "1" * 5000},
    {"Field I predictor": "0," * 5000},
    {"Field I name": "x" * 60_000},
    {"Field I name": ",".join(["time"] * 5000)},
    {"Field I name": ",".join([*BLACKBOX_NAMES[:-1], "x" * 9000])},
    {"Field P predictor": "6,2,0", "Field P encoding": "9,0,0"},
    {"Field P predictor": ",".join("6" * 13), "Field P encoding": ",".join("9" * 13)},
    {"Field S name": "a", "Field S signed": "0", "Field S predictor": "0", "Field S encoding": "9"},
    {"Field S name": ",".join("ab" * 4000), "Field S encoding": ",".join("99" * 4000)},
    {"Field G name": "time,GPS_coord[0],GPS_coord[1]", "Field G predictor": "7,7,7"},
    {"Field G name": "a,GPS_coord[0],GPS_coord[1]", "Field G encoding": "9,9,9"},
    {"Data version": "1", "Field I encoding": ",".join(["8"] * len(BLACKBOX_NAMES))},
    {"Data version": "x" * 9000},
    {"I interval": "0"},
    {"I interval": "-1", "P interval": "0/0"},
    {"P interval": "1/99999999999"},
    {"P ratio": "0"},
    {"looptime": "0", "minthrottle": "x", "motorOutput": "9" * 4000, "vbatref": "nan"},
    {"acc_1G": "1e-300"},
    {"acc_1G": "5e-324", "rc_rates": "1,1,1"},
    {"rc_rates": "1e-300,1e-300,1e-300", "rates_type": "3"},
    {"rc_rates": "1e9,1e9,1e9"},
    {"rates_type": "4", "rates": "99999999,99999999,99999999"},
    {"vbatcellvoltage": "0,0,0"},
    {"Firmware revision": "Betaflight " + "x" * 60_000},
    {"x" * 60_000: "1"},
    {"x1": ",".join(["1"] * 60_000)},
)  # fmt: skip


def blackboxes(contents: list[bytes]) -> list[bytes]:
    """Return Betaflight logs whose headers lie, which repeat, or are many in a file."""
    content = contents[0]
    rows = np.tile(BLACKBOX_ROW, (30, 1))
    rows[:, 0], rows[:, 1] = np.arange(30), 5_000_000 + 10_000 * np.arange(30)
    found = [blackbox(rows, BLACKBOX_NAMES, {**BLACKBOX_HEADERS, **one}) for one in HEADERS]
    lines = content.split(b"\n")[:-1]
    head = b"\n".join(lines) + b"\n"
    first, frames = lines[0] + b"\n", content[len(head) :]
    line = b"H Field I predictor:" + b",".join([b"0"] * len(BLACKBOX_NAMES)) + b"\n"
    found += [head + line * 5000 + frames]
    found += [b"".join([head, *(b"H x%d:1\n" % one for one in range(MANY)), frames])]
    found += [first * MANY + END_OF_LOG, (first + END_OF_LOG) * MANY, content * 300, first + END_OF_LOG]
    found += [head + b"H" + b"x" * LONG, head + b"x" * LONG + END_OF_LOG, head + b"\n" * LONG + END_OF_LOG]
    found += [
        head + one * LONG + END_OF_LOG
        for one in (b"E", b"E\x0f", b"S", b"P", b"I", b"G", b"H", b"E\x00", b"E\x0e")
    ]
    found += [head + frames[: len(frames) // 2] + b"\xff" * LONG + END_OF_LOG]
    found += [
        head + b"I" + b"\xff" * LONG + END_OF_LOG,
        head + frames.replace(END_OF_LOG, b"") * 300 + END_OF_LOG,
    ]
    return [*hostile_blackboxes(content), *found]
