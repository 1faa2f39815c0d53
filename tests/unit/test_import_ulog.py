"""PX4 logs: what a file written by the format's specification holds, in our units and frames."""

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_env.sandbox import ResourceLimits
from flytrack_sysid import LogError, import_log
from flytrack_sysid.importing import decoding
from tests.support.foreign_logs import (
    PARAMETERS,
    STEP_US,
    TIMES_US,
    VXYZ,
    XYZ,
    UlogWriter,
    constant,
    topics,
    ulog,
)
from tests.support.real_logs import shared

pytest.importorskip("pyulog", reason="pyulog is not installed: pip install 'flytrack[logs]'")


def write(path: Path, tables: dict[str, tuple[list, list]], parameters: Any = PARAMETERS) -> Path:
    """Write topics to a ULog file."""
    path.write_bytes(ulog(tables, parameters))
    return path


def test_frames_and_units_are_ours(tmp_path):
    found = import_log(write(tmp_path / "a.ulg", topics()), "ulog")
    first = {name: values[0] for name, values in found.log.channels.items()}
    np.testing.assert_allclose(first["w"], [0.1, -0.2, -0.3], atol=1e-6)
    np.testing.assert_allclose(first["f"], [0.5, -0.25, 9.75], atol=1e-6)
    np.testing.assert_allclose(first["p"], [1.0, -2.0, 3.0], atol=1e-6)  # north, west, up
    np.testing.assert_allclose(first["v"], [4.0, -5.0, 6.0], atol=1e-6)
    np.testing.assert_allclose(first["q"], [np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)], atol=1e-6)
    nose_w = Rotation.from_quat(first["q"], scalar_first=True).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(nose_w, [0.0, -1.0, 0.0], atol=1e-6)  # east is right of north
    # Half of full stick; pitch and yaw of FRD change sign.
    np.testing.assert_allclose(first["u"], [0.5, -0.25, 0.25, 0.5], atol=1e-6)
    assert first["v_bat"] == pytest.approx([16.25])
    assert found.craft.max_rate_deg_s == pytest.approx((720.0, 360.0, 180.0))
    assert found.log.time[0] == 0.0 and np.diff(found.log.time) == pytest.approx(1e-6 * STEP_US)


