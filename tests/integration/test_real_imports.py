"""Every real log: after import, sensors that measure one motion agree in sign and scale."""

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from flytrack_sysid import Imported, import_log
from flytrack_sysid.importing.units import GRAVITY
from flytrack_sysid.plausibility import summed_turns, windows_of
from tests.support.real_logs import shared

pytestmark = pytest.mark.slow  # half a second each
WINDOW_S = 0.3
LEE = {"cf_lee_standard": (182, 183), "cf_lee_upgraded": (29, 45, 108, 113, 115, 119, 202, 203)}
# Log 30 ends in a crash. Logs 182 and 183 hardly accelerate, and their velocity is a slow estimate.
NANOBENCH = ("B10_lissajous_fast_rep1", "B2_circle_fast_rep1", "B3_figure8_fast_rep1", "B3_figure8_slow_rep1")
NANOBENCH += ("B5_helix_fast_rep1", "B7_oval_fast_rep1", "B8_star_fast_rep1", "B9_trefoil_fast_rep14")
NANOBENCH += ("B9_trefoil_medium_rep12",)


def agreement(imported: Imported, change: np.ndarray, rate: np.ndarray) -> tuple[float, float]:
    """Return correlation and ratio of sizes of a rate and of the change it should show, over 0.3 s."""
    windows = windows_of(imported.log, WINDOW_S)
    shown = windows.change_of(change) / windows.durations[:, None]
    measured = windows.mean_of(imported.log, rate)
    shown, measured = shown - shown.mean(axis=0), measured - measured.mean(axis=0)
    sizes = np.linalg.norm(shown), np.linalg.norm(measured)
    return float(np.sum(shown * measured) / (sizes[0] * sizes[1])), float(sizes[1] / sizes[0])


def check(imported: Imported, least: float, tolerance: float) -> None:
    """Assert that gyroscope and attitude, accelerometer and velocity, velocity and position agree."""
    log = imported.log
    assert imported.problems == ()
    pairs = []
    if "q" in log and "w" in log:
        pairs.append((summed_turns(Rotation.from_quat(log["q"], scalar_first=True)), log["w"]))
    if "f" in log and "v" in log:
        force_w = Rotation.from_quat(log["q"], scalar_first=True).apply(log["f"])
        pairs.append((log["v"], force_w - np.array([0.0, 0.0, GRAVITY])))
    if "p" in log and "v" in log:
        pairs.append((log["p"], log["v"]))
    assert pairs
    for change, rate in pairs:
        correlation, ratio = agreement(imported, change, rate)
        assert correlation > least and ratio == pytest.approx(1.0, abs=tolerance)


@pytest.mark.parametrize(
    ("folder", "number"), [(name, one) for name, numbers in LEE.items() for one in numbers]
)
def test_lee_logs(tmp_path, folder, number):
    path = shared(folder) / f"log{number}"
    stated = yaml.safe_load(path.with_name(f"info{number}.yaml").read_text())
    thrust = f'[thrust_command]\ncolumn = "ctrlLee.{"thrustSI" if number > 180 else "thrustSi"}"\n'
    mass = f"[craft]\nmass_kg = {stated['mass']}\n"
    (tmp_path / "map.toml").write_text(f'extends = "crazyflie_lee"\n{thrust}{mass}')
    imported = import_log(path, "usd", tmp_path / "map.toml")
    check(imported, 0.95, 0.22)
    assert imported.nominal_model().m == stated["mass"]
    note = next(note for note in imported.notes if "rate commands" in note)
    gains = [float(text) for text in note.partition("with Kw ")[2].split(" N m")[0].split(", ")]
    true = {108: (0.001, 0.001, 0.001), 115: (0.002, 0.002, 0.004)}  # the info files are wrong
    expected = true.get(number, tuple(stated[f"Kw_{axis}"] for axis in "xyz"))
    assert gains == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("name", NANOBENCH)
def test_nanobench(name):
    imported = import_log(shared("nanobench") / f"{name}.csv.gz", "csv", "nanobench")
    check(imported, 0.9, 0.15)
    log = imported.log
    for axis in (0, 1):  # the drone turns as the attitude errors ask
        assert np.corrcoef(log["u"][:, axis], log["w"][:, axis])[0, 1] > 0.6


def test_angle_commands_without_a_gyroscope():
    imported = import_log(sorted(shared("cf_utias_angle").glob("*.gz")), "csv", "crazyflie_fmpc")
    check(imported, 0.95, 0.05)
    log = imported.log
    pitch_rates = np.gradient(Rotation.from_quat(log["q"], scalar_first=True).as_euler("ZYX")[:, 1], 0.02)
    assert np.corrcoef(log["u"][:-3, 1], pitch_rates[3:])[0, 1] > 0.7  # 60 ms later


@pytest.mark.parametrize(("number", "from_s", "to_s"), [(15, 14.0, 52.0), (16, 16.0, 31.0)])
def test_torques_of_motors_show_the_rotation_that_follows(tmp_path, number, from_s, to_s):
    rows = f"[rows]\nfrom_s = {from_s}\nto_s = {to_s}\n"
    (tmp_path / "map.toml").write_text(f'extends = "crazyflie_motors"\n{rows}')
    log = import_log(shared("cf_arpl_motors") / f"log{number}", "usd", tmp_path / "map.toml").log
    asked = log["u"][:, :3] * np.deg2rad([1500.0, 1500.0, 600.0]) - log["w"]  # torque over gain
    turned = np.zeros_like(asked)
    turned[:-60] = log["w"][60:] - log["w"][:-60]  # 60 ms: the motors' lag
    axes = (0, 1) if number == 15 else (2,)  # what was excited
    for axis in axes:
        smooth = [np.convolve(one[:, axis], np.ones(60) / 60, "same") for one in (asked, turned)]
        assert np.corrcoef(*smooth)[0, 1] > 0.5


def test_px4():
    check(import_log(shared("px4_h520") / "3DRFlight_1.ulg", "ulog"), 0.99, 0.02)
