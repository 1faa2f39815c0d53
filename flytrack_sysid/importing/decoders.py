"""Decoders of other programs' logs: pyulog, orangebox, pymavlink, mcap, rosbags, run by a sandbox.

A small file can make some of these packages run forever or exhaust the memory (an interval of 0;
arrays of arrays). The sandbox imports this file alone, so it imports nothing of this package. A
decoder takes its arguments, the path first, and returns an ``.npz`` of notes (JSON) and arrays.
"""

import io
import json
import logging
import math
import re
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ULOG_HEADER_BYTES = 3  # each message begins with its size and type
DATAFLASH_MESSAGE = b"\xa3\x95"  # each message begins with these bytes
INSTANCES = (
    "I",
    "C",
    "Instance",
    "Inst",
)  # fields of ArduPilot that number sensors, estimators, batteries
MAX_TEXTS = 1000  # text messages; the first ones name the firmware
WHOLE_FILE_COMPRESSION = re.compile(
    r"^\s*compression_mode:\s*[\"']?FILE\b", re.IGNORECASE | re.MULTILINE
)
MAIN_FRAME = "I"  # frame type of Betaflight whose fields the other types repeat


def _pack(notes: Any, arrays: list[np.ndarray]) -> bytes:
    content = io.BytesIO()
    np.savez(
        content, np.frombuffer(json.dumps(notes).encode(), np.uint8), *arrays, allow_pickle=False
    )
    return content.getvalue()


def decode_ulog(arguments: Any, _: bytes) -> bytes:
    """Return fields of a PX4 log's topics, of all their instances.

    Args:
        arguments: path, and the wanted fields by topic.

    Returns:
        Notes: ``fields``: topic, instance and field of each array; ``parameters``: finite numbers
            by name; ``is_damaged``; ``is_cut_off``.
        Arrays: float64, (num_rows,) each.
    """
    import pyulog

    path, wanted = arguments
    with open(path, "rb") as file:
        reads = _CountedReads(file)
        ulog = pyulog.ULog(reads, list(wanted))
    columns = {
        (data.name, int(data.multi_id), field): data.data[field].astype(float)
        for data in sorted(ulog.data_list, key=lambda data: data.multi_id)
        for field in wanted.get(data.name, ())
        if field in data.data
    }
    parameters = {
        name: value
        for name, value in ulog.initial_parameters.items()
        if isinstance(value, (int, float)) and math.isfinite(value)
    }
    notes = {
        "fields": list(columns),
        "parameters": parameters,
        "is_damaged": bool(ulog.file_corruption),
        "is_cut_off": reads.is_cut_off,
    }
    return _pack(notes, list(columns.values()))


class _CountedReads:
    """A binary file that records whether a read met the end of the file, unlike pyulog."""

    def __init__(self, file: Any):
        self.file, self.is_cut_off = file, False

    def read(self, size: int) -> bytes:
        """Return the next bytes; fewer at the end of the file."""
        data: bytes = self.file.read(size)
        is_header = size == ULOG_HEADER_BYTES  # a whole log ends where a header would begin
        self.is_cut_off |= len(data) < size and not (is_header and not data)
        return data

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)


def decode_betaflight(arguments: Any, _: bytes) -> bytes:
    """Return the main frames of a blackbox file's logs.

    Args:
        arguments: path, numbers of the logs, from 1, and numbers of those that are cut off: these
            end where no whole frame can be decoded.

    Returns:
        Notes, of each log: ``headers``; ``names`` of the fields; ``num_undecoded``: number of
            frames before the first full one, which are changes from a lost frame;
            ``num_bytes_left``: number of bytes after the last whole frame of a log that is cut off.
        Arrays: (num_frames, num_fields) float64, one for each log.
    """
    import orangebox

    path, numbers, cut_off = arguments
    logging.getLogger("orangebox").setLevel(logging.CRITICAL)  # it warns of unknown events
    notes, arrays = [], []
    for number in numbers:
        parser = orangebox.Parser.load(path, number)
        main = next(
            fields for kind, fields in parser.reader.field_defs.items() if kind.value == MAIN_FRAME
        )
        names = [str(field.name) for field in main]
        values, num_undecoded, end = array("d"), 0, 0
        for frame in _whole_frames(parser, number in cut_off):
            end = parser.reader.tell() if number in cut_off else 0
            if not values and frame.type.value != MAIN_FRAME:
                num_undecoded += 1
                continue
            if len(frame.data) < len(names):
                raise ValueError(
                    f"found a frame of {len(frame.data)} fields, expected {len(names)}"
                )
            values.extend(frame.data[: len(names)])
        num_left = parser.reader.tell() - end if number in cut_off else 0
        counts = {"num_undecoded": num_undecoded, "num_bytes_left": num_left}
        notes.append({"headers": parser.headers, "names": names, **counts})
        arrays.append(np.array(values, float).reshape(-1, len(names)))
    return _pack(notes, arrays)


