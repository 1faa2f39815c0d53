"""Effects that gain enough where they were fitted, and are not named: seen once, or what a law leaves."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from benchmarks.diagnosis import model_of, plant
from benchmarks.hidden import draw_base, fly, measure
from flytrack_env.effects import BY_NAME
from flytrack_sysid.diagnosis import doubt
from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.base import is_determined
from flytrack_sysid.diagnosis.candidates import CANDIDATES
from flytrack_sysid.diagnosis.lanes import make_lanes
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.search import fitted, threshold
from flytrack_sysid.diagnosis.weigh import Weighed

LIFT_GAIN = 20_000.0


def weighed(gain, count=1, inflation=1.0):
    less = SimpleNamespace(vector=np.zeros(1))
    return Weighed(gain, inflation, count, {}, {}, less)


def test_next_to_nothing_beside_a_larger_law_is_its_remainder():
    small, enough = (factor * doubt.OF_LAW * LIFT_GAIN for factor in (0.99, 1.01))
    for gain, expected in ((small, True), (enough, False)):
        models = {"translational_lift": weighed(LIFT_GAIN), "wind": weighed(gain)}
        assert doubt.is_remainder("wind", models) is expected
        assert not doubt.is_remainder("translational_lift", models)


@pytest.mark.parametrize(
    ("large", "small"),
    [
        ("thrust_scale", "linear_drag"),  # a factor is right or not
        ("rate_scale", "wind"),  # turns say nothing of forces
        ("rotor_drag", "voltage_sag"),  # which the battery shows
        ("rotor_drag", "accelerometer_bias"),
        ("rotor_drag", "thrust_lag_asymmetry"),
    ],
)
def test_what_is_no_law_of_a_force_leaves_no_remainder(large, small):
    assert {large, small} <= BY_NAME.keys()
    assert not doubt.is_remainder(small, {large: weighed(1e9), small: weighed(20.0)})


@pytest.mark.parametrize(
    ("thresholds", "held_out", "expected", "is_named"),
    [
        (1.9, -0.5, 9.0, False),  # barely seen, and not again
        (1.9, 0.5, 9.0, True),
        (2.1, -0.5, 9.0, True),  # seen clearly: ``is_contradicted`` decides
        (1.9, -0.5, 0.9, True),  # held-out rows could not have shown it
    ],
)
def test_what_is_barely_seen_has_to_be_seen_again(monkeypatch, thresholds, held_out, expected, is_named):
    monkeypatch.setattr(doubt, "held_out_gain", lambda judge, less, full: (held_out, expected))
    inflation = 1.5
    own = weighed(thresholds * threshold(3) * inflation, 3, inflation)
    result = SimpleNamespace(weighed={"gyro_scale": own}, found=SimpleNamespace(vector=np.zeros(1)))
    assert doubt.unfounded(result, None) == ([] if is_named else ["gyro_scale"])


def test_an_effect_that_could_as_well_be_none_is_not_determined():
    rng = np.random.default_rng(3)
    truth = draw_base(rng)
    log = measure(fly(truth, "scripted", 20.0, rng), "sensors", rng)  # high up: no ground near
    with jax.enable_x64(True):
        lanes = make_lanes(log, np.ones(len(log), bool), np.array(truth.tau), truth.gravity)
        problem = Problem(lanes, model_of(truth))
        problem.set_noise(noises.first_guess(lanes, problem.left(problem.start[None])[0]))
        for effect, value, is_there in (
            ("linear_drag", 0.0, False),
            ("linear_drag", 0.5, True),
            ("ground_effect", 0.03, False),
        ):
            way = next(one for one in CANDIDATES if one.effect == effect)
            found = fitted(problem, (way,), problem.start)
            vector = found.vector.copy()
            vector[problem.index(way.fields)] = value
            assert is_determined(problem, found._replace(vector=vector), way.fields) is is_there


@pytest.mark.slow
def test_what_another_law_of_lift_leaves_is_not_named():
    line = plant("one", 91, seed=1)
    assert line["effects"] == ["translational_lift"]
    assert [cause["effect"] for cause in line["causes"]] == ["translational_lift"]
