"""Which effects vetoes reject although they gain enough, and what a reader is warned of."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from benchmarks.diagnosis import model_of
from benchmarks.hidden import Truth, draw_base, fly, measure
from flytrack_env.effects import BY_NAME
from flytrack_sysid.diagnosis import vetoes
from flytrack_sysid.diagnosis.diagnose import thinning_warning
from flytrack_sysid.diagnosis.lanes import LANE_S, make_lanes, thinned
from flytrack_sysid.diagnosis.model_selection import Ablation, is_determined, select_effects, with_lags_anew
from flytrack_sysid.diagnosis.noise import first_guess
from flytrack_sysid.diagnosis.problem import Problem, Window
from flytrack_sysid.diagnosis.refinement import Fit, Refined
from flytrack_sysid.diagnosis.result import Cause, Estimated, Unexplained
from flytrack_sysid.diagnosis.score_test import CANDIDATES, threshold
from flytrack_sysid.diagnosis.search import FittedModel, Held, SearchState
from flytrack_sysid.diagnosis.summary import (
    causes_at_end,
    stand_in_notes,
    unseen_at_rest_notes,
    warnings_of,
    with_refined_values,
)
from flytrack_sysid.diagnosis.vetoes import HELD_OUT_SHOWN, Selection, is_contradicted, reject
from flytrack_sysid.parameters import TAUS, THRUST_COEFFS

LIFT_GAIN = 20_000.0
CAUSE = Cause("rate_scale", (), "rates", {}, 100.0, 30.0, 100.0, 90.0)


@pytest.fixture(scope="module")
def state():
    """The state of a search in twenty seconds of flight without effects."""
    rng = np.random.default_rng(3)
    with jax.enable_x64(True):
        yield state_of(draw_base(rng), rng)


def state_of(truth: Truth, rng: np.random.Generator) -> SearchState:
    """Return the state of a search in twenty seconds of a plant's flight."""
    log = measure(fly(truth, "scripted", 20.0, rng), "sensors", rng)  # high up: no ground near
    lanes = make_lanes(log, np.ones(len(log), bool), np.array(truth.tau), truth.gravity)
    problem = Problem.of(lanes, model_of(truth))
    noise = first_guess(lanes, problem.residuals(problem.start[None])[0])
    return SearchState.start(log, problem.with_noise(noise))


def ablation(gain: float, num_parameters: int = 1, inflation: float = 1.0) -> Ablation:
    without = SimpleNamespace(vector=np.zeros(1))
    return Ablation(gain, inflation, num_parameters, {}, {}, without)


def selection_of(*windows: Window, **ablations: Ablation) -> Selection:
    state = SimpleNamespace(problem=SimpleNamespace(windows=windows))
    return Selection(state, None, SimpleNamespace(vector=np.zeros(1)), ablations)


@pytest.mark.slow
def test_a_lag_that_ended_where_it_has_no_slope_is_fitted_from_nominal_again(state):
    problem, fitted = state.problem, state.fitted((), state.problem.start)
    assert with_lags_anew(state, fitted) == []
    place, vector = problem.names.index("tau_yaw"), fitted.vector.copy()
    vector[place] = problem.low[place]
    (found,) = with_lags_anew(state, fitted._replace(vector=vector))
    np.testing.assert_allclose(found.vector[place], fitted.vector[place], rtol=0.01)
    assert found.cost == pytest.approx(fitted.cost, abs=0.1)


def test_what_may_be_something_unknown_is_told_with_its_size_and_not_named(state):
    problem = state.problem
    vector = problem.start.copy()
    vector[problem.index(THRUST_COEFFS)] *= 1.146
    selection = Selection(state, None, None, {}, stand_ins=("thrust_curve", "wind", "tau_yaw"))
    thrust, lag = stand_in_notes(selection, vector)
    assert thrust.startswith("thrust_curve differs") and "thrust or your mass by +14.6% in the mean" in thrust
    assert lag.startswith("tau_yaw differs in the extended model, but is not named")


def test_next_to_nothing_beside_a_larger_law_is_its_remainder():
    for factor, expected in ((0.99, ["wind"]), (1.01, [])):
        small = ablation(factor * vetoes.FORCE_REMAINDER * LIFT_GAIN)
        selection = selection_of(translational_lift=ablation(LIFT_GAIN), wind=small)
        assert vetoes.remainder_of_force_law(selection, None) == expected


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
def test_only_laws_of_a_force_leave_remainders(large, small):
    assert {large, small} <= BY_NAME.keys()
    selection = selection_of(**{large: ablation(1e9), small: ablation(20.0)})
    assert vetoes.remainder_of_force_law(selection, None) == []


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
    monkeypatch.setattr(vetoes, "held_out_gain", lambda test, less, full: (held_out, expected))
    inflation = 1.5
    own = ablation(thresholds * threshold(3) * inflation, 3, inflation)
    assert vetoes.seen_once(selection_of(gyro_scale=own), None) == ([] if is_named else ["gyro_scale"])


