"""The search: add effects one by one, and refit each one together with all earlier ones."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME, Effect, takes_motors
from flytrack_sysid.inference import noise as noises
from flytrack_sysid.inference.chunks import measured_voltage_range
from flytrack_sysid.inference.parameters import DRAIN, base_of, neutral_value
from flytrack_sysid.inference.problem import NUM_PAIRS, SEARCHED, Problem
from flytrack_sysid.inference.score_test import (
    Candidate,
    Gain,
    Linearization,
    candidates_for,
    compute_costs,
    threshold,
)
from flytrack_sysid.inference.torque import unseen_in_chunks
from flytrack_sysid.log import FlightLog

PER_PARAMETER = 4.0  # of chi2: the gain that one more parameter needs to be preferred
MAX_EFFECTS = 6  # of a model, besides those that the given one has
# of the best gain: candidates this close to first order are refitted before one is chosen
CLOSE = 0.6
MAX_REFITTED = 4  # candidates of a round
MAX_FAILED_ROUNDS = 3  # rounds of refits without an effect before a search ends
PROMISING = 0.7  # of the threshold, to first order
SHARE_OF_WAY = (0.02, 1.5)  # range of the share of the way to a probe at which a fit starts
KEPT_PROMISE = 0.6  # of the first-order gain: a fit that gains less may have gone astray
SATURATED_SHARES = np.array([0.0, 1.0, 0.5, 0.2])  # of the step along every effect at once
# Gauss-Newton: the most rounds, the least gain of a round, and the gain after which slopes are
# computed again. Gains are in minus twice the log likelihood.
MAX_ROUNDS, MIN_GAIN, STALE = 30, 0.2, 30.0
TRIAL_ROUNDS = 5  # after these, a fit ends unless its cost is below the limit
# Shares of a step, tried in this order until one gains the given part of the first-order gain.
STEP_SHARES, PART_OF_PROMISE = np.array([1.0, 0.5, 0.2, 0.05]), 0.25


class FittedModel(NamedTuple):
    """A fitted model.

    Attributes:
        candidates: its effects.
        vector: its parameters.
        cost: minus twice the log likelihood, and the prior.
        indices: of its free parameters in the vector.
    """

    candidates: tuple[Candidate, ...]
    vector: np.ndarray
    cost: float
    indices: tuple[int, ...]

    @property
    def effects(self) -> set[str]:
        """The names of its effects."""
        return {candidate.effect for candidate in self.candidates}

    @property
    def num_priced(self) -> int:
        """The number of parameters that count against it."""
        return sum(candidate.num_priced for candidate in self.candidates)

    def candidate(self, effect: str) -> Candidate:
        """Return the candidate of one of the model's effects."""
        return next(existing for existing in self.candidates if existing.effect == effect)

    def lacks(self, candidate: Candidate) -> bool:
        """Return whether an effect may be added.

        It may if the model does not have it, or has only other settings of it.
        """
        return not any(existing.excludes(candidate) for existing in self.candidates)

    def joined_by(self, candidate: Candidate) -> tuple[Candidate, ...]:
        """Return the candidates with one more, or with more settings of one."""
        same_effect = [
            existing for existing in self.candidates if existing.effect == candidate.effect
        ]
        fields = tuple(field for existing in (*same_effect, candidate) for field in existing.fields)
        others = [existing for existing in self.candidates if existing not in same_effect]
        return (*others, candidate._replace(fields=fields))


def channels_for(effect: Effect, model: ModelParameters) -> tuple[str, ...]:
    """Return the channels that a log must have to show an effect of a model.

    Rates that follow from torques show a gyro's scale as inertia; attitude tells both apart.
    """
    is_gyro_scale = effect.name == "gyro_scale" and takes_motors(model.effects)
    return (*effect.search.needs, "q") if is_gyro_scale else effect.search.needs


