"""A log and a model in, a diagnosis out: what is wrong, why, how sure, and what it gains."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.effects import BY_NAME, effect_of
from flytrack_sysid.diagnosis.causes import (
    base_causes,
    effect_causes,
    held_out_gain,
    is_contradicted,
    sensor_noise,
)
from flytrack_sysid.diagnosis.cautions import cautions
from flytrack_sysid.diagnosis.doubt import unfounded
from flytrack_sysid.diagnosis.errors import errors_of
from flytrack_sysid.diagnosis.lanes import make_lanes, thinned, voltages_of
from flytrack_sysid.diagnosis.limits import unseen
from flytrack_sysid.diagnosis.linear import Outlook
from flytrack_sysid.diagnosis.pipeline import Settled, reviewed, settled, taken_back
from flytrack_sysid.diagnosis.plan import advise
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.result import (
    CAUSES_FOUND,
    CONSISTENT,
    TO_LOG,
    UNEXPLAINED,
    Cause,
    Diagnosis,
    NotIdentifiable,
    Unexplained,
)
from flytrack_sysid.diagnosis.search import Found, full_outlook
from flytrack_sysid.diagnosis.weigh import Weighed
from flytrack_sysid.log import FlightLog
from flytrack_sysid.parameters import as_float32, from_vector
from flytrack_sysid.split import HELD_OUT_EVERY, held_out_rows

STAGES = ("search", "held-out rows", "what the log cannot show", "errors")


class DiagnosisError(ValueError):
    """A log that cannot be diagnosed; the message names the file and channel, found and expected."""


def check_log(log: FlightLog) -> None:
    """Raise DiagnosisError for a log without rows, or that says nothing of how the drone turns."""
    if not len(log):
        raise DiagnosisError(f"{log.source}: found 0 rows, expected some seconds of flight")
    if "w" not in log and "q" not in log:
        found = ", ".join(log.channels)
        raise DiagnosisError(
            f"{log.source}: found channels {found}, expected w (gyro) or q (attitude) at least"
        )


def joined(logs: Sequence[FlightLog]) -> FlightLog:
    """Return logs as one, with the channels that all of them have.

    Raises:
        DiagnosisError: no log.
    """
    if not logs:
        raise DiagnosisError("logs: found none, expected at least one")
    if len(logs) == 1:
        return logs[0]
    names = set.intersection(*(set(log.channels) for log in logs))
    first = np.cumsum([0, *(len(np.unique(log.segment)) for log in logs)])
    segments = [np.cumsum(log.is_start()) - 1 + start for log, start in zip(logs, first, strict=False)]
    channels = {name: np.concatenate([log[name] for log in logs]) for name in sorted(names)}
    return FlightLog(
        time=np.concatenate([log.time for log in logs]),
        channels=channels,
        segment=np.concatenate(segments),
        source=" + ".join(Path(log.source).name for log in logs),
    )


def diagnose(
    log: FlightLog | Sequence[FlightLog],
    model: ModelParameters | None = None,
    held_out: np.ndarray | None = None,
    report: Callable[[int, int], None] = lambda done, stages: None,
) -> Diagnosis:
    """Return what a log says of a model: causes, what is unexplained, what it could not show, errors.

    log: one or several, taken together. model: the simulator's nominal one if None; what differs from it is
    named. held_out: (num_rows,) bool, rows to judge by, not to learn from; the last of every four blocks of
    at most 5 s if None. report: called with stages done and to do.

    Raises:
        DiagnosisError: a log that says nothing of how the drone turns; ``held_out`` of another shape.
    """
    started = time.monotonic()
    unused = [] if isinstance(log, FlightLog) else left_out(log)
    log = log if isinstance(log, FlightLog) else joined(log)
    check_log(log)
    out = held_out_rows(log, HELD_OUT_EVERY) if held_out is None else np.asarray(held_out)
    if out.shape != (len(log),) or out.dtype != bool:
        raise DiagnosisError(
            f"held_out: found {out.dtype} of shape {out.shape}, expected bool of ({len(log)},)"
        )
    model = nominal_parameters() if model is None else model
    with jax.enable_x64(True):
        found = _found(log, out, model, report)
    return replace(found, seconds=time.monotonic() - started, warnings=(*unused, *found.warnings))


def left_out(logs: Sequence[FlightLog]) -> list[str]:
    """Return a warning for each channel that some logs have and others lack."""
    every = sorted({name for log in logs for name in log.channels})
    lacking = {name: [Path(log.source).name for log in logs if name not in log.channels] for name in every}
    return [
        f"channel {name} is not used: {', '.join(files)} has none" for name, files in lacking.items() if files
    ]


def _found(
    log: FlightLog, out: np.ndarray, model: ModelParameters, report: Callable[[int, int], None]
) -> Diagnosis:
    """Return the diagnosis, in float64."""
    result = settled(log, ~out, model)
    report(1, len(STAGES))
    problem = result.problem
    judge = Problem(thinned(make_lanes(log, out, np.asarray(model.tau, float), float(model.g))), model)
    judge.set_noise(problem.noise)
    result, lost = _held(result, judge)
    report(2, len(STAGES))
    outlook = full_outlook(problem, result.found.vector)
    effects = effect_causes(problem, judge, outlook, result.found, result.weighed)
    of_base, lost_of_base = base_causes(problem, judge, outlook, result.found, result.doubtful, effects)
    causes = [*effects, *of_base]
    lost += lost_of_base
    limits = _limits(problem, outlook, result.found, causes)
    report(3, len(STAGES))
    vectors = {"nominal": problem.start, "refitted_base": result.base.vector, "extended": result.found.vector}
    errors = errors_of(judge, vectors, log, out)
    report(4, len(STAGES))
    rest = _with_lost(result.rest, lost)
    return Diagnosis(
        verdict=_verdict(causes, rest),
        causes=tuple(causes),
        unexplained=rest,
        not_identifiable=tuple(limits),
        error=errors,
        nominal=model,
        base=_model(problem, result.base),
        extended=_model(problem, result.found),
        noise=sensor_noise(problem),
        voltages=voltages_of(problem.lanes),
        source=Path(log.source).name,
        sha256=log.sha256,
        seconds=0.0,
        warnings=cautions(problem, result.found, causes, errors, lost, learnt=int((~out).sum())),
    )


def _held(result: Settled, judge: Problem) -> tuple[Settled, list[str]]:
    """Return the result without effects that held-out rows contradict, and their names.

    Those that the log says too little of are taken back without a word: nothing came and went.
    """
    lost: list[str] = []
    while True:
        now = [
            effect
            for effect, weight in result.weighed.items()
            if _is_contradicted(judge, weight, result.found)
        ]
        lost += now
        now = now or unfounded(result, judge)
        if not now:
            return result, lost
        result = reviewed(result.problem, result.base, *taken_back(result.problem, result.found, now))


def _is_contradicted(judge: Problem, weight: Weighed, found: Found) -> bool:
    gain, expected = held_out_gain(judge, weight.less.vector, found.vector)
    return is_contradicted(gain, expected, weight.inflation)


def _with_lost(rest: Unexplained, lost: Sequence[str]) -> Unexplained:
    """Return what is unexplained, with the time among what it depends on where a cause came and went."""
    if not lost or "time" in rest.depends_on:
        return rest
    return replace(rest, flagged=True, depends_on=(*rest.depends_on, "time"))


def _limits(
    problem: Problem, outlook: Outlook, found: Found, causes: Sequence[Cause]
) -> list[NotIdentifiable]:
    """Return what the log could not have shown, and causes it cannot tell from others, with what to fly."""
    limits = unseen(outlook, found)
    twins: dict[str, tuple[str, ...]] = {}
    for cause in causes:
        if cause.effect in BY_NAME and cause.equivalent and cause.effect != "thrust_scale":
            twins[cause.effect] = cause.equivalent
            twins |= {name: (cause.effect,) for name in cause.equivalent}
    wanted = {name: alike for name, (_, _, alike) in limits.items()} | twins
    flights = {name: TO_LOG + " and ".join(BY_NAME[name].needs) for name in problem.barred}
    asked = {name: alike for name, alike in wanted.items() if name not in problem.barred}
    if asked:
        flights |= advise(problem, found, outlook, asked)
    result = []
    for name, alike in wanted.items():
        field = next(iter(BY_NAME[name].notable))
        # Of a twin of what was found there is no such size: none is its own.
        smallest, unit = limits[name][:2] if name in limits else (np.inf, BY_NAME[name].ranges[field].unit)
        result.append(NotIdentifiable(name, smallest, unit, tuple(alike), flights[name]))
    return result


def _verdict(causes: Sequence[Cause], rest: Unexplained) -> str:
    if causes and rest.flagged:
        return f"{CAUSES_FOUND}+{UNEXPLAINED}"
    if causes:
        return CAUSES_FOUND
    return UNEXPLAINED if rest.flagged else CONSISTENT


def _model(problem: Problem, found: Found) -> ModelParameters:
    """Return a model in float32, with the effects that it has and those the nominal one had."""
    model = as_float32(from_vector(found.vector, problem.like))
    kept = {one.effect for one in found.chosen} | set(problem.given_effects)
    effects = tuple(one for one in model.effects if effect_of(one).name in kept)
    return model._replace(effects=effects)
