"""Parts of the diagnosis: its noise filter, chunks, messages, and logs that say too little."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import lfilter

from benchmarks.diagnosis import model_of
from flytrack_env.effects import CommandDelay, LearnedLaw, LinearDrag, RotorDrag, Wind
from flytrack_env.effects.grammar import Factor, Law, Term
from flytrack_sysid.diagnosis import DiagnosisError, diagnose, joined, onset, vetoes
from flytrack_sysid.diagnosis.craft import summarize_half_responses
from flytrack_sysid.diagnosis.diagnose import learn_rest, thinning_warning, unused_channels
from flytrack_sysid.diagnosis.flight_fit import Fit
from flytrack_sysid.diagnosis.learned import improves_flights
from flytrack_sysid.diagnosis.model_selection import Ablation
from flytrack_sysid.diagnosis.onset import ALWAYS, NEVER, Profile, at_best_row, windowed
from flytrack_sysid.diagnosis.refinement import Refined
from flytrack_sysid.diagnosis.report import describe_verdict
from flytrack_sysid.diagnosis.result import Cause, Estimated, Unexplained
from flytrack_sysid.diagnosis.size import is_bent
from flytrack_sysid.diagnosis.summary import (
    collect_warnings,
    given_law_notes,
    with_refined_values,
)
from flytrack_sysid.diagnosis.vetoes import Selection
from flytrack_sysid.inference import noise as noises
from flytrack_sysid.inference.chunks import (
    CHUNK_S,
    LEAD_IN_S,
    NUM_AXES,
    at_usual_rate,
    cut_chunks,
    make_chunks,
    spread_chunks,
    thinned,
)
from flytrack_sysid.inference.parameters import DRAIN
from flytrack_sysid.inference.problem import Problem, Window
from flytrack_sysid.inference.record import make_record
from flytrack_sysid.inference.score_test import Linearization
from flytrack_sysid.inference.search import FittedModel, SearchState, candidates_of_given
from flytrack_sysid.log_file import save_log
from tests.support.compiling import programs
from tests.support.hidden_flights import scripted
from tests.support.refusals import run
from tests.support.tables import table
from tests.support.written_logs import with_channels

SECONDS, DT_S = 40.0, 0.01
RATE = 100  # rows a second
BATTERY = NUM_AXES - 1  # it has no direct channel
NO_SLOPES = np.zeros((0, 0, 0))
# Of the sensors, rad/s, m/s^2, rad, m/s, V; and of gusts that shake both sides.
DIRECT = np.repeat([0.1, 1.5, 1.0], [3, 3, 1])
LEVEL = np.repeat([0.01, 0.05, 0.01], [3, 3, 1])
DISTURBANCE = np.repeat([0.1, 1.5, 1e-3], [3, 3, 1])
WANDER, TAU_S = 0.1 * LEVEL, 0.3


def make_cause(effect, **parameters):
    """Return a named cause with these estimates."""
    return Cause(effect, (), "rates", parameters, 100.0, 30.0, 100.0, 90.0)


def refined(problem, fit=None):
    """Return the result of a refinement that removes nothing and compares nothing."""
    return Refined((), fit, None, (), {}, problem, None)


def delay_after_flights(problem, half_widths_s, listed, **delays_s):
    """Return the causes that remain of a command delay whose fields were fitted to flights.

    Args:
        half_widths_s: of the fitted fields.
        listed: names of the fields that the cause has before.
        delays_s: the fitted fields.
    """
    indices = tuple(problem.parameter_indices([f"command_delay.{name}" for name in delays_s]))
    vector = problem.start.copy()
    vector[[*indices]] = [*delays_s.values()]
    half_widths = np.array(half_widths_s)
    fit = Fit(vector, indices, np.diag(half_widths**2), half_widths, np.zeros(1), NO_SLOPES)
    estimates = {name: Estimated(0.01, (0.0, 0.02), "s") for name in listed}
    return with_refined_values(
        [make_cause("command_delay", **estimates)], refined(problem, fit), vector
    )


@pytest.fixture(scope="module")
def flown():
    """A hidden plant without effects, and what its sensors log."""
    return scripted(3, SECONDS)


@pytest.fixture(scope="module")
def chunks(flown):
    """All rows of that log."""
    truth, log = flown
    return make_chunks(log, np.ones(len(log), bool), np.array(truth.tau), truth.gravity)


@pytest.fixture(scope="module")
def state(flown, chunks):
    """The state of a search in that log."""
    truth, log = flown
    with jax.enable_x64(True):
        problem = Problem.of(chunks, model_of(truth))
        noise = noises.first_guess(chunks, problem.residuals(problem.start[None])[0])
        yield SearchState.start(log, problem.with_noise(noise))


@pytest.fixture(scope="module")
def disturbed(chunks):
    """Residuals of white sensors and a disturbance of the drone, (rows, chunks, NUM_AXES, 2)."""
    rng, keep = np.random.default_rng(4), np.exp(-DT_S / TAU_S)
    count = 1 + int(chunks.row.max())
    fresh = rng.standard_normal((count, NUM_AXES))
    acting = DISTURBANCE * lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], fresh, axis=0)
    walk = WANDER * np.sqrt(DT_S) * rng.standard_normal((count, NUM_AXES))
    level = np.cumsum(acting * DT_S + walk, axis=0) + LEVEL * rng.standard_normal((count, NUM_AXES))
    direct = acting + DIRECT * rng.standard_normal((count, NUM_AXES))
    series = np.stack([direct, np.diff(level, axis=0, prepend=level[:1])], axis=-1)
    return series[chunks.row] * chunks.is_joined[..., None, None]


def test_a_given_effect_is_refitted_with_what_it_sets(flown, chunks):
    """An air that moves is no steady push; a delay of thrust alone is one of all commands, too."""
    model = model_of(flown[0]).with_effects(
        RotorDrag(0.01), Wind(v_x=2.0), CommandDelay(delay_s=0.01, thrust_extra_s=0.02)
    )
    with jax.enable_x64(True):
        candidates = candidates_of_given(Problem.of(chunks, model))
    fields = {
        candidate.effect: {name.partition(".")[2] for name in candidate.fields}
        for candidate in candidates
    }
    assert fields == {
        "rotor_drag": {"h"},
        "wind": {"v_x", "v_y", "v_z"},
        "command_delay": {*CommandDelay._fields},
    }


def test_the_noise_of_residuals_is_found_again(chunks, disturbed):
    with jax.enable_x64(True):
        noise = jax.tree.map(np.asarray, noises.noise_of(noises.fit_noise(chunks, disturbed)))
    moving = slice(0, BATTERY)
    assert_allclose(noise.direct[moving], DIRECT[moving], rtol=0.08)
    assert_allclose(noise.level, LEVEL, rtol=0.15)
    assert_allclose(noise.disturbance[moving], DISTURBANCE[moving], rtol=0.3)
    assert_allclose(np.log(noise.tau[moving] / TAU_S), 0.0, atol=np.log(2.0))
    assert np.all(noise.coupling[moving] > 0.6)


def test_the_shortest_disturbance_does_not_stay_the_noise_of_a_sensor(chunks, disturbed):
    with jax.enable_x64(True):
        right = noises.fit_noise(chunks, disturbed)
        stuck = right.copy()
        stuck[[0, 3, 4]] = np.log([[1e-4], [300.0], [noises.TAU_RANGE_S[0]]])
        refitted = noises.fit_noise(chunks, disturbed, stuck)
        misfit = [noises.total_misfit(chunks, disturbed, noise) for noise in (right, refitted)]
    assert misfit[1] < misfit[0] + 1.0


def test_chunks_are_only_where_something_is_judged(flown):
    truth, log = flown
    judged = (log.time > 7.0) & (log.time < 19.0) | (log.time > 33.0)
    chunks = make_chunks(log, judged, np.array(truth.tau), truth.gravity)
    lead_in, scored = np.split(chunks.row, [LEAD_IN_S * RATE])
    rows = scored[scored >= 0]
    assert len(np.unique(rows)) == len(rows)
    source = make_record(log).source_row
    wanted = np.flatnonzero((source >= 0) & judged[source])
    assert np.isin(wanted, rows).all()
    counting = scored[chunks.counts[LEAD_IN_S * RATE :].any(axis=(2, 3))]
    assert np.isin(counting, wanted).all() and not chunks.counts[: LEAD_IN_S * RATE].any()
    assert scored.shape[1] == 6  # 12 s and 7 s, in stretches of five, and one that fills up
    assert (
        np.diff(lead_in[:, :5], axis=0) == 1
    ).all()  # flown for real, also where it is not judged


def test_many_models_on_few_chunks_are_as_each_alone_on_all(state):
    with jax.enable_x64(True):
        problem, few = state.problem, state.problem.thinned(3)
        vectors = np.repeat(problem.start[None], 39, axis=0)
        vectors[:, 0] *= np.linspace(0.5, 2.0, len(vectors))
        many = few.residuals(vectors)
        white, on_side = few.whiten(many), few.whiten(many[..., 3:6, :], slice(3, 6))
        kept = spread_chunks(problem.chunks, 3)
        assert 1 < len(kept) < problem.chunks.row.shape[1]
        for index in (0, 31, 38):
            alone = problem.residuals(vectors[index][None])
            assert_array_equal(many[index], alone[0][:, kept])
            alone = problem.whiten(alone)[0][:, kept]
            assert_allclose(white[index], alone, atol=1e-9)
            assert_allclose(on_side[index], alone[..., 3:6, :], atol=1e-9)


def evaluate(log, model):
    """Run every program that a search for effects in a log needs."""
    problem = Problem.of(cut_chunks(log, np.ones(len(log), bool), model), model)
    residuals = problem.residuals(np.repeat(problem.start[None], 3, axis=0))
    problem = problem.with_noise(noises.fit_noise(problem.chunks, residuals[0]))
    assert np.isfinite(problem.whiten(residuals)).all()


def test_logs_of_another_length_rate_and_channels_compile_nothing(flown):
    truth, log = flown
    model = model_of(truth)
    others = (
        replace(log.select(np.arange(len(log)) < 1500), time=0.8 * log.time[:1500]),
        log.without("f", "v", "v_bat"),
    )
    with jax.enable_x64(True):
        evaluate(log, model)
        with programs() as compiled:
            for other in others:
                evaluate(other, model)
    assert compiled == []


def test_a_fast_log_keeps_rows_at_a_usual_rate_and_the_means_of_its_commands(flown):
    log = replace(flown[1], time=0.2 * flown[1].time)  # 500 Hz
    segment = np.where(np.arange(len(log)) < 1001, 0, 1)
    slower, is_kept, (note,) = at_usual_rate(replace(log, segment=segment))
    assert note.startswith("of 500 rows a second, one in 2 was used")
    assert_array_equal(np.flatnonzero(is_kept)[499:503], [998, 1000, 1001, 1003])
    assert_array_equal(slower["w"], log["w"][is_kept])
    assert_allclose(slower["u"][:500], 0.5 * (log["u"][:1000:2] + log["u"][1:1001:2]))
    assert_array_equal(slower["u"][500], log["u"][1000])
    as_it_was, is_kept, notes = at_usual_rate(flown[1])
    assert as_it_was is flown[1] and is_kept.all() and notes == []


def test_without_measured_voltages_the_drain_stays_nominal_also_where_effects_change(flown):
    truth, log = flown
    for without, is_free in ((log, True), (log.without("v_bat"), False)):
        chunks = cut_chunks(without, np.ones(len(log), bool), model_of(truth))
        state = windowed(SearchState(Problem.of(chunks, model_of(truth))), ())
        names = [state.problem.names[index] for index in state.base_indices]
        assert (DRAIN in names) is is_free and "tau_roll" in names


@pytest.mark.parametrize(
    ("window", "best", "left"),
    [
        (Window("wind", start=300), 400, [Window("wind", start=400)]),
        (Window("wind", start=300), 0, []),
        (Window("wind", 100, 300), 10**6, [Window("wind", 100, NEVER)]),
        (Window("wind", 300, 500), -4, [Window("wind", ALWAYS, 500)]),
    ],
)
def test_what_changes_outside_of_the_log_does_not_change(state, monkeypatch, window, best, left):
    profile = Profile(np.array([best]), np.zeros(1))
    monkeypatch.setattr(onset, "profile_change", lambda *_: profile)
    moved = at_best_row(windowed(state, (window,)), None, SimpleNamespace(vector=None), 300)
    assert [*moved.problem.windows] == left


def test_the_first_look_ranks_what_is_hidden_and_says_what_it_did_not_check(tmp_path, capsys):
    _, log = scripted(5, 20.0, effects={"linear_drag": {"d_x": 0.3, "d_y": 0.4, "d_z": 0.1}})
    save_log(tmp_path / "log.npz", log)
    run("diagnose", tmp_path / "log.npz", "--motion", "handout", "--quick")
    text = capsys.readouterr().out
    base, first = text.index("The base refitted: tau_roll = "), text.index("  linear_drag: ")
    assert base < first < text.index("Not checked: ")
    assert first == text.index("  ") and [*tmp_path.iterdir()] == [tmp_path / "log.npz"]


def test_a_log_without_turns_is_refused(flown):
    log = replace(flown[1].without("w", "q"), source="flight.csv")
    with pytest.raises(
        DiagnosisError, match=r"flight\.csv: found channels .*v_bat.*expected w \(gyro\) or q"
    ):
        diagnose(log)


@pytest.mark.parametrize("held_out", [np.zeros((5, 1), bool), np.zeros(5)])
def test_held_out_rows_of_another_shape_are_refused(flown, held_out):
    log = flown[1].select(slice(0, 5))
    with pytest.raises(DiagnosisError, match=r"held_out: found .* expected bool of \(5,\)"):
        diagnose(log, held_out=held_out)


@pytest.mark.slow
def test_what_a_given_model_has_too_much_is_taken_out_again(flown):
    truth, log = flown
    model = model_of(truth)._replace(battery_drain_v_per_min=0.0)
    diagnosis = diagnose(log, model.with_effects(LinearDrag(0.2, 0.2, 0.2)))
    drag, drain = sorted(diagnosis.causes, key=lambda cause: cause.effect)[::-1]
    assert (drag.effect, drain.effect) == ("linear_drag", "battery_drain")
    for estimate in drag.parameters.values():
        assert estimate.value == pytest.approx(0.0, abs=0.02)
    assert drag.heldout_gain > 0.0 and drag.lambda_ > 100.0
    assert drain.parameters["battery_drain_v_per_min"].value == pytest.approx(truth.drain, rel=0.05)
    for estimate, tau in zip(
        diagnosis.half_response_s["extended"].values(), truth.tau, strict=True
    ):
        half = estimate.ci95[1] - estimate.time
        assert 0.0 < half < 0.05 * tau and abs(estimate.time - tau * np.log(2.0)) < 1.5 * half


def test_logs_are_joined_by_what_they_all_have_with_a_warning(flown):
    first = replace(flown[1].select(slice(0, 30)), source="folder/a.npz")
    segments = np.repeat([4, 7], 10)
    second = replace(flown[1].select(slice(30, 50)).without("f"), segment=segments, source="b.npz")
    assert unused_channels([first, second]) == ["channel f is not used: b.npz has none"]
    assert unused_channels([first, first]) == []
    both = joined([first, second])
    assert (
        sorted(both.channels) == sorted(set(first.channels) - {"f"})
        and both.source == "a.npz + b.npz"
    )
    assert_array_equal(both.segment, np.repeat([0, 1, 2], [30, 10, 10]))
    assert_array_equal(both["w"], np.concatenate([first["w"], second["w"]]))
    assert joined([first]) is first
    with pytest.raises(DiagnosisError, match="logs: found none"):
        joined([])


def test_a_cause_matters_if_another_value_is_wrong_without_it(state):
    problem = state.problem
    index = problem.names.index("gyro_scale.x")
    cause = make_cause("gyro_scale", x=Estimated(0.05, (0.04, 0.06), "1"))
    vector, near, far = (problem.start.copy() for _ in range(3))
    vector[index], near[index], far[index] = 0.05, 0.055, 0.07
    assert not is_bent(cause, problem, vector, near)
    assert is_bent(cause, problem, vector, far)
    # A factor that was found between two thrust curves is no parameter of the model.
    factor = make_cause("thrust_scale", factor=Estimated(0.8, (0.7, 0.9), "1"))
    assert not is_bent(factor, problem, problem.start, problem.start)


@pytest.mark.slow
def test_a_force_may_be_a_law_whose_channels_the_log_lacks():
    """Without velocity and attitude, drag of forward flight would look like a tilted thrust."""
    truth, log = scripted(4, 20.0, effects={"thrust_tilt": {"towards_x": 0.1, "towards_y": 0.0}})
    blind = diagnose(log.without("p", "v", "q"), model_of(truth))
    (cause,) = blind.causes
    assert cause.effect == "thrust_tilt" and {"linear_drag", "wind"} <= {*cause.equivalent}
    assert "tilt of the thrust axis (or " in describe_verdict(blind).text


@pytest.mark.slow
def test_a_sensor_farther_off_than_any_on_the_list_is_told_and_not_named():
    truth, log = scripted(6, 20.0)
    diagnosis = diagnose(with_channels(log, f=log["f"] + [2.5, 0.0, 0.0]), model_of(truth))
    (cause,) = diagnosis.beyond
    assert (
        diagnosis.causes == ()
        and diagnosis.verdict == "unexplained"
        and diagnosis.unexplained.depends_on == ()
    )
    assert cause.effect == "accelerometer_bias" and cause.beyond == "x at least 2 m/s^2"
    assert float(diagnosis.extended.effect("accelerometer_bias").x) == 0.0
    (warning,) = (warning for warning in diagnosis.warnings if "beyond the list" in warning)
    assert warning.endswith("and is not in the extended model")


@pytest.mark.parametrize(
    ("field", "value", "is_warned_of"),
    [
        ("rate_scale.yaw", 0.9, False),
        ("rate_scale.yaw", None, True),
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
    cause = make_cause(effect or name, **{name: Estimated(value, (value, value), "1")})
    (cause,) = with_refined_values([cause], refined(problem), vector)
    assert cause.beyond.startswith(f"{name} at most {value:g}" if is_warned_of else "")
    warnings = "".join(collect_warnings(problem, [cause], []))
    assert warnings.count("beyond the list") == bool(cause.beyond) == is_warned_of


def test_a_response_that_ends_at_the_top_of_its_range_has_no_upper_limit(state):
    """A yaw as slow as the search allows may be slower; a roll in the middle is determined."""
    state, _ = state.linearized(state.problem.start)
    problem, vector = state.problem, state.problem.start.copy()
    index = problem.names.index("tau_yaw")
    vector[index] = problem.high[index]
    model = FittedModel((), vector, 0.0, tuple(state.base_indices))
    linearization = Linearization(problem, problem.slopes(vector, state.all_indices))
    half_responses = summarize_half_responses(
        linearization, model, refined(problem), {"extended": vector}
    )
    roll, _, yaw, _ = half_responses["extended"].values()
    assert 0.0 < roll.ci95[1] - roll.time < 0.01
    assert yaw.time == pytest.approx(problem.high[index] * np.log(2.0), rel=1e-3)
    assert yaw.ci95[0] <= yaw.time and yaw.ci95[1] == np.inf


def test_a_value_that_no_flight_depends_on_is_not_told(state):
    """A yaw that is ahead of the others by more than their delay is in time, whatever the value."""
    (cause,) = delay_after_flights(
        state.problem,
        [1e-3, 1e-19],  # what solving leaves of a column of zeros
        ("delay_s", "yaw_extra_s"),
        delay_s=0.01,
        yaw_extra_s=0.0,
    )
    assert list(cause.parameters) == ["delay_s"]
    assert cause.parameters["delay_s"].ci95 == pytest.approx((0.009, 0.011))


def test_a_cause_lists_all_that_was_fitted_and_goes_where_flights_show_none_of_it(state):
    """A delay of nothing and of thrust alone is one of thrust; one of neither is no cause."""
    causes_of_nothing, (cause,) = (
        delay_after_flights(
            state.problem, [0.02, 0.02], ("delay_s",), delay_s=0.0, thrust_extra_s=extra_s
        )
        for extra_s in (0.0, 0.039)
    )
    assert causes_of_nothing == () and list(cause.parameters) == ["delay_s", "thrust_extra_s"]


@pytest.mark.parametrize(("effect", "is_law"), [("rate_scale", True), ("command_delay", False)])
def test_a_law_without_memory_has_to_hold_while_commands_rest(state, effect, is_law):
    """Rows at rest contradict a rate scale that the flight lacks, not a true one or a delay."""
    problem = state.problem
    vector = problem.start.copy()
    field, size = {"rate_scale": ("roll", 0.3), "command_delay": ("delay_s", 0.02)}[effect]
    vector[problem.names.index(f"{effect}.{field}")] += size
    for less, full, is_false in ((problem.start, vector, True), (vector, problem.start, False)):
        ablation = Ablation(1e4, 1.0, 1, {}, {}, SimpleNamespace(vector=less))
        selection = Selection(state, None, SimpleNamespace(vector=full), {effect: ablation})
        # With one law all others go, which would pass for the same dynamics.
        expected = vetoes.stick_laws(problem) if is_false and is_law else []
        assert sorted(vetoes.not_seen_at_rest(selection, None)) == sorted(expected)


def test_a_long_log_is_thinned_with_a_warning_that_counts_judged_rows(state, monkeypatch):
    """Unscored rows in the chunks must not make up for scored rows that are lost."""
    chunks = state.problem.chunks
    half = chunks.counts & (np.arange(len(chunks.row)) % 2 == 0)[:, None, None, None]
    every = chunks._replace(counts=half)
    assert thinned(every) is every and thinning_warning(every) == []
    monkeypatch.setattr("flytrack_sysid.inference.chunks.MAX_ROWS", 4 * CHUNK_S * 100 + 10)
    (warning,) = thinning_warning(every)
    kept, number = thinned(every).num_judged, every.num_judged
    assert kept < 0.8 * number and warning.startswith(
        f"only {kept} of {number} rows were learnt from"
    )
    in_chunks = int((thinned(every).row[100:] >= 0).sum())
    assert (
        in_chunks >= number
    )  # as many rows as are judged: counting those would have hidden the loss


@pytest.mark.parametrize(
    ("ratio", "lost", "acts_there", "expected"), table("diagnoses")["improvements"]
)
def test_what_is_learnt_has_to_improve_held_out_flights(ratio, lost, acts_there, expected):
    assert improves_flights(np.array(ratio), np.array(lost), acts_there) is expected


@pytest.mark.parametrize("row", table("diagnoses")["absorptions"])
def test_a_name_that_outweighs_the_rest_is_not_absorbed_by_it(row):
    *gains, expected = row
    assert vetoes.is_absorbed(*gains) is expected


def test_every_veto_has_a_reason_to_tell():
    rules = {veto.__name__ for veto in vetoes.VETOES}
    assert set(vetoes.REASONS) == rules - {vetoes.CONTRADICTED}


def test_nothing_is_learnt_beside_a_law_of_another_log(flown, chunks):
    term = Term("force", "air", (Factor("airspeed", "bump", (6.0, 1.0)),), (-0.1,), (0.0,))
    given = model_of(flown[0]).with_effects(LearnedLaw(1.0, 0.0, Law((term,))))
    problem = Problem.of(chunks, given)
    model = FittedModel((), problem.start, 0.0, ())
    unexplained = Unexplained(True, shares={"force: airspeed": 1.0})
    selection = Selection(SearchState(problem), model, model, {}, unexplained)
    named = SimpleNamespace(selection=selection)
    law, _ = learn_rest(named, model, refined(problem), problem)
    assert law is None
    (note,) = given_law_notes(problem, unexplained)
    assert "learned_law from another log" in note
