"""Before and after: name only what has changed since an earlier log.

No model of a real drone is complete. The parts that it lacks act in the earlier and in the later
log, and laws that stand in for them are found in both. So each law is fitted to either log, beside
the same other laws. It names a change if the estimates differ by more than the uncertainty of both,
and by a notable size. Uncertainty is estimated from the disagreement between seconds of a log,
which includes the effect of the parts that the model lacks.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from scipy import signal

from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.effects import BY_NAME, acts
from flytrack_env.motion import Motion
from flytrack_sysid.diagnosis.controller import compare_controllers, examine_controller
from flytrack_sysid.diagnosis.diagnose import (
    Logs,
    Report,
    Split,
    refined_within_range,
    split,
    summarize,
)
from flytrack_sysid.diagnosis.model_selection import (
    EQUIVALENT,
    Marginal,
    ablate_all,
    commanded_thrust,
)
from flytrack_sysid.diagnosis.result import DRIFT, Cause, Diagnosis, Estimated, Unexplained
from flytrack_sysid.diagnosis.size import is_notable
from flytrack_sysid.diagnosis.summary import classify, effect_causes, mean_factor, mean_thrust
from flytrack_sysid.diagnosis.unexplained import find_unexplained
from flytrack_sysid.diagnosis.vetoes import Selection, held_out_under
from flytrack_sysid.inference import noise as noises
from flytrack_sysid.inference import search
from flytrack_sysid.inference.parameters import THRUST_COEFFS
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.score_test import (
    Candidate,
    Linearization,
    base_fields,
    candidates_for,
    solve,
    threshold,
)
from flytrack_sysid.kinematics import low_pass
from flytrack_sysid.log import FlightLog
from flytrack_sysid.log_motion import check_same_origin

MAX_EFFECTS = 4  # that changed between two logs
# Sticks jump if the sum of their distances from their low-pass exceeds JUMP. JUMP_S is the time
# constant of the low-pass; AFTERMATH_S is how long the rows after a jump do not count.
JUMP, JUMP_S, AFTERMATH_S = 0.5, 0.05, 0.2
# Share of the earlier log's rows whose thrusts count as flown, from either end, and share of the
# later log's rows that must lie within: below, the earlier thrust map would be extrapolated. Both
# are choices, tried on the pairs of ``benchmarks.repeatability --changes`` alone.
FLOWN, SHARED = 0.99, 0.2
EXPONENT = 0.5  # motors' thrust goes with the 1st to 2nd power of their command
WORSE = 1.5  # times what was left unexplained before: more than this is new
NOT_SHARED = (
    "the logs were flown at other thrusts: each was compared with the model at its own, so that "
    "a change of the thrust may be an error of the model's curve"
)


def _logs(logs: Logs) -> Sequence[FlightLog]:
    return [logs] if isinstance(logs, FlightLog) else logs


class Change(NamedTuple):
    """The change of parameters from the earlier log to the later one.

    Attributes:
        size: of each change.
        marginals: the information of each log about the parameters.
    """

    size: np.ndarray
    marginals: tuple[Marginal, Marginal]

    @property
    def chi2(self) -> float:
        """Of all changes."""
        covariance = np.sum([one.covariance() for one in self.marginals], axis=0)
        return float(self.size @ solve(covariance, self.size))

    def half_widths(self, weights: np.ndarray | None = None) -> np.ndarray:
        """Return half of the 95 % interval of each change, or of weighted sums of changes."""
        return np.hypot(*(one.half_widths(weights) for one in self.marginals))


class Estimate(NamedTuple):
    """A model fitted to one log, by likelihood.

    Attributes:
        state: of the search.
        base: the model without effects.
        model: the fitted one.
        linearization: of the model, along everything.
    """

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
        """Return the estimate with one more effect."""
        line, model = self.linearization, self.model
        gain = line.gain_of(candidate, line.columns_at(model.indices))
        if gain is None:
            fitted = self.state.fitted(model.joined_by(candidate), model.vector)
        else:
            fitted = search.add_effect(self.state, line, model, search.Scored(candidate, gain))
        state, linearization = self.state.linearized(fitted.vector)
        return Estimate(state, self.base, fitted, linearization)

    def step(self, columns: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the first-order step along columns beside the model, and its covariance.

        The covariance is the inverse of the information times the inflation of the scores after
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
    report: Report = lambda done, stages: None,
    motion: Motion | None = None,
) -> Diagnosis:
    """Return the diagnosis of a log, in which causes are changes since an earlier log.

    Values of causes are those of the model plus the change of the estimates. What the model lacks
    in both logs is in the extended model's other parameters, and is no cause. Only what
    was not unexplained in the earlier log is unexplained.

    Args:
        after: the later log, or several.
        before: the earlier log, or several, of the same craft as described by the model.
        model: as in ``diagnose``.
        held_out: as in ``diagnose``, of the later log.
        report: as in ``diagnose``.
        motion: as in ``diagnose``.

    Raises:
        DiagnosisError: as ``diagnose``, of either log.
        LogError: measured logs beside others.
    """
    check_same_origin(*_logs(after), *_logs(before))
    with jax.enable_x64(True):
        parts = calm(split(after, model, held_out, motion))
        model = nominal_parameters() if model is None else model
        later = Estimate.of(parts)
        parts_before = calm(split(before, model, None, parts.motion_estimate.motion))
        earlier = Estimate.of(parts_before)
        equivalents: dict[str, tuple[str, ...]] = {}
        report(1, 3)
        while len(later.model.candidates) < MAX_EFFECTS:
            change = next_change(later, earlier)
            if change is None:
                break
            best, equivalents[change[0].candidate.effect] = change
            later, earlier = best.later, best.earlier
        report(2, 3)
        selection = build_selection(later, earlier)
        test = held_out_under(selection, parts.test)
        vetted = refined_within_range(selection, {}, test, parts)
        diagnosis = summarize(vetted, parts._replace(test=test))
        # Steps and sizes name a change; the extended model has it only if it improves flights.
        effects = effect_causes(selection, test, later.linearization)
        base = [one for one in diagnosis.causes if one.effect not in later.model.effects]
        named = [*effects, *base]
        causes = tuple(one for cause in named for one in changed_cause(cause, later, earlier))
        report(3, 3)
    drifts = {one.effect: one.equivalent for one in base if DRIFT in one.equivalent}
    causes = tuple(
        replace(one, equivalent=(drifts | equivalents).get(one.effect, ())) for one in causes
    )
    controller_before = examine_controller(parts_before.logged, model, parts_before.logged_held_out)
    controller, controller_notes = compare_controllers(diagnosis.controller, controller_before)
    is_of_thrust = any(base_fields(one.effect) == THRUST_COEFFS for one in causes)
    unchanged = {one.effect for one in named} - {one.effect for one in causes}
    return replace(
        diagnosis,
        nominal=model._replace(motion=diagnosis.extended.motion),
        verdict=classify(causes, diagnosis.unexplained),
        causes=causes,
        controller=controller,
        warnings=(
            *diagnosis.warnings,
            *controller_notes,
            *(f"{name}: as in the log before, so no change" for name in sorted(unchanged)),
            *([NOT_SHARED] if is_of_thrust and not share_thrusts(later, earlier) else []),
        ),
    )


def calm(parts: Split) -> Split:
    """Return a split in which only rows count that do not follow a jump of the sticks.

    After a jump, motors saturate, and only a loop says how a controller shares the thrust among the
    axes.
    """
    if acts(parts.train.like.effects, "respond"):
        return parts
    return parts._replace(train=_calm(parts.train), test=_calm(parts.test))


def _calm(problem: Problem) -> Problem:
    record, counts = problem.chunks.record, problem.chunks.counts
    step_s = record.median_step_s
    sticks = record.command[..., :3]
    is_jump = np.abs(sticks - low_pass(sticks, step_s, JUMP_S)).sum(axis=-1) > JUMP
    rows = max(round(AFTERMATH_S / step_s), 1)
    follows = signal.lfilter(np.ones(rows), [1.0], is_jump.astype(float), axis=0) > 0.5
    quiet = counts & ~follows[..., None, None]
    quiet[..., -1, :] = counts[..., -1, :]  # jumps do not affect the battery
    return replace(problem, chunks=problem.chunks._replace(counts=quiet))


class Refit(NamedTuple):
    """Both logs refitted with one more effect.

    Attributes:
        candidate: the effect.
        later: the estimate from the later log.
        earlier: the estimate from the earlier log.
        merit: chi2 gained on the later log, less that gained on the earlier one and a price.
    """

    candidate: Candidate
    later: Estimate
    earlier: Estimate
    merit: float


def next_change(later: Estimate, earlier: Estimate) -> tuple[Refit, tuple[str, ...]] | None:
    """Return the effect whose change explains the logs best, and others that do so nearly as well.

    Effects that are promising to first order are refitted. Return None if none changed enough.
    """
    promises = {
        candidate: promise_of(candidate, later, earlier)
        for candidate in candidates_for(later.state.problem)
    }
    by_fields: dict[tuple[str, ...], Candidate] = {}
    for candidate in sorted(
        (candidate for candidate in promises if promises[candidate] > 0.0),
        key=lambda candidate: -promises[candidate],
    ):
        by_fields.setdefault(candidate.fields, candidate)
    refitted = [
        (candidate, later.with_effect(candidate))
        for candidate in [*by_fields.values()][: search.MAX_REFITTED]
    ]
    later_gains = {
        candidate: later.model.cost
        - later_refit.model.cost
        - search.PER_PARAMETER * len(candidate.fields)
        for candidate, later_refit in refitted
    }
    refits: list[Refit] = []
    for candidate, later_refit in sorted(refitted, key=lambda pair: -later_gains[pair[0]]):
        best = max((refit.merit for refit in refits), default=0.0)
        if later_gains[candidate] <= max(
            best - EQUIVALENT, 0.0
        ):  # the gain on the earlier log only reduces the merit
            break
        earlier_refit = earlier.with_effect(candidate)
        merit = later_gains[candidate] - (earlier.model.cost - earlier_refit.model.cost)
        if merit > 0.0 and change_between(
            later_refit, earlier_refit, candidate.fields
        ).chi2 > threshold(len(candidate.fields)):
            refits.append(Refit(candidate, later_refit, earlier_refit, merit))
    if not refits:
        return None
    best_refit = max(refits, key=lambda refit: refit.merit)
    close = {
        refit.candidate.effect for refit in refits if refit.merit > best_refit.merit - EQUIVALENT
    }
    return best_refit, tuple(sorted(close - {best_refit.candidate.effect}))


def promise_of(candidate: Candidate, later: Estimate, earlier: Estimate) -> float:
    """Return the first-order gain of an effect on the later log; 0 unless its change is promising.

    A promising change shows between the logs, and in the later log against the model.
    """
    estimates = later, earlier
    if candidate.effect in later.state.unobservable or not all(
        estimate.model.lacks(candidate) for estimate in estimates
    ):
        return 0.0
    columns = [estimate.linearization.columns_of(candidate) for estimate in estimates]
    if any(
        len(estimate.linearization.acting(columns_of_log)) < len(columns_of_log)
        for estimate, columns_of_log in zip(estimates, columns, strict=True)
    ):
        return 0.0
    (step, covariance), (step_before, covariance_before) = (
        later.step(columns[0]),
        earlier.step(columns[1]),
    )
    change = step - step_before
    # An effect that the model does not have cannot become smaller.
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

    Args:
        candidate: the effect.
        change: of probed parameters as a share of the way to the probe, of others in their units.
        later: the estimate from the later log.
    """
    problem = later.state.problem
    to_probes = [
        probe.value - problem.start[problem.parameter_indices([probe.field])[0]]
        for probe in candidate.probes
    ]
    sizes = np.concatenate([np.array(to_probes), np.ones(len(candidate.other_fields))]) * change
    fields = [*(probe.field for probe in candidate.probes), *candidate.other_fields]
    notable = BY_NAME[candidate.effect].notable
    size_by_name = dict(zip((field.split(".")[1] for field in fields), np.abs(sizes), strict=True))
    return any(
        size_by_name.get(name, 0.0) >= notable_size for name, notable_size in notable.items()
    )


