"""A cause that begins within a log, and one that ends: named, with the time, in a log that is explained."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.diagnosis import Trial, make_log, model_of
from benchmarks.hidden import Truth, draw_base, fly, measure
from flytrack_sysid import diagnose
from flytrack_sysid.diagnosis import text_of
from flytrack_sysid.log import FlightLog

ONSET_S, SECONDS = 17.3, 40.0
ROLL, PITCH = 0.003, -0.002


def truth(**effects: dict[str, float]) -> Truth:
    return replace(draw_base(np.random.default_rng(8)), motion="fine", effects=effects)


def flown(own: Truth, seconds: float, seed: int = 9) -> FlightLog:
    rng = np.random.default_rng(seed)
    return measure(fly(own, "scripted", seconds, rng), "sensors", rng)


@pytest.mark.slow
def test_a_cause_that_begins_in_flight_is_named_with_its_onset():
    own = replace(truth(motor_imbalance={"roll": ROLL, "pitch": PITCH}), onset_s=ONSET_S)
    found = diagnose(flown(own, SECONDS), model_of(own))
    assert found.verdict == "causes_found"  # explained, from beginning to end
    (cause,) = found.causes
    assert cause.effect == "motor_imbalance" and cause.end_s is None
    assert cause.onset_s.value == pytest.approx(ONSET_S, abs=0.5)
    for name, true in (("roll", ROLL), ("pitch", PITCH)):
        low, high = cause.parameters[name].ci95
        assert low <= true <= high
    assert f"motor_imbalance from {cause.onset_s.value:.1f} ± " in text_of(found)
    assert found.as_json()["causes"][0]["onset_s"]["value"] == pytest.approx(cause.onset_s.value, rel=1e-5)
    assert any("as at the end of the log" in warning for warning in found.warnings)
    assert found.extended.effect("motor_imbalance").roll == pytest.approx(ROLL, rel=0.3)


@pytest.mark.slow
def test_a_cause_that_ends_in_flight_is_not_in_the_extended_model():
    own = truth(motor_imbalance={"roll": ROLL, "pitch": PITCH})
    first, second = flown(own, 0.5 * SECONDS), flown(truth(), 0.5 * SECONDS, seed=10)
    channels = {name: np.concatenate([first[name], second[name]]) for name in first.channels}
    time = np.append(first.time, second.time + 0.5 * SECONDS)
    segment = np.append(first.segment, second.segment + 1)
    found = diagnose(FlightLog(time, channels, segment), model_of(own))
    (cause,) = found.causes
    assert cause.effect == "motor_imbalance" and cause.onset_s is None
    assert cause.end_s.value == pytest.approx(0.5 * SECONDS, abs=0.5)
    assert found.extended.effects == ()
    assert f"motor_imbalance until {cause.end_s.value:.1f} ± " in text_of(found)
    assert any("ended within the log" in warning for warning in found.warnings)


@pytest.mark.slow
def test_a_loss_of_thrust_is_told_from_a_thrust_curve_that_depends_on_voltage():
    """The battery drains all the while, and a wandering disturbance takes what a curve leaves of the step."""
    truth, _, log, model, _ = make_log(Trial("onset", 0, 28, "fine", 100))
    (cause,) = diagnose(log, model).causes
    assert cause.effect == "thrust_scale"
    assert cause.onset_s.value == pytest.approx(truth.onset_s, abs=0.5)
    assert cause.parameters["factor"].value == pytest.approx(
        truth.effects["thrust_scale"]["factor"], abs=0.005
    )