def test_setpoints_are_held_and_sensors_interpolated(tmp_path):
    tables = topics()
    fields, _ = tables["vehicle_rates_setpoint"]
    rolls = np.deg2rad(720.0) * np.linspace(0.0, 1.0, 40)
    times = TIMES_US[::5] + STEP_US // 2
    setpoints = [
        (int(time), roll, 0, 0, 0, 0, -0.5) for time, roll in zip(times, rolls, strict=True)
    ]
    places = [(int(time), 1e-6 * (time - 1e6), 0, 0, 1, 0, 0) for time in TIMES_US[::5]]
    tables["vehicle_rates_setpoint"] = (fields, setpoints)
    tables["vehicle_local_position"] = ([*XYZ, *VXYZ], places)
    log = import_log(write(tmp_path / "a.ulg", tables), "ulog").log
    assert (
        log.time[0] == 0.0 and len(log) == 195
    )  # after the first setpoint, before the last position
    held = np.linspace(0.0, 1.0, 40)[np.arange(195) // 5]
    np.testing.assert_allclose(log["u"][:, 0], held, atol=1e-6)
    np.testing.assert_allclose(log["p"][:, 0], 1e-6 * STEP_US * np.arange(1, 196), atol=1e-6)


def test_what_a_topic_misses_and_the_ground_are_no_rows(tmp_path):
    tables = topics()
    fields, rows = tables["vehicle_attitude"]
    tables["vehicle_attitude"] = (fields, [row for row in rows if not 1.2e6 < row[0] < 1.3e6])
    tables["vehicle_land_detected"] = ([("bool", "landed", 0)], [(0, True), (1_100_000, False)])
    found = import_log(write(tmp_path / "a.ulg", tables), "ulog")
    log_s = found.log.time + 1.0  # of the first row of rates
    assert log_s[-1] == pytest.approx(1e-6 * TIMES_US[-5])  # the last setpoint and attitude
    assert not np.any((log_s > 1.2001) & (log_s < 1.2999)) and np.sum(log_s < 1.2001) == 26
    assert "of 200 samples of the rates have all other topics around them" in found.notes[0]
    assert "25 of " in found.notes[-1] and found.notes[-1].endswith("rows left out: on the ground")


@pytest.mark.parametrize("pitch_max", [None, np.nan])
def test_unknown_full_stick_is_refused_unless_the_mapping_states_it(tmp_path, pitch_max):
    parameters = PARAMETERS | {"MC_ACRO_P_MAX": pitch_max}
    known = {name: value for name, value in parameters.items() if value is not None}
    path = write(tmp_path / "a.ulg", topics(), known)
    with pytest.raises(
        LogError, match=r"a\.ulg: parameter MC_ACRO_P_MAX or MC_PITCHRATE_MAX: missing"
    ):
        import_log(path, "ulog")
    mapping = tmp_path / "craft.toml"
    mapping.write_text("[craft]\nmax_rate_deg_s = [720, 180, 90]\n")
    commands = import_log(path, "ulog", mapping).log["u"]
    np.testing.assert_allclose(commands[0], [0.5, -0.5, 0.5, 0.5], atol=1e-6)
    mapping.write_text("[craft]\nmax_rate_deg_s = [90, 90, 90]\n")
    text = (
        r"up to 360, 90, 45 deg/s, .*, 90, 90, 90 deg/s; in a mapping, craft\.max_rate_deg_s = \["
    )
    with pytest.raises(LogError, match=text) as error:
        import_log(path, "ulog", mapping)
    advice = re.search(r"max_rate_deg_s = \[.*?\]", str(error.value)).group()
    mapping.write_text(f"[craft]\n{advice}\n")  # what the message says to write is read
    assert import_log(path, "ulog", mapping).log["u"][0, 0] == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize(
    ("first_v", "second_v"), [(16.25, 15.0), (0.0, 15.0), (np.nan, 15.0), (0.0, 0.0)]
)
def test_the_battery_that_is_measured_is_used(tmp_path, first_v, second_v):
    tables = topics()
    fields, rows = tables["battery_status"]
    writer = UlogWriter(PARAMETERS)
    for name, (names, values) in tables.items():
        if name != "battery_status":
            writer.add(name, names, values)
    for instance, volts in enumerate((first_v, second_v)):
        writer.add("battery_status", fields, [(row[0], volts) for row in rows], instance)
    (tmp_path / "a.ulg").write_bytes(writer.content())
    log = import_log(tmp_path / "a.ulg", "ulog").log
    expected = next((volts for volts in (first_v, second_v) if volts > 0.0), None)
    assert ("v_bat" in log) == (expected is not None)
    assert expected is None or log["v_bat"][:, 0] == pytest.approx(expected)


def test_samples_from_before_the_estimator_runs_are_left_out(tmp_path):
    tables = topics()
    fields, rows = tables["vehicle_attitude"]
    late = [(*row[:1], 0.0, 0.0, 0.0, 0.0) if index < 3 else row for index, row in enumerate(rows)]
    whole = import_log(write(tmp_path / "a.ulg", tables), "ulog").log
    found = import_log(
        write(tmp_path / "b.ulg", {**tables, "vehicle_attitude": (fields, late)}), "ulog"
    ).log
    assert 0 < len(found) < len(whole)
    none = [(*row[:1], 0.0, 0.0, 0.0, 0.0) for row in rows]
    path = write(tmp_path / "c.ulg", {**tables, "vehicle_attitude": (fields, none)})
    with pytest.raises(
        LogError, match=r"c\.ulg: topic vehicle_attitude: q: found no unit quaternion"
    ):
        import_log(path, "ulog")
    del tables["vehicle_attitude"]
    with pytest.raises(
        LogError, match=r"d\.ulg: topic vehicle_attitude .*missing or empty; found "
    ):
        import_log(write(tmp_path / "d.ulg", tables), "ulog")


def test_other_files_and_a_missing_package_are_named(tmp_path, monkeypatch):
    path = write(tmp_path / "a.ulg", topics())
    (tmp_path / "b.ulg").write_bytes(b"time,x\n0,1\n")
    with pytest.raises(
        LogError, match=r"b\.ulg: found text \(--format csv reads it\), expected a PX4 log \(ULog\)"
    ):
        import_log(tmp_path / "b.ulg", "ulog")
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(LogError, match=r"a\.ulg: ulog logs need pyulog.*flytrack\[logs\]"):
        import_log(path, "ulog")


@pytest.mark.slow
def test_topics_of_arrays_of_arrays_are_refused_in_time(tmp_path, monkeypatch):
    formats = ("vehicle_attitude:b[60000] q;", "b:c[60000] q;", "c:float[60000] q;")
    definitions = b"".join(UlogWriter.message("F", text.encode()) for text in formats)
    subscription = UlogWriter.message("A", b"\x00\x00\x00vehicle_attitude")
    path = tmp_path / "a.ulg"
    path.write_bytes(b"ULog\x01\x12\x35" + bytes(9) + definitions + subscription)
    limits = ResourceLimits(cpu_s=2, memory_bytes=2**27)
    monkeypatch.setattr(decoding, "limits_of", lambda num_bytes: limits)
    with pytest.raises(LogError, match=r"a\.ulg: cannot be decoded: (took|needs) more than"):
        import_log(path, "ulog")


def test_damage_is_noted_and_the_rest_is_read(tmp_path, capsys):
    path = write(tmp_path / "a.ulg", topics())
    content = path.read_bytes()
    place = content.rindex(b"battery_status") - 6  # where the subscription to the last topic begins
    path.write_bytes(content[:place] + bytes(60) + content[place:])
    found = import_log(path, "ulog")
    assert found.notes[-1].endswith("a.ulg: damaged in places; what could be read is used")
    assert len(found.log) == 196 and capsys.readouterr().out == ""  # pyulog prints
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(LogError, match=r"a\.ulg: topic vehicle_attitude .*missing or empty"):
        import_log(path, "ulog")


def test_slow_topics_are_told(tmp_path):
    tables = topics()
    slow = TIMES_US[::25]
    tables["vehicle_angular_velocity"] = ([("float", "xyz", 3)], constant((0.1, 0.2, 0.3), slow))
    said = " ".join(import_log(write(tmp_path / "a.ulg", tables), "ulog").notes)
    assert "w at 10 Hz" in said and "body rates at 10 Hz: too slow for a rate loop" in said


def test_a_real_hexacopter_is_told():
    found = import_log(shared("px4_h520") / "3DRFlight_1.ulg", "ulog")
    said = " ".join(found.notes)
    assert (
        "found a hexacopter (MAV_TYPE 13), not a quadcopter" in said
        and "u at 31.2 Hz, held" in said
    )


@pytest.mark.parametrize(("mav_type", "vehicle"), [(1, "a plane"), (10, "a rover")])
def test_other_vehicles_are_refused_for_what_they_are(tmp_path, mav_type, vehicle):
    """Not for the rate parameters or topics of a multicopter, which they lack."""
    path = write(tmp_path / "a.ulg", {}, {"MAV_TYPE": float(mav_type)})
    with pytest.raises(
        LogError, match=rf"a\.ulg: found a log of {vehicle} \(MAV_TYPE\), expected one of a multi"
    ):
        import_log(path, "ulog")


def test_a_helicopter_without_rate_parameters_is_told_as_one(tmp_path):
    path = write(tmp_path / "a.ulg", topics(), {"MAV_TYPE": 4.0})
    with pytest.raises(
        LogError, match=r"full stick is unknown; found a helicopter \(MAV_TYPE 4\), not a quad"
    ):
        import_log(path, "ulog")


@pytest.mark.parametrize("microseconds", [7_200_000_000, 2**32])
def test_stamps_of_samples_from_another_clock_give_way_to_those_of_publishing(
    tmp_path, microseconds
):
    tables = topics()
    for name, (fields, rows) in tables.items():
        sampled = [
            (row[0], row[0] - (microseconds if "velocity" in name else 500), *row[1:])
            for row in rows
        ]
        later = [
            (stamp + 2 * microseconds, sample + 2 * microseconds, *rest)
            for stamp, sample, *rest in sampled
        ]
        tables[name] = ([("uint64_t", "timestamp_sample", 0), *fields], later)
    found = import_log(write(tmp_path / "a.ulg", tables), "ulog")
    assert len(found.log) == 195  # the last attitude was sampled 0.5 ms before its row
    expected = (
        f"timestamp_sample of vehicle_angular_velocity is {microseconds * 1e-6:.6g} s "
        "before timestamp"
    )
    assert any(expected in note for note in found.notes)