def build_selection(later: Estimate, earlier: Estimate) -> Selection:
    """Return the model of the later log as a selection.

    Its unexplained part is what was explained, or much smaller, in the earlier log.
    """
    state, model = later.state, later.model
    ablations = ablate_all(state, model, later.linearization)
    present, past = (
        find_unexplained(estimate.state.problem, estimate.model, estimate.base.vector)[0].shares
        for estimate in (later, earlier)
    )
    largest = max(past.values(), default=0.0)
    shares = {
        name: size for name, size in present.items() if size > WORSE * past.get(name, largest)
    }
    names = tuple(dict.fromkeys(name.split(": ", 1)[1] for name in shares))
    return Selection(state, later.base, model, ablations, Unexplained(bool(shares), names, shares))


def change_between(later: Estimate, earlier: Estimate, fields: Sequence[str]) -> Change:
    """Return the change of parameters between both models."""
    indices = later.state.problem.parameter_indices(fields)
    size = later.model.vector[indices] - earlier.model.vector[indices]
    of_later, of_earlier = (
        Marginal(one.linearization, one.model, fields) for one in (later, earlier)
    )
    return Change(size, (of_later, of_earlier))


def changed_cause(cause: Cause, later: Estimate, earlier: Estimate) -> list[Cause]:
    """Return a cause with its new values; an empty list if it did not change.

    Of a loop's settings, only the changed ones are returned.
    """
    candidates = [
        candidate for candidate in later.model.candidates if candidate.effect == cause.effect
    ]
    base = base_fields(cause.effect)
    values: dict[str, Estimated] = {}
    for fields in candidates[0].groups if candidates else [base]:
        values |= changed_values(cause, fields, later, earlier)
    return [replace(cause, parameters=values)] if values else []


