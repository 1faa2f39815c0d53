"""Bags of the libraries are read back: ROS 2 bags, MCAP files of ROS 2 messages and of JSON."""

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_sysid import LogError, import_log
from tests.support.foreign_logs import save_messages
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


def made(kind: str, *values: Any) -> Any:
    """Return a message, by the short name of its type."""
    return next(one for name, one in TYPES.types.items() if name.endswith(f"/{kind}"))(*values)


def motion(time: Any) -> Rotation:
    """Return a roll from side to side."""
    return Rotation.from_rotvec(np.multiply.outer(0.5 * np.sin(time), [1.0, 0.0, 0.0]))


def messages() -> list[tuple[int, str, Any]]:
    """Return stamp, ns, topic and message at 50, 200 and 100 Hz over 5 s, in order of time."""
    found = []
    for topic, (_, step_ns) in KINDS.items():
        for stamp_ns in range(START_NS, START_NS + 5 * 10**9, step_ns):
            time = (stamp_ns - START_NS) * 1e-9
            header = made("Header", made("Time", *divmod(stamp_ns, 10**9)), "")
            if topic == "/sticks":
                axes = np.array([np.sin(time), 0.0, 0.0, 0.5], np.float32)
                message = made("Joy", header, axes, np.zeros(0, np.int32))
            elif topic == "/twist":
                turn = made("Vector3", 0.5 * np.cos(time), 0.0, 0.0)
                message = made(
                    "TwistStamped", header, made("Twist", made("Vector3", 0.0, 0.0, 0.0), turn)
                )
            else:
                place = made("Point", time, 0.0, 1.0)
                attitude = made("Quaternion", *motion(time).as_quat())
                message = made("PoseStamped", header, made("Pose", place, attitude))
            found.append((stamp_ns, topic, message))
    return sorted(found, key=lambda one: one[0])


def write_ros2(folder: Path, storage: str) -> Path:
    """Write a bag of ROS 2."""
    with Writer(folder / "bag", version=9, storage_plugin=StoragePlugin[storage]) as writer:
        topics = {
            topic: writer.add_connection(topic, kind, typestore=TYPES)
            for topic, (kind, _) in KINDS.items()
        }
        for stamp_ns, topic, message in messages():
            data = TYPES.serialize_cdr(message, KINDS[topic][0])
            writer.write(topics[topic], stamp_ns + RECORDED_LATE_NS, data)
    return folder / "bag"


def write_json(folder: Path) -> Path:
    """Write an MCAP file of JSON, without stamps."""
    contents = (
        (topic, stamp_ns, dataclasses.asdict(message)) for stamp_ns, topic, message in messages()
    )
    unstamped = ((topic, at, {**content, "header": None}) for topic, at, content in contents)
    save_messages(folder / "flight.mcap", unstamped)
    return folder / "flight.mcap"


WRITERS = {
    "ROS 2, SQLite": lambda folder: write_ros2(folder, "SQLITE3"),
    "ROS 2, MCAP": lambda folder: write_ros2(folder, "MCAP"),
    "MCAP of ROS 2": lambda folder: next(write_ros2(folder, "MCAP").glob("*.mcap")),
    "MCAP of JSON": write_json,
}


def test_a_bag_compressed_as_a_whole_is_told_and_the_command_named_makes_it_one_that_is_read(
    tmp_path,
):
    storage = StoragePlugin.SQLITE3
    unopened = Writer(tmp_path / "bag", version=9, storage_plugin=storage)
    unopened.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with unopened as writer:
        topics = {
            topic: writer.add_connection(topic, kind, typestore=TYPES)
            for topic, (kind, _) in KINDS.items()
        }
        for stamp_ns, topic, message in messages():
            writer.write(topics[topic], stamp_ns, TYPES.serialize_cdr(message, KINDS[topic][0]))
    (tmp_path / "map.toml").write_text(MAPPING)
    with pytest.raises(LogError, match=r"bag: compressed as a whole, .*: rosbags-convert") as error:
        import_log(tmp_path / "bag", "bag", tmp_path / "map.toml")
    assert "damaged" not in str(error.value)
    program, *arguments = str(error.value).rpartition("first: ")[2].split()
    subprocess.run([Path(sys.executable).with_name(program), *arguments], check=True)
    plain = import_log(tmp_path / "bag_plain", "bag", tmp_path / "map.toml").log
    (tmp_path / "other").mkdir()
    expected = import_log(
        write_ros2(tmp_path / "other", "SQLITE3"), "bag", tmp_path / "map.toml"
    ).log
    np.testing.assert_array_equal(plain["w"], expected["w"])


