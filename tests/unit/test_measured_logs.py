"""What a log states (its origin, its pack's voltages) survives and decides how it is replayed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from flytrack_env import Battery, Motion, blackbox, load_model, nominal_parameters, save_model
from flytrack_env.dynamics import collective_thrust
from flytrack_sysid import FlightLog, collect, fit, import_log, load_log, save_log, validate
from flytrack_sysid.clocks import align_clocks, on_one_clock
from flytrack_sysid.diagnosis import diagnose_change, joined, motion_of
from flytrack_sysid.diagnosis.diagnose import split
from flytrack_sysid.diagnosis.lateness import read_poses
from flytrack_sysid.diagnosis.size import is_notable
from flytrack_sysid.fit import what_is_fitted
from flytrack_sysid.log import STATED, LogError
from flytrack_sysid.log_motion import motion_notes, required_motion
from flytrack_sysid.log_voltage import (
    battery_of_craft,
    fitted_battery,
    flown_voltages,
    voltage_notes,
)
from flytrack_sysid.parameters import DRAIN
from flytrack_sysid.record import fill_gaps, make_record
from flytrack_sysid.sensors import measure
from tests.support.written_logs import NUM_ROWS, SUFFIXES, columns_of, make_log, read_mapping, write

FOUR_CELLS = (14.0, 16.8)
MIDDLE_V = 15.4
FORCE_PER_VOLT = 35.0 / 16.8  # m/s^2 at full stick
NOMINAL = nominal_parameters()
CONTINUOUS = NOMINAL._replace(motion=Motion.CONTINUOUS)


def through_file(log: FlightLog, suffix: str, folder) -> FlightLog:
    save_log(folder / f"log{suffix}", log)
    return load_log(folder / f"log{suffix}")


OPERATIONS = {
    **{
        suffix: lambda log, folder, suffix=suffix: through_file(log, suffix, folder)
        for suffix in SUFFIXES
    },
    "trimmed": lambda log, folder: log.select(slice(300, 900)),
    "one row of": lambda log, folder: log.select(np.arange(len(log)) == 7),
    "without": lambda log, folder: log.without("p", "a"),
    "split and joined": lambda log, folder: joined(
        [log.select(slice(0, 900)), log.select(slice(900, None))]
    ),
    "gaps filled": lambda log, folder: fill_gaps(log.select(np.arange(len(log)) % 50 > 0)).log,
    "clocks aligned": lambda log, folder: align_clocks(log, True)[0],
    "on one clock": lambda log, folder: on_one_clock(log)[0],
    "poses read later": lambda log, folder: read_poses(log, 0.01)[0],
}


@pytest.mark.parametrize("operation", OPERATIONS)
def test_what_is_stated_survives(operation, truth, tmp_path):
    for origin, voltages in (("measured", FOUR_CELLS), ("simulated", None), (None, FOUR_CELLS)):
        log = replace(truth.without("v_bat"), origin=origin, stated_voltage_v=voltages)
        result = OPERATIONS[operation](log, tmp_path)
        assert (result.origin, result.stated_voltage_v) == (origin, voltages)


def test_the_hash_is_of_the_rows_alone():
    log = make_log()
    assert replace(log, origin="measured", stated_voltage_v=FOUR_CELLS).sha256 == log.sha256


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (
            {"measured": [2.0] * NUM_ROWS},
            r"column measured: found 2\.0, expected 1 \(a real drone\) or 0",
        ),
        (
            {"measured": [1, 1, 1, 1, 0, 1]},
            r"row 4.*column measured: found 0\.0, expected 1 as in row 0",
        ),
        ({"v_bat_low": [14.0] * NUM_ROWS}, "column v_bat_high: missing; found only v_bat_low"),
        (
            {"v_bat_low": [17.0] * NUM_ROWS, "v_bat_high": [14.0] * NUM_ROWS},
            "found 17 to 14 V, expected",
        ),
    ],
)
def test_files_that_state_nonsense_are_refused(suffix, columns, message, tmp_path):
    path = tmp_path / f"log{suffix}"
    write(
        path, columns_of(make_log()) | {name: np.array(values) for name, values in columns.items()}
    )
    with pytest.raises(LogError, match=message):
        load_log(path)


def test_unmarked_logs_get_no_columns(tmp_path):
    save_log(tmp_path / "log.csv", make_log())
    header = (tmp_path / "log.csv").read_text(encoding="utf-8").splitlines()[0].split(",")
    assert not set(STATED) & set(header)


def test_who_flew_is_marked_where_logs_begin(tmp_path):
    flown = collect(blackbox.load(blackbox.SHIPPED), 1.0)
    assert (
        flown.origin == "simulated"
        and measure(flown, 1.0, 9.81, np.random.default_rng(0)).origin == "simulated"
    )
    assert import_four_cells(tmp_path).log.origin == "measured"


# --- How a log is replayed -----------------------------------------------------------------------

NOTES = [  # origin of the log, motion of the model, requested motion: the motion, and what is noted
    ("measured", None, None, Motion.CONTINUOUS, []),
    ("measured", Motion.CONTINUOUS, None, Motion.CONTINUOUS, []),
    ("measured", Motion.HANDOUT, None, Motion.CONTINUOUS, ["is measured; the model says handout"]),
    (
        "measured",
        Motion.CONTINUOUS,
        Motion.HANDOUT,
        Motion.HANDOUT,
        ["handout was requested, but log is measured", "as requested; the model says continuous"],
    ),
    ("simulated", Motion.HANDOUT, None, None, []),
    ("simulated", Motion.HANDOUT, Motion.CONTINUOUS, Motion.CONTINUOUS, ["the model says handout"]),
    (
        None,
        Motion.HANDOUT,
        None,
        None,
        ["motion: chosen so, since log does not say whether a drone"],
    ),
    (None, None, Motion.SEMI_IMPLICIT, Motion.SEMI_IMPLICIT, []),
]


@pytest.mark.parametrize(("origin", "of_model", "requested", "expected", "parts"), NOTES)
def test_contradictions_on_the_motion_are_noted(origin, of_model, requested, expected, parts):
    log = replace(make_log(), origin=origin, source="log")
    model = None if of_model is None else NOMINAL._replace(motion=of_model)
    assert required_motion(log, requested) is expected
    notes = motion_notes(log, model, requested, "chosen so")
    assert len(notes) == len(parts)
    for note, part in zip(notes, parts, strict=True):
        assert part in note


def test_measured_logs_are_replayed_continuously(truth):
    log = replace(truth, origin="measured")
    assert motion_of(log, NOMINAL) is Motion.CONTINUOUS
    assert what_is_fitted(log, NOMINAL)[0].motion is Motion.CONTINUOUS
    assert what_is_fitted(log, NOMINAL, motion=Motion.HANDOUT)[0].motion is Motion.HANDOUT
    parts = split(log, NOMINAL, None, None)
    assert (
        parts.moves.motion is parts.train.like.motion is parts.test.like.motion is Motion.CONTINUOUS
    )
    assert any("the model says handout" in warning for warning in parts.warnings)
    errors, continuous = validate(NOMINAL, log), validate(CONTINUOUS, log)
    assert errors.one_step == continuous.one_step
    assert errors.one_step != validate(NOMINAL, replace(log, origin="simulated")).one_step
    assert [note for note in errors.notes if note not in continuous.notes] == motion_notes(
        log, NOMINAL, None, ""
    )


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


# --- Voltage --------------------------------------------------------------------------------------


def import_four_cells(folder, battery_v: float | None = None, voltage_v: tuple | None = FOUR_CELLS):
    """Import a minute of a made-up 4S craft, 0.7 kg, whose thrust follows voltage, at 15.4 V."""
    step_s, rng = 0.01, np.random.default_rng(3)
    time = np.arange(6000) * step_s

    def lagged(values: np.ndarray, tau_s: float) -> np.ndarray:
        keep = np.exp(-step_s / tau_s)
        return lfilter([1.0 - keep], [1.0, -keep], values, axis=0)

    holds = np.column_stack(
        [rng.uniform(-1.0, 1.0, 200)[(time * hz).astype(int)] for hz in (1.5, 1.3, 1.1, 1.7)]
    )
    command = holds * [0.3, 0.3, 0.3, 0.8]
    held = np.vstack([command[:1], command[:-1]])
    rates = lagged(held[:, :3] * 6.0, 0.03) + rng.normal(0.0, 0.02, (len(time), 3))
    force = rng.normal(0.0, 0.3, (len(time), 3))
    force[:, 2] += FORCE_PER_VOLT * (battery_v or MIDDLE_V) * (lagged(held[:, 3], 0.04) + 1.0) / 2.0
    columns = {"t": time, **dict(zip("abcd", command.T, strict=True))}
    columns |= dict(
        zip(("wx", "wy", "wz", "fx", "fy", "fz"), np.column_stack([rates, force]).T, strict=True)
    )
    mapping = read_mapping("four_cells")
    if voltage_v is not None:
        mapping += f"voltage_v = {list(voltage_v)}\n"
    if battery_v is not None:
        columns["v"] = np.full(len(time), battery_v)
        mapping += '[battery]\ncolumn = "v"\nunit = "V"\n'
    write(folder / "four.csv", columns)
    (folder / "four.toml").write_text(mapping, encoding="utf-8")
    return import_log(folder / "four.csv", "csv", folder / "four.toml")


def test_a_log_without_voltage_is_fitted_at_what_its_mapping_states(tmp_path):
    found = import_four_cells(tmp_path)
    assert (
        found.log.stated_voltage_v == FOUR_CELLS
        and found.nominal_model().motion is Motion.CONTINUOUS
    )
    log = through_file(found.log, ".csv", tmp_path)
    np.testing.assert_array_equal(make_record(log).battery_v, MIDDLE_V)
    fitted = fit(log, found.nominal_model())
    coeffs = np.asarray(fitted.model.thrust_coeffs)
    force = float(collective_thrust(0.5, MIDDLE_V, coeffs)) / 0.7
    assert force == pytest.approx(FORCE_PER_VOLT * MIDDLE_V * 0.75, rel=0.01)
    assert fitted.model.battery == Battery(16.8, 14.0, MIDDLE_V, MIDDLE_V)
    assert fitted.model.motion is Motion.CONTINUOUS
    (note,) = (one for one in fitted.warnings if "15.4 V, the middle of" in one)
    assert "the voltages stated for the craft (14 to 16.8 V)" in note
    save_model(tmp_path / "model.json", fitted.model, fitted.provenance())
    assert load_model(tmp_path / "model.json").battery == fitted.model.battery
    other = fit(log, found.nominal_model()._replace(battery=Battery()))
    assert other.model.battery == fitted.model.battery
    assert any("is outside the model's battery, 22 to 24 V" in one for one in other.warnings)


def test_validation_and_diagnosis_name_both_ranges(tmp_path):
    log = import_four_cells(tmp_path, battery_v=15.0).log
    expected = "was flown at 15 to 15 V, which is outside the model's battery, 22 to 24 V"
    assert any(expected in note for note in validate(CONTINUOUS, log).notes)
    parts = split(log, CONTINUOUS, None, None)
    assert any(expected in warning for warning in parts.warnings)
    assert parts.train.like.battery == Battery(15.0, 13.75, 15.0, 15.0)
    own = import_four_cells(tmp_path, battery_v=15.0).nominal_model()
    assert own.battery.full_v == FOUR_CELLS[1] and not voltage_notes(log, own.battery)


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
            vector[problem.index([field])] += factor * size
            assert is_notable(cause, problem, vector) is expected


FOUR = Battery(16.8, 14.0, 14.2, 16.6)
# logged or stated voltages, the model's battery: the craft's, that of a fit, what is noted
BATTERIES = [
    ((14.5, 16.5), None, FOUR, FOUR, FOUR._replace(fitted_low_v=14.5, fitted_high_v=16.5), []),
    (
        (13.6, 16.9),
        None,
        FOUR,
        FOUR,
        FOUR._replace(fitted_low_v=13.6, fitted_high_v=16.9),
        [],
    ),  # within 3 %
    (
        (12.5, 16.0),
        None,
        FOUR,
        Battery(16.0, 12.5, 12.5, 16.0),
        Battery(16.0, 12.5, 12.5, 16.0),
        ["exceeds"],
    ),
    (
        (3.2, 4.1),
        None,
        Battery(),
        Battery(4.1, 3.2, 3.2, 4.1),
        Battery(4.1, 3.2, 3.2, 4.1),
        ["is outside"],
    ),
    (
        None,
        (3.2, 4.0),
        Battery(),
        Battery(4.0, 3.2, 3.2, 4.0),
        Battery(4.0, 3.2, 3.6, 3.6),
        ["3.6 V", "outside"],
    ),
    (
        None,
        None,
        FOUR,
        FOUR,
        FOUR._replace(fitted_low_v=15.4, fitted_high_v=15.4),
        ["15.4 V, the middle"],
    ),
    (
        None,
        None,
        Battery(),
        Battery(),
        Battery(24.0, 22.0, 23.0, 23.0),
        ["23 V, the middle of the model's"],
    ),
]


@pytest.mark.parametrize(("logged", "stated", "given", "of_craft", "fitted", "parts"), BATTERIES)
def test_batteries_follow_the_voltages_of_a_log(logged, stated, given, of_craft, fitted, parts):
    log = replace(make_log(num_rows=1000, names=("w",)), stated_voltage_v=stated)
    if logged is not None:
        volts = np.repeat(logged, 500)[:, None]
        volts[3] = 0.1  # a wrong sample is no range
        log = replace(log, channels={**log.channels, "v_bat": volts})
        assert flown_voltages(log) == logged
    own = replace(log, stated_voltage_v=stated or (given.empty_v, given.full_v))
    assert battery_of_craft(own, given) == of_craft and fitted_battery(own, given) == fitted
    notes = voltage_notes(log, given)
    assert len(notes) == len(parts)
    for note, part in zip(notes, parts, strict=True):
        assert part in note
