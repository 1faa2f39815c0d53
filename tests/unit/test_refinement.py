"""Refinement by prediction tells what commands do not explain and makes no horizon worse."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.diagnosis import model_of
from flytrack_sysid.diagnosis import flight_errors
from flytrack_sysid.diagnosis.flight_errors import Flights, sample_windows
from flytrack_sysid.diagnosis.flight_fit import Fit, Target
from flytrack_sysid.diagnosis.refinement import acting_effects, reduced, refine, superfluous
from flytrack_sysid.diagnosis.vetoes import Selection
from flytrack_sysid.inference.chunks import cut_chunks
from flytrack_sysid.inference.free_flight import QUANTITIES
from flytrack_sysid.inference.parameters import THRUST_COEFFS
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.score_test import CANDIDATES, Candidate
from flytrack_sysid.inference.search import FittedModel, SearchState
from flytrack_sysid.log import FlightLog
from flytrack_sysid.split import held_out_rows
from tests.support.hidden_flights import scripted
from tests.support.motor_flights import flown
from tests.support.motor_models import crafts
from tests.support.motor_models import model_of as motor_model_of
from tests.support.tables import table

SECONDS = 40.0
TRUE_DRAG = {"d_x": 0.4, "d_y": 0.4, "d_z": 0.2}
BY_EFFECT = {candidate.effect: candidate for candidate in CANDIDATES}
DRAG, BIAS = BY_EFFECT["linear_drag"], BY_EFFECT["accelerometer_bias"]
SCALE, DELAY = BY_EFFECT["rate_scale"], BY_EFFECT["command_delay"]
CIRCLE_S, RADIUS_M = 4.0, 1.0
LATE_S = 0.037
NO_SLOPES = np.zeros((0, 0, 0))


@pytest.fixture(scope="module", autouse=True)
def in_float64():
    with jax.enable_x64(True):
        yield


def build_problem(truth, log):
    """Return the problem of a plant's log and its team's model."""
    model = model_of(truth)
    return Problem.of(cut_chunks(log, ~held_out_rows(log), model), model)


def refined(problem, log, vector, candidates, values, doubted=()):
    """Return the refinement of a model with these values in place of a vector's."""
    vector = vector.copy()
    for name, value in values.items():
        vector[problem.names.index(name)] = value
    base = FittedModel((), problem.start, 0.0, ())
    model = base._replace(candidates=candidates, vector=vector)
    return refine(SearchState(problem), base, model, log, held_out_rows(log), (), doubted)


@pytest.fixture(scope="module")
def dragged():
    """A plant with drag, and a refined model that began with half of it and a bias nobody flew."""
    truth, log = scripted(3, SECONDS, effects={"linear_drag": TRUE_DRAG})
    values = {f"linear_drag.{name}": 0.5 * value for name, value in TRUE_DRAG.items()}
    values |= {"accelerometer_bias.x": 0.3}
    problem = build_problem(truth, log)
    return truth, log, problem, refined(problem, log, problem.start, (DRAG, BIAS), values)


def test_values_are_refined_by_flights(dragged):
    *_, problem, refinement = dragged
    fit, costs = refinement.fit, refinement.removal_costs
    assert refinement.kept == (DRAG, BIAS) and not refinement.removed
    half_widths = dict(zip(fit.indices, fit.half_widths, strict=True))
    for name, value in TRUE_DRAG.items():
        index = problem.names.index(f"linear_drag.{name}")
        assert abs(fit.vector[index] - value) < max(1.5 * half_widths[index], 0.05 * value)
    bias = problem.names.index("accelerometer_bias.x")
    assert fit.vector[bias] == 0.3  # no flight shows it
    assert refinement.vector_without("accelerometer_bias", fit)[bias] == 0.0
    assert costs["linear_drag"] > 0.1 and "accelerometer_bias" not in costs
    assert refinement.flight_test.worst_ratio(fit.vector) < 1.0


def test_models_are_compared_with_the_base_that_is_given(dragged):
    *_, problem, refinement = dragged
    right, wrong = refinement.fit.vector, problem.start
    flight_test = refinement.flight_test.with_base(right)
    assert flight_test.worst_ratio(wrong) > 1.0
    assert flight_test.prefers(right, wrong) and not flight_test.prefers(wrong, right)
    assert not flight_test.with_base(wrong).prefers(right, wrong)  # none is worse


