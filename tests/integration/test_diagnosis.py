"""The diagnosis names what hidden plants have and nothing else."""

import json
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from benchmarks.diagnosis import Trial, model_of, plant
from benchmarks.hidden import Truth, draw_base, draw_effect, draw_outside, fly, measure
from flytrack_bench.hidden import pilot
from flytrack_env import load_model
from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.effects import BY_NAME, LinearDrag
from flytrack_env.motion import Motion
from flytrack_env.plants import Simulator
from flytrack_sysid import collect
from flytrack_sysid.diagnosis import DiagnosisError, diagnose, write_diagnosis
from flytrack_sysid.log import FlightLog
from tests.support.slow import slow_but
from tests.support.written_logs import with_channels

SEED = int(os.environ.get("FLYTRACK_TEST_SEED", "11"))  # of plants that a case draws
# Every other block is held out, and all but the simulator move finely: all logs share one compiled
# program.
SECONDS, BLOCK_S = 20.0, 5.0
LATE_S, SPIKES = 0.0164, 12
DRAG = {"d_x": 0.4, "d_y": 0.4, "d_z": 0.2}
HOVER_WIND = 0.25  # m/s^2; corrections of a few degrees tell a stronger one from a tilt
CHANNELS = {"rates", "attitude", "force", "velocity", "battery"}
WIDENED = 1.5  # of 95 % intervals: a correct one misses such a wide one 3 times in a thousand
Rng = np.random.Generator


class Case(NamedTuple):
    """A plant, what its team believes in, its measured log, and rows that are held out."""

    truth: Truth | None
    model: ModelParameters
    log: FlightLog
    held_out: np.ndarray | None = None


def _drawn(rng):
    return replace(draw_base(rng), motion="fine")


def _measured(truth, clean, rng):
    log = measure(clean, "sensors", rng)
    return Case(truth, model_of(truth), log, _blocks(log) % 2 == 1)


def _blocks(log):
    return np.floor(log.time / BLOCK_S).astype(int)


def _flown(truth, rng):
    return _measured(truth, fly(truth, SECONDS, rng), rng)


def _known(number, spikes=0, **fields):
    """Return a flight of a plant that no seed changes, with some outliers of the velocity."""
    rng = np.random.default_rng([3, number])
    case = _flown(replace(_drawn(np.random.default_rng(3)), **fields), rng)
    case.log["v"][rng.choice(len(case.log), spikes, replace=False)] += rng.normal(
        0.0, 2.0, (spikes, 3)
    )
    return case


def _in_training_only(rng):
    """Return a plant with drag that is absent from what is held out, each block a segment."""
    still = _drawn(rng)
    dragged = replace(still, effects={"linear_drag": draw_effect("linear_drag", rng, 0.4)})
    parts = [fly(truth, SECONDS, rng) for truth in (dragged, still)]
    segment = _blocks(parts[0])
    is_still = segment[:, None] % 2 == 1
    channels = {
        name: np.where(is_still, parts[1][name], values)
        for name, values in parts[0].channels.items()
    }
    return _measured(still, FlightLog(parts[0].time, channels, segment), rng)


def _wind_in_hover(rng):
    """Return a flight that only hovers, with small corrections and one heading, in wind."""

    def hover(sketch):
        sketch.wait(sketch.rng.uniform(2.0, 4.5))
        there = np.array(sketch.start_w) + 0.25 * sketch.rng.uniform(-1.0, 1.0, 3)
        speed = tuple(((there - sketch.pos_w) / 0.8).tolist())
        for _ in range(80):
            sketch.add(speed)

    truth, way = _drawn(rng), rng.uniform(-np.pi, np.pi)
    wind = {
        "a_x": HOVER_WIND * float(np.cos(way)),
        "a_y": HOVER_WIND * float(np.sin(way)),
        "a_z": 0.0,
    }
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(pilot, "cycle", hover)
        return _flown(replace(truth, effects={"wind": wind}), rng)


def _changed(field, size, rng):
    """Return a plant of which the team believes an older base, flown as it is now.

    Args:
        size: |ln factor| of the field's values is at most that, and at least half of it.
    """
    believed = _drawn(rng)
    values = np.array(getattr(believed, field))
    shares = rng.uniform(0.5, 1.0, values.shape) * rng.choice([-1.0, 1.0], values.shape)
    now = replace(believed, **{field: (values * np.exp(size * shares)).tolist()})
    return _flown(now, rng)._replace(model=model_of(believed))


