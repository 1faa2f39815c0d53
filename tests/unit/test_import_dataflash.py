"""ArduPilot's DataFlash logs: instances, other rates, full stick, and other vehicles."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_sysid import LogError, import_log
from tests.support.foreign_logs import COPTER_PARAMETERS, dataflash, dataflash_messages
from tests.support.tables import table

pytest.importorskip("pymavlink", reason="pymavlink is not installed: pip install 'flytrack[logs]'")


@pytest.fixture
def messages(truth):
    """Return the messages of 2 s of the made flight."""
    return dataflash_messages(truth.select(slice(200)))


@pytest.fixture
def read(tmp_path):
    """Return the import of messages."""

    def import_messages(messages, mapping="", **options):
        (tmp_path / "a.bin").write_bytes(dataflash(messages, **options))
        (tmp_path / "map.toml").write_text(mapping)
        return import_log(tmp_path / "a.bin", "dataflash", tmp_path / "map.toml", align=False)

    return import_messages


def change(messages, name, **columns):
    """Return the rows of a message with other values in some columns."""
    rows = np.array(messages[name][2])
    for column, value in columns.items():
        rows[:, messages[name][1].split(",").index(column)] = value
    return [(int(row[0]), *row[1:].tolist()) for row in rows]


def test_the_first_healthy_instance_is_used(truth, messages, read):
    healthy, volts = change(messages, "IMU", I=1), change(messages, "BAT", Instance=1)
    volts[100] = (*volts[100][:2], 0.0)  # one reading fails
    broken = change(messages, "IMU", GyrX=0.0, GH=0)
    messages["IMU"] = (*messages["IMU"][:2], broken + healthy + change(messages, "IMU", I=2, GH=0))
    messages["BAT"] = (*messages["BAT"][:2], change(messages, "BAT", Volt=0.0) + volts)
    del messages["RATE"][2][1::2]  # which leaves the IMU's rates as the faster ones
    imported = read(messages)
    rows = np.round(100.0 * imported.log.time).astype(int)
    np.testing.assert_allclose(imported.log["w"], truth["w"][rows], atol=1e-5)
    np.testing.assert_allclose(imported.log["v_bat"], truth["v_bat"][rows], atol=1e-5)
    notes = " ".join(imported.notes)
    assert "instance 1 of IMU is used, not 0 (not healthy), 2" in notes
    assert "instance 1 of BAT is used, not 0 (not healthy)" in notes
    assert "1 of 200 voltages of battery 1 are not above 0" in notes and "rates of IMU" in notes


def test_angles_are_read_where_there_are_no_quaternions(truth, messages, read):
    del messages["XKQ"]
    log = read(messages).log
    attitude, expected = (
        Rotation.from_quat(quat, scalar_first=True) for quat in (log["q"], truth["q"][: len(log)])
    )
    assert np.max((attitude.inv() * expected).magnitude()) < 1e-4


def test_motors_are_thrust_if_a_mapping_says_so(messages, read):
    # Of the range of a motor, 0.15 to 0.95: 0, 1/4, 1/2 and 3/4.
    rows = [(row[0], 1150, 1350, 1550, 1750) for row in messages["RATE"][2]]
    messages["RCOU"] = ("QHHHH", "TimeUS,C1,C2,C3,C4", rows)
    imported = read(messages, "[motors]\nas_thrust = true\n")
    assert imported.log["u"][:, 3] == pytest.approx(2.0 * 0.375 - 1.0, abs=1e-3)
    assert "a motor at its upper end in 0.00%" in " ".join(imported.notes)


def test_setpoints_past_full_stick_raise_it(messages, read):
    rows = messages["RATE"][2]
    rows[100] = (rows[100][0], 777.0, *rows[100][2:])
    imported = read(messages)
    assert imported.craft.max_rate_deg_s == pytest.approx((777.0, 360.0, 180.0))
    assert imported.log["u"].max() == 1.0
    assert "RDes reaches 777 deg/s: full stick is that, not 500" in " ".join(imported.notes)


@pytest.mark.parametrize(
    ("absent", "options", "message"),
    [
        ("RATE", {}, "message RATE: missing or without R, P, .*found ATT, BAT, IMU"),
        (
            "",
            {"parameters": {"ACRO_RP_RATE": 360.0}},
            "parameters ACRO_Y_RATE, .*so full stick is unknown",
        ),
        (
            "",
            {"text": "ArduPlane V4.5.7"},
            r"found a log of ArduPlane V4\.5\.7, expected one of ArduCopter",
        ),
        (
            "",
            {"parameters": {**COPTER_PARAMETERS, "Q_ENABLE": 1.0}},
            "found a log of a quadplane",
        ),
    ],
)
def test_other_logs_are_refused(messages, read, absent, options, message):
    messages.pop(absent, None)
    with pytest.raises(LogError, match=rf"a\.bin: {message}"):
        read(messages, **options)


def test_another_airframe_is_noted(messages, read):
    notes = read(messages, parameters={**COPTER_PARAMETERS, "FRAME_CLASS": 2.0}).notes
    assert "found a hexacopter (FRAME_CLASS 2), not a quadcopter" in " ".join(notes)


CASES = table("dataflash")
OF_MOTORS = "[motors]\nas_command = true\n"


def with_outputs(messages, every=1):
    """Return messages with outputs 1 to 4 of a tenth to four of the range, and a movement."""
    rows = [
        (row[0], *(1000 + 100 * motor + index % 2 for motor in range(1, 5)))
        for index, row in enumerate(messages["RATE"][2][::every])
    ]
    return {**messages, "RCOU": ("QHHHH", "TimeUS,C1,C2,C3,C4", rows)}


@pytest.mark.parametrize(("parameters", "shares"), CASES["order"])
def test_motors_are_commands_in_our_order(messages, read, parameters, shares):
    log = read(with_outputs(messages), OF_MOTORS, parameters=parameters).log
    assert log.has_motors and "sticks" not in log  # full stick is not known
    np.testing.assert_allclose(log["u"][0], 2.0 * np.array(shares) - 1.0, atol=3e-3)


def test_sticks_are_kept_beside_motors_which_must_be_there(messages, read):
    of_motors = read(with_outputs(messages), OF_MOTORS).log
    np.testing.assert_allclose(of_motors["sticks"], read(messages).log["u"])
    with pytest.raises(LogError, match="message RCOU: missing or without C4, C1, C2, C3"):
        read(messages, OF_MOTORS)


@pytest.mark.parametrize(("every", "parameters", "frame", "message"), CASES["refused"])
def test_motors_that_do_not_suit_are_refused(messages, read, every, parameters, frame, message):
    with pytest.raises(LogError, match=message):
        read(with_outputs(messages, every), OF_MOTORS + frame, parameters=parameters)