def changed_values(
    cause: Cause, fields: Sequence[str], later: Estimate, earlier: Estimate
) -> dict[str, Estimated]:
    """Return the new values of a cause's parameters; none without a clear change."""
    problem, name = later.state.problem, cause.effect
    change = change_between(later, earlier, fields)
    if tuple(fields) == THRUST_COEFFS and not share_thrusts(later, earlier):
        return scaled_thrust(name, later, earlier, change)
    indices, vector = problem.parameter_indices(fields), problem.start.copy()
    vector[indices] += change.size
    factor: dict[str, Estimated] = {}  # by which the mean thrust changed
    if tuple(fields) == THRUST_COEFFS:
        half_n = float(change.half_widths(mean_thrust(problem)[None])[0])
        factor = mean_factor(problem, vector, half_n)
    halves = change.half_widths()
    is_clear = np.any(np.abs(change.size) > halves) and change.chi2 > threshold(len(fields))
    is_clear |= any(not one.ci95[0] <= 1.0 <= one.ci95[1] for one in factor.values())
    if not is_clear or not is_notable(name, problem, vector):
        return {}
    values = {}
    for field, index, half in zip(fields, indices, halves, strict=True):
        key, value = field.split(".")[-1], float(vector[index])
        if key in cause.parameters:
            values[key] = Estimated.around(value, float(half), cause.parameters[key].unit)
    if factor:
        values |= {"factor": factor["mean_factor"]} if name == "thrust_scale" else factor
    return values


