"""Betaflight blackbox logs: units, rates, refusals; and a real one against its decoded frames."""

import gzip
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flytrack_env.effects import effect_of
from flytrack_env.state import Action
from flytrack_sysid import LogError, import_log
from flytrack_sysid.importing.betaflight_settings import full_stick_rate, stick_curve
from tests.support.foreign_logs import BLACKBOX_FULL_STICK_DEG_S as FULL_STICK_DEG_S
from tests.support.foreign_logs import BLACKBOX_HEADERS, blackbox, flying
from tests.support.foreign_logs import BLACKBOX_NAMES as NAMES
from tests.support.foreign_logs import blackbox_frames as frames_of
from tests.support.real_logs import BETAFLIGHT, import_shared, shared
from tests.support.tables import table

pytest.importorskip("orangebox", reason="orangebox is not installed: pip install 'flytrack[logs]'")

GRAVITY = 9.80665
STEP_S = 500e-6
CASES = table("betaflight_headers")


def frames():
    """Return frames of a steady turn, the throttle rising."""
    return frames_of(flying(200, STEP_S))


def standing():
    """Return frames of a drone that is armed and stands, sticks at rest."""
    rows = frames()
    rows[:, 2:6] = 0
    return rows


def log_with(rows=None, names=NAMES, **headers):
    """Return a log with other headers; an empty one is left out."""
    headers = BLACKBOX_HEADERS | headers
    kept = {name: value for name, value in headers.items() if value}
    return blackbox(frames() if rows is None else rows, names, kept)


@pytest.fixture
def read(tmp_path):
    """Return the import of all rows of logs one after the other, as a flash chip has them."""

    def import_content(*logs, mapping="", **options):
        (tmp_path / "a.bbl").write_bytes(b"".join(logs))
        (tmp_path / "map.toml").write_text(f"[rows]\nevery = 1\n{mapping}")
        return import_log(tmp_path / "a.bbl", "betaflight", tmp_path / "map.toml", **options)

    return import_content


def test_headers_say_full_stick_and_the_curve_of_the_sticks(read):
    imported = read(log_with())
    assert imported.craft.max_rate_deg_s == pytest.approx(FULL_STICK_DEG_S)
    curve = 'the effect betaflight_rates: {"pitch": 0.7, "yaw": 0.8, "roll_expo": 0.1}'
    assert curve in str(imported.notes) and "Betaflight 4.5.1" in imported.notes[0]


def test_fine_rates_are_scaled(read):
    is_fine = np.char.startswith(NAMES, "gyro") | np.isin(NAMES, NAMES[2:5])
    plain = read(log_with()).log
    fine = read(log_with(frames() * np.where(is_fine, 10, 1), blackbox_high_resolution="1")).log
    for name in plain.channels:
        assert_allclose(fine[name], plain[name], atol=1e-12, err_msg=name)


def test_logs_of_one_file_become_segments_and_lost_frames_no_rows(read):
    rows = np.delete(frames(), slice(50, 60), axis=0)
    imported = read(log_with(), log_with(rows))
    assert np.bincount(imported.log.segment).tolist() == [200, 190]
    assert [source.rpartition("a.bbl")[2] for source in imported.sources] == [", log 1", ", log 2"]
    assert np.diff(imported.log.time[200:]).max() == pytest.approx(11 * STEP_S)


