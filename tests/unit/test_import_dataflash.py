"""ArduPilot's DataFlash logs: a made-up flight comes back in our frames."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_sysid import LogError, import_log
from tests.support.foreign_logs import COPTER_PARAMETERS, RATE_COLUMNS, dataflash
from tests.support.made_flight import GRAVITY, flight

pytest.importorskip("pymavlink", reason="pymavlink is not installed: pip install 'flytrack[logs]'")

TURN = np.array([1.0, -1.0, -1.0])  # FRD to FLU, NED to north, west, up
TIME_S = 0.0025 * np.arange(4800)
START_US = 7_000_000
TRUTH = flight(TIME_S)
FULL_STICK_DEG_S = np.array([500.0, 360.0, 180.0])
Messages = dict[str, tuple[str, str, list[tuple[Any, ...]]]]


def rows_of(every: int, *columns: Any) -> list[tuple[Any, ...]]:
    """Return rows of stamps and columns; each of every so many samples."""
    stamps_us = np.round(START_US + 1e6 * TIME_S)
    table = np.column_stack(
        [
            stamps_us,
            *(np.broadcast_to(column, (len(TIME_S), *np.shape(column)[1:])) for column in columns),
        ]
    )
    return [(int(row[0]), *row[1:].tolist()) for row in table[::every]]


def messages() -> Messages:
    """Return the messages of the made flight: NED and FRD, degrees."""
    attitude = Rotation.from_quat(TRUTH["q"], scalar_first=True)
    half = Rotation.from_rotvec([np.pi, 0.0, 0.0])
    ned = half * attitude * half
    quat, euler = ned.as_quat(scalar_first=True), ned.as_euler("ZYX", degrees=True)[:, ::-1]
    rates = np.rad2deg(TRUTH["w"] * TURN)
    setpoints = TRUTH["u"][:, :3] * FULL_STICK_DEG_S * TURN
    zero = np.zeros(len(TIME_S))
    columns = [zero] * 12
    columns[0:9:3], columns[1:9:3] = list(setpoints.T), list(rates.T)
    columns[11] = 0.5 * (TRUTH["u"][:, 3] + 1.0)
    imu = (TRUTH["w"] * TURN, TRUTH["f"] * TURN)
    imu_columns = "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,GH,AH"
    instance = [(0, 0.0, 1.0), (1, 1.0, 1.0), (2, 1.0, 0.0)]  # the gyro of the first is broken
    sensors = [
        row
        for number, good, scale in instance
        for row in rows_of(
            8, zero + number, *(scale * part for part in imu), zero + good, zero + 1.0
        )
    ]
    volts = TRUTH["v_bat"][:, 0]
    packs = rows_of(400, zero, zero) + rows_of(400, zero + 1, volts)
    packs[len(packs) // 2 + 3] = (*packs[len(packs) // 2 + 3][:2], 0.0)  # one reading fails
    motors = [1000.0 + 1000.0 * (0.15 + 0.8 * 0.25 * (number + 0 * zero)) for number in range(4)]
    return {
        "RATE": ("Qffffffffffff", RATE_COLUMNS, rows_of(1, *columns)),
        "IMU": ("QBffffffBB", imu_columns, sensors),
        "ATT": ("Qfff", "TimeUS,Roll,Pitch,Yaw", rows_of(8, euler)),
        "XKQ": ("QBffff", "TimeUS,C,Q1,Q2,Q3,Q4", rows_of(8, zero, quat)),
        "XKF1": (
            "QBffffff",
            "TimeUS,C,VN,VE,VD,PN,PE,PD",
            rows_of(8, zero, TRUTH["v"] * TURN, TRUTH["p"] * TURN),
        ),
        "BAT": ("QBf", "TimeUS,Instance,Volt", packs),
        "RCOU": ("QHHHH", "TimeUS,C1,C2,C3,C4", rows_of(8, *motors)),
    }


def write(path: Path, found: Messages, **options: Any) -> Path:
    path.write_bytes(dataflash(found, **options))
    return path


@pytest.mark.parametrize("attitude", ["XKQ", "ATT"])
def test_a_made_flight_comes_back(tmp_path: Path, attitude: str) -> None:
    written = messages()
    if attitude == "ATT":
        del written["XKQ"]
    found = import_log(write(tmp_path / "a.bin", written), "dataflash", align=False)
    log = found.log
    assert (
        len(log) > 4700
        and log.time[0] == 0.0
        and np.diff(log.time) == pytest.approx(0.0025, abs=1e-6)
    )
    rows = np.round(log.time / 0.0025).astype(int)
    tolerances = {
        "u": 1e-6,
        "w": 1e-6,
        "f": 0.3,
        "v": 0.02,
        "p": 0.01,
        "v_bat": 0.02,
    }  # interpolated at 50 Hz; the battery ends 1 s earlier
    for name, tolerance in tolerances.items():
        np.testing.assert_allclose(log[name], TRUTH[name][rows], atol=tolerance, err_msg=name)
    turned = Rotation.from_quat(log["q"], scalar_first=True).inv() * Rotation.from_quat(
        TRUTH["q"][rows], scalar_first=True
    )
    assert np.max(turned.magnitude()) < 0.01
    assert found.problems == () and found.craft.max_rate_deg_s == pytest.approx(
        tuple(FULL_STICK_DEG_S)
    )
    said = " ".join(found.notes)
    assert "instance 1 of IMU is used, not 0 (not healthy), 2" in said
    assert "instance 1 of BAT is used, not 0 (not healthy)" in said
    assert "1 of 12 voltages of battery 1 are not above 0" in said and "rates of RATE" in said
    assert "a motor at its upper end in 0.00%" in said


def test_frames_agree_by_the_motion(tmp_path: Path) -> None:
    """Rates turn the attitude; turned specific force less gravity is the velocity's derivative."""
    log = import_log(write(tmp_path / "a.bin", messages()), "dataflash", align=False).log
    attitude = Rotation.from_quat(log["q"], scalar_first=True)
    step_s = np.diff(log.time)[:, None]
    turns = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / step_s
    accelerations = np.diff(log["v"], axis=0) / step_s
    forces = attitude.apply(log["f"])[:-1] - np.array([0.0, 0.0, GRAVITY])
    for axis in range(3):
        assert np.corrcoef(turns[:, axis], log["w"][:-1, axis])[0, 1] > 0.99
        assert np.corrcoef(accelerations[:, axis], forces[:, axis])[0, 1] > 0.95


