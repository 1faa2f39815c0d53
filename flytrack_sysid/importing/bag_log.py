"""Bags of topics: MCAP files, bags of ROS 2 and ROS 1, read by mcap and rosbags.

A mapping names the fields. A column is a topic and a field of its messages, as in
``/imu/data:angular_velocity.x`` or ``/rc:channels[0]``.
"""

from pathlib import Path

from flytrack_env.messages import quote_name
from flytrack_sysid.importing.decoding import decode
from flytrack_sysid.importing.file_kinds import UNKNOWN, ZSTD, check_kind
from flytrack_sysid.importing.flight import ImportedFlight, list_names
from flytrack_sysid.importing.mapping import Mapping
from flytrack_sysid.importing.table_flight import RECORDED, TIMESTAMP, build_flight
from flytrack_sysid.log import LogError
from flytrack_sysid.log_table import Table

MAX_BYTES = 2**30


def read_bag(path: Path, mapping: Mapping) -> ImportedFlight:
    """Return the flight in a bag, by a mapping of its topics' fields; SI units and our frames.

    The times of messages are those in their headers, else those of their recording.

    Raises:
        LogError: the file is no bag, or lacks a topic or a field that the mapping names.
    """
    wanted: dict[str, list[str]] = {}
    for channel in mapping.channels:
        for column in channel.columns:
            topic, colon, field = column.rpartition(":")
            if not colon or not topic or not field:
                expected = "expected topic:field, as in /imu:angular_velocity.x"
                raise LogError(
                    f"{mapping.source}: {channel.table}: found {quote_name(column)}, {expected}"
                )
            wanted.setdefault(topic, []).append(field)
    if not path.exists():
        raise LogError(f"{path}: cannot be read: no such file or folder")
    if not (path.is_file() or path.is_dir()) or (
        path.is_file() and path.stat().st_size > MAX_BYTES
    ):
        raise LogError(
            f"{path}: cannot be read: expected a folder, or a file of at most {MAX_BYTES} bytes"
        )
    if path.is_file():
        check_kind(
            path, "bag", "an MCAP file, a ROS 1 bag or the folder of a ROS 2 bag", (UNKNOWN, ZSTD)
        )
    notes, arrays = decode(path, "bag", wanted)
    for topic, field, kind in notes["missing"]:
        where = f"{path}: topic {quote_name(topic)}: field {quote_name(field)}"
        raise LogError(f"{where}: not a number in messages of type {quote_name(kind)}")
    names = [topic["topic"] for topic in notes["found"]]
    for topic in wanted:
        if topic not in names:
            listed = list_names(notes["topics"]) or "no topics"
            raise LogError(f"{path}: topic {quote_name(topic)}: no messages; found {listed}")
    topics, remarks = [], []
    for entry, rows in zip(notes["found"], arrays, strict=True):
        columns = [TIMESTAMP, RECORDED, *(f"{entry['topic']}:{field}" for field in entry["fields"])]
        topics.append(Table(str(path), dict(zip(columns, rows.T, strict=True))))
        if not entry["is_stamped"]:
            name = quote_name(entry["topic"])
            remarks.append(
                f"{path}: topic {name}: no stamps in its messages: times are those of their "
                "recording"
            )
    flight = build_flight(str(path), topics, mapping)
    return flight._replace(notes=(*remarks, *flight.notes))