@pytest.mark.parametrize(("step_s", "every"), [(125e-6, 16), (500e-6, 4), (1e-3, 2), (2e-3, 1)])
def test_rows_beyond_500_hz_are_left_out_unless_a_mapping_says_how_many(tmp_path, step_s, every):
    path = tmp_path / "a.bbl"
    path.write_bytes(log_with(frames_of(flying(200, step_s))))
    imported = import_log(path, "betaflight")
    assert len(imported.log) == -(-200 // every)
    assert np.median(np.diff(imported.log.time)) == pytest.approx(0.002)
    assert (f"one row of {every} is used" in " ".join(imported.notes)) == (every > 1)


@pytest.mark.parametrize(("rates_type", "rc_rate", "super_rate", "deg_s"), CASES["full_stick"])
def test_rates_at_full_stick_are_the_firmwares(rates_type, rc_rate, super_rate, deg_s):
    assert full_stick_rate(rates_type, rc_rate, super_rate, 1998.0) == pytest.approx(deg_s)


AXES = [(30, 67, 40), (70, 70, 0), (100, 40, 100)]  # rc rate, rate and expo of the table


@pytest.mark.parametrize(("rates_type", "straight", "deg_s"), CASES["curves"])
def test_stick_curves_are_the_firmwares(rates_type, straight, deg_s):
    curve = stick_curve(rates_type, AXES)
    full = [full_stick_rate(rates_type, rc, rate, 1998.0) for rc, rate, _ in AXES]
    for stick, expected in zip((-0.9, -0.3, 0.6, 1.0), deg_s, strict=True):
        sticks = Action(stick, stick, stick, 0.3)
        bent = effect_of(curve).hooks["command"](curve, None, sticks, None)
        assert_allclose(bent, [*np.divide(expected, full), 0.3], atol=1e-6)
    assert stick_curve(rates_type, [(62, straight, 0)] * 3) is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (log_with()[: log_with().index(b"\nI\x00") + 9], "cut off: .* and no whole frame"),
        (log_with(standing()), "nothing flies: the thrust command never exceeds 5 %"),
        (log_with().replace(b"encoding:1", b"encoding:77"), "damaged, cannot be decoded"),
        (log_with(frames()[:0]), "(found no frames|damaged)"),
        (log_with(names=[NAMES[0], "\x1b[2J", *NAMES[2:]]), r"field time: missing; found [ -~]+$"),
        *((log_with(**headers), message) for headers, message in CASES["refused"]),
    ],
)
def test_wrong_files_are_refused(read, content, message):
    with pytest.raises(LogError, match=rf"a\.bbl.*: {message}"):
        read(content)


def test_overshoot_is_clipped_and_counted(read):
    rows = frames()
    # Full stick is 1021.6: rounding, 1.8 % past it, 4.7 % past it.
    rows[10:13, 2] = [1022, 1040, -1070]
    imported = read(log_with(rows))
    assert imported.log["u"][10:13, 0].tolist() == [1.0, 1.0, -1.0]
    assert "2 rows clipped to full stick" in imported.notes[1] and "4.7 %" in imported.notes[1]


def test_a_log_without_accelerometer_is_read(read):
    imported = read(log_with(frames()[:, :-3], NAMES[:-3], acc_1G=""))
    assert set(imported.log.channels) == {"u", "w", "v_bat"}
    assert "no accelerometer in the log" in imported.notes[1]
    assert "f" not in read(log_with(frames() * ~np.char.startswith(NAMES, "acc"))).log


def test_one_bad_log_of_many_is_left_out_with_its_reason(read):
    cut_off, rearmed = log_with()[:-200], log_with(rc_rates="")
    imported = read(log_with(standing()), cut_off, log_with(), rearmed)
    assert [source.rpartition(", ")[2] for source in imported.sources] == ["log 2", "log 3"]
    assert 180 < np.sum(imported.log.segment == 0) < 200 and np.sum(imported.log.segment) == 200
    left_out = [note for note in imported.notes if note.startswith("left out: ")]
    assert [note.partition("log ")[2][:1] for note in left_out] == ["4", "1"]
    assert "rc_rates: missing" in left_out[0] and "nothing flies" in left_out[1]


def test_a_voltage_of_0_was_not_measured(read):
    rows = frames()
    rows[50:60, 6] = 0
    imported = read(log_with(rows))
    assert imported.log["v_bat"][:, 0] == pytest.approx(24.1)
    assert "v_bat: not above 0 V in 10 of 200 rows: interpolated" in imported.notes[-1]
    rows[:, 6] = 0
    imported = read(log_with(rows))
    assert "v_bat" not in imported.log and "in 200 of 200 rows: left out" in imported.notes[-1]


def test_logged_attitude_is_read(read, truth):
    quat = truth["q"] * np.sign(truth["q"][:, :1])
    names = [*NAMES, *(f"imuQuaternion[{axis}]" for axis in range(3))]
    rows = np.column_stack([frames_of(truth), np.round(32767 * quat[:, 1:])])
    imported = read(log_with(rows, names), align=False)
    assert_allclose(imported.log["q"], quat, atol=1e-3)
    assert imported.problems == ()
    rows[:, -3:] = 0
    assert "q" not in read(log_with(rows, names)).log


@pytest.mark.parametrize(("headers", "note"), CASES["noted"])
def test_settings_that_change_the_thrust_curve_are_noted(read, headers, note):
    notes = [text for text in read(log_with(**headers)).notes if re.search("limit|sag|line", text)]
    assert len(notes) == bool(note) and note in "".join(notes)


