"""Before and after: of all that a model lacks, only what has changed since an earlier log is named.

No model of a real drone is complete. What it lacks is in the log before and in the log after alike,
and laws that stand in for it are found in both. So each law is fitted to either log, beside the
same others, and names a change where the estimates differ by more than both are uncertain, and by a
size that matters. Uncertainty is judged from how much seconds of a log disagree, which counts what
the model lacks.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from scipy import signal

from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.effects import BY_NAME, acts
from flytrack_env.motion import Motion
from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis import search
from flytrack_sysid.diagnosis.diagnose import (
    Split,
    held_out_under,
    refined_within_range,
    split,
    summarize,
)
from flytrack_sysid.diagnosis.model_selection import EQUIVALENT, Marginal, ablate_all
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.result import DRIFT, Cause, Diagnosis, Estimated, Unexplained
from flytrack_sysid.diagnosis.score_test import (
    BASE_CAUSES,
    Candidate,
    Linearization,
    candidates_for,
    solve,
    threshold,
)
from flytrack_sysid.diagnosis.size import is_notable
from flytrack_sysid.diagnosis.summary import effect_causes, mean_factor, mean_thrust, verdict_of
from flytrack_sysid.diagnosis.unexplained import find_unexplained
from flytrack_sysid.diagnosis.vetoes import Selection
from flytrack_sysid.log import FlightLog
from flytrack_sysid.log_motion import check_same_origin
from flytrack_sysid.parameters import THRUST_COEFFS

MAX_EFFECTS = 4
# Sticks that are farther from where they were lately, in sum; the time constant of lately, and for
# how long what follows does not count.
JUMP, JUMP_S, AFTERMATH_S = 0.5, 0.05, 0.2
WORSE = 1.5  # times what was left unexplained before: so much more is new
Logs = FlightLog | Sequence[FlightLog]


def _logs(logs: Logs) -> Sequence[FlightLog]:
    return [logs] if isinstance(logs, FlightLog) else logs


class Change(NamedTuple):
    """The change of parameters from the earlier log to the later one.

    half: half of the 95 % interval of each change. chi2: of all changes.
    """

    size: np.ndarray
    half: np.ndarray
    chi2: float


class Estimate(NamedTuple):
    """A model fitted to one log, by likelihood; base: the same without effects."""

    state: search.SearchState
    base: search.FittedModel
    model: search.FittedModel
    linearization: Linearization

    @classmethod
    def of(cls, parts: Split) -> "Estimate":
        """Return the refitted base, with the noise that it leaves."""
        problem = parts.train
        state = search.SearchState.start(parts.log, problem)
        base = state.fitted((), problem.start)
        state, linearization = state.linearized(base.vector)
        state = state.with_noise(
            noises.fit_noise(problem.chunks, search.saturated_residuals(linearization))
        )
        base = state.fitted((), base.vector)
        state, linearization = state.linearized(base.vector)
        return cls(state, base, base, linearization)

    def with_effect(self, candidate: Candidate) -> "Estimate":
        """Return the estimate with an effect more."""
        line, model = self.linearization, self.model
        gain = line.gain_of(candidate, line.columns_at(model.indices))
        if gain is None:
            fitted = self.state.fitted(model.joined_by(candidate), model.vector)
        else:
            fitted = search.add_effect(self.state, line, model, search.Scored(candidate, gain))
        state, linearization = self.state.linearized(fitted.vector)
        return Estimate(state, self.base, fitted, linearization)

    def step(self, columns: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return to first order the step along columns beside the model, and its covariance.

        The covariance is as much larger than the information's inverse as seconds disagree after
        the step.
        """
        gain = self.linearization.freed(
            list(columns), self.linearization.columns_at(self.model.indices)
        )
        return gain.step, gain.inflation * solve(gain.information, np.eye(len(columns)))