@dataclass(frozen=True, eq=False)
class SearchState:
    """State of a search; every step of the search returns a new one.

    Attributes:
        problem: the rows to learn from, with the noise.
        unobservable: effects that need channels the log lacks.
        refused: effects that vetoes have rejected.
        held: parameters that stay nominal: the log does not show them, or a load stands in their
            place.
        linearization: the last one along everything, kept because slopes are expensive.
    """

    problem: Problem
    unobservable: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    linearization: Linearization | None = None

    @classmethod
    def start(cls, log: FlightLog, problem: Problem) -> "SearchState":
        """Return the state before the search, with a first guess of the noise.

        Args:
            problem: of rows of the log.
        """
        noise = noises.first_guess(problem.chunks, problem.residuals(problem.start[None])[0])
        channels = {*log.channels, *problem.chunks.measured}
        lacking = tuple(
            effect.name
            for effect in SEARCHED
            if not set(channels_for(effect, problem.like)) <= channels
        )
        held = unseen_in_chunks(problem.chunks, problem.like)
        return cls(problem.with_noise(noise), unobservable=lacking, held=held)

    @property
    def base_indices(self) -> list[int]:
        """The indices of the free base parameters.

        Without measured voltages the drain stays nominal: the replay assumes a voltage at every
        row, so that a drop within a step would pass for thrust.
        """
        held_fields = {*self.held}
        if measured_voltage_range(self.problem.chunks) is None:
            held_fields.add(DRAIN)
        return self.problem.parameter_indices(
            [name for name in base_of(self.problem.like) if name not in held_fields]
        )

    @property
    def all_indices(self) -> list[int]:
        """The indices that may become free: of the base, and of all effects' parameters."""
        base = self.base_indices
        others = {
            index
            for candidate in candidates_for(self.problem)
            for index in self.problem.parameter_indices(candidate.fields)
        } - {*base}
        return base + sorted(others)

    def with_noise(self, noise: np.ndarray) -> "SearchState":
        """Return the state with another noise.

        Args:
            noise: as of ``noise.fit_noise``, (6, NUM_AXES).
        """
        return replace(self, problem=self.problem.with_noise(noise))

    def linearized(self, vector: np.ndarray) -> tuple["SearchState", Linearization]:
        """Return the state with a linearization of a model along everything, and this.

        The slopes of a model closer than ``STALE`` are used again.
        """
        problem, last = self.problem, self.linearization
        is_same = last is not None and last.indices == self.all_indices
        if last is not None and is_same and last.distance(vector) <= STALE:
            if last.noise is not problem.noise:
                last = Linearization(problem, last.slopes, last.probes)
            linearization = last.moved(vector)
        else:
            probes = list(
                dict.fromkeys(
                    probe for candidate in candidates_for(problem) for probe in candidate.probes
                )
            )
            at_probes = problem.clipped(
                np.array([probe.placed_in(problem, vector) for probe in probes])
            )
            linearization = Linearization(
                problem, problem.slopes(vector, self.all_indices, at_probes), probes
            )
        return replace(self, linearization=linearization), linearization

    def fitted(
        self,
        candidates: Sequence[Candidate],
        vector: np.ndarray,
        nearby: Linearization | None = None,
        limit: float = np.inf,
    ) -> FittedModel:
        """Return the best fit of the model with these effects.

        Args:
            candidates: the effects.
            vector: where the fit starts.
            nearby: as in ``refine``.
            limit: as in ``refine``.
        """
        effect_indices = [
            index
            for candidate in candidates
            for index in self.problem.parameter_indices(candidate.fields)
        ]
        indices = self.base_indices + effect_indices
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

    Slopes are kept while little is gained: residuals cost a tenth of them.

    Args:
        problem: the rows, with the noise.
        vector: where the fit starts.
        indices: of the parameters that are free.
        nearby: a linearization whose slopes are used at first.
        limit: of the cost; a fit that is above it after ``TRIAL_ROUNDS`` rounds ends there.
    """
    indices = list(indices)
    if nearby is None:
        current = Linearization(problem, problem.slopes(vector, indices))
    else:
        current = nearby.narrowed(indices).moved(vector)
    cost_at_slopes, is_fresh = current.cost, nearby is None
    for round_number in range(MAX_ROUNDS):
        if round_number == TRIAL_ROUNDS and current.cost > limit:
            break
        gain, following = _step(problem, current)
        if gain > 0.0:
            current, is_fresh = following, False
        if gain < MIN_GAIN:
            if is_fresh or cost_at_slopes - current.cost < STALE:
                break
            current = Linearization(problem, problem.slopes(current.vector, indices))
            cost_at_slopes, is_fresh = current.cost, True
    return current.vector, float(current.cost)


def _step(problem: Problem, current: Linearization) -> tuple[float, Linearization]:
    """Return the gain of the best share of a step, and the linearization after it.

    As many shares are tried at once as are replayed at once.
    """
    step, at_once = current.step_inside(), max(NUM_PAIRS // problem.chunks.row.shape[1], 1)
    expected_gain = float(step @ current.score)
    best, gain = current, -np.inf
    for first in range(0, len(STEP_SHARES), at_once):
        shares = STEP_SHARES[first : first + at_once]
        vectors = np.repeat(current.vector[None], len(shares), axis=0)
        vectors[:, current.indices] += shares[:, None] * step
        vectors = problem.clipped(vectors)
        white = problem.whitened_residuals(*vectors)
        costs = compute_costs(problem, vectors, white)
        index = int(np.nanargmin(np.where(np.isfinite(costs), costs, np.inf)))
        if current.cost - costs[index] > gain:
            best, gain = current.moved(vectors[index], white[index]), current.cost - costs[index]
        if gain > PART_OF_PROMISE * expected_gain:
            break
    return gain, best


class Scored(NamedTuple):
    """A candidate and its first-order gain."""

    candidate: Candidate
    gain: Gain

    @property
    def merit(self) -> float:
        """The gain over its inflation, less a price per parameter."""
        return self.gain.robust - PER_PARAMETER * self.gain.num_parameters


def score_candidates(
    state: SearchState, linearization: Linearization, model: FittedModel
) -> list[Scored]:
    """Return the best candidate of each effect that a model lacks, by first-order merit."""
    given = linearization.columns_at(model.indices)
    excluded = {*state.unobservable, *state.refused}
    best: dict[str, Scored] = {}
    for candidate in candidates_for(state.problem):
        is_held = not {*state.held}.isdisjoint(candidate.fields)
        if is_held or candidate.effect in excluded or not model.lacks(candidate):
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
    """Return the model with one more effect, fitted from the first-order estimate.

    An effect with probes is also fitted from these, if the first fit gains much less than expected.

    Args:
        state: of the search.
        linearization: of the model.
        model: to which the effect is added.
        scored: the effect, and its first-order gain.
        limit: as in ``refine``.
    """
    problem, (candidate, gain) = state.problem, scored
    candidates = model.joined_by(candidate)
    if not candidate.probes:
        vector = model.vector.copy()
        vector[problem.parameter_indices(candidate.fields)] += gain.step
        return state.fitted(candidates, problem.clipped(vector), linearization, limit)
    best = state.fitted(candidates, _on_the_way(problem, model, scored), limit=limit)
    if model.cost - best.cost < KEPT_PROMISE * gain.chi2:
        at_probes = model.vector
        for probe, share in zip(candidate.probes, gain.step, strict=False):
            at_probes = probe.placed_in(problem, at_probes) if share > 0.0 else at_probes
        from_probes = state.fitted(candidates, problem.clipped(at_probes), limit=limit)
        best = min(best, from_probes, key=lambda fitted: fitted.cost)
    return best


def _on_the_way(problem: Problem, model: FittedModel, scored: Scored) -> np.ndarray:
    """Return the vector at the best shares of the ways to probes, with all others moved."""
    candidate, gain = scored
    vector = model.vector.copy()
    vector[list(model.indices)] += gain.given_step
    vector[problem.parameter_indices(candidate.other_fields)] += gain.step[len(candidate.probes) :]
    for probe, step in zip(candidate.probes, gain.step, strict=False):
        index = problem.names.index(probe.field)
        share = np.sign(step) * np.clip(np.abs(step), *SHARE_OF_WAY)
        vector[index] += share * (probe.value - vector[index])
    return problem.clipped(vector)


def add_best(
    state: SearchState, linearization: Linearization, model: FittedModel
) -> FittedModel | None:
    """Return the model with the best effect added; None if no effect explains enough."""
    ranked = [
        scored
        for scored in score_candidates(state, linearization, model)
        if scored.gain.robust > PROMISING * threshold(scored.gain.num_parameters)
    ]
    for _ in range(MAX_FAILED_ROUNDS):
        near = [
            scored for scored in ranked[:MAX_REFITTED] if scored.merit > CLOSE * ranked[0].merit
        ]
        best: tuple[float, FittedModel] | None = None
        for scored in near:
            trial = add_effect(state, linearization, model, scored, limit=-np.inf)
            gain = (model.cost - trial.cost) / scored.gain.inflation
            merit = gain - PER_PARAMETER * scored.gain.num_parameters
            if gain > threshold(scored.gain.num_parameters) and (best is None or merit > best[0]):
                best = merit, trial
        if best is not None:
            return best[1]
        ranked = ranked[max(len(near), 1) :]
        if not ranked:
            break
    return None


def add_effects(state: SearchState, model: FittedModel) -> tuple[SearchState, FittedModel]:
    """Add effects while one explains enough, best first; return the same model if none does."""
    while len(model.effects.difference(state.problem.given_effects)) < MAX_EFFECTS:
        state, linearization = state.linearized(model.vector)
        extended_model = add_best(state, linearization, model)
        if extended_model is None:
            break
        model = extended_model
    return state, model


def saturated_residuals(linearization: Linearization) -> np.ndarray:
    """Return the residuals after one step along every effect at once, regularised by the prior.

    Noise is fitted to these, so that a missing effect is not mistaken for noise.
    """
    problem, indices = linearization.problem, linearization.indices
    vectors = np.repeat(linearization.vector[None], len(SATURATED_SHARES), axis=0)
    vectors[:, indices] += SATURATED_SHARES[:, None] * linearization.step(range(len(indices)))
    vectors = problem.clipped(vectors)
    residuals = problem.residuals(vectors)
    return residuals[int(np.nanargmin(compute_costs(problem, vectors, problem.whiten(residuals))))]


def with_refitted_noise(state: SearchState, model: FittedModel) -> tuple[SearchState, FittedModel]:
    """Return the state with the noise fitted beside a model, and the model refitted under it.

    The noise is fitted to the saturated residuals, which lack no effect.
    """
    state, linearization = state.linearized(model.vector)
    residuals = saturated_residuals(linearization)
    state = state.with_noise(noises.fit_noise(state.problem.chunks, residuals, state.problem.noise))
    state, linearization = state.linearized(model.vector)
    return state, state.fitted(model.candidates, model.vector, linearization)


def candidates_of_given(problem: Problem) -> list[Candidate]:
    """Return a candidate of each effect that the given model has, with all that it sets there.

    Settings of the craft are left out: they are searched for one by one. So is an effect of which
    no candidate has all that is set, as a wind that both pushes and moves the air.
    """
    candidates: dict[str, Candidate] = {}
    for candidate in candidates_for(problem):
        effect = BY_NAME[candidate.effect]
        if effect.name not in problem.given_effects or effect.search.is_setting:
            continue
        names = [f"{effect.name}.{field}" for field in effect.ranges]
        starts = dict(zip(names, problem.start[problem.parameter_indices(names)], strict=True))
        is_set = {field for field, start in starts.items() if start != neutral_value(field)}
        if is_set <= {*candidate.fields}:
            candidates.setdefault(effect.name, candidate)
    return list(candidates.values())


def with_given_refitted(
    state: SearchState, base: FittedModel
) -> tuple[SearchState, FittedModel, FittedModel]:
    """Return the state, the base, and the base with the given model's effects refitted.

    A plant without an effect of the given model differs by that effect. A search that adds effects
    first finds one that undoes it, such as a drag that accelerates, and does not leave it again.
    """
    candidates = [
        candidate
        for candidate in candidates_of_given(state.problem)
        if candidate.effect not in state.unobservable and {*state.held}.isdisjoint(candidate.fields)
    ]
    if not candidates:
        return state, base, base
    state, model = with_refitted_noise(state, state.fitted(candidates, base.vector))
    return state, state.fitted((), base.vector), model


def extended(
    state: SearchState, base: FittedModel, model: FittedModel
) -> tuple[SearchState, FittedModel, FittedModel]:
    """Return the state with its noise, the refitted base, and the model with effects added.

    Noise and effects are fitted in turns: a large effect hides small ones while its remainder is
    taken for noise.
    """
    while True:
        state, extended_model = add_effects(state, model)
        if extended_model is model:
            return state, base, model
        state, model = with_refitted_noise(state, extended_model)
        base = state.fitted((), base.vector)
