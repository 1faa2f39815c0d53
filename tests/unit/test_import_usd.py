"""Crazyflie's uSD logs: the binary format, and commands of torques."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_sysid import LogError, import_log
from tests.support.foreign_logs import usd, usd_log
from tests.support.written_logs import read_mapping

USD_MAPPING = read_mapping("usd")
GAINS = {"KR": (0.009, 0.008, 0.007), "Kw": (0.00125, 0.001, 0.0025), "KI": (0.05, 0.04, 0.0)}
LEE = 'extends = "crazyflie_lee"\n'
VECTORS = ("rpy", "rpyd", "omega", "omegar", "torque")


def read(folder: Path, content: bytes, mapping: str = USD_MAPPING):
    """Return the import of a log with that content."""
    (folder / "log00").write_bytes(content)
    (folder / "map.toml").write_text(mapping)
    return import_log(folder / "log00", "usd", folder / "map.toml")


@pytest.mark.parametrize("version", [1, 2])
def test_events_of_other_rates_become_one_log(tmp_path, version):
    time = 5.0 + 0.002 * np.arange(400)
    motion = np.column_stack([time, np.rad2deg(np.sin(time)), 0 * time, 0 * time])
    sticks = np.column_stack([5.0 + 0.01 * np.arange(85), *[np.linspace(-1.0, 1.0, 85)] * 4])
    names = {"roll": "d", "pitch": "f", "yaw": "f", "thrust": "f"}
    volts = np.array([[5.1, 3900.0], [5.5, 3700.0]])
    events = {
        "gyro": ({"gyro.x": "d", "gyro.y": "f", "gyro.z": "f"}, motion),
        "sticks": (names, sticks),
        "battery": ({"pm.vbat": "H"}, volts),
    }
    log = read(tmp_path, usd_log(events, version)).log
    np.testing.assert_allclose(log.time, 0.002 * np.arange(400), atol=1e-9)
    np.testing.assert_allclose(log["w"][:, 0], np.sin(time), atol=1e-9)
    assert (log["u"][:5, 0] == -1.0).all() and log["u"][5, 0] == pytest.approx(
        -1.0 + 2.0 / 84
    )  # held
    assert log["v_bat"][[0, 150, -1], 0] == pytest.approx([3.9, 3.8, 3.7])


def test_rows_that_are_no_numbers_are_left_out_and_counted(tmp_path):
    time = 1.0 + 0.01 * np.arange(50)
    rows = np.column_stack([time, *[0 * time] * 7])
    rows[:, 4], rows[20:22, 6] = 0.1, np.nan
    names = dict.fromkeys(("roll", "pitch", "yaw", "thrust", "gyro.x", "gyro.y", "gyro.z"), "f")
    battery = {"pm.vbat": "f"}, np.array([[1.0, 3900.0], [1.2, np.inf]])
    found = read(tmp_path, usd_log({"e": (names, rows), "battery": battery}))
    assert len(found.log) == 48 and found.log["v_bat"] == pytest.approx(3.9)
    said = " ".join(found.notes)
    assert (
        "2 of 50 rows of rates left out: 2 not finite" in said
        and "1 of 2 rows of battery left out" in said
    )


def test_a_cut_off_or_damaged_log_is_read_to_its_end(tmp_path):
    found = read(tmp_path, usd()[:-100])
    assert (
        20 <= len(found.log) < 30 and "damaged or cut off: the checksum is wrong" in found.notes[0]
    )
    content = bytearray(usd())
    content[-150] ^= 1
    assert "the checksum is wrong" in read(tmp_path, bytes(content)).notes[0]


REFUSALS = {
    r"log00: found an empty file, expected a Crazyflie uSD log": b"",
    r"log00: damaged header: found version 3, expected one of 1, 2": b"\xbc\x03" + usd()[2:],
    r"damaged header: found variable gyro\.x\(s\), expected name": usd().replace(b"x(f)", b"x(s)"),
    r"column gyro\.x: found 0 times among .*map\.toml: rates": usd().replace(
        b"gyro.x(f)", b"gyro.q(f)"
    ),
}


@pytest.mark.parametrize("message", REFUSALS)
def test_what_is_no_such_log_is_refused(tmp_path, message):
    with pytest.raises(LogError, match=message):
        read(tmp_path, REFUSALS[message])


def lee_log() -> tuple[bytes, np.ndarray]:
    """Return a log whose torques follow the law, 10 s at 250 Hz, and its rate setpoints, rad/s."""
    time = 1.0 + 0.004 * np.arange(2500)
    phases = np.array([0.0, 1.0, 2.0])
    angles, wanted = (0.1 * np.sin(scale * time[:, None] + phases) for scale in (2.0, 2.3))
    rates, reference = (np.cos(scale * time[:, None] + phases) for scale in (3.0, 1.7))
    r, rd = (Rotation.from_euler("ZYX", one[:, ::-1]).as_matrix() for one in (angles, wanted))
    skew = 0.5 * (np.einsum("nji,njk->nik", rd, r) - np.einsum("nji,njk->nik", r, rd))
    errors = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    kr, kw, ki = (np.array(GAINS[name]) for name in ("KR", "Kw", "KI"))
    asked = reference - kr / kw * errors
    torque = kw * (asked - rates) - ki * (np.cumsum(errors, axis=0) - 0.5 * errors) * 0.004
    names = [f"ctrlLee.{vector}{axis}" for vector in VECTORS for axis in "xyz"] + [
        "ctrlLee.thrustSI"
    ]
    names += [f"stateEstimateZ.{axis}" for axis in ("x", "y", "z", "vx", "vy", "vz")]
    rows = np.column_stack(
        [time, angles, wanted, rates, reference, torque, 0.35 + 0 * time, *[0 * time] * 6]
    )
    return usd_log({"fixedFrequency": (dict.fromkeys(names, "d"), rows)}), asked


def test_torques_become_the_rates_that_the_controller_tracks(tmp_path):
    content, asked = lee_log()
    found = read(tmp_path, content, f"{LEE}[craft]\nmass_kg = 0.032\n")
    commanded = found.log["u"][:, :3] * np.deg2rad([800.0, 800.0, 400.0])
    np.testing.assert_allclose(commanded, asked, atol=0.001 * np.abs(asked).max())
    said = " ".join(found.notes)
    assert "identified with Kw 0.00125, 0.001, 0.0025 N m s/rad; the law explains 100.0%" in said
    assert found.log["u"][:, 3] == pytest.approx(0.0)
    assert found.craft.mass_kg == 0.032 and "f" not in found.log
    stated = "[torque_command]\ninertia_kg_m2 = [1e-5, 1e-5, 2e-5]\nlag_s = [0.01, 0.01, 0.01]\n"
    assert "0.001, 0.001, 0.002 N m s/rad (given)" in " ".join(
        read(tmp_path, content, LEE + stated).notes
    )
