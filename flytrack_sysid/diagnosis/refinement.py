"""Refinement: keep the effects that make the free-flight prediction of held-out rows better.

One-step residuals show what a model lacks. Where they leave something unexplained, a law that
stands in for it may fit every step although its prediction diverges over many steps. Refinement
therefore

1. starts free flights of 0.1 to 2 s from measured states (multiple shooting),
2. fits all parameters to the flights on the training rows,
3. removes effects that make no flight better that was not fitted, or any horizon worse: flights of
   held-out rows, and to first order those of each block of training rows without this block,
4. holds parameters at nominal that an effect does not need,
5. where effects were removed, compares them with a base that is fitted to the same flights instead,
   and keeps what predicts held-out flights better. If all effects stay, they keep the values
   of single steps where those of flights predict a horizon worse.

Flights without position and velocity show no force: the thrust map of single steps stands, since
rates alone show only its ratio to inertia.

Where a placebo without the commands predicts as well as the models, the diagnosis names nothing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flytrack_env.effects import BY_NAME, LearnedLaw
from flytrack_sysid.diagnosis.flight_errors import (
    LIKELY,
    MAX_FITTED_WINDOWS,
    Flights,
    FlightTest,
    sample_windows,
    sureness,
    tabulate_errors,
)
from flytrack_sysid.diagnosis.flight_fit import Fit, Target, at_bounds
from flytrack_sysid.diagnosis.model_selection import ablate_all
from flytrack_sysid.diagnosis.vetoes import Selection
from flytrack_sysid.inference.free_flight import HORIZONS_S, QUANTITIES, UNITS, Windows
from flytrack_sysid.inference.parameters import DRAIN, THRUST_COEFFS
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.score_test import Candidate, base_fields, candidates_for
from flytrack_sysid.inference.search import FittedModel, SearchState
from flytrack_sysid.log import FlightLog

ALWAYS_FITTED_S = 0.25  # horizons up to this are fitted even where the placebo is as good
MAX_ROUNDS, REFIT_ROUNDS = 10, 2  # iterations of a fit, and of a fit without an effect
NEUTRAL = 1e-3  # largest distance from nominal, relative to a parameter's scale
# An effect has to improve the prediction of blocks by SURE standard errors over them. LIKELY
# standard errors are enough where it is worth the share WORTHWHILE of the error: single steps have
# shown it already.
SURE, WORTHWHILE = 2.0, 0.02


class Refined(NamedTuple):
    """The result of a refinement.

    Attributes:
        kept: the effects of the extended model.
        fit: the extended model, if it was fitted to windows, with the widths of that fit; None if
            the model from one-step residuals stands.
        base: the base alone, fitted to the same windows.
        removed: effects that held-out prediction does not need, or that make it worse.
        without: by kept effect, the model without it, refitted.
        problem: the problem with the ranges that were searched.
        flight_test: held-out windows and errors; None if there are no windows.
    """

    kept: tuple[Candidate, ...]
    fit: Fit | None
    base: np.ndarray | None
    removed: tuple[str, ...]
    without: Mapping[str, np.ndarray]
    problem: Problem
    flight_test: FlightTest | None

    def with_law(self, law: LearnedLaw) -> "Refined":
        """Return the result for the problem with a law added, which is neutral in the base."""
        problem = self.problem.with_law(law)
        law_start = problem.start[len(self.problem.start) :]
        return self._replace(
            problem=problem, base=None if self.base is None else np.append(self.base, law_start)
        )

    @property
    def removal_costs(self) -> dict[str, float]:
        """Relative increase of the held-out error without an effect, all else refitted."""
        if self.flight_test is None or self.fit is None or not self.without:
            return {}
        losses = self.flight_test.losses(self.fit.vector, *self.without.values()).sum(axis=1)
        costs = np.sqrt(losses[1:] / losses[0]) - 1.0
        return {name: float(cost) for name, cost in zip(self.without, costs, strict=True)}

    def vector_without(self, effect: str, fit: Fit) -> np.ndarray:
        """Return the fitted model without an effect, or with nominal base parameters."""
        if effect in self.without:
            return self.without[effect]
        of_sensor = [name for name in self.problem.names if name.startswith(f"{effect}.")]
        return self.problem.at_start(fit.vector, base_fields(effect) or of_sensor)

    def flight_errors(self, vector: np.ndarray) -> dict[str, float]:
        """Return the held-out errors of free flight by horizon in seconds; empty without a test.

        The errors are those of position; without position in the log, those of attitude, or else of
        the rates.
        """
        if self.flight_test is None:
            return {}
        errors = tabulate_errors(self.flight_test.tested(vector).rms()[0])
        keys = (
            f"{name}_{UNITS[name].replace('/', '_per_')}"
            for name in ("position", "attitude", "rates")
        )
        return next((errors[key] for key in keys if key in errors), {})


def widened(problem: Problem, fields: Sequence[str]) -> Problem:
    """Return the problem with twice the range for some parameters, except for remembered delays.

    A non-negative range stays non-negative, and a one-sided range stays one-sided.
    """
    low, high = problem.low.copy(), problem.high.copy()
    for name, index in zip(fields, problem.parameter_indices(fields), strict=True):
        effect, _, field = name.partition(".")
        if not field or field in BY_NAME[effect].max_steps:
            continue
        width = high[index] - low[index]
        if low[index] < problem.start[index]:
            low[index] = low[index] - width if low[index] < 0.0 else 0.2 * low[index]
        high[index] += width if high[index] > problem.start[index] else 0.0
    return replace(problem, low=low, high=high)


def refine(
    state: SearchState,
    base: FittedModel,
    model: FittedModel,
    log: FlightLog,
    held_out: np.ndarray,
    settled: Sequence[str] = (),
    doubted: Sequence[str] = (),
) -> Refined:
    """Select the effects of a model that predict held-out flights better, and fit their values.

    Args:
        base: the base from one-step residuals.
        model: the extended model from one-step residuals.
        held_out: rows of the log that no fit uses, (num_rows,) bool.
        settled: effects that act where single steps leave nothing unexplained. The model has their
            most likely values already. They stand unless it predicts a horizon worse than the base.
        doubted: effects that held-out single steps contradict: flights of these rows decide.
    """
    learnt_windows, held_out_windows = (
        sample_windows(log, ~held_out, MAX_FITTED_WINDOWS),
        sample_windows(log, held_out),
    )
    problem, candidates, extended = state.problem, model.candidates, model.vector
    unrefined = Refined(candidates, None, None, (), {}, problem, None)
    if learnt_windows is None or held_out_windows is None:
        return unrefined
    learnt = Flights(learnt_windows)
    flight_test = FlightTest.of(
        problem, learnt_windows, Flights(held_out_windows), base.vector
    ).seeing(extended)
    unrefined = unrefined._replace(flight_test=flight_test)
    if not candidates or not flight_test.is_known.any():
        return unrefined
    if doubted and not flight_test.matters.any():
        return unrefined  # flights of which commands predict nothing settle no doubt
    acting = acting_effects(problem, _probed(problem, extended, candidates), candidates, learnt)
    refinement = _Refinement(
        flight_test,
        learnt,
        base.vector,
        tuple(state.base_indices),
        acting,
        tuple(settled),
        tuple(doubted),
    )
    is_at_bound = bool(at_bounds(problem, extended, refinement.fields_of(candidates)))
    is_settled = all(candidate.effect in settled for candidate in candidates)
    if is_settled and not is_at_bound and not flight_test.is_surely_worse(extended):
        return unrefined
    return refinement.run(extended, unrefined)


class _Refinement(NamedTuple):
    """The data that the steps of a refinement share.

    Attributes:
        flight_test: held-out windows and the errors on them.
        learnt: flights that the fits use.
        base: the base from one-step residuals, (num_parameters,).
        base_indices: the free parameters of the base.
        acting: the effects that change the predictions. Effects of sensors that windows do not
            contain are not among them; their values stay as they are.
        settled: as in ``refine``.
        doubted: as in ``refine``.
    """

    flight_test: FlightTest
    learnt: Flights
    base: np.ndarray
    base_indices: tuple[int, ...]
    acting: tuple[str, ...]
    settled: tuple[str, ...]
    doubted: tuple[str, ...]

    def fields_of(self, candidates: Sequence[Candidate]) -> list[str]:
        """Return the parameters of effects that act on the windows."""
        return [
            name
            for candidate in candidates
            if candidate.effect in self.acting
            for name in candidate.fields
        ]

    def target(self, problem: Problem) -> Target:
        """Return the cost of a fit, over cells that are evidence and over short horizons."""
        scale = self.learnt.errors_at(problem, self.base[None]).scale
        is_short = (np.array(HORIZONS_S) <= ALWAYS_FITTED_S)[:, None]
        return Target(problem, self.learnt, scale, self.flight_test.matters | is_short)

    def indices(self, problem: Problem, candidates: Sequence[Candidate]) -> list[int]:
        """Return the indices of the free parameters that act on the windows."""
        unseen = {DRAIN} if shows_force(self.learnt.windows) else {DRAIN, *THRUST_COEFFS}
        base_indices = [index for index in self.base_indices if problem.names[index] not in unseen]
        return base_indices + problem.parameter_indices(self.fields_of(candidates))

    def run(self, extended: np.ndarray, unrefined: Refined) -> Refined:
        """Return the refined model with the effects that held-out prediction needs."""
        problem, candidates = unrefined.problem, unrefined.kept
        target = self.target(problem)
        indices = self.indices(problem, candidates)
        fit = target.fitted(extended, indices, MAX_ROUNDS)
        probed = _probed(problem, fit.vector, candidates)
        if np.any(probed != fit.vector):  # single steps left a parameter where its slope is zero
            from_probes = target.fitted(probed, indices, MAX_ROUNDS)
            vectors = np.stack([fit.vector, from_probes.vector])
            fit = (fit, from_probes)[
                int(np.argmin(target.cost(target.residuals(vectors), vectors)))
            ]
        stuck = at_bounds(problem, fit.vector, self.fields_of(candidates))
        if stuck:
            problem = widened(problem, stuck)
            target = target._replace(problem=problem)
            fit = target.fitted(fit.vector, fit.indices, MAX_ROUNDS)
        base = target.fitted(self.base, self.indices(problem, ()), MAX_ROUNDS).vector
        flight_test = self.flight_test.seeing(fit.vector)
        refined = unrefined._replace(fit=fit, base=base, problem=problem, flight_test=flight_test)
        remaining = self._eliminate(refined, fit, flight_test, target)
        if not remaining.removed:
            return remaining
        # A fit to flights may make a horizon worse with the effects and without them.
        alternative = self._eliminate(refined, fit, flight_test.with_base(base), target)
        if (
            alternative.fit is not None
            and alternative.kept == candidates
            and flight_test.prefers(extended, alternative.fit.vector)
        ):
            alternative = alternative._replace(fit=alternative.fit._replace(vector=extended))
        losses = flight_test.losses(
            self._final_parameters(remaining), self._final_parameters(alternative)
        )
        worth = np.sqrt(losses[0].sum() / losses[1].sum()) - 1.0
        is_better = worth >= WORTHWHILE and sureness(losses[0] - losses[1]) >= LIKELY
        return alternative if is_better else remaining

    def _final_parameters(self, refined: Refined) -> np.ndarray:
        """Return the parameters that a refinement leaves; those of the base if it fits none."""
        return self.base if refined.fit is None else refined.fit.vector

    def _eliminate(
        self, refined: Refined, fit: Fit, flight_test: FlightTest, target: Target
    ) -> Refined:
        """Remove effects that are not needed, or that make any horizon worse."""
        without: dict[str, np.ndarray] = {}
        kept = [
            candidate
            for candidate in refined.kept
            if not _is_neutral(refined.problem, fit.vector, candidate.fields)
            and (candidate.effect in self.acting or candidate.effect not in self.doubted)
        ]
        removed = [candidate.effect for candidate in refined.kept if candidate not in kept]
        while any(candidate.effect in self.acting for candidate in kept):
            weakest, fits = self._least_needed(target, fit, kept, flight_test, nearby=fit)
            if weakest is None:  # slopes of the fit make effects look more needed than they are
                weakest, fits = self._least_needed(target, fit, kept, flight_test)
            without = {effect: one.vector for effect, one in fits.items()}
            if weakest is None:
                break
            kept = [candidate for candidate in kept if candidate.effect != weakest]
            removed.append(weakest)
            indices = self.indices(target.problem, kept)
            fit = target.fitted(fits[weakest].vector, indices, MAX_ROUNDS)
        if not any(
            candidate.effect in self.acting for candidate in kept
        ):  # the base from single steps stands
            return refined._replace(kept=tuple(kept), fit=None, removed=tuple(removed), without={})
        fit, kept = self._narrowed(target, fit, kept)
        return refined._replace(kept=tuple(kept), fit=fit, removed=tuple(removed), without=without)

    def _least_needed(
        self,
        target: Target,
        fit: Fit,
        kept: Sequence[Candidate],
        flight_test: FlightTest,
        nearby: Fit | None = None,
    ) -> tuple[str | None, dict[str, Fit]]:
        """Return the effect to remove, None if all are needed, and the fits without each effect.

        Args:
            target: of the fits.
            fit: with all effects.
            kept: the effects.
            flight_test: of the fit.
            nearby: as of ``Target.fitted``.
        """
        tried = [candidate for candidate in kept if candidate.effect in self.acting]
        fits = [self._without(target, fit, kept, candidate, nearby) for candidate in tried]
        by_effect = {one.effect: reduced for one, reduced in zip(tried, fits, strict=True)}
        may_go = np.array([candidate.effect not in self.settled for candidate in tried])
        may_go |= flight_test.is_surely_worse(fit.vector)
        if not may_go.any():
            return None, by_effect
        losses = self._losses(target, fit, *fits)
        losses_more = (losses[1:] - losses[0]).T
        sure = sureness(losses_more)
        worth = np.sqrt(losses[1:].sum(axis=1) / losses[0].sum()) - 1.0
        needed = np.where((worth >= WORTHWHILE) & (sure >= LIKELY), np.maximum(sure, SURE), sure)
        needed[:] = needed if flight_test.matters.any() else np.inf  # no cell is evidence
        held_out_sure = sureness(losses_more[len(fit.losses) :])
        is_doubted = np.array([candidate.effect in self.doubted for candidate in tried])
        needed[is_doubted & (held_out_sure < LIKELY)] = -np.inf
        needed[~may_go] = np.inf
        weakest = int(np.argmin(needed))
        if needed[weakest] >= SURE:
            if flight_test.worst_ratio(fit.vector) < 1.0:
                return None, by_effect
            ratios = np.array([flight_test.worst_ratio(one.vector) for one in fits])
            weakest = int(np.argmin(np.where(may_go, ratios, np.inf)))
        return tried[weakest].effect, by_effect

    def _narrowed(
        self, target: Target, fit: Fit, kept: Sequence[Candidate]
    ) -> tuple[Fit, list[Candidate]]:
        """Return a fit and its effects without parameters that effects do not need.

        Some parameters of an effect trade off: each may be nominal, and not all of them. Others
        end at a bound, since nothing in the flights depends on them. They are held at nominal.
        """
        kept = list(kept)
        unsettled = [one.effect not in self.settled for one in kept]
        for number in np.flatnonzero(unsettled):
            while (field := superfluous(target.problem, fit, kept[number])) is not None:
                candidate, others = kept[number], [*kept]
                others[number] = candidate._replace(
                    fields=tuple(name for name in candidate.fields if name != field),
                    probes=tuple(probe for probe in candidate.probes if probe.field != field),
                )
                vector = target.problem.at_start(fit.vector, [field])
                held = target.fitted(vector, self.indices(target.problem, others), MAX_ROUNDS)
                losses = self._losses(target, fit, held)
                if sureness(losses[1] - losses[0]) >= SURE:
                    break
                fit, kept = held, others
            for field in at_bounds(target.problem, fit.vector, kept[number].fields):
                fit = target.nearer_nominal(fit, field)
        return fit, kept

    def _losses(self, target: Target, *fits: Fit) -> np.ndarray:
        """Return the cross-validated cost of each block, learnt ones first, (fits, blocks)."""
        held_out = target._replace(flights=self.flight_test.flights)
        learnt = np.stack([fit.losses for fit in fits])
        return np.concatenate([learnt, held_out.losses(*(fit.vector for fit in fits))], axis=1)

    def _without(
        self,
        target: Target,
        fit: Fit,
        kept: Sequence[Candidate],
        removed: Candidate,
        nearby: Fit | None,
    ) -> Fit:
        vector = target.problem.at_start(fit.vector, removed.fields)
        remaining = [candidate for candidate in kept if candidate is not removed]
        indices = self.indices(target.problem, remaining)
        return target.fitted(vector, indices, REFIT_ROUNDS, nearby)


def shows_force(windows: Windows) -> bool:
    """Return whether position or velocity is scored in any window."""
    seen = [QUANTITIES.index(name) for name in ("velocity", "position")]
    return bool(windows.counts[..., seen].any())


def acting_effects(
    problem: Problem, vector: np.ndarray, candidates: Sequence[Candidate], flights: Flights
) -> tuple[str, ...]:
    """Return the effects that change the predictions of a model, by all that they change of it."""
    fields = [field for candidate in candidates for field in candidate.fields]
    without = [problem.at_start(vector, [field]) for field in fields]
    errors = flights.errors_at(problem, np.stack([vector, *without])).errors
    changes = np.abs(errors[1:] - errors[0]).max(axis=(1, 2, 3, 4))
    is_neutral = [np.array_equal(one, vector) for one in without]
    unseen = {
        field
        for field, change, neutral in zip(fields, changes, is_neutral, strict=True)
        if change == 0.0 and not neutral
    }
    seen = {field for field, change in zip(fields, changes, strict=True) if change > 0.0}
    return tuple(
        candidate.effect
        for candidate in candidates
        if seen.intersection(candidate.fields) and unseen.isdisjoint(candidate.fields)
    )


def _is_neutral(problem: Problem, vector: np.ndarray, fields: Sequence[str]) -> bool:
    """Return whether parameters are nominal, apart from those that only shape a law."""
    scaled_fields = [
        name
        for name in fields
        if name.split(".")[1] not in BY_NAME[name.split(".")[0]].search.shapes
    ]
    indices = problem.parameter_indices(scaled_fields)
    return bool(np.all(np.abs(vector - problem.start)[indices] < NEUTRAL * problem.scale[indices]))


def superfluous(problem: Problem, fit: Fit, candidate: Candidate) -> str | None:
    """Return a parameter that an effect may not need, if there is one beside others.

    It is at a bound, or the nearest to its nominal value where all may be nominal.
    """
    half = fit.half_widths_by_index
    change = np.abs(fit.vector - problem.start)
    indices = problem.parameter_indices(candidate.fields)
    shown = [index for index in indices if half.get(index, 0.0) > 0.0]
    if len(shown) < 2:
        return None
    stuck = at_bounds(problem, fit.vector, [problem.names[index] for index in shown])
    if stuck:
        return stuck[0]
    if any(change[index] > half[index] for index in shown):
        return None
    return problem.names[min(shown, key=lambda index: change[index] / half[index])]


def _probed(problem: Problem, vector: np.ndarray, candidates: Sequence[Candidate]) -> np.ndarray:
    """Return the vector with the neutral ones of the probed parameters set to their probes."""
    result = vector.copy()
    for probe in (probe for candidate in candidates for probe in candidate.probes):
        if _is_neutral(problem, vector, [probe.field]):
            result[problem.names.index(probe.field)] = probe.value
    return result


def reduced(selection: Selection, refined: Refined) -> Selection:
    """Return the selection with only the effects that a refinement kept; the base if it kept none.

    If no kept effect was fitted to flights, as with effects of sensors that flights do not contain,
    single steps decide.
    """
    model = selection.model
    if refined.fit is not None:
        if refined.kept == model.candidates:
            return selection
        nominal = [
            name
            for candidate in refined.kept
            for name in model.candidate(candidate.effect).fields
            if name not in candidate.fields
        ]
        vector = refined.problem.at_start(model.vector, nominal)
        thrust = {*refined.problem.parameter_indices(THRUST_COEFFS)} & {*model.indices}
        indices = (*refined.fit.indices, *sorted(thrust - {*refined.fit.indices}))
        return selection._replace(
            model=model._replace(candidates=refined.kept, vector=vector, indices=indices)
        )
    if refined.kept:
        return selection if refined.kept == model.candidates else _narrowed(selection, refined.kept)
    return selection._replace(model=selection.base)


def with_effects(selection: Selection, effects: Sequence[str]) -> Selection:
    """Return the selection with some effects added, fitted to single steps again."""
    problem, model = selection.state.problem, selection.model
    added: dict[str, Candidate] = {}
    for candidate in candidates_for(problem):
        known = added.get(candidate.effect, candidate)
        if candidate.effect in effects and len(candidate.fields) >= len(known.fields):
            added[candidate.effect] = candidate
    candidates = (*model.candidates, *added.values())
    return _fitted_again(selection, candidates, _probed(problem, model.vector, candidates))


def _narrowed(selection: Selection, kept: Sequence[Candidate]) -> Selection:
    """Return the selection with some of its effects only, fitted to single steps again.

    The fit starts at the base: an effect that is gone may have taken a lag's place, which at its
    lower bound has no slope that leads back.
    """
    vector = selection.base.vector.copy()
    fields = [field for candidate in kept for field in candidate.fields]
    indices = selection.state.problem.parameter_indices(fields)
    vector[indices] = selection.model.vector[indices]
    return _fitted_again(selection, kept, vector)


def _fitted_again(
    selection: Selection, candidates: Sequence[Candidate], vector: np.ndarray
) -> Selection:
    """Return the selection with these effects, fitted to single steps from a vector."""
    model = selection.state.fitted(candidates, vector)
    state, linearization = selection.state.linearized(model.vector)
    ablations = ablate_all(state, model, linearization)
    return selection._replace(state=state, model=model, ablations=ablations)
