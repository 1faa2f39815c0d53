"""Measured flights: imported sensors agree on the motion; the diagnosis of a Crazyflie."""

import json

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from flytrack_sysid import diagnose, import_log
from flytrack_sysid.diagnosis.controller import examine_controller
from flytrack_sysid.kinematics import GRAVITY, cut_windows, summed_turns
from flytrack_sysid.split import held_out_rows
from tests.support.real_logs import CRAZYFLIE, import_shared, shared
from tests.support.tables import table

pytestmark = pytest.mark.slow
WINDOW_S = 0.3
FLIGHTS = table("real_flights")


def check(imported, least, tolerance):
    """Assert that sensors agree on the motion over 0.3 s.

    Gyroscope is compared with attitude, accelerometer with velocity, velocity with position.

    A rate and the change it should show are at least so correlated, and of one size but for a
    tolerance.
    """
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
    windows = cut_windows(log, WINDOW_S)
    for change, rate in pairs:
        shown, measured = (
            windows.mean_rate(change),
            windows.mean_of(log, rate),
        )
        shown, measured = shown - shown.mean(axis=0), measured - measured.mean(axis=0)
        sizes = np.linalg.norm(shown), np.linalg.norm(measured)
        assert np.sum(shown * measured) / (sizes[0] * sizes[1]) > least
        assert sizes[1] / sizes[0] == pytest.approx(1.0, abs=tolerance)


@pytest.mark.parametrize(("folder", "number"), FLIGHTS["lee"])
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


@pytest.mark.parametrize("name", FLIGHTS["nanobench"])
def test_nanobench(name):
    imported = import_log(shared("nanobench") / f"{name}.csv.gz", "csv", "nanobench")
    check(imported, 0.9, 0.15)
    log = imported.log
    for axis in (0, 1):  # the drone turns as the attitude errors ask
        assert np.corrcoef(log["u"][:, axis], log["w"][:, axis])[0, 1] > 0.6


def test_rate_commands_of_learned_policies():
    imported = import_log(
        sorted(shared(CRAZYFLIE).glob("seed*.csv.gz")), "csv", "crazyflie_phoenix"
    )
    check(imported, 0.9, 0.15)
    log = imported.log
    for axis in range(3):  # it turns as commanded, 50 ms later
        assert np.corrcoef(log["u"][:-5, axis], log["w"][5:, axis])[0, 1] > 0.35


def test_angle_commands_without_a_gyroscope():
    imported = import_log(sorted(shared("cf_utias_angle").glob("*.gz")), "csv", "crazyflie_fmpc")
    check(imported, 0.95, 0.05)
    log = imported.log
    pitch_rates = np.gradient(
        Rotation.from_quat(log["q"], scalar_first=True).as_euler("ZYX")[:, 1], 0.02
    )
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


def test_the_settings_of_a_betaflight_controller_are_found_between_sticks_and_motors(tmp_path):
    """The log's header states 700 deg/s at full stick, and P 35, 39 and 40."""
    (tmp_path / "map.toml").write_text(
        "[rows]\nevery = 1\n[motors]\nas_command = true\n"
        '[frame]\npropellers = "out"\ncraft = "five_inch"\nmass_kg = 0.6\n'
    )
    flight = import_shared("bf_gecko/btfl_002.bbl", "betaflight", tmp_path / "map.toml")
    log = flight.log
    controller = examine_controller(log, flight.nominal_model(), held_out_rows(log))
    assert controller.faults == ()
    for loop, setting in zip(controller.loops, (35, 39, 40), strict=True):
        assert loop.full_stick.value == pytest.approx(700.0, rel=0.1)
        # Thousandths of the range from idle (5.5 %) a deg/s, times Betaflight's scale.
        assert loop.gain.value == pytest.approx(0.945 * 10.0 * 0.032029 * setting, rel=0.2)
        assert loop.gyro_delay_s <= 0.01


def test_px4():
    check(import_shared("px4_h520/3DRFlight_1.ulg", "ulog", None), 0.99, 0.02)


# --- The diagnosis of a Crazyflie -----------------------------------------------------------------

AS_GOOD = 1.02  # times another model's error
PARTS = (
    "seed00053_log2",
    "seed00067_log1",
    "seed00066_log1",
    "seed00052_log3",
)  # 23 s of four policies
NEEDS_ACCELEROMETER = {"accelerometer_bias", "accelerometer_scale", "imu_offset"}


@pytest.fixture(scope="module")
def crazyflie():
    """The diagnosis of four short Crazyflie flights, from the nominal model of the importer."""
    files = [shared(CRAZYFLIE) / f"{name}.csv.gz" for name in PARTS]
    found = import_log(files, "csv", "crazyflie_phoenix")
    return diagnose(found.log, found.nominal_model())


def test_what_the_nominal_crazyflie_certainly_lacks_is_named_and_no_more(crazyflie):
    assert crazyflie.verdict.startswith("causes_found")
    causes = {cause.effect: cause for cause in crazyflie.causes}
    thrust = causes.get("thrust_curve", causes.get("thrust_scale"))
    assert thrust is not None and thrust.heldout_gain > 0.0  # it hovers at another stick
    assert not NEEDS_ACCELEROMETER & set(causes)
    unseen = {one.effect for one in crazyflie.not_identifiable}
    assert {"ground_effect", "translational_lift"} <= unseen  # at 1 m, below 2 m/s
    json.dumps(crazyflie.as_json(), allow_nan=False)


def test_the_extended_crazyflie_flies_better_where_it_was_not_fitted(crazyflie):
    nominal, extended = crazyflie.error["nominal"], crazyflie.error["extended"]
    for channel in ("rates", "velocity"):
        assert extended.one_step_nrmse[channel] < nominal.one_step_nrmse[channel]
    for horizon in ("0.5", "1", "2"):  # before, the noise of the start decides
        assert extended.position_m[horizon] < 0.5 * nominal.position_m[horizon]
    base, extended = (crazyflie.prediction.errors[name] for name in ("refitted_base", "extended"))
    for quantity, by_horizon in extended.items():
        for horizon, error in by_horizon.items():
            assert error <= AS_GOOD * base[quantity][horizon]
