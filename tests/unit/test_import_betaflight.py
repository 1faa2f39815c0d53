"""Betaflight blackbox logs: units, rates, refusals; and a real one against its decoded frames."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_env.effects import effect_of
from flytrack_env.state import Action
from flytrack_sysid import LogError, import_log
from flytrack_sysid.importing.betaflight_settings import full_stick_rate, stick_curve
from flytrack_sysid.plausibility import summed_turns
from tests.support.foreign_logs import BLACKBOX_HEADERS, blackbox
from tests.support.foreign_logs import BLACKBOX_NAMES as NAMES
from tests.support.foreign_logs import blackbox_frames as frames
from tests.support.real_logs import BETAFLIGHT, shared

pytest.importorskip("orangebox", reason="orangebox is not installed: pip install 'flytrack[logs]'")

GRAVITY = 9.80665
FULL_STICK = (
    1021.6,
    200.0 / 0.3,
    500.0,
)  # of the headers: 5.108 x 200; 200 / (1 - 0.7); 100 / (1 - 0.8)


def still() -> np.ndarray:
    """Return frames of a drone that is armed and stands, sticks at rest."""
    found = frames()
    found[:, 2:6] = 0
    return found


def write(path: Path, *logs: bytes) -> Path:
    """Write logs one after the other, as a flash chip has them."""
    path.write_bytes(b"".join(logs))
    return path


def log_with(
    rows: np.ndarray | None = None, names: list[str] = NAMES, **headers: str | None
) -> bytes:
    """Return a log with other headers; None leaves one out."""
    kept = {
        name: value for name, value in (BLACKBOX_HEADERS | headers).items() if value is not None
    }
    return blackbox(frames() if rows is None else rows, names, kept)


def test_units_and_frames_are_ours(tmp_path):
    found = import_log(write(tmp_path / "a.bbl", log_with()), "betaflight")
    log = found.log
    assert found.craft.max_rate_deg_s == pytest.approx(FULL_STICK)
    np.testing.assert_allclose(log.time, 500e-6 * np.arange(200), atol=1e-12)
    np.testing.assert_allclose(log["u"][0], [511 / 1021.6, -0.4995, 0.5, -1.0], atol=1e-9)
    assert log["u"][-1, 3] == 1.0
    np.testing.assert_allclose(log["w"][0], np.deg2rad([100.0, -50.0, 25.0]))
    np.testing.assert_allclose(log["f"][0], [0.5 * GRAVITY, -0.25 * GRAVITY, GRAVITY])
    assert log["v_bat"][0] == pytest.approx(24.1)
    assert 'the effect betaflight_rates: {"pitch": 0.7, "yaw": 0.8, "roll_expo": 0.1}' in str(
        found.notes
    )
    assert set(log.channels) == {"u", "w", "f", "v_bat"} and "Betaflight 4.5.1" in found.notes[0]


def test_fine_rates_are_scaled(tmp_path):
    fine = frames() * np.isin(NAMES, ["setpoint[0]", "setpoint[1]", "setpoint[2]"]) * 9 + frames()
    fine += frames() * np.char.startswith(NAMES, "gyro") * 9
    plain = import_log(write(tmp_path / "a.bbl", log_with()), "betaflight").log
    headers = {"blackbox_high_resolution": "1"}
    log = import_log(write(tmp_path / "b.bbl", log_with(fine, **headers)), "betaflight").log
    for name in plain.channels:
        np.testing.assert_allclose(log[name], plain[name], atol=1e-12, err_msg=name)


def test_logs_of_one_file_become_segments_and_lost_frames_no_rows(tmp_path):
    rows = np.delete(frames(), slice(50, 60), axis=0)
    rows[100, 1] = rows[99, 1]  # a frame with the time of the one before
    found = import_log(write(tmp_path / "a.bbl", log_with(), log_with(rows)), "betaflight")
    assert np.bincount(found.log.segment).tolist() == [200, 189]
    assert [source.rpartition("a.bbl")[2] for source in found.sources] == [", log 1", ", log 2"]
    assert any(
        "log 2: 1 of 190 rows of the frames left out: 1 with a repeated" in note
        for note in found.notes
    )
    assert np.diff(found.log.time[200:]).max() == pytest.approx(11 * 500e-6)


@pytest.mark.parametrize(
    ("rates_type", "rc_rate", "super_rate", "expected_deg_s"),
    [
        ("BETAFLIGHT", 220, 0, 200 * (2.2 + 14.54 * 0.2)),
        ("RACEFLIGHT", 37, 80, 370 * 1.8),
        ("KISS", 100, 70, 200 / 0.3),
        ("BETAFLIGHT", 255, 90, 1998),  # the limit
    ],
)
def test_rates_at_full_stick_are_the_firmwares(rates_type, rc_rate, super_rate, expected_deg_s):
    assert full_stick_rate(rates_type, rc_rate, super_rate, 1998.0) == pytest.approx(expected_deg_s)


def of_firmware(rates_type: str, stick: float, rc_rate: float, rate: float, expo: float) -> float:
    """Return the setpoint, deg/s, as the firmware computes it."""
    size, expo = abs(stick), expo / 100
    if rates_type == "ACTUAL":
        late = size * (stick**5 * expo + stick * (1 - expo))
        return stick * 10 * rc_rate + max(0, 10 * rate - 10 * rc_rate) * late
    if rates_type == "QUICK":
        slope, most = 2 * rc_rate, max(10 * rate, 2 * rc_rate)
        factor = (most / slope - 1) / (most / slope)
        return stick * slope / (1 - (size**3 * expo + size * (1 - expo)) * factor)
    curved = stick * size**3 * expo + stick * (1 - expo)
    return 200 * rc_rate / 100 * curved / min(max(1 - size * rate / 100, 0.01), 1)


@pytest.mark.parametrize("rates_type", ["ACTUAL", "BETAFLIGHT", "QUICK"])
def test_stick_curves_are_the_firmwares(rates_type):
    axes = [(30, 67, 40), (70, 70, 0), (100, 40, 100)]
    curve, sticks = stick_curve(rates_type, axes), np.linspace(-1, 1, 21)
    full = [full_stick_rate(rates_type, rc, rate, 1998.0) for rc, rate, _ in axes]
    for stick in sticks:
        bent = effect_of(curve).hooks["command"](
            curve, None, Action(stick, stick, stick, 0.3), None
        )
        expected = [of_firmware(rates_type, stick, *axis) for axis in axes]
        np.testing.assert_allclose(bent[:3], np.divide(expected, full), atol=1e-6)
        assert bent.thrust == 0.3
    straight = {"ACTUAL": 62, "BETAFLIGHT": 0, "QUICK": 12}[rates_type]
    assert stick_curve(rates_type, [(62, straight, 0)] * 3) is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", r"a\.bbl: found an empty file, expected a Betaflight blackbox log"),
        (
            log_with()[: log_with().index(b"\nI\x00") + 9],
            r"a\.bbl: cut off: found no end-of-log event, and no",
        ),
        (log_with(rows=still()), r"a\.bbl: nothing flies: the thrust command never exceeds 5 %"),
        (log_with().replace(b"encoding:1", b"encoding:77"), r"a\.bbl: damaged, cannot be decoded"),
        (log_with(rows=frames(0)), r"a\.bbl: (found no frames|damaged)"),
        (
            log_with(**{"Firmware revision": "INAV 7.1"}),
            r"Firmware revision: found 'INAV 7\.1', exp",
        ),
        (log_with(rc_rates=None), r"a\.bbl: header rc_rates: missing, so full stick is unknown"),
        (
            log_with(acc_1G=None),
            r"a\.bbl: header acc_1G: found None, expected 1 numbers of at least 0",
        ),
        (log_with(names=[NAMES[0], "\x1b[2J", *NAMES[2:]]), r"field time: missing; found [ -~]+$"),
        (
            log_with(rc_rates="50,50,50"),
            r"column u_roll: found 5\.11, expected a command in \[-1, 1\]",
        ),
    ],
)
def test_wrong_files_are_refused(tmp_path, content, message):
    with pytest.raises(LogError, match=message):
        import_log(write(tmp_path / "a.bbl", content), "betaflight")


def test_overshoot_is_clipped_and_counted(tmp_path):
    rows = frames()
    rows[10:13, 2] = [
        1022,
        1040,
        -1070,
    ]  # full stick is 1021.6: rounding, 1.8 % past it, 4.7 % past it
    found = import_log(write(tmp_path / "a.bbl", log_with(rows)), "betaflight")
    assert found.log["u"][10:13, 0].tolist() == [1.0, 1.0, -1.0]
    assert (
        "2 rows clipped to full stick: smoothed setpoints overshoot, at most 4.7 %"
        in found.notes[1]
    )


def test_a_log_without_accelerometer_is_read(tmp_path):
    names = [name.replace("accSmooth", "other") for name in NAMES]
    found = import_log(write(tmp_path / "a.bbl", log_with(names=names, acc_1G=None)), "betaflight")
    assert set(found.log.channels) == {"u", "w", "v_bat"}
    assert "no accelerometer in the log" in found.notes[1]
    rows = frames() * ~np.char.startswith(NAMES, "acc")
    assert "f" not in import_log(write(tmp_path / "b.bbl", log_with(rows)), "betaflight").log


def test_one_bad_log_of_many_is_left_out_with_its_reason(tmp_path):
    cut_off, rearmed = log_with()[:-200], log_with(rc_rates=None)
    path = write(tmp_path / "a.bbl", log_with(rows=still()), cut_off, log_with(), rearmed)
    found = import_log(path, "betaflight")
    assert found.sources == (f"{path}, log 2", f"{path}, log 3")
    assert 180 < np.sum(found.log.segment == 0) < 200 and np.sum(found.log.segment == 1) == 200
    left_out = [note for note in found.notes if note.startswith("left out: ")]
    assert [note.partition("log ")[2][:1] for note in left_out] == ["4", "1"]
    assert "rc_rates: missing" in left_out[0] and "nothing flies" in left_out[1]


@pytest.mark.parametrize("num_missing", [1, 13, 14, 15, 16, 200])
def test_a_log_cut_off_is_used_up_to_its_last_whole_frame(tmp_path, num_missing):
    whole = import_log(write(tmp_path / "a.bbl", log_with()), "betaflight").log
    found = import_log(write(tmp_path / "b.bbl", log_with()[:-num_missing]), "betaflight")
    num_rows = len(found.log)
    for name in whole.channels:
        np.testing.assert_array_equal(found.log[name], whole[name][:num_rows])
    end, size = len(b"E\xffEnd of log\x00"), len(log_with()) - len(log_with(frames()[:-1]))
    num_expected = 200 - max(0, num_missing - end + size - 1) // size - (num_missing >= end)
    assert num_rows in (num_expected, num_expected + 1)
    if num_missing > 1:
        assert f"cut off: found no end-of-log event; {num_rows} whole frames used" in found.notes[1]


def test_a_voltage_of_0_was_not_measured(tmp_path):
    rows = frames()
    rows[50:60, 6] = 0
    found = import_log(write(tmp_path / "a.bbl", log_with(rows)), "betaflight")
    assert found.log["v_bat"][:, 0] == pytest.approx(24.1)
    assert "v_bat: not above 0 V in 10 of 200 rows: interpolated" in found.notes[-1]
    rows[:, 6] = 0
    found = import_log(write(tmp_path / "a.bbl", log_with(rows)), "betaflight")
    assert "v_bat" not in found.log and "in 200 of 200 rows: left out" in found.notes[-1]


ATTITUDE = [f"imuQuaternion[{axis}]" for axis in range(3)]


def test_logged_attitude_is_read(tmp_path):
    rows, time = frames(3000), 0.004 * np.arange(3000)
    truth = Rotation.from_euler(
        "xyz", np.column_stack([0.3 * np.sin(time), 0.2 * np.cos(time), 0.1 * time])
    )
    quat = truth.as_quat(canonical=True)
    turns = np.gradient(summed_turns(truth), time, axis=0)
    rows[:, 1], rows[:, 7:10] = 1e6 * time, np.round(np.rad2deg(turns))
    names = [*NAMES, *ATTITUDE]
    content = log_with(np.column_stack([rows, np.round(32767 * quat[:, :3])]), names)
    found = import_log(write(tmp_path / "a.bbl", content), "betaflight", align=False)
    read = Rotation.from_quat(found.log["q"], scalar_first=True)
    assert np.max((read.inv() * truth).magnitude()) < 1e-3
    assert not any("q_w" in problem for problem in found.problems)
    empty = log_with(np.column_stack([rows, np.zeros((3000, 3))]), names)
    assert "q" not in import_log(write(tmp_path / "b.bbl", empty), "betaflight").log


@pytest.mark.parametrize(
    ("headers", "note"),
    [
        (
            {"vbat_sag_compensation": "75"},
            "vbat_sag_compensation 75: motors get more at a low voltage",
        ),
        ({"thrust_linear": "20"}, "thrust_linear 20: motors get less"),
        ({"motor_output_limit": "80"}, "motor_output_limit 80: motors get that percentage"),
        (
            {"throttle_limit_type": "1", "throttle_limit_percent": "60"},
            "the throttle is scaled to 60 %",
        ),
        (
            {"throttle_limit_type": "2", "throttle_limit_percent": "60"},
            "the throttle is clipped at 60 %",
        ),
        (
            {
                "throttle_limit_type": "0",
                "throttle_limit_percent": "60",
                "motor_output_limit": "100",
            },
            None,
        ),
    ],
)
def test_settings_that_change_the_thrust_curve_are_told(tmp_path, headers, note):
    said = import_log(write(tmp_path / "a.bbl", log_with(**headers)), "betaflight").notes
    told = [text for text in said if "limit" in text or "sag" in text or "linear" in text]
    assert len(told) == (note is not None) and (note is None or note in told[0])


def test_motors_are_counted_and_their_saturation_told(tmp_path):
    names = [*NAMES, *(f"motor[{number}]" for number in range(6))]
    rows = np.column_stack([frames(), np.full((200, 6), 700)])
    rows[:5, -1] = 2047
    found = import_log(
        write(tmp_path / "a.bbl", log_with(rows, names, motorOutput="158,2047")), "betaflight"
    )
    assert "found 6 motors, not a quadcopter" in found.notes[1]
    assert "a motor at its upper end in 2.50% of the rows" in found.notes[2]
    (tmp_path / "map.toml").write_text("[motors]\nas_thrust = true\n")
    thrust = import_log(tmp_path / "a.bbl", "betaflight", tmp_path / "map.toml").log["u"][:, 3]
    assert (
        thrust[-1] == pytest.approx(2.0 * (700 - 158) / (2047 - 158) - 1.0)
        and thrust[0] > thrust[-1]
    )


def test_logs_of_different_craft_or_channels_make_no_log(tmp_path):
    first = write(tmp_path / "a.bbl", log_with())
    second = write(tmp_path / "b.bbl", log_with(rc_rates="220,100,60"))
    with pytest.raises(
        LogError, match=r"b\.bbl: craft: full stick .* 600 deg/s.*a\.bbl.* 500 deg/s"
    ):
        import_log([first, second], "betaflight")
    write(second, log_with(names=[name.replace("vbatLatest", "x") for name in NAMES]))
    with pytest.raises(
        LogError, match=r"b\.bbl: channels v_bat: not in both this file and .*a\.bbl"
    ):
        import_log([first, second], "betaflight")


def test_real_log_holds_what_another_decoder_found(tmp_path):
    """Which has every second frame, in raw units."""
    folder = shared(BETAFLIGHT)
    with gzip.open(folder / "shortLog_decoded_1kHz.csv.gz", "rt") as file:
        decoded = np.genfromtxt(file, delimiter=",", names=True, deletechars="")
    (tmp_path / "map.toml").write_text('[rows]\non_ground = "keep"\n')
    found = import_log(folder / "shortLog.BFL", "betaflight", tmp_path / "map.toml")
    log = found.log
    assert found.problems == ()
    every = log.select(slice(0, None, 2))
    assert len(every) == len(decoded)
    time_us = decoded["time"] - decoded["time"][0]
    np.testing.assert_allclose(every.time, 1e-6 * time_us, atol=1e-9)
    for axis in range(3):
        np.testing.assert_allclose(
            np.rad2deg(every["w"][:, axis]), decoded[f"gyroADC[{axis}]"], atol=1e-9
        )
        force_g = every["f"][:, axis] / GRAVITY
        np.testing.assert_allclose(force_g, decoded[f"accSmooth[{axis}]"] / 2048, atol=1e-9)
    np.testing.assert_allclose(every["v_bat"][:, 0], decoded["vbatLatest"] / 100, atol=1e-9)
    np.testing.assert_allclose(500.0 * (every["u"][:, 3] + 1.0), decoded["setpoint[3]"], atol=1e-9)
    assert found.craft.max_rate_deg_s == pytest.approx((1021.6, 1021.6, 772.96))
    for axis in (0, 1):  # the largest setpoint is full stick, in whole numbers
        assert decoded[f"setpoint[{axis}]"].max() == 1022 and log["u"][:, axis].max() == 1.0


def test_gecko_flies_without_a_mapping():
    """The first 14 frames change a frame that the decoder lost; smoothing overshoots full stick."""
    found = import_log(shared("bf_gecko") / "btfl_002.bbl", "betaflight")
    log = found.log
    assert len(log) == 66000 and np.diff(log.time).max() < 0.005 and log["v_bat"].min() > 13.0
    assert found.craft.max_rate_deg_s == pytest.approx((700.0, 700.0, 700.0)) and not found.problems
    said = " ".join(found.notes)
    assert "14 frames before the first full one" in said and "9 rows clipped to full stick" in said
    for axis in range(3):  # closely followed
        assert np.corrcoef(log["u"][:, axis], log["w"][:, axis])[0, 1] > 0.98
