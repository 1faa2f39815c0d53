"""The diagnosis names what hidden plants have and nothing else."""

import json
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.diagnosis import Trial, model_of, plant
from benchmarks.hidden import EFFECTS, Truth, draw_base, draw_effect, draw_outside, fly, measure
from flytrack_env import load_model
from flytrack_env.dynamics import nominal_parameters
from flytrack_env.effects import BY_NAME, LinearDrag
from flytrack_env.motion import Motion
from flytrack_env.plants import Simulator
from flytrack_sysid import collect
from flytrack_sysid.diagnosis import Diagnosis, DiagnosisError, diagnose, write_diagnosis
from flytrack_sysid.log import FlightLog
from flytrack_sysid.split import blocks_of, held_out_rows
from tests.support.slow import slow_but

SHORT_S, BLOCK_S = 20.0, 5.0  # every other block is held out: both parts share one compiled program
LATE_S, SPIKES = 0.0164, 12
DRAG = {"d_x": 0.4, "d_y": 0.4, "d_z": 0.2}
BROKEN = ("stuck_gyro", "stuck_commands")
CHANNELS = {"rates", "attitude", "force", "velocity", "battery"}
WIDENED = 1.5  # of 95 % intervals: a correct one misses such a wide one 3 times in a thousand
Found = Mapping[str, Any]


@pytest.fixture(scope="session")
def short() -> Callable[[str], tuple[Diagnosis, FlightLog]]:
    """Diagnoses of plants in fine steps: clean, drag, a force that no list has, late poses and outliers."""
    base = replace(draw_base(np.random.default_rng(3)), motion="fine")
    outside = draw_outside(np.random.default_rng(4), "heading", 2.0)
    plants = {
        "clean": base,
        "drag": replace(base, effects={"linear_drag": DRAG}),
        "outside": replace(base, outside=outside),
        "late": replace(base, mocap_late_s=LATE_S),
    }

    @cache
    def diagnosis_of(name: str) -> tuple[Diagnosis, FlightLog]:
        rng, truth = np.random.default_rng([3, list(plants).index(name)]), plants[name]
        log = measure(fly(truth, "scripted", SHORT_S, rng), "sensors", rng)
        spikes = SPIKES * (name == "late")
        log["v"][rng.choice(len(log), spikes, replace=False)] += rng.normal(0.0, 2.0, (spikes, 3))
        held_out = np.floor(log.time / BLOCK_S).astype(int) % 2 == 1
        return diagnose(log, model_of(truth), held_out), log

    return diagnosis_of


def check_content(one: Found) -> None:
    """Check that a diagnosis has what its schema says, in numbers that mean something."""
    assert one["schema"] == 1
    assert one["verdict"] in ("consistent", "causes_found", "unexplained", "causes_found+unexplained")
    assert ("causes_found" in one["verdict"]) == bool(one["causes"])
    assert ("unexplained" in one["verdict"]) == one["unexplained"]["flagged"]
    assert one["unexplained"]["flagged"] == bool(one["unexplained"]["depends_on"] or one["beyond_the_list"])
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
    judged = {"nominal", "refitted_base", "extended", "noise_floor"}
    assert set(one["error"]) == judged | ({"without_learned"} if one["learned"] else set())
    for errors in one["error"].values():
        assert errors["one_step_nrmse"] and set(errors["one_step_nrmse"]) <= CHANNELS
        assert all(value > 0.0 for value in errors["one_step_nrmse"].values())
    assert len(one["data"]["sha256"]) == 64


@pytest.mark.slow  # of the one with drag, the fast test sees that nothing else is named
def test_a_clean_plant_is_consistent_with_its_model(short) -> None:
    found, _ = short("clean")
    assert found.causes == () and found.verdict == "consistent" and found.warnings == ()
    assert found.as_json()["motion"] == "continuous"