def test_what_flights_do_not_show_is_removed(dragged):
    """No block of flights needs the scale, and no flight depends on the bias."""
    _, log, problem, earlier = dragged
    candidates, doubted = (DRAG, SCALE, BIAS), ("linear_drag", "accelerometer_bias")
    scale = {"rate_scale.roll": 1.02}
    later = refined(problem, log, earlier.fit.vector, candidates, scale, doubted)
    assert later.kept == (DRAG,) and {*later.removed} == {SCALE.effect, BIAS.effect}


def test_a_lag_comes_back_when_the_effect_in_its_place_is_gone(dragged):
    problem = build_problem(*scripted(3, 20.0))
    state, (roll,) = SearchState(problem), problem.parameter_indices(["tau_roll"])
    vector = problem.start.copy()
    vector[roll] = problem.low[roll]  # where no slope leads back
    base = state.fitted((), problem.start)
    selection = Selection(state, base, FittedModel((DRAG, BIAS), vector, 0.0, ()), {})
    smaller = reduced(selection, dragged[-1]._replace(kept=(BIAS,), fit=None))
    assert list(smaller.model.effects) == ["accelerometer_bias"] == list(smaller.ablations)
    assert smaller.model.vector[roll] == pytest.approx(base.vector[roll], rel=0.01)


def test_slopes_of_a_fit_lead_to_nearly_the_same_fit_without_an_effect(dragged):
    problem, flight_test, fit = dragged[2], dragged[3].flight_test, dragged[3].fit
    is_fitted = np.ones(flight_test.scale.shape, bool)
    target = Target(problem, flight_test.flights, flight_test.scale, is_fitted)
    fields = problem.parameter_indices(DRAG.fields)
    remaining = [index for index in fit.indices if index not in fields]
    start = problem.at_start(fit.vector, DRAG.fields)
    whole = target.fitted(fit.vector, fit.indices, 10)
    own, shared = (target.fitted(start, remaining, 2, nearby) for nearby in (None, whole))
    before, of_whole, of_own, of_shared = (
        target.losses(vector)[0].sum()
        for vector in (start, whole.vector, own.vector, shared.vector)
    )
    assert of_whole < 0.7 * of_own and of_own < before
    assert of_shared == pytest.approx(of_own, rel=0.02)
    columns = [whole.indices.index(index) for index in remaining]
    assert np.array_equal(shared.columns, whole.columns[columns])


def test_what_changes_no_flight_at_a_bound_goes_back(dragged):
    problem, flight_test = dragged[2], dragged[3].flight_test
    fields = ("command_delay.delay_s", "command_delay.yaw_extra_s", "linear_drag.d_x")
    vector = dragged[3].fit.vector.copy()
    indices = problem.parameter_indices(fields)
    vector[indices] = 0.01, problem.low[indices[1]], problem.high[indices[2]]
    fit = dragged[3].fit._replace(vector=vector)
    is_fitted = np.ones(flight_test.scale.shape, bool)
    target = Target(problem, flight_test.flights, flight_test.scale, is_fitted)
    moved = [target.nearer_nominal(fit, field).vector for field in fields[1:]]
    assert -0.02 < moved[0][indices[1]] <= -0.01 and moved[1][indices[2]] == vector[indices[2]]


@pytest.mark.parametrize(("values", "halves", "expected"), table("diagnoses")["superfluous"])
def test_a_parameter_is_superfluous_beside_others_at_a_bound_or_where_all_may_be_nominal(
    dragged, values, halves, expected
):
    problem = dragged[2]
    indices = problem.parameter_indices(DELAY.fields)
    vector = problem.start.copy()
    vector[indices] = values
    fit = Fit(vector, tuple(indices), np.zeros((3, 3)), np.array(halves), np.zeros(1), NO_SLOPES)
    assert (superfluous(problem, fit, DELAY) or "") == expected