def diagnose_change(
    after: Logs,
    before: Logs,
    model: ModelParameters | None = None,
    held_out: np.ndarray | None = None,
    report: Callable[[int, int], None] = lambda done, stages: None,
    motion: Motion | None = None,
) -> Diagnosis:
    """Return the diagnosis of a log, in which causes are what changed since a log before.

    before: of the same craft, as the model knows it. The rest as in ``diagnose``. Values of causes
    are those of the model, changed as the estimates changed. What the model lacks in both logs is
    in the extended model's other parameters, and is no cause; unexplained is only what was not so
    before.

    Raises:
        DiagnosisError: as ``diagnose``, of either log.
        LogError: measured logs beside others.
    """
    check_same_origin(*_logs(after), *_logs(before))
    with jax.enable_x64(True):
        parts = calm(split(after, model, held_out, motion))
        model = nominal_parameters() if model is None else model
        later = Estimate.of(parts)
        earlier = Estimate.of(calm(split(before, model, None, parts.motion_estimate.motion)))
        alike: dict[str, tuple[str, ...]] = {}
        report(1, 3)
        while len(later.model.candidates) < MAX_EFFECTS:
            change = next_change(later, earlier)
            if change is None:
                break
            best, alike[change[0].candidate.effect] = change
            later, earlier = best.later, best.earlier
        report(2, 3)
        selection = selection_of(later, earlier)
        test = held_out_under(selection, parts.test)
        judged = refined_within_range(selection, {}, test, parts)
        found = summarize(judged, parts._replace(test=test))
        # A change is named by its steps and size; the extended model has it only if flights gain by
        # it.
        effects = effect_causes(selection, test, later.linearization)
        base = [one for one in found.causes if one.effect not in later.model.effects]
        named = [*effects, *base]
        causes = tuple(one for cause in named for one in changed_cause(cause, later, earlier))
        report(3, 3)
    drifts = {one.effect: one.equivalent for one in base if DRIFT in one.equivalent}
    causes = tuple(replace(one, equivalent=(drifts | alike).get(one.effect, ())) for one in causes)
    same = {one.effect for one in named} - {one.effect for one in causes}
    return replace(
        found,
        nominal=model._replace(motion=found.extended.motion),
        verdict=verdict_of(causes, found.unexplained),
        causes=causes,
        warnings=(
            *found.warnings,
            *(f"{name}: as in the log before, so no change" for name in sorted(same)),
        ),
    )


def calm(parts: Split) -> Split:
    """Return a split in which only rows count before which the sticks did not jump.

    Where they do, motors end, and how a controller shares what there is among the axes only a loop
    says.
    """
    if acts(parts.train.like.effects, "respond"):
        return parts
    return parts._replace(train=_calm(parts.train), test=_calm(parts.test))


def _calm(problem: Problem) -> Problem:
    record, counts = problem.chunks.record, problem.chunks.counts
    step_s = float(np.median(record.step_s))
    keep = np.exp(-step_s / JUMP_S)
    sticks = record.command[..., :3]
    lagged = signal.lfilter([1.0 - keep], [1.0, -keep], sticks, axis=0)
    is_jump = np.abs(sticks - lagged).sum(axis=-1) > JUMP
    rows = max(round(AFTERMATH_S / step_s), 1)
    follows = signal.lfilter(np.ones(rows), [1.0], is_jump.astype(float), axis=0) > 0.5
    quiet = counts & ~follows[..., None, None]
    quiet[..., -1, :] = counts[..., -1, :]  # a battery does not mind
    return replace(problem, chunks=problem.chunks._replace(counts=quiet))


class Refit(NamedTuple):
    """Both logs refitted with one more effect.

    merit: chi2 gained on the later log, less that gained on the earlier one and a price.
    """

    candidate: Candidate
    later: Estimate
    earlier: Estimate
    merit: float


def next_change(later: Estimate, earlier: Estimate) -> tuple[Refit, tuple[str, ...]] | None:
    """Return the effect whose change explains the logs best, and others that do so nearly as well.

    Those that are promising to first order are refitted. None where none changed enough.
    """
    promise = {one: promise_of(one, later, earlier) for one in candidates_for(later.state.problem)}
    ways: dict[tuple[str, ...], Candidate] = {}
    for one in sorted(
        (one for one in promise if promise[one] > 0.0), key=lambda one: -promise[one]
    ):
        ways.setdefault(one.fields, one)
    refitted = [(one, later.with_effect(one)) for one in [*ways.values()][: search.MAX_REFITTED]]
    worth = {
        one: later.model.cost - more.model.cost - search.PER_PARAMETER * len(one.fields)
        for one, more in refitted
    }
    found: list[Refit] = []
    for one, more in sorted(refitted, key=lambda pair: -worth[pair[0]]):
        best = max((own.merit for own in found), default=0.0)
        if worth[one] <= max(
            best - EQUIVALENT, 0.0
        ):  # what the log before gains only takes from it
            break
        less = earlier.with_effect(one)
        merit = worth[one] - (earlier.model.cost - less.model.cost)
        if merit > 0.0 and change_between(more, less, one.fields).chi2 > threshold(len(one.fields)):
            found.append(Refit(one, more, less, merit))
    if not found:
        return None
    best_one = max(found, key=lambda own: own.merit)
    close = {own.candidate.effect for own in found if own.merit > best_one.merit - EQUIVALENT}
    return best_one, tuple(sorted(close - {best_one.candidate.effect}))