def test_a_hidden_effect_is_found_and_measured(short) -> None:
    (cause,) = short("drag")[0].causes
    assert cause.effect == "linear_drag" and cause.heldout_gain > 0.0 and cause.lambda_ > 100.0
    for name, one in cause.parameters.items():
        assert abs(one.value - DRAG[name]) <= WIDENED * one.half_width


@pytest.mark.slow
def test_late_motion_capture_is_named_and_corrected(short, tmp_path: Path) -> None:
    found, log = short("late")
    (cause,) = found.causes
    low, high = cause.parameters["latency_s"].ci95
    assert cause.effect == "mocap_latency" and cause.heldout_gain > 0.0 and found.verdict == "causes_found"
    assert abs(cause.parameters["latency_s"].value - LATE_S) < 1e-3 and high - low < 2e-3
    assert found.extended.motion is Motion.CONTINUOUS
    write_diagnosis(tmp_path, found, log)
    assert load_model(tmp_path / "extended_model.json").effect("mocap_latency").latency_s > 0.0


@pytest.mark.slow
def test_outliers_are_counted_and_told(short) -> None:
    found, _ = short("late")
    assert set(found.outliers) == {"velocity"} and abs(found.outliers["velocity"].rows - SPIKES) <= 2
    (warning,) = found.warnings
    assert warning.startswith("outliers") and "rows of velocity" in warning
    assert short("clean")[0].outliers == {}


@pytest.mark.slow
def test_what_no_list_has_is_flagged_and_not_named(short) -> None:
    found, _ = short("outside")
    assert found.causes == () and found.verdict == "unexplained"
    assert "heading" in found.unexplained.depends_on


@pytest.mark.parametrize("name", slow_but(["drag"], ["clean", "drag", "outside", "late"]))
def test_a_diagnosis_has_its_content(name, short) -> None:
    found, log = short(name)
    content = json.loads(json.dumps(found.as_json(), allow_nan=False))
    check_content(content)
    assert content["data"]["sha256"] == log.sha256
    low, high = content["data"]["voltages"]
    assert log["v_bat"].min() <= low < high <= log["v_bat"].max()


def test_the_extended_model_can_be_flown(short, tmp_path: Path) -> None:
    found, log = short("drag")
    write_diagnosis(tmp_path, found, log)
    assert json.loads((tmp_path / "diagnosis.json").read_text()) == json.loads(json.dumps(found.as_json()))
    assert (tmp_path / "report.html").stat().st_size > 0
    model = load_model(tmp_path / "extended_model.json")
    assert any(type(one) is LinearDrag for one in model.effects)
    env, params = gymnax.make("FlyTrack-v0", model=model)
    key = jax.random.key(0)
    observation, state = env.reset(key, params)
    observation, state, reward, *_ = env.step(key, state, jnp.zeros(4), params)
    assert np.isfinite(observation).all() and np.isfinite(reward)


SEED = int(os.environ.get("FLYTRACK_TEST_SEED", "11"))
SECONDS = 40.0  # all logs have as many lanes, so that all share one compiled program
SIGNED = {"thrust_tilt": -1.0, "wind": -1.0, "yaw_reaction": -1.0}  # what mirrors each parameter
SEGMENT_ROWS, HELD_OUT_EVERY = 330, 4  # twelve segments, each short enough to be a block
HOVER_WIND = 0.25  # m/s^2; corrections of a few degrees tell a stronger one from a tilt
Rng = np.random.Generator


class Case(NamedTuple):
    """A plant, what its team believes in, and its measured log."""

    truth: Truth
    believed: Truth
    log: FlightLog


def rng_of(name: str) -> Rng:
    """Return the random numbers of a case."""
    return np.random.default_rng([SEED, *name.encode()])


def _flown(truth: Truth, rng: Rng, kind: str = "scripted") -> Case:
    return Case(truth, truth, measure(fly(truth, kind, SECONDS, rng), "sensors", rng))


def _signed(rng: Rng, sign: float = 1.0) -> Case:
    """Return a plant with a large signed effect, or its mirror image; both are drawn and flown alike."""
    truth, name = draw_base(rng), str(rng.choice(list(SIGNED)))
    values = draw_effect(name, rng, EFFECTS[name].high)
    effects = {name: {field: sign * value for field, value in values.items()}}
    return _flown(replace(truth, effects=effects), rng)