def _simulated(rng):
    """Return flights of the simulator itself, without noise, of all kinds."""
    log = collect(Simulator(), 1.0, int(rng.integers(2**31)))
    return Case(None, nominal_parameters(), log.select(log.segment % 3 != 2))


def _with_stuck_gyro(rng):
    """Return a flight whose gyro reads nothing from the first row to the last."""
    case = _flown(_drawn(rng), rng)
    return case._replace(log=with_channels(case.log, w=np.zeros_like(case.log["w"])))


CASES: Mapping[str, Callable[[Rng], Case]] = {
    "clean": lambda rng: _known(0),
    "drag": lambda rng: _known(1, effects={"linear_drag": DRAG}),
    "outside": lambda rng: _known(
        2, outside=draw_outside(np.random.default_rng(4), "heading", 2.0)
    ),
    "late": lambda rng: _known(3, SPIKES, mocap_late_s=LATE_S),
    "training_only": _in_training_only,
    "wind_in_hover": _wind_in_hover,
    # Without tilt, the thrust map runs so far away that slopes say nothing of wind.
    "wind_in_another_hover": lambda rng: _wind_in_hover(
        np.random.default_rng([12, *b"wind_in_hover"])
    ),
    "tau": lambda rng: _changed("tau", 0.6, rng),
    "mass": lambda rng: _changed("mass", 0.2, rng),
    "simulated": _simulated,
    "stuck_gyro": _with_stuck_gyro,
}


@pytest.fixture(scope="module")
def diagnosed():
    """A case by name, and its diagnosis."""
    print(f"FLYTRACK_TEST_SEED={SEED}")

    @cache
    def of(name):
        case = CASES[name](np.random.default_rng([SEED, *name.encode()]))
        return case, diagnose(case.log, case.model, case.held_out)

    return of


def is_within(value, estimate):
    """Return whether a value lies in an estimate's interval, made wider by half."""
    return abs(value - estimate.value) <= WIDENED * estimate.half_width


@pytest.mark.parametrize("name", slow_but(["drag"], CASES))
def test_every_log_is_diagnosed_or_refused(name, diagnosed):
    """A diagnosis has what its schema says, in numbers that mean something."""
    try:
        case, found = diagnosed(name)
    except DiagnosisError as error:
        assert name.startswith("stuck") and "expected" in str(error)
        return
    one = json.loads(json.dumps(found.as_json(), allow_nan=False))
    assert one["schema"] == 1
    assert ("causes_found" in one["verdict"]) == bool(one["causes"])
    assert ("unexplained" in one["verdict"]) == one["unexplained"]["flagged"]
    assert one["unexplained"]["flagged"] == bool(
        one["unexplained"]["depends_on"] or one["beyond_the_list"]
    )
    for cause in one["causes"]:
        assert cause["parameters"], f"{cause['effect']} has no size"
        assert cause["channel"] in CHANNELS
        for key in ("chi2_gain", "heldout_gain", "lambda", "lambda_sep"):
            assert isinstance(cause[key], float) and math.isfinite(cause[key])
        for estimate in cause["parameters"].values():
            low, high = estimate["ci95"]
            assert low <= estimate["value"] <= high and estimate["unit"]
    for limit in one["not_identifiable"]:
        assert limit["effect"] in BY_NAME and limit["smallest_detectable"]["unit"]
        assert set(limit["confused_with"]) <= set(BY_NAME) - {limit["effect"]}
    assert {"nominal", "refitted_base", "extended", "noise_floor"} <= one["error"].keys()
    for errors in one["error"].values():
        assert errors["one_step_nrmse"].keys() <= CHANNELS
        assert min(errors["one_step_nrmse"].values()) > 0.0
    assert one["data"]["sha256"] == case.log.sha256
    low, high = one["data"]["voltages"]
    assert case.log["v_bat"].min() <= low < high <= case.log["v_bat"].max()