@pytest.mark.slow
def test_flights_without_velocity_leave_the_thrust_of_single_steps():
    """Torque over inertia is all that rates show: a map and radii of gyration trade off."""
    weak = crafts(thrust=[4.8] * 4)
    log = flown(weak, SECONDS).without("p", "v", "q")
    model = motor_model_of(crafts())
    problem = Problem.of(cut_chunks(log, ~held_out_rows(log), model), model)
    vector = problem.start.copy()
    vector[problem.names.index("motors.damping_x")] = 0.5
    flights = Flights(sample_windows(log, held_out_rows(log)))
    damping = Candidate("motors", ("motors.load", "motors.damping_x"))
    assert acting_effects(problem, vector, [damping], flights) == ("motors",)
    vector[problem.names.index("motors.load")] = 0.1  # acts on force alone
    assert acting_effects(problem, vector, [damping], flights) == ()
    delay = Candidate("command_delay", ("command_delay.delay_s",))
    base = refined(problem, log, problem.start, (delay,), {delay.fields[0]: 0.01}).base
    thrust = problem.parameter_indices(THRUST_COEFFS)
    np.testing.assert_array_equal(base[thrust], problem.start[thrust])
    radius = problem.names.index("motors.radius_x")
    assert abs(base[radius] / problem.start[radius] - np.sqrt(6.0 / 4.8)) < 0.05


def test_a_late_gyro_starts_flights_at_the_rates_of_their_time():
    """Rates are corrected by a late reading until it arrives."""
    late = {"imu_latency": {"latency_s": LATE_S}}
    truth, log = scripted(3, SECONDS, effects=late)
    problem, windows = build_problem(truth, log), sample_windows(log, held_out_rows(log))
    late = problem.start.copy()
    late[problem.names.index("imu_latency.latency_s")] = LATE_S
    base, corrected = Flights(windows).errors_at(problem, np.stack([problem.start, late])).rms()
    rates = QUANTITIES.index("rates")
    assert np.all(corrected <= 1.05 * base)
    assert np.all(corrected[:4, rates] < 0.8 * base[:4, rates])


def test_a_model_that_flew_does_not_fly_again(monkeypatch):
    truth, log = scripted(3, SECONDS)
    flights, problem = Flights(sample_windows(log, held_out_rows(log))), build_problem(truth, log)
    vectors = np.stack([problem.start, problem.start + 1e-3])
    errors = flights.errors_at(problem, vectors).errors
    monkeypatch.setattr(flight_errors, "_errors", None)
    again = flights.errors_at(problem, vectors[::-1]).errors
    np.testing.assert_array_equal(again, errors[::-1])
    assert np.any(errors[0] != errors[1])


def circle():
    """Return a level flight on one circle, always the same, whatever the commands say."""
    rng = np.random.default_rng(7)
    time = np.arange(0.0, 10.0 * CIRCLE_S, 0.01)
    yaw_rate = 2.0 * np.pi / CIRCLE_S
    attitude = Rotation.from_rotvec(np.outer(time, [0.0, 0.0, yaw_rate]))
    channels = {
        "p": attitude.apply([RADIUS_M, 0.0, 1.0]),
        "v": attitude.apply([0.0, RADIUS_M * yaw_rate, 0.0]),
        "q": attitude.as_quat(scalar_first=True),
        "w": np.tile([0.0, 0.0, yaw_rate], (len(time), 1)),
    }
    noisy = {
        name: values + 1e-3 * rng.standard_normal(values.shape) for name, values in channels.items()
    }
    commands = np.clip(0.3 * rng.standard_normal((len(time), 4)), -1.0, 1.0)
    return FlightLog(time, noisy | {"u": commands}, np.zeros(len(time), int))


def test_a_path_that_is_known_without_commands_settles_no_doubt(dragged):
    truth, _, _, commanded = dragged
    assert commanded.flight_test.matters.mean() > 0.5
    log = circle()
    problem = build_problem(truth, log)
    values = {f"linear_drag.{name}": value for name, value in TRUE_DRAG.items()}
    refinement = refined(problem, log, problem.start, (DRAG,), values, ("linear_drag",))
    flight_test = refinement.flight_test
    assert flight_test.is_known[:3].all() and not flight_test.matters.any()
    assert refinement.fit is None and refinement.kept == (DRAG,)
