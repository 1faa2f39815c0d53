"""The search: add effects one by one, and refit each together with all before it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.chunks import voltages_of
from flytrack_sysid.diagnosis.problem import NUM_PAIRS, SEARCHED, Problem
from flytrack_sysid.diagnosis.score_test import (
    Candidate,
    Gain,
    Linearization,
    candidates_for,
    costs_of,
    threshold,
)
from flytrack_sysid.log import FlightLog
from flytrack_sysid.parameters import DRAIN, base_of

PER_PARAMETER = 4.0  # of chi2: what one more parameter has to gain to be preferred to fewer
MAX_EFFECTS = 6
# of the best gain: candidates that come so near to first order are refitted before one is chosen
CLOSE = 0.6
MAX_REFITTED = 4
MAX_FAILED_ROUNDS = 3  # of refits before a search ends
PROMISING = 0.7  # of the threshold, to first order
SHARE_OF_WAY = (0.02, 1.5)  # to a probe, at which a fit starts
KEPT_PROMISE = 0.6  # of a gain to first order: a fit that comes to less may have gone astray
SATURATED_SHARES = np.array([0.0, 1.0, 0.5, 0.2])  # of the step to everything at once
# Gauss-Newton: rounds, the least gain of a round, and after how much gain slopes are taken again;
# gains in minus twice the log likelihood.
MAX_ROUNDS, MIN_GAIN, STALE = 30, 0.2, 30.0
TRIAL_ROUNDS = 5  # after which a fit says whether it is worth carrying on
# Of a step, tried one after the other until one gains a part of what first order promises.
STEP_SHARES, PART_OF_PROMISE = np.array([1.0, 0.5, 0.2, 0.05]), 0.25


class FittedModel(NamedTuple):
    """A fitted model: its effects as candidates, its vector, cost, and free indices."""

    candidates: tuple[Candidate, ...]
    vector: np.ndarray
    cost: float
    indices: tuple[int, ...]

    @property
    def effects(self) -> set[str]:
        """The names of its effects."""
        return {one.effect for one in self.candidates}

    @property
    def num_priced(self) -> int:
        """How many parameters count against it."""
        return sum(one.num_priced for one in self.candidates)

    def candidate(self, effect: str) -> Candidate:
        """Return the way in which an effect of the model was found."""
        return next(one for one in self.candidates if one.effect == effect)

    def lacks(self, candidate: Candidate) -> bool:
        """Return whether an effect may be added.

        The model does not have it, or has only other settings of it.
        """
        return not any(one.excludes(candidate) for one in self.candidates)

    def joined_by(self, candidate: Candidate) -> tuple[Candidate, ...]:
        """Return the effects with one more, or with more settings of one."""
        own = [one for one in self.candidates if one.effect == candidate.effect]
        fields = tuple(field for one in (*own, candidate) for field in one.fields)
        rest = [one for one in self.candidates if one not in own]
        return (*rest, candidate._replace(fields=fields))


class HeldParameter(NamedTuple):
    """A base parameter held at nominal; effect: what explains its change, "" if none does."""

    field: str
    effect: str


@dataclass(frozen=True, eq=False)
class SearchState:
    """What a search knows; every step of the search returns a new one.

    problem: what is learnt from, with the noise. unobservable: effects that need channels the log
    lacks. refused: effects that vetoes have rejected. held: base parameters that stay nominal.
    linearization: the last one along everything, kept because slopes are expensive.
    """

    problem: Problem
    unobservable: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    held: tuple[HeldParameter, ...] = ()
    linearization: Linearization | None = None

    @classmethod
    def start(cls, log: FlightLog, problem: Problem) -> "SearchState":
        """Return the state before anything was searched for, with a first guess of the noise.

        problem: of rows of the log.
        """
        noise = noises.first_guess(problem.chunks, problem.residuals(problem.start[None])[0])
        channels = {*log.channels, *problem.chunks.measured}
        lacking = tuple(
            effect.name for effect in SEARCHED if not set(effect.search.needs) <= channels
        )
        # The replay's voltage is then assumed at every row; what falls within a step would pass for
        # thrust.
        held = () if voltages_of(problem.chunks) else (HeldParameter(DRAIN, ""),)
        return cls(problem.with_noise(noise), unobservable=lacking, held=held)

    @property
    def base_indices(self) -> list[int]:
        """The indices of the free base parameters."""
        held = {one.field for one in self.held}
        return self.problem.indices_of(
            [name for name in base_of(self.problem.like) if name not in held]
        )

    @property
    def all_indices(self) -> list[int]:
        """The indices that may become free: the base, and all parameters of all effects."""
        base, fields = self.base_indices, [one.fields for one in candidates_for(self.problem)]
        others = {index for some in fields for index in self.problem.indices_of(some)} - {*base}
        return base + sorted(others)

    def with_noise(self, noise: np.ndarray) -> "SearchState":
        """Return the state with another noise, (6, NUM_AXES)."""
        return replace(self, problem=self.problem.with_noise(noise))

    def linearized(
        self, vector: np.ndarray, max_distance: float = STALE
    ) -> tuple["SearchState", Linearization]:
        """Return the state that has a linearization along everything, and the linearization.

        Slopes of one that is near, within ``max_distance`` of chi2, are used again.
        """
        problem, last = self.problem, self.linearization
        is_same = last is not None and last.indices == self.all_indices
        if last is not None and is_same and last.distance(vector) <= max_distance:
            if last.noise is not problem.noise:
                last = Linearization(problem, last.slopes, last.probes)
            found = last.moved(vector)
        else:
            probes = list(
                dict.fromkeys(probe for one in candidates_for(problem) for probe in one.probes)
            )
            others = problem.clipped(
                np.array([probe.placed_in(problem, vector) for probe in probes])
            )
            found = Linearization(problem, problem.slopes(vector, self.all_indices, others), probes)
        return replace(self, linearization=found), found

    def fitted(
        self,
        candidates: Sequence[Candidate],
        vector: np.ndarray,
        nearby: Linearization | None = None,
        limit: float = np.inf,
    ) -> FittedModel:
        """Return the best fit of the model with these effects, starting from a vector.

        nearby, limit: as in ``refine``.
        """
        effects = [index for one in candidates for index in self.problem.indices_of(one.fields)]
        indices = self.base_indices + effects
        vector, cost = refine(self.problem, vector, indices, nearby, limit)
        return FittedModel(tuple(candidates), vector, cost, tuple(indices))


def refine(
    problem: Problem,
    vector: np.ndarray,
    indices: Sequence[int],
    nearby: Linearization | None = None,
    limit: float = np.inf,
) -> tuple[np.ndarray, float]:
    """Minimise the cost along some indices by Gauss-Newton; return the vector and its cost.

    Slopes are kept while little is gained: residuals cost a tenth of them. nearby: a linearization
    whose slopes serve at first. limit: of the cost; a fit that is above it after a few rounds ends
    there.
    """
    indices = list(indices)
    if nearby is None:
        now = Linearization(problem, problem.slopes(vector, indices))
    else:
        now = nearby.narrowed(indices).moved(vector)
    since, is_fresh = now.cost, nearby is None
    for number in range(MAX_ROUNDS):
        if number == TRIAL_ROUNDS and now.cost > limit:
            break
        gained, later = _step(problem, now)
        if gained > 0.0:
            now, is_fresh = later, False
        if gained < MIN_GAIN:
            if is_fresh or since - now.cost < STALE:
                break
            now = Linearization(problem, problem.slopes(now.vector, indices))
            since, is_fresh = now.cost, True
    return now.vector, float(now.cost)


def _step(problem: Problem, now: Linearization) -> tuple[float, Linearization]:
    """Return what the best share of a step gains, and the linearization after it.

    As many shares are tried at once as are replayed at once.
    """
    step, at_once = now.step_inside(), max(NUM_PAIRS // problem.chunks.row.shape[1], 1)
    promised = float(step @ now.score)
    best, gained = now, -np.inf
    for first in range(0, len(STEP_SHARES), at_once):
        shares = STEP_SHARES[first : first + at_once]
        tried = np.repeat(now.vector[None], len(shares), axis=0)
        tried[:, now.indices] += shares[:, None] * step
        tried = problem.clipped(tried)
        white = problem.whitened_residuals(*tried)
        costs = costs_of(problem, tried, white)
        index = int(np.nanargmin(np.where(np.isfinite(costs), costs, np.inf)))
        if now.cost - costs[index] > gained:
            best, gained = now.moved(tried[index], white[index]), now.cost - costs[index]
        if gained > PART_OF_PROMISE * promised:
            break
    return gained, best


class Scored(NamedTuple):
    """A candidate and what it would gain, to first order."""

    candidate: Candidate
    gain: Gain

    @property
    def merit(self) -> float:
        """The gain over its inflation, less a price per parameter."""
        return self.gain.robust - PER_PARAMETER * self.gain.num_parameters


def score_candidates(
    state: SearchState, linearization: Linearization, model: FittedModel
) -> list[Scored]:
    """Return all effects that a model lacks, by merit to first order, one way of each."""
    given = linearization.columns_at(model.indices)
    excluded = {*state.unobservable, *state.refused}
    best: dict[str, Scored] = {}
    for candidate in candidates_for(state.problem):
        if candidate.effect in excluded or not model.lacks(candidate):
            continue
        gain = linearization.gain_of(candidate, given)
        if gain is None:
            continue
        scored = Scored(candidate, gain)
        if candidate.effect not in best or scored.merit > best[candidate.effect].merit:
            best[candidate.effect] = scored
    return sorted(best.values(), key=lambda scored: -scored.merit)


def add_effect(
    state: SearchState,
    linearization: Linearization,
    model: FittedModel,
    scored: Scored,
    limit: float = np.inf,
) -> FittedModel:
    """Return the model with an effect more, fitted from where first order says.

    An effect that is looked for at a probe also starts there, if it came to much less than
    promised. limit: as in ``refine``.
    """
    problem, (candidate, gain) = state.problem, scored
    candidates = model.joined_by(candidate)
    if not candidate.probes:
        vector = model.vector.copy()
        vector[problem.indices_of(candidate.fields)] += gain.step
        return state.fitted(candidates, problem.clipped(vector), linearization, limit)
    best = state.fitted(candidates, _on_the_way(problem, model, scored), limit=limit)
    if model.cost - best.cost < KEPT_PROMISE * gain.chi2:
        at_probes = model.vector
        for probe, share in zip(candidate.probes, gain.step, strict=False):
            at_probes = probe.placed_in(problem, at_probes) if share > 0.0 else at_probes
        other = state.fitted(candidates, problem.clipped(at_probes), limit=limit)
        best = min(best, other, key=lambda one: one.cost)
    return best


def _on_the_way(problem: Problem, model: FittedModel, scored: Scored) -> np.ndarray:
    """Return the vector at the best shares of the ways to probes, with all else moved along."""
    candidate, gain = scored
    vector = model.vector.copy()
    vector[list(model.indices)] += gain.given_step
    vector[problem.indices_of(candidate.other_fields)] += gain.step[len(candidate.probes) :]
    for probe, step in zip(candidate.probes, gain.step, strict=False):
        index = problem.names.index(probe.field)
        share = np.sign(step) * np.clip(np.abs(step), *SHARE_OF_WAY)
        vector[index] += share * (probe.value - vector[index])
    return problem.clipped(vector)


def add_best(
    state: SearchState, linearization: Linearization, model: FittedModel
) -> FittedModel | None:
    """Return the model with the best effect added; None where none explains enough."""
    ranked = [
        one
        for one in score_candidates(state, linearization, model)
        if one.gain.robust > PROMISING * threshold(one.gain.num_parameters)
    ]
    for _ in range(MAX_FAILED_ROUNDS):
        near = [one for one in ranked[:MAX_REFITTED] if one.merit > CLOSE * ranked[0].merit]
        best: tuple[float, FittedModel] | None = None
        for one in near:
            trial = add_effect(state, linearization, model, one, limit=-np.inf)
            gain = (model.cost - trial.cost) / one.gain.inflation
            merit = gain - PER_PARAMETER * one.gain.num_parameters
            if gain > threshold(one.gain.num_parameters) and (best is None or merit > best[0]):
                best = merit, trial
        if best is not None:
            return best[1]
        ranked = ranked[max(len(near), 1) :]
        if not ranked:
            break
    return None


def add_effects(state: SearchState, model: FittedModel) -> tuple[SearchState, FittedModel]:
    """Add effects while one explains enough, the best first; return the model, the same if none."""
    while len(model.candidates) < MAX_EFFECTS:
        state, linearization = state.linearized(model.vector)
        more = add_best(state, linearization, model)
        if more is None:
            break
        model = more
    return state, model


def saturated_residuals(linearization: Linearization) -> np.ndarray:
    """Return the residuals one step towards every effect at once, regularised by the prior.

    Noise is fitted to this, so that a missing effect is not mistaken for noise.
    """
    problem, indices = linearization.problem, linearization.indices
    tried = np.repeat(linearization.vector[None], len(SATURATED_SHARES), axis=0)
    tried[:, indices] += SATURATED_SHARES[:, None] * linearization.step(range(len(indices)))
    tried = problem.clipped(tried)
    left = problem.residuals(tried)
    return left[int(np.nanargmin(costs_of(problem, tried, problem.whiten(left))))]


def with_noise_of(state: SearchState, model: FittedModel) -> tuple[SearchState, FittedModel]:
    """Return the state with the noise that a model and everything it may lack leave, and its fit.

    The fit is the model's own, under that noise.
    """
    state, linearization = state.linearized(model.vector)
    left = saturated_residuals(linearization)
    state = state.with_noise(noises.fit_noise(state.problem.chunks, left, state.problem.noise))
    state, linearization = state.linearized(model.vector)
    return state, state.fitted(model.candidates, model.vector, linearization)


def extended(
    state: SearchState, base: FittedModel, model: FittedModel
) -> tuple[SearchState, FittedModel, FittedModel]:
    """Return the state with its noise, the refitted base, and the model with effects added.

    Noise and effects take turns: a large effect hides small ones as long as its remainder passes
    for noise.
    """
    while True:
        state, more = add_effects(state, model)
        if more is model:
            return state, base, model
        state, model = with_noise_of(state, more)
        base = state.fitted((), base.vector)