def share_thrusts(later: Estimate, earlier: Estimate) -> bool:
    """Return whether the earlier log has flown at the thrusts that the later one commands.

    A thrust map says nothing of commands that its log does not have.
    """
    commanded = []
    for one in (later, earlier):
        problem = one.state.problem
        nominal = problem.start[problem.parameter_indices(THRUST_COEFFS)]
        commanded.append(commanded_thrust(problem, nominal)[problem.counts.any(axis=(2, 3))])
    low, high = np.quantile(commanded[1], [1.0 - FLOWN, FLOWN])
    return bool(np.mean((commanded[0] >= low) & (commanded[0] <= high)) > SHARED)


def scaled_thrust(
    name: str, later: Estimate, earlier: Estimate, change: Change
) -> dict[str, Estimated]:
    """Return by which factor the thrust changed between logs that share no thrusts.

    The mean thrust of each log is compared with the nominal map at the log's own commands. Its
    exponent over the command may be wrong by ``EXPONENT``. Empty without a clear change.
    """
    factors: list[Estimated] = []
    nominal_n: list[float] = []
    for one, marginal in zip((later, earlier), change.marginals, strict=True):
        problem = one.state.problem
        slopes = mean_thrust(problem)
        half_n = float(marginal.half_widths(slopes[None])[0])
        factors += mean_factor(problem, one.model.vector, half_n).values()
        nominal_n.append(float(slopes @ problem.start[problem.parameter_indices(THRUST_COEFFS)]))
    if len(factors) < 2 or min(one.value for one in factors) <= 0.0:
        return {}
    now, then = factors
    ratio = now.value / then.value
    of_curve = EXPONENT * np.log(nominal_n[0] / nominal_n[1])
    half = np.hypot(now.half_width / now.value, then.half_width / then.value)
    most = float(np.exp(np.hypot(half, of_curve)))
    problem = later.state.problem
    vector, indices = problem.start.copy(), problem.parameter_indices(THRUST_COEFFS)
    vector[indices] *= ratio
    if 1.0 / most < ratio < most or not is_notable(name, problem, vector):
        return {}
    key = "factor" if name == "thrust_scale" else "mean_factor"
    return {key: Estimated(ratio, (ratio / most, ratio * most), "1")}