def promise_of(candidate: Candidate, later: Estimate, earlier: Estimate) -> float:
    """Return the first-order gain of an effect on the later log; 0 unless its change is promising.

    A change shows between the logs, and in the log after against the model.
    """
    both = later, earlier
    if candidate.effect in later.state.unobservable or not all(
        one.model.lacks(candidate) for one in both
    ):
        return 0.0
    ways = [one.linearization.columns_of(candidate) for one in both]
    if any(
        len(one.linearization.acting(way)) < len(way) for one, way in zip(both, ways, strict=True)
    ):
        return 0.0
    (step, covariance), (step_before, covariance_before) = (
        later.step(ways[0]),
        earlier.step(ways[1]),
    )
    change = step - step_before
    # What the model does not have at all cannot become less.
    if any(
        probe.is_one_way and share <= 0.0
        for probe, share in zip(candidate.probes, step, strict=False)
    ):
        return 0.0
    chi2 = min(
        change @ solve(covariance + covariance_before, change), step @ solve(covariance, step)
    )
    if chi2 < search.PROMISING * threshold(len(change)) or not is_large(candidate, change, later):
        return 0.0
    gain = later.linearization.gain_of(
        candidate, later.linearization.columns_at(later.model.indices)
    )
    return gain.chi2 if gain is not None else 0.0


def is_large(candidate: Candidate, change: np.ndarray, later: Estimate) -> bool:
    """Return whether a change is notable in any of a candidate's parameters.

    change: of probed parameters as a share of the way to the probe, of others in their units.
    """
    problem = later.state.problem
    ways = [
        probe.value - problem.start[problem.indices_of([probe.field])[0]]
        for probe in candidate.probes
    ]
    sizes = np.concatenate([np.array(ways), np.ones(len(candidate.other_fields))]) * change
    fields = [*(probe.field for probe in candidate.probes), *candidate.other_fields]
    notable = BY_NAME[candidate.effect].notable
    sized = dict(zip((field.split(".")[1] for field in fields), np.abs(sizes), strict=True))
    return any(sized.get(name, 0.0) >= least for name, least in notable.items())


def selection_of(later: Estimate, earlier: Estimate) -> Selection:
    """Return the model of the later log as a selection.

    Its unexplained part is what was not unexplained, or much less, in the earlier log.
    """
    state, model = later.state, later.model
    ablations = ablate_all(state, model, later.linearization)
    rest, past = (
        find_unexplained(one.state.problem, one.model, one.base.vector)[0].shares
        for one in (later, earlier)
    )
    most = max(past.values(), default=0.0)
    shares = {name: size for name, size in rest.items() if size > WORSE * past.get(name, most)}
    names = tuple(dict.fromkeys(name.split(": ", 1)[1] for name in shares))
    return Selection(state, later.base, model, ablations, Unexplained(bool(shares), names, shares))


def change_between(later: Estimate, earlier: Estimate, fields: Sequence[str]) -> Change:
    """Return how parameters of both models changed."""
    indices = later.state.problem.indices_of(fields)
    size = later.model.vector[indices] - earlier.model.vector[indices]
    margins = [Marginal(one.linearization, one.model, fields) for one in (later, earlier)]
    half = np.hypot(*(one.half_widths() for one in margins))
    covariance = margins[0].covariance() + margins[1].covariance()
    return Change(size, half, float(size @ solve(covariance, size)))


def changed_cause(cause: Cause, later: Estimate, earlier: Estimate) -> list[Cause]:
    """Return a cause with the values that it changed to; nothing where it is as it was before.

    Of a loop's settings, those that changed.
    """
    effect = [one for one in later.model.candidates if one.effect == cause.effect]
    base = THRUST_COEFFS if cause.effect == "thrust_scale" else BASE_CAUSES.get(cause.effect, ())
    values: dict[str, Estimated] = {}
    for fields in effect[0].groups if effect else [base]:
        values |= changed_values(cause, fields, later, earlier)
    return [replace(cause, parameters=values)] if values else []


def changed_values(
    cause: Cause, fields: Sequence[str], later: Estimate, earlier: Estimate
) -> dict[str, Estimated]:
    """Return the values that a cause's parameters changed to; none without a clear change."""
    problem, name = later.state.problem, cause.effect
    change = change_between(later, earlier, fields)
    indices, vector = problem.indices_of(fields), problem.start.copy()
    vector[indices] += change.size
    factor: dict[str, Estimated] = {}  # by which the mean thrust changed
    if tuple(fields) == THRUST_COEFFS:
        ways = mean_thrust(problem)[None]
        margins = [Marginal(one.linearization, one.model, fields) for one in (later, earlier)]
        half_n = float(np.hypot(*(one.half_widths(ways)[0] for one in margins)))
        factor = mean_factor(problem, vector, half_n)
    is_clear = np.any(np.abs(change.size) > change.half) and change.chi2 > threshold(len(fields))
    is_clear |= any(not one.ci95[0] <= 1.0 <= one.ci95[1] for one in factor.values())
    if not is_clear or not is_notable(name, problem, vector):
        return {}
    values = {}
    for field, index, half in zip(fields, indices, change.half, strict=True):
        key, value = field.split(".")[-1], float(vector[index])
        if key in cause.parameters:
            values[key] = Estimated.around(value, float(half), cause.parameters[key].unit)
    if factor:
        values |= {"factor": factor["mean_factor"]} if name == "thrust_scale" else factor
    return values