@pytest.mark.parametrize("kind", WRITERS)
def test_what_was_written_is_read_back(tmp_path, kind):
    (tmp_path / "map.toml").write_text(MAPPING)
    found = import_log(WRITERS[kind](tmp_path), "bag", tmp_path / "map.toml", align=False)
    log, time = found.log, found.log.time
    assert len(log) >= 990 and np.diff(time) == pytest.approx(
        0.005, abs=1e-6
    )  # the rates' own rows
    np.testing.assert_allclose(log["w"][:, 0], 0.5 * np.cos(time), atol=1e-6)
    np.testing.assert_allclose(log["p"][:, 0], time, atol=1e-6)  # interpolated
    assert (
        Rotation.from_quat(log["q"], scalar_first=True).inv() * motion(time)
    ).magnitude().max() < 1e-4
    np.testing.assert_allclose(
        log["u"][:, 0], np.sin(np.floor(time / 0.02 + 1e-6) * 0.02), atol=1e-6
    )  # held
    is_told = any("times are those of their recording" in note for note in found.notes)
    assert is_told == (kind == "MCAP of JSON") and log["u"][:, 3] == pytest.approx(0.5)


def test_what_lacks_a_topic_or_a_field_is_refused(tmp_path):
    mapping, flight = tmp_path / "map.toml", write_json(tmp_path)
    for path, old, new, message in (
        (
            flight,
            "/twist:twist.angular.x",
            "/gyro:x",
            "topic /gyro: no messages; found /pose, /sticks, /tw",
        ),
        (
            flight,
            "twist.angular.x",
            "rate",
            "topic /twist: field rate: not a number in messages of type any",
        ),
        (
            flight,
            "/sticks:axes[0]",
            "roll",
            r"map\.toml: command: found roll, expected topic:field",
        ),
    ):
        mapping.write_text(MAPPING.replace(old, new, 1))
        with pytest.raises(LogError, match=message):
            import_log(path, "bag", mapping)


def test_topics_of_other_epochs_are_put_together_by_their_recording(tmp_path):
    """The pose counts from the boot of its sensor; the recorder has one clock for all."""
    found = []
    for stamp_ns, topic, message in messages():
        content = dataclasses.asdict(message)
        boot_ns = START_NS - 77 * 10**9 if topic == "/pose" else 0
        sec, nanosec = divmod(stamp_ns - boot_ns, 10**9)
        found.append(
            (
                topic,
                stamp_ns + RECORDED_LATE_NS,
                {**content, "header": {"stamp": {"sec": sec, "nanosec": nanosec}}},
            )
        )
    save_messages(tmp_path / "flight.mcap", found)
    (tmp_path / "map.toml").write_text(MAPPING)
    imported = import_log(tmp_path / "flight.mcap", "bag", tmp_path / "map.toml", align=False)
    position_m = imported.log["p"][:, 0]  # 1 m/s
    assert position_m[0] < 0.0051  # the rounding of 77 s may cost the first row
    np.testing.assert_allclose(position_m - position_m[0], imported.log.time, atol=1e-5)
    assert any(
        f"stamps of q are {START_NS * 1e-9 - 77:+.6g} s before those of w" in note
        for note in imported.notes
    )
