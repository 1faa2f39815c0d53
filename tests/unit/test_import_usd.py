"""Crazyflie's uSD logs: the binary format, and commands of torques."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from flytrack_sysid import LogError, import_log
from tests.support.foreign_logs import flying, usd_log, write_mapping, write_usd

KR, KW, KI = np.array([[0.009, 0.008, 0.007], [0.00125, 0.001, 0.0025], [0.05, 0.04, 0.0]])
LEE = 'extends = "crazyflie_lee"\n'
VECTORS = ("rpy", "rpyd", "omega", "omegar", "torque")


def read(folder, content, mapping=None):
    """Return the import of a log with that content."""
    (folder / "log00").write_bytes(content)
    path = write_mapping(folder)
    if mapping is not None:
        path.write_text(mapping)
    return import_log(folder / "log00", "usd", path)


def events():
    """Return sensors at 500 Hz, sticks at 100 Hz, and two voltages."""
    time = 5.0 + 0.002 * np.arange(400)
    sensors = np.column_stack([time, np.rad2deg(np.sin(time)), np.zeros((400, 5))])
    sticks = np.column_stack([5.0 + 0.01 * np.arange(85), *[np.linspace(-1.0, 1.0, 85)] * 4])
    volts = np.array([[5.1, 39.0], [5.5, 37.0]])
    return {
        "sensors": (dict.fromkeys(("p", "q", "r", "ax", "ay", "az"), "d"), sensors),
        "sticks": ({"roll": "d", "pitch": "f", "yaw": "f", "thrust": "f"}, sticks),
        "battery": ({"volts": "H"}, volts),
    }


@pytest.mark.parametrize("version", [1, 2])
def test_events_of_other_rates_become_one_log(tmp_path, version):
    log = read(tmp_path, usd_log(events(), version)).log
    assert_allclose(log.time, 0.002 * np.arange(400), atol=1e-9)
    assert_allclose(log["w"][:, 0], np.sin(5.0 + log.time), atol=1e-9)
    held = -1.0 + 2.0 / 84 * np.arange(80)
    assert_allclose(log["u"][:, 0], np.repeat(held, 5), atol=1e-9)
    assert log["v_bat"][[0, 150, -1], 0] == pytest.approx([39.0, 38.0, 37.0])


def test_rows_that_are_no_numbers_are_left_out_and_counted(tmp_path):
    parts = events()
    parts["sensors"][1][20:22, 3] = np.nan
    battery = {"volts": "f"}, np.array([[5.1, 39.0], [5.5, np.inf]])
    imported = read(tmp_path, usd_log({**parts, "battery": battery}))
    assert len(imported.log) == 398 and imported.log["v_bat"] == pytest.approx(39.0)
    notes = " ".join(imported.notes)
    assert "2 of 400 rows of rates left out: 2 not finite" in notes
    assert "1 of 2 rows of battery left out" in notes


def test_a_damaged_log_is_read_and_said_to_be_damaged(tmp_path):
    content = bytearray(usd_log(events()))
    content[-1500] ^= 1
    assert "the checksum is wrong" in read(tmp_path, bytes(content)).notes[0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"\xbc\x02", b"\xbc\x03", "damaged header: found version 3, expected one of 1, 2"),
        (b"ax(f)", b"ax(s)", r"damaged header: found variable ax\(s\), expected name"),
        (b"p(f)", b"o(f)", r"column p: found 0 times among .*map\.toml: rates"),
    ],
)
def test_what_is_no_such_log_is_refused(tmp_path, old, new, message):
    content = write_usd(tmp_path, flying())[0].read_bytes()
    with pytest.raises(LogError, match=f"log00: .*{message}"):
        read(tmp_path, content.replace(old, new))


def lee_log():
    """Return a log whose torques follow the law, 10 s at 250 Hz, and its rate setpoints, rad/s."""
    time = 1.0 + 0.004 * np.arange(2500)
    phases = np.array([0.0, 1.0, 2.0])
    angles, wanted = (0.1 * np.sin(scale * time[:, None] + phases) for scale in (2.0, 2.3))
    rates, reference = (np.cos(scale * time[:, None] + phases) for scale in (3.0, 1.7))
    attitude = Rotation.from_euler("ZYX", angles[:, ::-1])
    turn = (Rotation.from_euler("ZYX", wanted[:, ::-1]).inv() * attitude).as_matrix()
    skew = 0.5 * (turn - turn.transpose(0, 2, 1))
    errors = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    setpoints = reference - KR / KW * errors
    torque = KW * (setpoints - rates) - KI * (np.cumsum(errors, axis=0) - 0.5 * errors) * 0.004
    names = [f"ctrlLee.{vector}{axis}" for vector in VECTORS for axis in "xyz"]
    names.append("ctrlLee.thrustSI")
    names += [f"stateEstimateZ.{axis}" for axis in ("x", "y", "z", "vx", "vy", "vz")]
    thrust_and_place = np.tile([0.35, *[0.0] * 6], (len(time), 1))
    rows = np.column_stack([time, angles, wanted, rates, reference, torque, thrust_and_place])
    return usd_log({"fixedFrequency": (dict.fromkeys(names, "d"), rows)}), setpoints


def test_torques_become_the_rates_that_the_controller_tracks(tmp_path):
    content, setpoints = lee_log()
    imported = read(tmp_path, content, f"{LEE}[craft]\nmass_kg = 0.032\n")
    commanded = imported.log["u"][:, :3] * np.deg2rad([800.0, 800.0, 400.0])
    assert_allclose(commanded, setpoints, atol=0.001 * np.abs(setpoints).max())
    gains = "identified with Kw 0.00125, 0.001, 0.0025 N m s/rad; the law explains 100.0%"
    assert gains in " ".join(imported.notes)
    assert imported.log["u"][:, 3] == pytest.approx(0.0)
    assert imported.craft.mass_kg == 0.032 and "f" not in imported.log
    stated = "[torque_command]\ninertia_kg_m2 = [1e-5, 1e-5, 2e-5]\nlag_s = [0.01, 0.01, 0.01]\n"
    notes = " ".join(read(tmp_path, content, LEE + stated).notes)
    assert "0.001, 0.001, 0.002 N m s/rad (given)" in notes
