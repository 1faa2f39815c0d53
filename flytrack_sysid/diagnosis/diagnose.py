"""Diagnose a model from a log: causes, their certainty, and what correcting them gains."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.effects import takes_motors
from flytrack_env.motion import Motion
from flytrack_sysid.clocks import on_one_clock, with_causal_commands
from flytrack_sysid.diagnosis import craft, summary
from flytrack_sysid.diagnosis.beyond import Learned, with_and_without, with_learned
from flytrack_sysid.diagnosis.by_flight import notes_on_flights, with_flights
from flytrack_sysid.diagnosis.controller import controller_notes, examine_controller
from flytrack_sysid.diagnosis.families import with_families
from flytrack_sysid.diagnosis.first_look import FirstLook
from flytrack_sysid.diagnosis.late_poses import with_late_poses
from flytrack_sysid.diagnosis.learned import find_learned
from flytrack_sysid.diagnosis.motion_choice import (
    MotionEstimate,
    build_problem,
    choose_simulator_step,
    estimate_motion,
)
from flytrack_sysid.diagnosis.onset import (
    at_end,
    describe_changes,
    find_spans,
    first_row_as_at_end,
    with_changes,
)
from flytrack_sysid.diagnosis.outliers import find_outliers, outlier_notes
from flytrack_sysid.diagnosis.refinement import Refined, reduced, refine, with_effects
from flytrack_sysid.diagnosis.result import CHANNELS, Cause, Diagnosis
from flytrack_sysid.diagnosis.size import split_by_size
from flytrack_sysid.diagnosis.unexplained import SIDES
from flytrack_sysid.diagnosis.vetoes import (
    CONTRADICTED,
    Selection,
    apply_vetoes,
    examined,
    held_out_under,
    reject,
    select,
)
from flytrack_sysid.inference.chunks import (
    Chunks,
    at_usual_rate,
    cut_chunks,
    measured_voltage_range,
    thinned,
)
from flytrack_sysid.inference.lateness import read_poses
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.score_test import Linearization
from flytrack_sysid.inference.search import (
    FittedModel,
    SearchState,
    extended,
    with_given_refitted,
    with_refitted_noise,
)
from flytrack_sysid.inference.torque import torque_notes
from flytrack_sysid.log import STATED_MASS, STATED_VOLTAGES, FlightLog, LogError
from flytrack_sysid.log_motion import (
    check_commands,
    check_same_origin,
    motion_notes,
    required_motion,
)
from flytrack_sysid.log_voltage import battery_of_craft, voltage_notes, with_voltage
from flytrack_sysid.split import HELD_OUT_EVERY, held_out_rows

STAGES = ("first look", "search", "vetoes", "refinement", "summary")
Report = Callable[[int, int], None]
Logs = FlightLog | Sequence[FlightLog]


class DiagnosisError(ValueError):
    """A log that cannot be diagnosed; the message says file, channel, found and expected."""


class Split(NamedTuple):
    """A log, split into rows to learn from and held-out rows.

    Attributes:
        logged: the log as it was; it may have more rows.
        logged_held_out: its held-out rows, bool.
        motion_estimate: the motion, and how late poses were.
        log: with all channels on one clock.
        held_out: rows of ``log``, (num_rows,) bool.
        train: the problem to learn from.
        test: the problem of the held-out rows.
        as_logged: the chunks of both problems with poses as logged; empty if these were in time.
        warnings: for the reader.
    """

    logged: FlightLog
    logged_held_out: np.ndarray
    motion_estimate: MotionEstimate
    log: FlightLog
    held_out: np.ndarray
    train: Problem
    test: Problem
    as_logged: tuple[Chunks, ...]
    warnings: tuple[str, ...]


def diagnose(
    log: Logs,
    model: ModelParameters | None = None,
    held_out: np.ndarray | None = None,
    report: Report = lambda done, stages: None,
    motion: Motion | None = None,
    show: Callable[[FirstLook], None] = lambda look: None,
) -> Diagnosis:
    """Diagnose a model from a log: causes, what is unexplained or not identifiable, errors.

    Args:
        log: one or several, taken together.
        model: the simulator's nominal one if None; causes are differences from it.
        held_out: rows for testing and not for learning, (num_rows,) bool; the last of every four
            blocks of at most 5 s if None.
        report: called with stages done and to do.
        motion: the motion of the log within a step, whatever the model says; if None, continuous
            if the log is measured, else chosen by the sensors or by likelihood.
        show: called with the first look, before the search.

    Raises:
        DiagnosisError: a log with neither gyro nor attitude; ``held_out`` of another shape.
    """
    # Matrices are small: BLAS threads wait for each other longer than they compute.
    with threadpool_limits(1, "blas"), jax.enable_x64(True):
        parts = split(log, model, held_out, motion)
        report(1, len(STAGES))
        state, base = begun(parts)
        show(FirstLook.of(state, base))
        selection = select(*extended(*with_given_refitted(state, base)))
        # Timestamps identify continuous motion and late poses; the two discrete integrators differ
        # only in their residuals. A measured log is continuous, and never gets here.
        motion_estimate = parts.motion_estimate
        if not (
            motion_estimate.is_sure
            or motion_estimate.late_s
            or motion_estimate.motion is Motion.CONTINUOUS
        ):
            likelier = choose_simulator_step(selection.state.problem, selection.model.vector)
            if likelier is not parts.motion_estimate.motion:
                parts = split(log, model, held_out, likelier)
                state, base = begun(parts)
                selection = select(*extended(*with_given_refitted(state, base)))
        report(2, len(STAGES))
        selection = with_changes(selection, parts.test, parts.log)
        test = held_out_under(selection, parts.test)
        selection, rejected = apply_vetoes(selection, test)
        report(3, len(STAGES))
        vetted = refined_within_range(selection, rejected, test, parts)
        report(4, len(STAGES))
        diagnosis = summarize(vetted, parts._replace(test=test))
        nominal = nominal_parameters() if model is None else model
        diagnosis = replace(diagnosis, nominal=nominal._replace(motion=diagnosis.extended.motion))
        diagnosis = with_late_poses(
            diagnosis, parts.motion_estimate, (selection.state.problem, test), parts.as_logged
        )
        report(5, len(STAGES))
    return diagnosis


def first_look(
    log: Logs,
    model: ModelParameters | None = None,
    held_out: np.ndarray | None = None,
    motion: Motion | None = None,
) -> FirstLook:
    """Return only the first look of ``diagnose``; arguments and errors are the same."""
    with threadpool_limits(1, "blas"), jax.enable_x64(True):
        return FirstLook.of(*begun(split(log, model, held_out, motion)))


def begun(parts: Split) -> tuple[SearchState, FittedModel]:
    """Return the state before the search, with the noise of the training rows, and the base."""
    state = SearchState.start(parts.log, parts.train)
    return with_refitted_noise(state, state.fitted((), state.problem.start))


def split(
    log: Logs,
    model: ModelParameters | None,
    held_out: np.ndarray | None,
    motion: Motion | None,
) -> Split:
    """Return a log, or several joined, split into rows to learn from and held-out rows.

    Raises:
        DiagnosisError: as ``diagnose``.
    """
    warnings = [] if isinstance(log, FlightLog) else unused_channels(log)
    log = log if isinstance(log, FlightLog) else joined(log)
    check_is_usable(log)
    mask = held_out_rows(log, HELD_OUT_EVERY) if held_out is None else np.asarray(held_out)
    if mask.shape != (len(log),) or mask.dtype != bool:
        raise DiagnosisError(
            f"held_out: found {mask.dtype} of shape {mask.shape}, expected bool of ({len(log)},)"
        )
    logged, logged_held_out = log, mask
    log, is_kept, notes = on_one_clock(log.without("sticks"))  # nothing below reads them
    warnings, mask = [*warnings, *notes], mask[is_kept]
    warnings += motion_notes(log, model, motion, "chosen by likelihood")
    motion = required_motion(log, motion)
    model = nominal_parameters() if model is None else model
    check_commands(log, model)
    warnings += torque_notes(log, model) + voltage_notes(log, model.battery)
    warnings += controller_notes(logged, logged_held_out)
    log = with_voltage(log, model)
    model = model._replace(battery=battery_of_craft(log, model.battery))
    reductions: list[Callable[[FlightLog], tuple[FlightLog, np.ndarray, list[str]]]] = [
        partial(with_causal_commands, model=model)
    ]
    if motion is Motion.CONTINUOUS:  # two steps of a simulator are not one step twice as long
        reductions.append(at_usual_rate)
    for reduce in reductions:
        log, is_kept, notes = reduce(log)
        warnings, mask = [*warnings, *notes], mask[is_kept]
    motion_estimate = estimate_motion(log, model, ~mask, motion)
    model = model._replace(motion=motion_estimate.motion)
    corrected, is_known = read_poses(log, motion_estimate.late_s)
    corrected, mask = corrected.select(is_known), mask[is_known]
    train_chunks, test_chunks = (cut_chunks(corrected, rows, model) for rows in (~mask, mask))
    warnings += thinning_warning(train_chunks)
    same_rows = log.select(is_known)
    as_logged = tuple(
        thinned(cut_chunks(same_rows, rows, model))
        for rows in (~mask, mask)
        if motion_estimate.late_s
    )
    train, test = (
        build_problem(thinned(chunks), corrected, log, model, motion_estimate.late_s)
        for chunks in (train_chunks, test_chunks)
    )
    return Split(
        logged,
        logged_held_out,
        motion_estimate,
        corrected,
        mask,
        train,
        test,
        as_logged,
        tuple(warnings),
    )


class VettedModel(NamedTuple):
    """A selection after its vetoes and its refinement.

    Attributes:
        selection: without the rejected and the refused effects.
        rejected: the veto's name of each rejected effect.
        refused: effects removed because they fit best at the end of the search range.
        refined: the refinement by free flight.
    """

    selection: Selection
    rejected: Mapping[str, str]
    refused: tuple[Cause, ...]
    refined: Refined


def refined_within_range(
    selection: Selection, rejected: Mapping[str, str], test: Problem, parts: Split
) -> VettedModel:
    """Return a selection and its refinement, without effects that end at a search bound.

    A law that fits best beyond the known range stands in for another one, and biases the values of
    the other effects.
    """
    refused: tuple[Cause, ...] = ()
    while True:
        tried, refined = judged_by_flights(selection, rejected, parts)
        at_bound = summary.causes_at_end(tried, refined, test)
        if not at_bound:
            kept = {candidate.effect for candidate in refined.kept}
            rejected = {name: veto for name, veto in rejected.items() if name not in kept}
            removed = tuple(name for name in refined.removed if name not in rejected)
            return VettedModel(tried, rejected, refused, refined._replace(removed=removed))
        stuck = [cause.effect for cause in at_bound]
        selection, further = apply_vetoes(reject(tried, stuck), test)
        rejected = {name: veto for name, veto in rejected.items() if name not in stuck} | further
        refused = (*refused, *at_bound)


def judged_by_flights(
    selection: Selection, rejected: Mapping[str, str], parts: Split
) -> tuple[Selection, Refined]:
    """Return a selection with the effects that flights may bring back, and its refinement.

    Beside something unexplained, the noise of single steps is no measure of a gain. So flights
    judge effects again that held-out single steps contradict, if commands predict any of them.
    """
    doubted = [name for name in contradicted(rejected) if name not in selection.model.effects]
    if doubted and selection.unexplained.flagged:
        tried = with_effects(selection, doubted)
        refined = refined_by_prediction(tried, parts, doubted)
        kept = {candidate.effect for candidate in refined.kept}
        if refined.fit is not None:
            return examined(tried) if kept & {*doubted} else tried, refined
    return selection, refined_by_prediction(selection, parts)


def contradicted(rejected: Mapping[str, str]) -> list[str]:
    """Return the effects that held-out single steps contradict."""
    return [name for name, veto in rejected.items() if veto == CONTRADICTED]


def refined_by_prediction(
    selection: Selection, parts: Split, doubted: Sequence[str] = ()
) -> Refined:
    """Return which effects of a selected model predict held-out flights better than its base does.

    Flights are from the last part of the log, in which the same effects act as at its end. Effects
    that ended before are kept.
    """
    model, last_model = selection.model, at_end(selection, selection.model)
    since = np.arange(len(parts.log)) >= first_row_as_at_end(selection, parts.test)
    log = parts.log.select(since)
    refined = refine(
        selection.state,
        selection.base,
        last_model,
        log,
        parts.held_out[since],
        [name for name in settled_effects(selection) if name not in doubted],
        doubted,
    )
    kept = {candidate.effect: candidate for candidate in refined.kept}
    kept |= {one.effect: one for one in model.candidates if one not in last_model.candidates}
    in_order = [kept[name] for one in model.candidates if (name := one.effect) in kept]
    return refined._replace(kept=tuple(in_order))


def settled_effects(selection: Selection) -> list[str]:
    """Return the effects that act where a model leaves nothing unexplained.

    What disturbs the rates makes the errors of all flights larger, and may hide in these what
    single steps show of a force.
    """
    problem, model = selection.state.problem, selection.model
    disturbed = {name.partition(":")[0] for name in selection.unexplained.shares}
    explained = {
        channel
        for side, channels in zip(SIDES, CHANNELS, strict=False)
        if side not in disturbed
        for channel in channels
    }
    return [
        effect
        for effect, ablation in selection.ablations.items()
        if not disturbed
        or summary.find_channel(problem, ablation.without.vector, model.vector) in explained
    ]


class NamedModel(NamedTuple):
    """A refined model and its causes.

    Attributes:
        selection: reduced to the effects that the refinement kept.
        linearization: of its model.
        extended: the model with refined values and all effects of the log.
        found: causes that matter, including those at a search bound.
        negligible: as in ``Diagnosis``.
        lost: causes that held-out rows contradict.
        neutral: causes whose refined intervals hold the nominal values.
    """

    selection: Selection
    linearization: Linearization
    extended: FittedModel
    found: tuple[Cause, ...]
    negligible: tuple[Cause, ...]
    lost: tuple[str, ...]
    neutral: tuple[str, ...]


def name_causes(vetted: VettedModel, parts: Split) -> NamedModel:
    """Return the causes of a refined model, in float64."""
    test, refined = parts.test, vetted.refined
    selection = reduced(vetted.selection, refined)
    model = selection.model
    # Intervals need the slopes of the model itself: with those of a nearby model, intervals of
    # ground_effect were a third too short.
    state, linearization = selection.state.linearized(model.vector)
    linearization = linearization.refreshed(model.indices)
    selection = selection._replace(state=replace(state, linearization=linearization))
    effects = summary.effect_causes(selection, test, linearization)
    in_base, lost_in_base = summary.base_causes(selection, test, linearization, effects)
    fit = refined.fit
    extended = model if fit is None else model._replace(vector=fit.vector)
    before = [*effects, *in_base]
    causes = summary.with_refined_values(before, refined, extended.vector)
    names = {cause.effect for cause in causes}
    neutral = tuple(cause.effect for cause in before if cause.effect not in names)
    spans = find_spans(selection, test, parts.log)
    causes = tuple(replace(named, **spans.get(named.effect, {})) for named in causes)
    causes = with_flights(causes, linearization, model, parts.log)

    def without(cause: Cause) -> np.ndarray:
        if fit is None:
            return summary.vector_without(cause, selection, linearization)
        return refined.vector_without(cause.effect, fit)

    causes, negligible = split_by_size(
        causes, state.problem, extended.vector, refined.flight_errors, without
    )
    return NamedModel(
        selection=selection,
        linearization=linearization,
        extended=extended,
        found=causes,
        negligible=negligible,
        lost=(*contradicted(vetted.rejected), *lost_in_base),
        neutral=neutral,
    )


def learn_rest(
    named: NamedModel, extended: FittedModel, refined: Refined, test: Problem
) -> tuple[Learned | None, np.ndarray]:
    """Return the law of what is left unexplained, if one is found, and the vector with it.

    No law is searched for beside an effect that acts for a part of the log, nor beside a law that
    the given model has.
    """
    selection, problem = named.selection, named.selection.state.problem
    changing = [one.effect for one in problem.windows]
    if (
        not selection.unexplained.shares
        or not extended.effects.isdisjoint(changing)
        or problem.has_given_law
    ):
        return None, extended.vector
    always, always_held = (replace(one, windows=()) for one in (problem, test))
    return find_learned(always, always_held, extended, selection.base.vector, refined.flight_test)


def summarize(vetted: VettedModel, parts: Split) -> Diagnosis:
    """Return the diagnosis of a refined model; it and its nominal model are in float64."""
    test, refined = parts.test, vetted.refined
    named = name_causes(vetted, parts)
    selection, linearization = named.selection, named.linearization
    problem, unexplained = selection.state.problem, selection.unexplained
    has_motors = takes_motors(problem.like.effects)
    causes = with_families((one for one in named.found if not one.beyond), unexplained, has_motors)
    beyond = (*vetted.refused, *(one for one in named.found if one.beyond))
    outliers = find_outliers((problem, test), named.extended.vector)
    vectors = {
        "nominal": problem.start,
        "refitted_base": selection.base.vector,
        "extended": named.extended.vector,
    }
    extended = at_end(selection, named.extended)
    flying = {**vectors, "extended": extended.vector}
    learned, vector = learn_rest(named, extended, refined, test)
    if learned is not None:
        change = vector - extended.vector
        vectors, flying = (with_and_without(learned, one, change) for one in (vectors, flying))
        extended = extended._replace(vector=vector)
        test, refined = test.with_law(learned.effect), refined.with_law(learned.effect)
    prediction = summary.summarize_prediction(refined, flying)
    all_unexplained = summary.with_lost_causes(unexplained, named.lost)
    all_unexplained = replace(all_unexplained, flagged=all_unexplained.flagged or bool(beyond))
    return Diagnosis(
        verdict=summary.classify(causes, all_unexplained),
        causes=causes,
        negligible=named.negligible,
        beyond=beyond,
        unsettled=summary.unsettled(selection, vetted.rejected, (*named.neutral, *refined.removed)),
        unexplained=all_unexplained,
        not_identifiable=summary.not_identifiable(
            selection.state,
            linearization,
            selection.model,
            (*named.found, *named.negligible),
        ),
        error=summary.errors_of(test, vectors, prediction),
        nominal=problem.like,
        base=summary.model_of(problem, selection.base),
        extended=with_learned(summary.model_of(problem, extended), learned),
        noise=summary.sensor_noise(problem),
        voltages=measured_voltage_range(problem.chunks),
        source=Path(parts.logged.source).name,
        sha256=parts.logged.sha256,
        warnings=(
            *parts.warnings,
            *outlier_notes(outliers),
            *notes_on(named, vetted, parts, flying),
        ),
        prediction=prediction,
        controller=examine_controller(parts.logged, problem.like, parts.logged_held_out),
        changed=summary.changed_parameters(linearization, extended, vetted.refined),
        half_response_s={}
        if parts.log.has_motors
        else craft.summarize_half_responses(linearization, selection.model, refined, flying),
        lift=craft.summarize_lift(linearization, selection.model, refined, flying),
        outliers=outliers,
        learned=learned,
        joint=summary.estimate_joint(linearization, named.extended, refined),
    )


def notes_on(
    named: NamedModel, vetted: VettedModel, parts: Split, flying: Mapping[str, np.ndarray]
) -> list[str]:
    """Return what a reader has to know about the causes and about what else was found."""
    selection = named.selection
    problem = selection.state.problem
    return [
        *summary.collect_warnings(problem, (*vetted.refused, *named.found), named.lost),
        *summary.neutral_notes(named.neutral),
        *summary.refinement_notes(vetted.refined, selection.model),
        *summary.stand_in_notes(selection, flying["extended"]),
        *summary.given_law_notes(problem, selection.unexplained),
        *summary.veto_notes(vetted.rejected),
        *notes_on_flights(named.found),
        *describe_changes(selection, named.linearization, parts.log),
    ]


def check_is_usable(log: FlightLog) -> None:
    """Raise DiagnosisError for a log without rows, or with neither gyro nor attitude."""
    if not len(log):
        raise DiagnosisError(f"{log.source}: found 0 rows, expected some seconds of flight")
    if "w" not in log and "q" not in log:
        channels = ", ".join(log.channels)
        raise DiagnosisError(
            f"{log.source}: found channels {channels}, expected w (gyro) or q (attitude) at least"
        )


def joined(logs: Sequence[FlightLog]) -> FlightLog:
    """Return logs as one, with the channels that all of them have.

    Raises:
        DiagnosisError: no log.
        LogError: measured logs beside others, or packs of different stated voltages, or craft of
            different stated masses.
    """
    if not logs:
        raise DiagnosisError("logs: found none, expected at least one")
    if len(logs) == 1:
        return logs[0]
    check_same_origin(*logs)

    def listed(values: Iterable[object]) -> str:
        pairs = zip(logs, values, strict=True)
        return ", ".join(f"{Path(log.source).name}: {value}" for log, value in pairs)

    kinds = ["motors" if log.has_motors else "sticks" for log in logs]
    if len(set(kinds)) > 1:
        raise LogError(f"u: found commands of {listed(kinds)}; expected one kind in one command")
    voltages = [log.stated_voltage_v for log in logs]
    if len(set(voltages)) > 1:
        raise LogError(
            f"{', '.join(STATED_VOLTAGES)}: found {listed(voltages)}; expected logs of one pack in "
            "one command"
        )
    stated_kg = [log.stated_mass_kg for log in logs]
    masses = set(stated_kg) - {None}
    if len(masses) > 1:
        raise LogError(
            f"{STATED_MASS}: found {listed(stated_kg)}; expected logs of one craft in one command"
        )
    names = set.intersection(*(set(log.channels) for log in logs))
    first = np.cumsum([0, *(len(np.unique(log.segment)) for log in logs)])
    segments = [
        np.cumsum(log.is_start()) - 1 + start for log, start in zip(logs, first, strict=False)
    ]
    channels = {name: np.concatenate([log[name] for log in logs]) for name in sorted(names)}
    return FlightLog(
        time=np.concatenate([log.time for log in logs]),
        channels=channels,
        segment=np.concatenate(segments),
        source=" + ".join(Path(log.source).name for log in logs),
        origin=logs[0].origin,
        has_motors=logs[0].has_motors,
        stated_voltage_v=logs[0].stated_voltage_v,
        stated_mass_kg=next(iter(masses), None),
    )


def unused_channels(logs: Sequence[FlightLog]) -> list[str]:
    """Return a warning for each channel that some logs have and others lack."""
    all_names = sorted({name for log in logs for name in log.channels})
    lacking = {
        name: [Path(log.source).name for log in logs if name not in log.channels]
        for name in all_names
    }
    return [
        f"channel {name} is not used: {', '.join(files)} has none"
        for name, files in lacking.items()
        if files
    ]


def thinning_warning(chunks: Chunks) -> list[str]:
    """Return a warning if a log is so long that only some of its chunks are learnt from."""
    kept = thinned(chunks)
    if kept.num_judged == chunks.num_judged:
        return []
    return [
        f"only {kept.num_judged} of {chunks.num_judged} rows were learnt from, spread evenly: "
        "more would need too much memory"
    ]