# Of the one with drag, the fast test sees that nothing else is named.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "motion"), [("clean", Motion.CONTINUOUS), ("simulated", Motion.EULER)]
)
def test_a_clean_plant_is_consistent_with_its_model(name, motion, diagnosed):
    _, found = diagnosed(name)
    assert found.causes == () and found.verdict == "consistent" and found.warnings == ()
    assert found.extended.motion is motion


def test_a_hidden_effect_is_found_and_measured(diagnosed):
    (cause,) = diagnosed("drag")[1].causes
    assert cause.effect == "linear_drag" and cause.heldout_gain > 0.0 and cause.lambda_ > 100.0
    assert all(is_within(DRAG[name], one) for name, one in cause.parameters.items())


@pytest.mark.slow
def test_late_motion_capture_is_named_and_corrected_and_outliers_told(diagnosed, tmp_path):
    case, found = diagnosed("late")
    (cause,) = found.causes
    low, high = cause.parameters["latency_s"].ci95
    assert (
        cause.effect == "mocap_latency"
        and cause.heldout_gain > 0.0
        and found.verdict == "causes_found"
    )
    assert abs(cause.parameters["latency_s"].value - LATE_S) < 1e-3 and high - low < 2e-3
    assert found.extended.motion is Motion.CONTINUOUS
    write_diagnosis(tmp_path, found, case.log)
    assert load_model(tmp_path / "extended_model.json").effect("mocap_latency").latency_s > 0.0
    assert (
        set(found.outliers) == {"velocity"} and abs(found.outliers["velocity"].rows - SPIKES) <= 2
    )
    (warning,) = found.warnings
    assert warning.startswith("outliers") and "rows of velocity" in warning
    assert diagnosed("clean")[1].outliers == {}


@pytest.mark.slow
def test_what_no_list_has_is_flagged_and_not_named(diagnosed):
    _, found = diagnosed("outside")
    assert found.causes == () and found.verdict == "unexplained"
    assert "heading" in found.unexplained.depends_on


def test_the_extended_model_is_written(diagnosed, tmp_path):
    case, found = diagnosed("drag")
    write_diagnosis(tmp_path, found, case.log)
    assert json.loads((tmp_path / "diagnosis.json").read_text()) == json.loads(
        json.dumps(found.as_json())
    )
    assert (tmp_path / "report.html").stat().st_size > 0
    model = load_model(tmp_path / "extended_model.json")
    assert any(type(one) is LinearDrag for one in model.effects)


@pytest.mark.slow
def test_what_is_gone_on_held_out_rows_is_no_cause(diagnosed):
    _, found = diagnosed("training_only")
    assert found.causes == ()
    assert found.unexplained.flagged and "time" in found.unexplained.depends_on
    assert any("linear_drag" in warning for warning in found.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["wind_in_hover", "wind_in_another_hover"])
def test_a_hover_cannot_tell_wind_from_tilt(name, diagnosed):
    found, both = diagnosed(name)[1], {"wind", "thrust_tilt"}
    assert any(both <= {cause.effect, *cause.equivalent} for cause in found.causes)
    assert "headings" in [limit.fly for limit in found.not_identifiable if limit.effect in both]


@pytest.mark.slow
def test_other_base_parameters_are_named_and_measured(diagnosed):
    case, found = diagnosed("tau")
    by_name = dict(
        zip(("tau_roll", "tau_pitch", "tau_yaw", "tau_thrust"), case.truth.tau, strict=True)
    )
    assert {cause.effect for cause in found.causes} == set(by_name)
    for cause in found.causes:
        assert is_within(by_name[cause.effect], cause.parameters[cause.effect]), cause
    case, found = diagnosed("mass")
    (cause,) = found.causes
    assert cause.effect == "thrust_scale"
    lighter = case.model.m / case.truth.mass
    assert is_within(lighter, cause.parameters["factor"])
    nominal, extended = (found.lift[name].thrust_to_weight for name in ("nominal", "extended"))
    low, high = (end / nominal.value for end in extended.ci95)
    assert low <= lighter <= high and high - low < 0.05


@pytest.mark.slow
def test_what_another_law_of_lift_leaves_is_not_named():
    line = plant(Trial("one", 91, seed=1))
    assert line["effects"] == ["translational_lift"]
    assert [cause["effect"] for cause in line["causes"]] == ["translational_lift"]