@pytest.mark.parametrize(("held_out", "is_named"), [(0.5, True), (0.0, False), (-0.5, False)])
def test_what_begins_in_flight_has_to_be_seen_again_however_clear(monkeypatch, held_out, is_named):
    monkeypatch.setattr(vetoes, "held_out_gain", lambda test, less, full: (held_out, 0.9))
    selection = selection_of(Window("gyro_scale", start=100), gyro_scale=ablation(1e3, 3))
    assert vetoes.seen_once(selection, None) == ([] if is_named else ["gyro_scale"])


@pytest.mark.parametrize(
    ("share", "contradicted"), [(1.0, False), (0.5, False), (0.2, True), (0.0, True), (-1.0, True)]
)
def test_what_held_out_rows_hardly_show_is_contradicted(share, contradicted):
    expected = 1000.0  # the gain of a cause of which a share is there: 2 share - 1 of it
    assert is_contradicted((2.0 * share - 1.0) * expected, expected, inflation=1.0) == contradicted


def test_held_out_rows_that_would_not_show_an_effect_contradict_nothing():
    assert not is_contradicted(-100.0, 0.9 * HELD_OUT_SHOWN, inflation=1.0)
    assert not is_contradicted(0.0, 1.5 * HELD_OUT_SHOWN, inflation=2.0)


def test_a_cause_that_held_out_rows_are_likelier_without_is_contradicted():
    expected, inflation = 2.7 * HELD_OUT_SHOWN, 4.0
    absent = expected - 2.5 * 2.0 * (expected * inflation) ** 0.5
    assert absent < 0.0
    assert is_contradicted(absent - 1.0, expected, inflation)
    assert not is_contradicted(absent + 1.0, expected, inflation)


def test_true_causes_are_kept_in_noise():
    rng, expected = np.random.default_rng(5), 60.0
    gains = expected + 2.0 * np.sqrt(expected) * rng.standard_normal(10_000)
    assert not any(is_contradicted(gain, expected, inflation=1.0) for gain in gains)


@pytest.mark.slow
def test_an_effect_that_could_as_well_be_none_is_not_determined(state):
    problem = state.problem
    for effect, value, expected in (
        ("linear_drag", 0.0, False),
        ("linear_drag", 0.5, True),
        ("ground_effect", 0.03, False),
    ):
        way = next(one for one in CANDIDATES if one.effect == effect)
        found = state.fitted((way,), problem.start)
        vector = found.vector.copy()
        vector[problem.index(way.fields)] = value
        assert is_determined(state, found._replace(vector=vector), way.fields)[1] is expected


@pytest.mark.slow
def test_a_push_becomes_a_moving_air_where_there_is_drag():
    """Axes differ in their drag, so that air which moves does not push as a constant force does."""
    effects = {
        "linear_drag": {"d_x": 0.1, "d_y": 0.3, "d_z": 0.05},
        "wind": {"v_x": -3.0, "v_y": 2.0, "v_z": -4.0},
    }
    rng = np.random.default_rng(3)
    with jax.enable_x64(True):
        state = state_of(replace(draw_base(rng), effects=effects), rng)
        drag = next(one for one in CANDIDATES if one.effect == "linear_drag")
        push = next(one for one in CANDIDATES if "wind.a_x" in one.fields)
        _, model, _ = select_effects(state, state.fitted((drag, push), state.problem.start))
    assert model.candidate("wind").fields == ("wind.v_x", "wind.v_y", "wind.v_z")


def test_base_parameters_held_for_an_effect_are_free_without_it(state):
    delay = next(one for one in CANDIDATES if one.effect == "command_delay")
    held = (*(Held(tau, "command_delay") for tau in TAUS), Held("c0", "wind"))
    holding = replace(state, held=held)
    model = holding.fitted((delay,), holding.problem.start)
    left = reject(Selection(holding, model, model, {}), ["command_delay"])
    assert left.state.held == (Held("c0", "wind"),) and left.state.refused == ("command_delay",)
    assert left.model.candidates == ()
    assert set(state.problem.index(TAUS)) <= set(left.model.places)
    assert holding.held == held and holding.refused == ()  # the state before is as it was


