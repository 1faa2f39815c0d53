"""Crazyflie's binary logs on a micro SD card, as its firmware writes them.

All numbers are little-endian. A file has

- a byte 0xBC, the version and the number of event types (uint16 each);
- for each type its number (uint16), its name, its number of variables (uint16) and their names with
  a struct format, as in ``gyro.x(f)``; names end in a zero byte;
- records: number of the type, time (version 1: uint32, ms; version 2: uint64, us), values;
- a CRC-32.

Source: bitcraze/crazyflie-firmware, docs and tools/usdlog.
"""

import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flytrack_env.messages import error_text, quote_name
from flytrack_sysid.importing.flight import ImportedFlight, read_log_file
from flytrack_sysid.importing.mapping import Mapping
from flytrack_sysid.importing.table_flight import TIMESTAMP, build_flight
from flytrack_sysid.log import LogError
from flytrack_sysid.log_table import Table

MAX_BYTES = 2**27  # 40 min at 1 kHz with 50 bytes a record
FIRST_BYTE = b"\xbc"
NUM_HEADER_BYTES, NUM_CRC_BYTES = 5, 4
STAMPS = {1: ("<u4", 1e-3), 2: ("<u8", 1e-6)}  # by version: type and unit (s) of times
FORMATS = "bBhHiIqQefd"  # of ``struct``, one value each


class _Event(NamedTuple):
    """A type of event.

    Attributes:
        layout: of its records.
        starts: offsets of its records in the file.
    """

    layout: np.dtype
    starts: list[int]


def read_usd(path: Path, mapping: Mapping) -> ImportedFlight:
    """Return the flight in a uSD log, by a mapping of its variables; SI units and our frames.

    Raises:
        LogError: the file is no such log, or lacks a variable that the mapping names.
    """
    content = read_log_file(path, MAX_BYTES, FIRST_BYTE, "a Crazyflie uSD log")
    try:
        stamp_s, events, end = _header(content)
    except (struct.error, ValueError) as error:
        raise LogError(f"{path}: damaged header: {error_text(error)}") from error
    is_whole = struct.pack("<I", zlib.crc32(content[:-NUM_CRC_BYTES])) == content[-NUM_CRC_BYTES:]
    end = _find_records(content, end, len(content) - NUM_CRC_BYTES * is_whole, events)
    wanted = {column for channel in mapping.channels for column in channel.columns}
    topics = [_table(path, content, event, stamp_s, wanted) for event in events.values()]
    flight = build_flight(str(path), topics, mapping)
    if is_whole:
        return flight
    note = (
        f"{path}: damaged or cut off: the checksum is wrong; the first {end} of {len(content)} "
        "bytes are used"
    )
    return flight._replace(notes=(note, *flight.notes))


def _header(content: bytes) -> tuple[float, dict[int, _Event], int]:
    """Return the unit of times, s, the event types by number, and the offset of the records."""
    version, num_events = struct.unpack_from("<HH", content, 1)
    if version not in STAMPS:
        raise ValueError(f"found version {version}, expected one of {', '.join(map(str, STAMPS))}")
    stamp, stamp_s = STAMPS[version]
    offset, events = NUM_HEADER_BYTES, {}
    for _ in range(num_events):
        (number,) = struct.unpack_from("<H", content, offset)
        _, offset = _text(content, offset + 2)
        (num_variables,) = struct.unpack_from("<H", content, offset)
        offset += 2
        fields = [("", "<u2"), (TIMESTAMP, stamp)]
        for _ in range(num_variables):
            text, offset = _text(content, offset)
            name, kind = text[:-3], text[-2:-1]
            if text != f"{name}({kind})" or kind not in FORMATS or not kind:
                raise ValueError(f"found variable {quote_name(text)}, expected name(format)")
            fields.append((name, "<" + kind))
        events[number] = _Event(np.dtype(fields), [])
    return stamp_s, events, offset


def _text(content: bytes, offset: int) -> tuple[str, int]:
    """Return the text that begins at an offset, and the offset after it."""
    end = content.index(b"\0", offset)
    return content[offset:end].decode(), end + 1


def _find_records(content: bytes, offset: int, end: int, events: dict[int, _Event]) -> int:
    """Append the offset of each whole record to its event, and return the offset after the last."""
    sizes = {number: event.layout.itemsize for number, event in events.items()}
    while offset + 2 <= end:
        number = content[offset] | content[offset + 1] << 8
        size = sizes.get(number)
        if size is None or offset + size > end:
            break
        events[number].starts.append(offset)
        offset += size
    return offset


def _table(path: Path, content: bytes, event: _Event, stamp_s: float, wanted: set[str]) -> Table:
    """Return the wanted variables of an event's records, and their times, s."""
    size = event.layout.itemsize
    rows = np.frombuffer(content, np.uint8)[
        np.add.outer(np.array(event.starts, int), np.arange(size))
    ]
    records = rows.reshape(-1, size).view(event.layout)[:, 0]
    with np.errstate(invalid="ignore"):  # damaged numbers may be signalling NaNs
        columns = {
            name: records[name].astype(float) for name in event.layout.names or () if name in wanted
        }
    return Table(str(path), {**columns, TIMESTAMP: records[TIMESTAMP] * stamp_s})