def _in_training_only(rng: Rng) -> Case:
    """Return a plant with drag that is absent from the last of every four segments."""
    still = draw_base(rng)
    dragged = replace(still, effects={"linear_drag": draw_effect("linear_drag", rng, 0.4)})
    parts = [fly(truth, "scripted", SECONDS, rng) for truth in (dragged, still)]
    rows = np.arange(len(parts[0]))
    segment = rows // SEGMENT_ROWS
    is_still = segment % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    channels = {
        name: np.where(is_still[:, None], parts[1][name], values)
        for name, values in parts[0].channels.items()
    }
    clean = FlightLog(parts[0].time, channels, segment).select(segment < len(rows) // SEGMENT_ROWS)
    return Case(still, still, measure(clean, "sensors", rng))


def _wind_in_hover(rng: Rng) -> Case:
    truth = draw_base(rng)
    way = rng.uniform(-np.pi, np.pi)
    wind = {"a_x": HOVER_WIND * float(np.cos(way)), "a_y": HOVER_WIND * float(np.sin(way)), "a_z": 0.0}
    return _flown(replace(truth, effects={"wind": wind}), rng, kind="hover")


def _changed(field: str, size: float, rng: Rng) -> Case:
    """Return a plant of which the team believes an older base, flown as it is now.

    size: |ln factor| of the field's values is at most that, and at least half of it.
    """
    believed = draw_base(rng)
    values = np.array(getattr(believed, field))
    shares = rng.uniform(0.5, 1.0, values.shape) * rng.choice([-1.0, 1.0], values.shape)
    now = replace(believed, **{field: (values * np.exp(size * shares)).tolist()})
    return _flown(now, rng)._replace(believed=believed)


def _simulated(rng: Rng) -> Case:
    """Return flights of the simulator itself, without noise; all kinds, as many rows as the other logs."""
    log = collect(Simulator(), 1.0, int(rng.integers(2**31)))
    log = log.select(log.segment % 3 != 2)
    nominal = Truth((0.03,) * 4, (0.0,) * 6)  # not looked at: the model is the simulator's own
    return Case(nominal, nominal, log)


def _broken(rng: Rng, channel: str, value: float) -> Case:
    """Return a flight with one channel stuck at a value from the first row to the last."""
    case = _flown(draw_base(rng), rng)
    stuck = np.full_like(case.log[channel], value)
    return case._replace(log=replace(case.log, channels={**case.log.channels, channel: stuck}))


CASES: Mapping[str, Callable[[Rng], Case]] = {
    "signed": _signed,
    "mirrored": lambda rng: _signed(rng_of("signed"), -1.0),
    "training_only": _in_training_only,
    "wind_in_hover": _wind_in_hover,
    "thermal": lambda rng: _flown(replace(draw_base(rng), outside=draw_outside(rng, "position", 2.0)), rng),
    "tau": lambda rng: _changed("tau", 0.6, rng),
    "mass": lambda rng: _changed("mass", 0.2, rng),
    "simulated": _simulated,
    "stuck_gyro": lambda rng: _broken(rng, "w", 0.0),
    "stuck_commands": lambda rng: _broken(rng, "u", -0.3),
}


@pytest.fixture(scope="module")
def cases() -> dict[str, Case]:
    """The plants of this seed, and their logs."""
    print(f"FLYTRACK_TEST_SEED={SEED}")
    return {name: make(rng_of(name)) for name, make in CASES.items()}


@pytest.fixture(scope="module")
def found(cases: dict[str, Case]) -> dict[str, Found]:
    """The diagnosis of each log, or what is raised."""
    result = {}
    for name, case in cases.items():
        model = nominal_parameters() if name == "simulated" else model_of(case.believed)
        try:
            result[name] = diagnose(case.log, model).as_json()
        except DiagnosisError as error:
            result[name] = {"raised": str(error)}
    return result


def names_of(one: Found) -> set[str]:
    """Return what a diagnosis names."""
    return {cause["effect"] for cause in one["causes"]}


def cause_of(one: Found, effect: str) -> Found:
    """Return the cause of that name, which has to be there."""
    assert effect in names_of(one)
    return next(cause for cause in one["causes"] if cause["effect"] == effect)


def is_within(value: float, estimate: Mapping[str, Any]) -> bool:
    """Return whether a value lies in an estimate's interval, made wider by half."""
    low, high = estimate["ci95"]
    return abs(value - estimate["value"]) <= WIDENED * 0.5 * (high - low)


@pytest.mark.slow
def test_every_log_is_diagnosed_or_refused(found: dict[str, Found]) -> None:
    for name, one in found.items():
        if name in BROKEN and "raised" in one:
            assert "expected" in one["raised"]
        else:
            check_content(one)


@pytest.mark.slow
def test_the_simulator_is_consistent_with_itself(found: dict[str, Found]) -> None:
    one = found["simulated"]
    assert one["causes"] == [] and one["verdict"] == "consistent" and one["warnings"] == []


@pytest.mark.slow
def test_a_mirrored_effect_is_found_mirrored(found, cases) -> None:
    ((effect, true),) = cases["signed"].truth.effects.items()
    plain, mirrored = (cause_of(found[name], effect)["parameters"] for name in ("signed", "mirrored"))
    assert plain and all(is_within(true[field], one) for field, one in plain.items())
    for field, one in mirrored.items():
        assert is_within(cases["mirrored"].truth.effects[effect][field], one)


@pytest.mark.slow
def test_what_is_gone_on_held_out_rows_is_no_cause(found, cases) -> None:
    log, one = cases["training_only"].log, found["training_only"]
    # Blocks are the segments, so that what is held out is what was flown without the effect.
    np.testing.assert_array_equal(blocks_of(log), np.cumsum(log.is_start()) - 1)
    np.testing.assert_array_equal(blocks_of(log) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1, held_out_rows(log))
    assert one["causes"] == []
    assert one["unexplained"]["flagged"] and "time" in one["unexplained"]["depends_on"]
    assert any("held-out" in warning for warning in one["warnings"])


@pytest.mark.slow
def test_a_hover_cannot_tell_wind_from_tilt(found) -> None:
    one, both = found["wind_in_hover"], {"wind", "thrust_tilt"}
    classes = [{cause["effect"], *cause["equivalent"]} for cause in one["causes"]]
    assert any(both <= alike for alike in classes)
    flights = [limit for limit in one["not_identifiable"] if limit["effect"] in both]
    assert "headings" in [limit["fly"] for limit in flights]


@pytest.mark.slow
def test_a_force_about_one_place_depends_on_position(found) -> None:
    thermal = found["thermal"]
    assert thermal["causes"] == [] and thermal["unexplained"]["depends_on"] == ["position"]


@pytest.mark.slow
def test_other_base_parameters_are_named_and_measured(found, cases) -> None:
    true, causes = cases["tau"].truth.tau, found["tau"]["causes"]
    by_name = dict(zip(("tau_roll", "tau_pitch", "tau_yaw", "tau_thrust"), true, strict=True))
    assert names_of(found["tau"]) == set(by_name)
    for cause in causes:
        assert is_within(by_name[cause["effect"]], cause["parameters"][cause["effect"]]), cause
    assert names_of(found["mass"]) == {"thrust_scale"}
    factor = cause_of(found["mass"], "thrust_scale")["parameters"]["factor"]
    assert is_within(cases["mass"].believed.mass / cases["mass"].truth.mass, factor)


@pytest.mark.slow
def test_what_another_law_of_lift_leaves_is_not_named() -> None:
    line = plant(Trial("one", 91, seed=1))
    assert line["effects"] == ["translational_lift"]
    assert [cause["effect"] for cause in line["causes"]] == ["translational_lift"]