def test_slopes_serve_again_nearby_and_not_for_an_effect_without_a_slope(state):
    problem = state.problem
    later, first = state.linearized(problem.start)
    limited, lagging = problem.start.copy(), problem.start.copy()
    limited[problem.names.index("rate_slew_limit.roll_s")] = 0.03
    lagging[problem.names.index("tau_roll")] *= 1.0001
    assert first.distance(limited) == np.inf and 0.0 < first.distance(lagging) < 1.0
    assert later.linearized(lagging)[1].slopes is first.slopes
    other = later.linearized(limited)[1]
    column = other.column("rate_slew_limit.roll_s")
    assert other.total[column, column] > 1e3 * first.total[column, column]


@pytest.mark.parametrize(
    ("field", "value", "is_warned_of"),
    [
        ("rate_scale.yaw", 0.9, False),
        ("rate_scale.yaw", None, True),
        ("tau_roll", 0.1, False),
        ("tau_roll", None, True),
        ("rate_saturation.softness", 0.0, False),  # a limit may well be hard
    ],
)
def test_values_at_the_end_of_their_range_are_beyond_the_list(state, field, value, is_warned_of):
    problem = state.problem
    value = problem.low[problem.names.index(field)] if value is None else value
    vector = problem.start.copy()
    vector[problem.names.index(field)] = value
    effect, _, name = field.rpartition(".")
    cause = replace(CAUSE, effect=effect or name, parameters={name: Estimated(value, (value, value), "1")})
    found = with_refined_values([cause], Refined((), None, None, (), {}, problem, None), vector)
    assert found[0].beyond.startswith(f"{name} at most {value:g}" if is_warned_of else "")
    warned = [one for one in warnings_of(problem, found, []) if "beyond the list" in one]
    assert len(warned) == is_warned_of and bool(found[0].beyond) == is_warned_of


def test_a_value_that_no_flight_depends_on_is_not_told(state):
    """A yaw that is ahead of the others by more than their delay is in time, whatever the value."""
    problem, names = state.problem, ("delay_s", "yaw_extra_s")
    places = tuple(problem.index([f"command_delay.{name}" for name in names]))
    fit = Fit(problem.start, places, np.diag([1e-6, 0.0]))
    told = {name: Estimated(0.01, (0.0, 0.02), "s") for name in names}
    cause = replace(CAUSE, effect="command_delay", parameters=told)
    (found,) = with_refined_values([cause], Refined((), fit, None, (), {}, problem, None), problem.start)
    assert list(found.parameters) == ["delay_s"] and found.parameters["delay_s"].ci95 == (0.0, 0.001)


@pytest.mark.parametrize(
    ("field", "is_refused"),
    [
        ("gyro_scale.x", True),
        ("command_delay.delay_s", False),  # its law holds: so many rows are remembered
        ("ground_effect.gain", False),  # no ground was near
    ],
)
def test_only_an_effect_whose_law_ends_where_the_search_does_is_refused(state, field, is_refused):
    problem, effect = state.problem, field.partition(".")[0]
    vector = problem.start.copy()
    vector[problem.names.index(field)] = problem.high[problem.names.index(field)]
    way = next(one for one in CANDIDATES if one.effect == effect and field in one.fields)
    base = FittedModel((), problem.start, 0.0, tuple(state.base_places))
    model = FittedModel((way,), vector, 0.0, (*state.base_places, *problem.index(way.fields)))
    selection = Selection(state, base, model, {effect: Ablation(1e4, 1.0, 1, {}, {}, base)})
    refined = Refined((way,), None, None, (), {}, problem, None)
    found = causes_at_end(selection, refined, problem)
    assert [one.effect for one in found] == ([effect] if is_refused else [])
    assert all(one.beyond.startswith("x at least 1.2") and "x" in one.parameters for one in found)


@pytest.mark.parametrize(("effect", "is_law"), [("rate_scale", True), ("command_delay", False)])
def test_a_law_without_memory_has_to_hold_while_commands_rest(state, effect, is_law):
    """A scale of rates that nobody flew is contradicted there; one that was flown is not, nor a delay."""
    problem = state.problem
    vector = problem.start.copy()
    field, size = {"rate_scale": ("roll", 0.3), "command_delay": ("delay_s", 0.02)}[effect]
    vector[problem.names.index(f"{effect}.{field}")] += size
    for less, full, is_false in ((problem.start, vector, True), (vector, problem.start, False)):
        own = Ablation(1e4, 1.0, 1, {}, {}, SimpleNamespace(vector=less))
        found = Selection(state, None, SimpleNamespace(vector=full), {effect: own})
        assert vetoes.not_seen_at_rest(found, None) == ([effect] if is_false and is_law else [])


