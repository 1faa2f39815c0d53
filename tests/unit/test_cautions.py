"""What a diagnosis warns of: values at the end of their range, and free flight that got worse."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from benchmarks.hidden import draw_base, fly, measure
from flytrack_env.dynamics import nominal_parameters
from flytrack_sysid.diagnosis.cautions import cautions
from flytrack_sysid.diagnosis.lanes import make_lanes
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.result import Cause, Errors, Estimated
from flytrack_sysid.diagnosis.search import Found

CAUSE = Cause("rate_scale", (), "rates", {}, 100.0, 30.0, 100.0, 90.0)
AS_GOOD = {"refitted_base": Errors({}, {"1": 0.5}), "extended": Errors({}, {"1": 0.5})}


@pytest.fixture(scope="module")
def problem():
    """A short flight."""
    rng = np.random.default_rng(6)
    log = measure(fly(draw_base(rng), "hover", 6.0, rng), "sensors", rng)
    model = nominal_parameters()
    with jax.enable_x64(True):
        return Problem(make_lanes(log, np.ones(len(log), bool), np.asarray(model.tau, float), 9.81), model)


def with_value(problem: Problem, field: str, value: float) -> tuple[Found, list[Cause]]:
    """A model with one value, and the cause that tells it."""
    vector = problem.start.copy()
    vector[problem.names.index(field)] = value
    effect, name = field.split(".")
    cause = replace(CAUSE, effect=effect, parameters={name: Estimated(value, (value, value), "1")})
    return Found((), vector, 0.0, ()), [cause]


def test_a_value_inside_its_range_is_no_caution(problem):
    assert cautions(problem, *with_value(problem, "rate_scale.yaw", 0.9), AS_GOOD, [], 0) == ()


def test_a_value_at_the_end_of_its_range_is_told(problem):
    low = problem.low[problem.names.index("rate_scale.yaw")]
    (told,) = cautions(problem, *with_value(problem, "rate_scale.yaw", low), AS_GOOD, [], 0)
    assert told.startswith(f"rate_scale.yaw = {low:g} is at the end")


def test_a_limit_that_is_as_hard_as_can_be_is_no_caution(problem):
    assert cautions(problem, *with_value(problem, "rate_saturation.softness", 0.0), AS_GOOD, [], 0) == ()


def test_a_base_parameter_has_no_range_to_end_at(problem):
    cause = replace(CAUSE, effect="tau_roll", parameters={"tau_roll": Estimated(0.1, (0.1, 0.1), "s")})
    found = Found((), problem.start, 0.0, ())
    assert cautions(problem, found, [cause], AS_GOOD, [], 0) == ()


def test_free_flight_that_got_worse_is_told(problem):
    errors = AS_GOOD | {"extended": Errors({}, {"1": 0.78})}
    (told,) = cautions(problem, Found((), problem.start, 0.0, ()), [], errors, [], 0)
    assert "0.78 m against 0.5 m after 1 s" in told


def test_what_was_taken_back_is_told(problem):
    (told,) = cautions(problem, Found((), problem.start, 0.0, ()), [], AS_GOOD, ["wind"], 0)
    assert told.startswith("wind gained nothing on the held-out part")