def test_motors_are_counted_their_saturation_noted_and_their_mean_is_thrust(read):
    names = [*NAMES, *(f"motor[{number}]" for number in range(6))]
    rows = np.column_stack([frames(), np.full((200, 6), 700)])
    rows[:5, -1] = 2047
    imported = read(
        log_with(rows, names, motorOutput="158,2047"), mapping="[motors]\nas_thrust = true\n"
    )
    notes, thrust = " ".join(imported.notes), imported.log["u"][:, 3]
    assert "found 6 motors, not a quadcopter" in notes
    assert "a motor at its upper end in 2.50% of the rows" in notes
    assert thrust[-1] == pytest.approx(2.0 * (700 - 158) / (2047 - 158) - 1.0)
    assert thrust[0] > thrust[-1]


@pytest.mark.parametrize(
    ("ends", "off", "full"),
    [("158,2047", 48, 2047), ("158,1647", 48, 2047), ("1070,2000", 1000, 2000)],
)
def test_limited_outputs_of_motors_are_shares_of_the_protocols_range(read, ends, off, full):
    names = [*NAMES, *(f"motor[{number}]" for number in range(4))]
    motors = 1100 + np.arange(200)[:, None] + np.arange(4)
    log = log_with(np.column_stack([frames(), motors]), names, motorOutput=ends)
    of_motors = read(log, mapping="[motors]\nas_command = true\n", align=False).log
    assert_allclose(of_motors["u"][0], 2.0 * (motors[0] - off) / (full - off) - 1.0)
    assert_allclose(of_motors["sticks"], read(log, align=False).log["u"])


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (log_with(rc_rates="220,100,60"), r"craft: full stick .* 600 deg/s.*a\.bbl.* 500 deg/s"),
        (
            log_with(names=[name.replace("vbatLatest", "x") for name in NAMES]),
            r"channels v_bat: not in both this file and .*a\.bbl",
        ),
    ],
)
def test_logs_of_different_craft_or_channels_make_no_log(tmp_path, other, message):
    files = [tmp_path / "a.bbl", tmp_path / "b.bbl"]
    files[0].write_bytes(log_with())
    files[1].write_bytes(other)
    with pytest.raises(LogError, match=rf"b\.bbl: {message}"):
        import_log(files, "betaflight")


def test_real_log_holds_what_another_decoder_found(tmp_path):
    """Which has every second frame, in raw units."""
    folder = shared(BETAFLIGHT)
    with gzip.open(folder / "shortLog_decoded_1kHz.csv.gz", "rt") as file:
        decoded = np.genfromtxt(file, delimiter=",", names=True, deletechars="")
    (tmp_path / "map.toml").write_text('[rows]\non_ground = "keep"\nevery = 1\n')
    imported = import_log(folder / "shortLog.BFL", "betaflight", tmp_path / "map.toml")
    log = imported.log
    assert imported.problems == ()
    every_second = log.select(slice(0, None, 2))
    assert len(every_second) == len(decoded)
    raw = {
        "time": 1e6 * every_second.time + decoded["time"][0],
        "vbatLatest": 100.0 * every_second["v_bat"][:, 0],
        "setpoint[3]": 500.0 * (every_second["u"][:, 3] + 1.0),
    }
    for axis in range(3):
        raw[f"gyroADC[{axis}]"] = np.rad2deg(every_second["w"][:, axis])
        raw[f"accSmooth[{axis}]"] = 2048.0 / GRAVITY * every_second["f"][:, axis]
    for name, values in raw.items():
        assert_allclose(values, decoded[name], atol=1e-6, err_msg=name)
    assert imported.craft.max_rate_deg_s == pytest.approx((1021.6, 1021.6, 772.96))
    for axis in (0, 1):  # the largest setpoint is full stick, in whole numbers
        assert decoded[f"setpoint[{axis}]"].max() == 1022 and log["u"][:, axis].max() == 1.0


@pytest.mark.slow
def test_gecko_flies_without_a_mapping():
    """The first 14 frames change a frame that the decoder lost; smoothing overshoots full stick."""
    imported = import_shared("bf_gecko/btfl_002.bbl", "betaflight", None)
    log = imported.log
    assert len(log) == 66000 and np.diff(log.time).max() < 0.005 and log["v_bat"].min() > 13.0
    assert imported.craft.max_rate_deg_s == pytest.approx((700.0, 700.0, 700.0))
    assert imported.problems == ()
    notes = " ".join(imported.notes)
    assert "14 frames before the first full one" in notes
    assert "9 rows clipped to full stick" in notes
    for axis in range(3):  # closely followed
        assert np.corrcoef(log["u"][:, axis], log["w"][:, axis])[0, 1] > 0.98
