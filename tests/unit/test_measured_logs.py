"""What a log states (its origin, its pack's voltages) survives and decides how it is replayed."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from flytrack_env import Battery, Motion, load_model, nominal_parameters, save_model
from flytrack_env.dynamics import collective_thrust
from flytrack_sysid import fit, load_log, save_log, validate
from flytrack_sysid.clocks import align_clocks, on_one_clock
from flytrack_sysid.diagnosis import diagnose_change, joined, motion_of
from flytrack_sysid.diagnosis.diagnose import split
from flytrack_sysid.diagnosis.size import is_notable
from flytrack_sysid.fit import what_is_fitted
from flytrack_sysid.importing.flight import Craft
from flytrack_sysid.inference.chunks import NUM_AXES
from flytrack_sysid.inference.lateness import TAPS, Late, read_poses
from flytrack_sysid.inference.parameters import DRAIN
from flytrack_sysid.inference.record import fill_gaps, make_record
from flytrack_sysid.log import STATED, LogError
from flytrack_sysid.log_motion import motion_notes, required_motion
from flytrack_sysid.log_voltage import (
    battery_of_craft,
    fitted_battery,
    flown_voltages,
    voltage_notes,
)
from flytrack_sysid.sensors import measure
from tests.support.handout_plant import GRAVITY, HandoutPlant, excited
from tests.support.tables import table
from tests.support.written_logs import (
    NUM_ROWS,
    SUFFIXES,
    columns_of,
    make_log,
    through_file,
    with_channels,
    write,
)

FOUR_CELLS, MIDDLE_V = (14.0, 16.8), 15.4
CRAFT = Craft((343.775, 343.775, 343.775), 0.7, FOUR_CELLS)
FORCE_PER_VOLT = 35.0 / 16.8  # m/s^2 at full stick
NOMINAL = nominal_parameters()
CONTINUOUS = NOMINAL._replace(motion=Motion.CONTINUOUS)
CASES = table("measured_logs")


OPERATIONS = {
    "written as .npz": lambda log, folder: through_file(log, folder / "log.npz"),
    "written as .csv": lambda log, folder: through_file(log, folder / "log.csv"),
    "trimmed": lambda log, folder: log.select(slice(300, 900)),
    "one row of": lambda log, folder: log.select(np.arange(len(log)) == 7),
    "without": lambda log, folder: log.without("p", "a"),
    "joined": lambda log, folder: joined([log, log]),
    "gaps filled": lambda log, folder: fill_gaps(log.select(np.arange(len(log)) % 50 > 0)).log,
    "clocks aligned": lambda log, folder: align_clocks(log, True)[0],
    "on one clock": lambda log, folder: on_one_clock(log)[0],
    "poses read later": lambda log, folder: read_poses(log, 0.01)[0],
}


@pytest.mark.parametrize("operation", OPERATIONS)
def test_what_is_stated_survives(operation, truth, tmp_path):
    for origin, voltages in (("measured", FOUR_CELLS), ("simulated", None), (None, FOUR_CELLS)):
        log = replace(
            truth.without("v_bat"), origin=origin, stated_voltage_v=voltages, stated_mass_kg=0.7
        )
        result = OPERATIONS[operation](log, tmp_path)
        assert (result.origin, result.stated_voltage_v) == (origin, voltages)
        assert result.stated_mass_kg == 0.7


def test_the_hash_is_of_the_rows_alone():
    log = make_log()
    assert replace(log, origin="measured", stated_voltage_v=FOUR_CELLS).sha256 == log.sha256


ONES = np.ones(NUM_ROWS)
LATER = (np.arange(NUM_ROWS) > 3) * ONES


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"measured": 2.0 * ONES}, r"measured: found 2\.0, expected 1 \(a real drone\) or 0"),
        ({"measured": LATER}, r"row 4.*measured: found 1\.0, expected 0 as in row 0"),
        ({"v_bat_low": ONES}, "column v_bat_high: missing; found only v_bat_low"),
        ({"v_bat_low": 17.0 * ONES, "v_bat_high": ONES}, "found 17 to 1 V, expected"),
        ({"mass_kg": 0.0 * ONES}, "mass_kg: found 0 kg, expected a mass above 0"),
    ],
)
def test_files_that_state_nonsense_are_refused(suffix, columns, message, tmp_path):
    path = tmp_path / f"log{suffix}"
    write(path, columns_of(make_log()) | columns)
    with pytest.raises(LogError, match=message):
        load_log(path)


def test_unmarked_logs_get_no_columns(tmp_path):
    save_log(tmp_path / "log.csv", make_log())
    header = (tmp_path / "log.csv").read_text(encoding="utf-8").splitlines()[0].split(",")
    assert not set(STATED) & set(header)


# --- How a log is replayed -----------------------------------------------------------------------


def assert_noted(notes, parts):
    """Assert that there are as many notes as parts, each with its part."""
    for note, part in zip(notes, parts, strict=True):
        assert part in note


@pytest.mark.parametrize(("origin", "of_model", "requested", "expected", "parts"), CASES["motions"])
def test_contradictions_on_the_motion_are_noted(origin, of_model, requested, expected, parts):
    log = replace(make_log(), origin=origin or None, source="log")
    model = NOMINAL._replace(motion=Motion(of_model)) if of_model else None
    requested = Motion(requested) if requested else None
    assert required_motion(log, requested) is (Motion(expected) if expected else None)
    assert_noted(motion_notes(log, model, requested, "chosen so"), parts)


def test_measured_logs_are_replayed_continuously(truth):
    log = replace(truth, origin="measured")
    assert motion_of(log, NOMINAL) is Motion.CONTINUOUS
    assert what_is_fitted(log, NOMINAL)[0].motion is Motion.CONTINUOUS
    assert what_is_fitted(log, NOMINAL, motion=Motion.EULER)[0].motion is Motion.EULER
    parts = split(log, NOMINAL, None, None)
    for motion in (parts.motion_estimate.motion, parts.train.like.motion, parts.test.like.motion):
        assert motion is Motion.CONTINUOUS
    assert "the model says euler" in " ".join(parts.warnings)
    errors, continuous = validate(NOMINAL, log), validate(CONTINUOUS, log)
    assert errors.one_step == continuous.one_step
    notes = [note for note in errors.notes if note not in continuous.notes]
    assert notes == motion_notes(log, NOMINAL, None, "")
    (outside,) = voltage_notes(log, NOMINAL.battery)
    assert outside in parts.warnings and outside in errors.notes
    assert parts.train.like.battery == fitted_battery(log, NOMINAL.battery)


def test_a_model_of_another_mass_than_is_stated_is_doubted():
    log = replace(make_log(), origin="measured", source="log", stated_mass_kg=0.8)
    assert not motion_notes(log, CONTINUOUS._replace(m=0.8), None, "")
    (note,) = motion_notes(log, CONTINUOUS._replace(m=0.9), None, "")
    assert "log states 0.8 kg, and the model 0.9 kg, which is used" in note


def test_logs_of_different_origin_are_refused():
    first, second = (
        replace(make_log(), origin=origin, source=str(origin)) for origin in ("measured", None)
    )
    for refused in (lambda: joined([first, second]), lambda: diagnose_change(first, second)):
        with pytest.raises(
            LogError, match="None is not marked and measured is measured; expected logs of one"
        ):
            refused()
    other = replace(second, origin="measured", stated_voltage_v=FOUR_CELLS)
    with pytest.raises(LogError, match=r"v_bat_low, v_bat_high: found .*expected logs of one pack"):
        joined([first, other])
    light, heavy = (replace(first, stated_mass_kg=mass_kg) for mass_kg in (0.7, 0.8))
    with pytest.raises(
        LogError, match=r"mass_kg: found .*0\.7, .*0\.8; expected logs of one craft"
    ):
        joined([light, heavy])
    assert joined([first, heavy]).stated_mass_kg == 0.8


# --- Voltage --------------------------------------------------------------------------------------


def four_cells():
    """Return flights of a 4S craft that was fed 15.4 V; the log has no voltage."""
    half = 0.5 * FORCE_PER_VOLT * MIDDLE_V
    plant = HandoutPlant(coeffs=(half, half, 0.0, 0.0, 0.0, 0.0), max_rate=CRAFT.max_rate_deg_s)
    flown = measure(excited(plant), 1.0, GRAVITY, np.random.default_rng(3))
    channels = {name: flown[name] for name in "uwf"}
    return replace(flown, channels=channels, origin="measured", stated_voltage_v=FOUR_CELLS)


def test_a_log_without_voltage_is_fitted_at_what_is_stated(tmp_path):
    log, nominal = four_cells(), CRAFT.nominal_model("a log")
    np.testing.assert_array_equal(make_record(log).battery_v, MIDDLE_V)
    fitted = fit(log, nominal)
    coeffs = np.asarray(fitted.model.thrust_coeffs)
    force = float(collective_thrust(0.5, MIDDLE_V, coeffs)) / 0.7
    assert force == pytest.approx(FORCE_PER_VOLT * MIDDLE_V * 0.75, rel=0.01)
    assert fitted.model.battery == Battery(16.8, 14.0, MIDDLE_V, MIDDLE_V)
    assert fitted.model.motion is Motion.CONTINUOUS
    warnings = " ".join(fitted.warnings)
    assert "15.4 V, the middle of the voltages stated for the craft (14 to 16.8 V)" in warnings
    save_model(tmp_path / "model.json", fitted.model, fitted.provenance())
    assert load_model(tmp_path / "model.json").battery == fitted.model.battery
    other = fit(log, nominal._replace(battery=Battery()))
    assert other.model.battery == fitted.model.battery
    assert "is outside the model's battery, 22 to 24 V" in " ".join(other.warnings)


@pytest.mark.parametrize(
    ("battery", "drain", "sag_v"),
    [(Battery(), 0.2, 0.3), (Battery(4.2, 3.2, 3.2, 4.2), 0.1, 0.0525)],
)
def test_what_matters_is_a_share_of_the_battery(battery, drain, sag_v, truth):
    log = truth.without("v_bat")
    problem = split(log, NOMINAL._replace(battery=battery), None, Motion.CONTINUOUS).train
    for cause, field, size in (
        ("battery_drain", DRAIN, drain),
        ("voltage_sag", "voltage_sag.at_full_v", sag_v),
    ):
        for factor, expected in ((0.99, False), (1.01, True)):
            vector = problem.start.copy()
            vector[problem.parameter_indices([field])] += factor * size
            assert is_notable(cause, problem, vector) is expected


@pytest.mark.parametrize(
    ("logged", "stated", "given", "of_craft", "fitted", "parts"), CASES["batteries"]
)
def test_batteries_follow_the_voltages_of_a_log(logged, stated, given, of_craft, fitted, parts):
    given = Battery(*given)
    log = make_log(num_rows=1000, names=("w",))
    if stated:
        log = replace(log, stated_voltage_v=tuple(stated))
    if logged:
        volts = np.repeat(logged, 500)[:, None]
        volts[3] = 0.1  # a wrong sample is no range
        log = with_channels(log, v_bat=volts)
        assert flown_voltages(log) == tuple(logged)
    known = replace(log, stated_voltage_v=tuple(stated) or (given.empty_v, given.full_v))
    assert battery_of_craft(known, given) == Battery(*of_craft)
    assert fitted_battery(known, given) == Battery(*fitted)
    assert_noted(voltage_notes(log, given), parts)


def test_late_residuals_of_a_diverged_trial_give_no_warning():
    taps = np.where(np.arange(len(TAPS)) % 2, -1.0, 1.0)
    late = Late(np.tile(taps, (9, 1, 1)), np.zeros((9, 1, NUM_AXES)))
    diverged = np.full((1, 9, 1, NUM_AXES, 2), np.inf)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isnan(late.residuals(diverged)[..., :-1, 1]).all()