def decode_dataflash(arguments: Any, _: bytes) -> bytes:
    """Return fields of the messages of an ArduPilot log.

    Args:
        arguments: path, and the wanted fields by message.

    Returns:
        Notes: ``found``: for each array, the ``name`` of the message, its ``instance`` (0 without
            one) and its ``fields``; ``parameters``: their first values; ``texts``; ``is_cut_off``:
            the last message is not whole.
        Arrays: (num_messages, num_fields) float64, one for each instance of each message.
    """
    from pymavlink.DFReader import DFReader_binary

    path, wanted = arguments
    reader = DFReader_binary(path)
    parameters: dict[str, float] = {}
    texts: list[str] = []
    fields: dict[str, list[str]] = {}
    values: dict[tuple[str, int], array[float]] = {}
    while (message := reader.recv_match(type=[*wanted, "PARM", "MSG"])) is not None:
        name = message.get_type()
        if name == "PARM" and math.isfinite(message.Value):
            parameters.setdefault(message.Name, float(message.Value))
        elif name == "MSG" and len(texts) < MAX_TEXTS:
            texts.append(message.Message)
        if name not in wanted:
            continue
        columns = message.get_fieldnames()
        if name not in fields:
            fields[name] = [field for field in wanted[name] if field in columns]
        instance = next(
            (int(getattr(message, field)) for field in INSTANCES if field in columns), 0
        )
        values.setdefault((name, instance), array("d")).extend(
            float(getattr(message, field)) for field in fields[name]
        )
    instances = [
        {"name": name, "instance": instance, "fields": fields[name]} for name, instance in values
    ]
    arrays = [
        np.array(rows, float).reshape(-1, len(fields[name])) for (name, _), rows in values.items()
    ]
    ends = [
        offsets[-1] + reader.formats[kind].len
        for kind, offsets in enumerate(reader.offsets)
        if len(offsets)
    ]
    end = max(ends, default=0)
    # Flash memory is padded after the last message, but not with the beginning of another message.
    is_cut_off = end > reader.data_len or reader.data_map[end : end + 2] == DATAFLASH_MESSAGE
    notes = {"found": instances, "parameters": parameters, "texts": texts, "is_cut_off": is_cut_off}
    return _pack(notes, arrays)


def _whole_frames(parser: Any, is_cut_off: bool) -> Iterator[Any]:
    """Yield the frames of a blackbox log; only the whole frames of a log that is cut off."""
    try:
        yield from parser.frames()
    except (TypeError, IndexError, ValueError, OverflowError):  # raised at the end of the bytes
        if not is_cut_off:
            raise


def decode_bag(arguments: Any, _: bytes) -> bytes:
    """Return fields of a bag's topics: a folder of ROS 2, a ``.bag`` of ROS 1, an ``.mcap`` file.

    Args:
        arguments: path, and the wanted fields by topic, as in ``pose.position.x`` or ``axes[0]``.

    Returns:
        Notes: ``topics``: all topics of the bag; ``found``: for each array, its ``topic``, its
            ``fields``, and whether the sender stamps messages (``is_stamped``); ``missing``: absent
            fields, as [topic, field, type of the messages].
        Arrays: (num_messages, 2 + num_fields) float64, one for each topic: time and time of
            recording, s from 1 s before the first recording, and the fields. The time is NaN for
            single messages without a stamp.
    """
    path, wanted = arguments
    messages = _mcap_messages if Path(path).suffix == ".mcap" else _bag_messages
    topics: set[str] = set()
    missing: list[list[str]] = []
    fields: dict[str, list[str]] = {}
    is_stamped: dict[str, bool] = {}
    values: dict[str, array[float]] = {}
    first_ns = None
    for topic, kind, time_ns, message in messages(path, list(wanted)):
        topics.add(topic)
        if message is None:
            continue
        if topic not in fields:
            values[topic], is_stamped[topic] = array("d"), False
            fields[topic] = [field for field in wanted[topic] if _is_number(message, field)]
            missing += [
                [topic, field, kind] for field in wanted[topic] if field not in fields[topic]
            ]
        stamp_ns = _stamp_ns(message)
        is_stamped[topic] |= stamp_ns > 0
        first_ns = time_ns - 10**9 if first_ns is None else first_ns  # a time of 0 means "not set"
        stamp_s = (stamp_ns - first_ns) * 1e-9 if stamp_ns > 0 else math.nan
        values[topic].extend((stamp_s, (time_ns - first_ns) * 1e-9))
        values[topic].extend(float(_part(message, field)) for field in fields[topic])
    found_topics = [
        {"topic": name, "fields": fields[name], "is_stamped": is_stamped[name]} for name in fields
    ]
    arrays = [np.array(values[name], float).reshape(-1, 2 + len(fields[name])) for name in fields]
    for name, rows in zip(fields, arrays, strict=True):
        if not is_stamped[name]:
            rows[:, 0] = rows[:, 1]
    return _pack({"topics": sorted(topics), "found": found_topics, "missing": missing}, arrays)


