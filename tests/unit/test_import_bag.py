"""Bags of the libraries are read back: ROS 2 bags, MCAP files of ROS 2 messages and of JSON."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from flytrack_sysid import LogError, import_log
from tests.support.foreign_logs import save_messages
from tests.support.tables import table
from tests.support.written_logs import read_mapping

pytest.importorskip("mcap", reason="mcap is not installed: pip install 'flytrack[bags]'")
pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'flytrack[bags]'")
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

MAPPING = read_mapping("ros_topics")
KINDS = {
    "/sticks": ("sensor_msgs/msg/Joy", 20_000_000),
    "/twist": ("geometry_msgs/msg/TwistStamped", 5_000_000),
    "/pose": ("geometry_msgs/msg/PoseStamped", 10_000_000),
}
START_NS = 1_700_000_000 * 10**9
RECORDED_LATE_NS = 7_000_000  # the bag's own times; the stamps are right
TYPES = get_typestore(Stores.ROS2_HUMBLE)


def made(kind, *values):
    """Return a message, by the short name of its type."""
    (message_type,) = (TYPES.types[name] for name in TYPES.types if name.endswith(f"/{kind}"))
    return message_type(*values)


def motion(time):
    """Return a roll from side to side."""
    return Rotation.from_rotvec(np.multiply.outer(0.5 * np.sin(time), [1.0, 0.0, 0.0]))


def messages():
    """Return stamp, ns, topic and message at 50, 200 and 100 Hz over 2 s, in order of time."""
    stamped = []
    for topic, (kind, step_ns) in KINDS.items():
        for stamp_ns in range(START_NS, START_NS + 2 * 10**9, step_ns):
            time = (stamp_ns - START_NS) * 1e-9
            zero = made("Vector3", 0.0, 0.0, 0.0)
            if topic == "/sticks":
                axes = np.array([np.sin(time), 0.0, 0.0, 0.5], np.float32)
                content = (axes, np.zeros(0, np.int32))
            elif topic == "/twist":
                content = (made("Twist", zero, made("Vector3", 0.5 * np.cos(time), 0.0, 0.0)),)
            else:
                attitude = made("Quaternion", *motion(time).as_quat())
                content = (made("Pose", made("Point", time, 0.0, 1.0), attitude),)
            header = made("Header", made("Time", *divmod(stamp_ns, 10**9)), "")
            message = made(kind.rpartition("/")[2], header, *content)
            stamped.append((stamp_ns, topic, message))
    return sorted(stamped, key=lambda entry: entry[0])


def write_ros2(folder, storage, is_compressed=False):
    """Write a bag of ROS 2."""
    unopened = Writer(folder / "bag", version=9, storage_plugin=StoragePlugin[storage])
    if is_compressed:
        unopened.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with unopened as writer:
        topics = {
            topic: writer.add_connection(topic, kind, typestore=TYPES)
            for topic, (kind, _) in KINDS.items()
        }
        for stamp_ns, topic, message in messages():
            data = TYPES.serialize_cdr(message, KINDS[topic][0])
            writer.write(topics[topic], stamp_ns + RECORDED_LATE_NS, data)
    return folder / "bag"


def write_json(folder):
    """Write an MCAP file of JSON, without stamps."""
    contents = []
    for stamp_ns, topic, message in messages():
        contents.append((topic, stamp_ns, {**dataclasses.asdict(message), "header": None}))
    save_messages(folder / "flight.mcap", contents)
    return folder / "flight.mcap"


WRITERS = {
    "ROS 2, SQLite": lambda folder: write_ros2(folder, "SQLITE3"),
    "ROS 2, MCAP": lambda folder: write_ros2(folder, "MCAP"),
    "MCAP of ROS 2": lambda folder: next(write_ros2(folder, "MCAP").glob("*.mcap")),
    "MCAP of JSON": write_json,
}


@pytest.fixture
def mapping(tmp_path):
    """Return the path of the mapping."""
    (tmp_path / "map.toml").write_text(MAPPING)
    return tmp_path / "map.toml"


def test_the_command_named_for_a_bag_compressed_as_a_whole_makes_it_readable(tmp_path, mapping):
    write_ros2(tmp_path, "SQLITE3", is_compressed=True)
    with pytest.raises(LogError, match=r"bag: compressed as a whole, .*: rosbags-convert") as error:
        import_log(tmp_path / "bag", "bag", mapping)
    program, *arguments = str(error.value).rpartition("first: ")[2].split()
    subprocess.run([Path(sys.executable).with_name(program), *arguments], check=True)
    assert len(import_log(tmp_path / "bag_plain", "bag", mapping).log) >= 390


@pytest.mark.parametrize("kind", WRITERS)
def test_what_was_written_is_read_back(tmp_path, mapping, kind):
    imported = import_log(WRITERS[kind](tmp_path), "bag", mapping, align=False)
    log, time = imported.log, imported.log.time
    assert len(log) >= 390
    assert np.diff(time) == pytest.approx(0.005, abs=1e-6)  # the rates' own rows
    assert_allclose(log["w"][:, 0], 0.5 * np.cos(time), atol=1e-6)
    assert_allclose(log["p"][:, 0], time, atol=1e-6)  # interpolated
    attitude = Rotation.from_quat(log["q"], scalar_first=True)
    assert (attitude.inv() * motion(time)).magnitude().max() < 1e-4
    held = np.sin(np.floor(time / 0.02 + 1e-6) * 0.02)
    assert_allclose(log["u"][:, 0], held, atol=1e-6)
    assert log["u"][:, 3] == pytest.approx(0.5)
    is_noted = "times are those of their recording" in " ".join(imported.notes)
    assert is_noted == (kind == "MCAP of JSON")


@pytest.mark.parametrize(("old", "new", "message"), table("bags")["refused"])
def test_what_lacks_a_topic_or_a_field_is_refused(tmp_path, mapping, old, new, message):
    mapping.write_text(MAPPING.replace(old, new, 1))
    with pytest.raises(LogError, match=message):
        import_log(write_json(tmp_path), "bag", mapping)


def test_topics_of_other_epochs_are_put_together_by_their_recording(tmp_path, mapping):
    """The pose counts from the boot of its sensor; the recorder has one clock for all."""
    boot_ns = START_NS - 77 * 10**9
    contents = []
    for stamp_ns, topic, message in messages():
        sec, nanosec = divmod(stamp_ns - boot_ns * (topic == "/pose"), 10**9)
        header = {"stamp": {"sec": sec, "nanosec": nanosec}}
        content = {**dataclasses.asdict(message), "header": header}
        contents.append((topic, stamp_ns + RECORDED_LATE_NS, content))
    save_messages(tmp_path / "flight.mcap", contents)
    imported = import_log(tmp_path / "flight.mcap", "bag", mapping, align=False)
    position_m = imported.log["p"][:, 0]  # 1 m/s
    assert position_m[0] < 0.0051  # the rounding of 77 s may cost the first row
    assert_allclose(position_m - position_m[0], imported.log.time, atol=1e-5)
    note = f"stamps of q are {START_NS * 1e-9 - 77:+.6g} s before those of w"
    assert note in " ".join(imported.notes)
