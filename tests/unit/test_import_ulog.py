"""PX4 logs: topics of other rates, gaps, batteries, parameters, damage and other vehicles."""

import re
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flytrack_env.sandbox import ResourceLimits
from flytrack_sysid import LogError, import_log
from flytrack_sysid.importing import decoding
from tests.support.foreign_logs import (
    PX4_PARAMETERS,
    flying,
    ulog,
    ulog_message,
    ulog_topics,
)
from tests.support.tables import table

pytest.importorskip("pyulog", reason="pyulog is not installed: pip install 'flytrack[logs]'")

STEP_S, NUM_ROWS = 0.004, 200
RATES, ATTITUDE = "vehicle_angular_velocity", "vehicle_attitude"
SETPOINT, BATTERY = "vehicle_rates_setpoint", "battery_status"
CASES = table("ulog")


@pytest.fixture
def topics():
    """Return the topics of a flight of 0.8 s from 1 s on."""
    return ulog_topics(flying(NUM_ROWS, STEP_S))


@pytest.fixture
def read(tmp_path):
    """Return the import of topics, or of what a file has."""

    def import_content(content, parameters=PX4_PARAMETERS, full_stick=None, mapping=""):
        content = content if isinstance(content, bytes) else ulog(content, parameters)
        (tmp_path / "a.ulg").write_bytes(content)
        craft = f"[craft]\nmax_rate_deg_s = {full_stick}\n" if full_stick else ""
        (tmp_path / "map.toml").write_text(craft + mapping)
        return import_log(tmp_path / "a.ulg", "ulog", tmp_path / "map.toml")

    return import_content