class UnsupportedError(Exception):
    """A whole file of a kind that is not read; the message says what helps."""


def _bag_messages(path: str, wanted: list[str]) -> Iterator[tuple[str, str, int, Any]]:
    """Yield topic, type, recording time (ns) and content; None as content of unwanted topics."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    metadata = Path(path) / "metadata.yaml"
    if metadata.is_file() and WHOLE_FILE_COMPRESSION.search(metadata.read_text(errors="replace")):
        convert = f"rosbags-convert --src {path} --dst {path}_plain"
        raise UnsupportedError(f"compressed as a whole, which is not read; first: {convert}")
    with AnyReader([Path(path)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        yield from ((topic, "", 0, None) for topic in reader.topics)
        connections = [
            connection for connection in reader.connections if connection.topic in wanted
        ]
        if connections:  # an empty list would mean all
            for connection, time_ns, raw in reader.messages(connections):
                message = reader.deserialize(raw, connection.msgtype)
                yield connection.topic, connection.msgtype, time_ns, message


def _mcap_messages(path: str, wanted: list[str]) -> Iterator[tuple[str, str, int, Any]]:
    """Yield the same as ``_bag_messages`` of an MCAP file, whose messages are of ROS 2 or JSON."""
    from mcap.reader import NonSeekingReader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.EMPTY)
    known_schemas: set[int] = set()
    with open(path, "rb") as file:
        for schema, channel, message in NonSeekingReader(file).iter_messages():
            if channel.topic not in wanted:
                yield channel.topic, "", 0, None
                continue
            kind = schema.name if schema else "no type"
            if channel.message_encoding == "json":
                content = json.loads(message.data)
            elif channel.message_encoding == "cdr" and schema and schema.encoding == "ros2msg":
                if schema.id not in known_schemas:
                    known_schemas.add(schema.id)
                    schemas = get_types_from_msg(schema.data.decode(), kind)
                    types.register(
                        {
                            name: fielddefs
                            for name, fielddefs in schemas.items()
                            if name not in types.fielddefs
                        }
                    )
                content = types.deserialize_cdr(message.data, kind)
            else:
                encodings = (
                    f"{channel.message_encoding} of {schema.encoding if schema else 'no schema'}"
                )
                raise ValueError(
                    f"topic {channel.topic}: found {encodings}, expected cdr of ros2msg, or json"
                )
            yield channel.topic, kind, message.log_time, content


def _part(message: Any, field: str) -> Any:
    """Return a part of a message; raises an error where it has none of that name."""
    for name in field.replace("]", "").replace("[", ".").split("."):
        if name.isdecimal():
            message = message[int(name)]
        else:
            message = message[name] if isinstance(message, dict) else getattr(message, name)
    return message


def _is_number(message: Any, field: str) -> bool:
    try:
        float(_part(message, field))
    except (AttributeError, KeyError, IndexError, TypeError, ValueError):
        return False
    return True


def _stamp_ns(message: Any) -> int:
    """Return the time at which the sender stamped a message, ns; 0 without a stamp."""
    for name in ("nanosec", "nsec"):
        if _is_number(message, f"header.stamp.{name}"):
            return int(_part(message, "header.stamp.sec")) * 10**9 + int(
                _part(message, f"header.stamp.{name}")
            )
    return 0