def test_rates_of_the_imu_where_it_is_faster_and_motors_as_thrust(tmp_path: Path) -> None:
    written = messages()
    written["RATE"] = (*written["RATE"][:2], written["RATE"][2][::16])
    (tmp_path / "map.toml").write_text("[motors]\nas_thrust = true\n")
    found = import_log(
        write(tmp_path / "a.bin", written), "dataflash", tmp_path / "map.toml", align=False
    )
    assert np.diff(found.log.time) == pytest.approx(0.02) and "rates of IMU" in " ".join(
        found.notes
    )
    assert found.log["u"][:, 3] == pytest.approx(
        2.0 * 0.375 - 1.0, abs=1e-3
    )  # the mean of 0, 1/4, 1/2, 3/4


def test_setpoints_past_full_stick_raise_it(tmp_path: Path) -> None:
    written = messages()
    rows = written["RATE"][2]
    rows[100] = (rows[100][0], 777.0, *rows[100][2:])
    found = import_log(write(tmp_path / "a.bin", written), "dataflash", align=False)
    assert (
        found.craft.max_rate_deg_s == pytest.approx((777.0, 360.0, 180.0))
        and found.log["u"].max() == 1.0
    )
    assert any(
        "RDes reaches 777 deg/s: full stick is that, not 500" in note for note in found.notes
    )


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (("RATE",), {}, r"a\.bin: message RATE: missing or without R, P, .*found ATT, BAT, IMU"),
        (
            (),
            {"parameters": {"ACRO_RP_RATE": 360.0}},
            r"a\.bin: parameters ACRO_Y_RATE, .*so full stick is unknown",
        ),
        (
            (),
            {"text": "ArduPlane V4.5.7"},
            r"a\.bin: found a log of ArduPlane V4\.5\.7, expected one of ArduCopter",
        ),
        (
            (),
            {"parameters": {**COPTER_PARAMETERS, "Q_ENABLE": 1.0}},
            r"a\.bin: found a log of a quadplane",
        ),
        ((), None, r"a\.bin: damaged|a\.bin: message RATE: missing"),
    ],
)
def test_other_logs_are_refused(
    tmp_path: Path, change: tuple[str, ...], options: Any, message: str
) -> None:
    written = {name: content for name, content in messages().items() if name not in change}
    path = write(tmp_path / "a.bin", written, **(options or {}))
    if options is None:
        path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(LogError, match=message):
        import_log(path, "dataflash")


def test_another_airframe_is_told(tmp_path: Path) -> None:
    parameters = {**COPTER_PARAMETERS, "FRAME_CLASS": 2.0}
    found = import_log(write(tmp_path / "a.bin", messages(), parameters=parameters), "dataflash")
    assert any(
        "found a hexacopter (FRAME_CLASS 2), not a quadcopter" in note for note in found.notes
    )