def test_setpoints_are_held_and_sensors_interpolated(topics, read):
    stamps_us = [row[0] for row in topics[RATES][1][::5]]
    rolls = np.linspace(0.0, 1.0, len(stamps_us))
    setpoints = zip(stamps_us, np.deg2rad(720.0) * rolls, strict=True)
    half_a_step_later = [(stamp + 2000, roll, 0, 0, 0, 0, -0.5) for stamp, roll in setpoints]
    topics[SETPOINT] = (topics[SETPOINT][0], half_a_step_later)
    forces = [(stamp, 1e-6 * stamp, 0.0, -9.8) for stamp in stamps_us]
    topics["vehicle_acceleration"] = ("float[3] xyz", forces)
    log = read(topics).log  # after the first setpoint, before the last force
    assert_allclose(log["u"][:, 0], rolls[np.arange(195) // 5], atol=1e-6)
    assert_allclose(log["f"][:, 0], 1.0 + STEP_S * np.arange(1, 196), atol=1e-6)


def test_what_a_topic_misses_and_the_ground_are_no_rows(topics, read):
    fields, rows = topics[ATTITUDE]
    topics[ATTITUDE] = (fields, [row for row in rows[::5] if not 1.2e6 < row[0] < 1.3e6])
    topics["vehicle_land_detected"] = ("bool landed", [(0, True), (1_100_000, False)])
    imported = read(topics)
    log_s = imported.log.time + 1.0  # of the first row of rates
    assert log_s[-1] == pytest.approx(1.0 + 195 * STEP_S)  # the last attitude
    assert not np.any((log_s > 1.2001) & (log_s < 1.2999)) and np.sum(log_s < 1.2001) == 26
    assert "of 200 samples of the rates have all other topics around them" in imported.notes[0]
    assert re.search(r"25 of \d+ rows left out: on the ground", imported.notes[-1])


@pytest.mark.parametrize("pitch_max", [None, np.nan])
def test_unknown_full_stick_is_refused_unless_the_mapping_states_it(topics, read, pitch_max):
    known = {name: value for name, value in PX4_PARAMETERS.items() if name != "MC_ACRO_P_MAX"}
    if pitch_max is not None:
        known["MC_ACRO_P_MAX"] = pitch_max
    with pytest.raises(LogError, match=r"a\.ulg: parameter MC_ACRO_P_MAX or MC_PITCHRATE_MAX: mis"):
        read(topics, known)
    commands = read(topics, known, [720, 180, 90]).log["u"]
    assert_allclose(commands[0, :3], [0.5, -0.5, 0.5], atol=1e-6)
    with pytest.raises(LogError, match=r"up to 360, 90, 45 deg/s, .*, 90, 90, 90 deg/s") as error:
        read(topics, known, [90, 90, 90])
    (advice,) = re.findall(r"max_rate_deg_s = (\[.*?\])", str(error.value))
    assert read(topics, known, advice).log["u"][0, 0] == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize(("first_v", "second_v", "used_v"), CASES["batteries"])
def test_the_battery_that_is_measured_is_used(topics, read, first_v, second_v, used_v):
    fields, rows = topics[BATTERY]
    packs = [[(row[0], volts) for row in rows] for volts in (first_v, second_v)]
    topics[BATTERY] = (fields, *packs)
    imported = read(topics)
    assert ("v_bat" in imported.log) == bool(used_v)
    for volts in used_v:
        assert imported.log["v_bat"][:, 0] == pytest.approx(volts)
    is_choice = "instance 0 of battery_status is used, not 1" in " ".join(imported.notes)
    assert is_choice == (used_v == [first_v])


def test_samples_from_before_the_estimator_runs_are_left_out(topics, read):
    fields, rows = topics[ATTITUDE]
    unknown = [(row[0], 0.0, 0.0, 0.0, 0.0) for row in rows]
    topics[ATTITUDE] = (fields, unknown[:15] + rows[15:])
    assert len(read(topics).log) == NUM_ROWS - 15
    topics[ATTITUDE] = (fields, unknown)
    with pytest.raises(LogError, match=r"a\.ulg: topic vehicle_attitude: q: found no unit quat"):
        read(topics)
    del topics[ATTITUDE]
    with pytest.raises(LogError, match=r"a\.ulg: topic vehicle_attitude .*missing or empty; found"):
        read(topics)


def test_a_missing_package_is_named(topics, read, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(LogError, match=r"a\.ulg: ulog logs need pyulog.*flytrack\[logs\]"):
        read(topics)


@pytest.mark.slow
def test_topics_of_arrays_of_arrays_are_refused_in_time(read, monkeypatch):
    formats = ("vehicle_attitude:b[60000] q;", "b:c[60000] q;", "c:float[60000] q;")
    definitions = b"".join(ulog_message("F", text.encode()) for text in formats)
    subscription = ulog_message("A", b"\x00\x00\x00vehicle_attitude")
    limits = ResourceLimits(cpu_s=2, memory_bytes=2**27)
    monkeypatch.setattr(decoding, "limits_of", lambda num_bytes: limits)
    with pytest.raises(LogError, match=r"a\.ulg: cannot be decoded: (took|needs) more than"):
        read(b"ULog\x01\x12\x35" + bytes(9) + definitions + subscription)


def test_damage_is_noted_and_the_rest_is_read(topics, read, capsys):
    content = ulog(topics)
    index = content.rindex(SETPOINT.encode()) - 6  # where the subscription to the last topic begins
    imported = read(content[:index] + bytes(60) + content[index:])
    assert imported.notes[-1].endswith("a.ulg: damaged in places; what could be read is used")
    assert len(imported.log) == NUM_ROWS and capsys.readouterr().out == ""  # pyulog prints


def test_slow_topics_and_another_craft_are_noted(topics, read):
    for name in (RATES, SETPOINT):
        topics[name] = (topics[name][0], topics[name][1][::25])
    notes = " ".join(read(topics, {**PX4_PARAMETERS, "MAV_TYPE": 13.0}).notes)
    assert "w at 10 Hz" in notes and "body rates at 10 Hz: too slow for a rate loop" in notes
    assert "u at 10 Hz, held" in notes
    assert "found a hexacopter (MAV_TYPE 13), not a quadcopter" in notes


@pytest.mark.parametrize(("mav_type", "message"), CASES["vehicles"])
def test_other_vehicles_are_refused_for_what_they_are(topics, read, mav_type, message):
    """Not for the rate parameters of a multicopter alone, which they lack."""
    with pytest.raises(LogError, match=message):
        read(topics, {"MAV_TYPE": mav_type})


@pytest.mark.parametrize("microseconds", [7_200_000_000, 2**32])
def test_stamps_of_samples_from_another_clock_give_way_to_those_of_publishing(
    topics, read, microseconds
):
    for name, (fields, rows) in topics.items():
        latency_us = microseconds if name == RATES else 500
        sampled = []
        for stamp, *rest in rows:
            later = stamp + 2 * microseconds
            sampled.append((later, later - latency_us, *rest))
        topics[name] = (f"uint64_t timestamp_sample;{fields}", sampled)
    imported = read(topics)
    assert len(imported.log) == NUM_ROWS - 1  # the last attitude was sampled 0.5 ms before its row
    latency = f"timestamp_sample of {RATES} is {microseconds * 1e-6:.6g} s before timestamp"
    assert latency in " ".join(imported.notes)


OF_MOTORS = "[motors]\nas_command = true\n"
PLACED = {"CA_ROTOR_COUNT": 4.0}
for rotor, (ahead, right) in enumerate(((-1, -1), (1, 1), (-1, 1), (1, -1))):  # not PX4's X
    PLACED |= {f"CA_ROTOR{rotor}_PX": 0.1 * ahead, f"CA_ROTOR{rotor}_PY": 0.1 * right}


def with_motors(topics, every=1):
    """Return topics with controls of motors: a tenth of their number, and a little movement."""
    stamps = [row[0] for row in topics[RATES][1][::every]]
    unused = [np.nan] * 8
    rows = [(stamp, *(0.1 * np.arange(1, 5) + 1e-9 * stamp), *unused) for stamp in stamps]
    return {**topics, "actuator_motors": ("float[12] control", rows)}


@pytest.mark.parametrize(
    ("parameters", "shares"), [({}, (0.4, 0.1, 0.2, 0.3)), (PLACED, (0.3, 0.2, 0.1, 0.4))]
)
def test_motors_are_commands_in_our_order(topics, read, parameters, shares):
    content = with_motors(topics)
    del content[SETPOINT]  # and full stick need not be known
    flight = read(content, parameters, mapping=OF_MOTORS)
    log = flight.log
    assert log.has_motors
    assert any("a motor at its upper end in 0.00% of the rows" in note for note in flight.notes)
    assert_allclose(log["u"][0], 2.0 * np.array(shares) - 1.0, atol=3e-3)


def test_sticks_are_kept_beside_motors_which_must_be_there(topics, read):
    of_motors = read(with_motors(topics), mapping=OF_MOTORS).log
    assert_allclose(of_motors["sticks"], read(topics).log["u"])
    with pytest.raises(LogError, match=r"topic actuator_motors .*: missing or empty"):
        read(topics, mapping=OF_MOTORS)


@pytest.mark.parametrize("rates_are_stated", [True, False])
def test_sticks_that_one_of_two_files_lacks_are_left_out(topics, tmp_path, rates_are_stated):
    content, files = with_motors(topics), [tmp_path / "a.ulg", tmp_path / "b.ulg"]
    files[0].write_bytes(ulog(content))
    files[1].write_bytes(ulog({name: content[name] for name in content if name != SETPOINT}))
    rates = "[craft]\nmax_rate_deg_s = [700, 700, 300]\n" if rates_are_stated else ""
    (tmp_path / "map.toml").write_text(OF_MOTORS + rates)
    flights = import_log(files, "ulog", tmp_path / "map.toml")
    assert len(np.unique(flights.log.segment)) == 2 and "sticks" not in flights.log
    assert any("sticks are left out: found files without them" in note for note in flights.notes)


def test_sticks_of_a_part_of_a_flight_are_left_out_and_no_row_is(topics, read):
    content = with_motors(topics)
    fields, rows = content[SETPOINT]
    flight = read({**content, SETPOINT: (fields, rows[: len(rows) // 4])}, mapping=OF_MOTORS)
    assert "sticks" not in flight.log
    assert len(flight.log) == len(read({**content, SETPOINT: (fields, [])}, mapping=OF_MOTORS).log)
    assert any("sticks are left out: topic vehicle_rates" in note for note in flight.notes)


@pytest.mark.parametrize(("every", "parameters", "frame", "message"), CASES["refused"])
def test_motors_that_do_not_suit_are_refused(topics, read, every, parameters, frame, message):
    with pytest.raises(LogError, match=message):
        read(with_motors(topics, every), parameters, mapping=OF_MOTORS + frame)