def test_what_only_transients_show_is_no_law_where_turns_are_unexplained(state):
    vector = state.problem.start.copy()
    vector[state.problem.names.index("rate_scale.roll")] += 0.001
    own = Ablation(1e4, 1.0, 1, {}, {}, SimpleNamespace(vector=state.problem.start))
    found = Selection(state, None, SimpleNamespace(vector=vector), {"rate_scale": own})
    assert vetoes.not_seen_at_rest(found, None) == []
    for side, is_rejected in (("force", False), ("rate", True)):
        left = found._replace(unexplained=Unexplained(True, ("stochastic",), {f"{side}: stochastic": 9.0}))
        assert vetoes.not_seen_at_rest(left, None) == (["rate_scale"] if is_rejected else [])
    (note,) = unseen_at_rest_notes({"wind": vetoes.seen_once, "rate_scale": vetoes.not_seen_at_rest})
    assert note.startswith("rate_scale: ") and unseen_at_rest_notes({"wind": vetoes.seen_once}) == []


def test_attitude_tells_a_gyro_from_a_rate_loop(state):
    """A scale of the gyro shows in every turn, whatever the sticks do; a scale of the rates may not."""
    vector = state.problem.start.copy()
    vector[state.problem.names.index("gyro_scale.x")] += 0.001
    own = Ablation(1e4, 1.0, 1, {}, {}, SimpleNamespace(vector=state.problem.start))
    left = Unexplained(True, ("stochastic",), {"rate: stochastic": 9.0})
    blind = state.problem.counts & (np.arange(2) == 0)  # direct channels only
    for counts, is_rejected in ((state.problem.counts, False), (blind, True)):
        lanes = state.problem.lanes._replace(counts=counts)
        seen = replace(state, problem=replace(state.problem, lanes=lanes))
        found = Selection(seen, None, SimpleNamespace(vector=vector), {"gyro_scale": own}, left)
        assert vetoes.not_seen_at_rest(found, None) == (["gyro_scale"] if is_rejected else [])


def test_laws_that_undo_each_other_are_contradicted_together(state):
    """A scale and a saturation of rates: one without the other is worse than both, and neither was flown."""
    problem, laws = state.problem, {"rate_scale": 1.25, "rate_saturation": 0.2}
    ways = {one.effect: one for one in CANDIDATES if one.effect in laws}
    places = {name: problem.index([f"{name}.{axis}" for axis in ("roll", "pitch", "yaw")]) for name in laws}
    both = problem.start.copy()
    for name, value in laws.items():
        both[places[name]] = value
    needed = {}
    for name in laws:
        less = both.copy()
        less[places[name]] = problem.start[places[name]]
        rest = tuple(way for effect, way in ways.items() if effect != name)
        needed[name] = Ablation(1e4, 1.0, 1, {}, {}, FittedModel(rest, less, 0.0, tuple(state.base_places)))
    model = FittedModel(tuple(ways.values()), both, 0.0, tuple(state.base_places))
    for name in laws:  # alone, neither is
        assert vetoes.not_seen_at_rest(Selection(state, None, model, {name: needed[name]}), None) == []
    assert vetoes.not_seen_at_rest(Selection(state, None, model, needed), None) == [*laws]


def test_commands_rest_some_time_after_they_moved():
    sticks = np.zeros((100, 1, 4))
    sticks[30:, 0, 0], sticks[:, 0, 3] = 0.8, np.linspace(-1.0, 1.0, 100)  # thrust may move
    record = SimpleNamespace(command=sticks, step_s=np.full((100, 1), 0.01))
    found = vetoes.rests(record)[:, 0]
    again = 30 + round(vetoes.REST_S / 0.01)
    assert found[:30].all() and not found[30:again].any() and found[again:].all()


def test_lost_causes_are_warned_of(state):
    (lost,) = warnings_of(state.problem, [], ["wind"])
    assert lost.startswith("wind gained nothing on the held-out part")


def test_a_long_log_is_thinned_with_a_warning_that_counts_judged_rows(state, monkeypatch):
    """Lanes also hold rows that are not judged: those must not make up for judged rows that are lost."""
    lanes = state.problem.lanes
    half = lanes.counts & (np.arange(len(lanes.row)) % 2 == 0)[:, None, None, None]
    every = lanes._replace(counts=half)
    assert thinned(every) is every and thinning_warning(every, every) == []
    monkeypatch.setattr("flytrack_sysid.diagnosis.lanes.MOST_ROWS", 2 * LANE_S * 100 + 10)
    (warning,) = thinning_warning(every, thinned(every))
    kept, number = thinned(every).num_judged, every.num_judged
    assert kept < 0.8 * number and warning.startswith(f"only {kept} of {number} rows were learnt from")
    in_lanes = int((thinned(every).row[100:] >= 0).sum())
    assert in_lanes >= number  # as many rows as are judged: counting those would have hidden the loss
