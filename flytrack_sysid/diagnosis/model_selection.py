"""Select effects: drop those not needed, swap rivals, and replace base changes by one effect."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from flytrack_env.dynamics import collective_thrust
from flytrack_env.effects import BY_NAME
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.score_test import (
    BASE_CAUSES,
    Candidate,
    Linearization,
    candidates_for,
    inflation_of,
    solve,
    threshold,
)
from flytrack_sysid.diagnosis.search import (
    MAX_REFITTED,
    PER_PARAMETER,
    FittedModel,
    HeldParameter,
    SearchState,
    add_effect,
    score_candidates,
)
from flytrack_sysid.parameters import TAUS, THRUST_COEFFS

EQUIVALENT = 10.0  # of chi2: a rival that explains so nearly as much cannot be told apart
# of chi2: where less than EQUIVALENT is expected, it hardly ever is as much
EQUIVALENT_BY_CHANCE = 30.0
MAX_RIVALS = 3
# Rivals are refitted where first order says that they come within so much chi2, or within a share
# of the gain: first order is less exact for large changes, and least for effects that are looked
# for at probes.
NEARLY, NEAR_SHARE, PROBE_SHARE = 60.0, 0.15, 0.25
CLEARLY_CHEAPER = 0.5  # of cost and price: swaps for less would go back and forth
IMMATERIAL = 0.01  # of a lag or a drain
IMMATERIAL_THRUST = 0.003  # of the weight, rms over what was flown
HOPELESS = 0.01  # of the cost, above the limit to first order: not worth a fit


class Ablation(NamedTuple):
    """One effect of a model against doing without it and against its rivals.

    gain: of chi2 over the model without it, refitted. inflation: of that gain's variance.
    num_parameters: of its parameters, those that the log determines. rivals: effect -> how much
    worse the model is with that one instead, of chi2; the better ones are refitted, and those are
    in ``swaps``, with the effect itself in another group of its parameters. without: the model
    without the effect.
    """

    gain: float
    inflation: float
    num_parameters: int
    rivals: Mapping[str, float]
    swaps: Mapping[str, FittedModel]
    without: FittedModel

    @property
    def robust(self) -> float:
        """The gain over its inflation."""
        return self.gain / self.inflation

    @property
    def margin(self) -> float:
        """By how much the gain exceeds what chance brings about."""
        return self.robust - threshold(self.num_parameters)


def without_effect(state: SearchState, model: FittedModel, effect: str) -> FittedModel:
    """Return the model without an effect, refitted."""
    vector = state.problem.at_start(model.vector, model.candidate(effect).fields)
    return state.fitted([one for one in model.candidates if one.effect != effect], vector)


def ablate(
    state: SearchState, model: FittedModel, linearization: Linearization, effect: str
) -> Ablation:
    """Return what an effect of a model is worth, without rivals.

    linearization: of the model, along everything.
    """
    less = without_effect(state, model, effect)
    columns = [linearization.column(field) for field in model.candidate(effect).fields]
    own = linearization.gain(columns, linearization.columns_at(model.indices, without=columns))
    inflation, determined = (1.0, 1) if own is None else (own.inflation, own.num_parameters)
    return Ablation(less.cost - model.cost, inflation, determined, {}, {}, less)


def ablate_all(
    state: SearchState, model: FittedModel, linearization: Linearization
) -> dict[str, Ablation]:
    """Return what every effect of a model is worth, and its rivals in its place."""
    alone = [ablate(state, model, linearization, one.effect) for one in model.candidates]
    return with_rivals(state, model, linearization, alone)


def with_rivals(
    state: SearchState,
    model: FittedModel,
    linearization: Linearization,
    ablations: Sequence[Ablation],
) -> dict[str, Ablation]:
    """Return ablations, in the order of the model's effects, with their rivals, by effect."""
    effects = (one.effect for one in model.candidates)
    return {
        effect: _with_rivals(state, model, linearization, effect, one)
        for effect, one in zip(effects, ablations, strict=True)
    }


def _with_rivals(
    state: SearchState,
    model: FittedModel,
    linearization: Linearization,
    effect: str,
    ablation: Ablation,
) -> Ablation:
    """Return the ablation of an effect with what its rivals are worth in its place."""
    less, gain, limit = ablation.without, ablation.gain, model.cost + NEARLY
    # Slopes with the effect serve without it: rivals that come near are refitted.
    nearby = linearization.moved(less.vector)
    rivals: dict[str, float] = {}
    swaps: dict[str, FittedModel] = {}
    ranked = [
        one for one in score_candidates(state, nearby, less) if one.candidate.effect != effect
    ]
    for number, one in enumerate(ranked):
        rival = one.candidate.effect
        rivals[rival] = gain - one.gain.chi2
        share = PROBE_SHARE if one.candidate.probes else NEAR_SHARE
        if number < MAX_RIVALS and rivals[rival] < max(NEARLY, share * gain):
            swaps[rival] = add_effect(state, nearby, less, one, limit)
            rivals[rival] = swaps[rival].cost - model.cost
    # Without the effect the rest may have moved so far that slopes say nothing of a rival like it.
    beside = separation(linearization, model, effect).beside
    for one in ranked:
        rival = one.candidate.effect
        if rival not in swaps and beside.get(rival, np.inf) < EQUIVALENT:
            swaps[rival] = with_candidate(state, model, effect, one.candidate, limit)
            rivals[rival] = swaps[rival].cost - model.cost
    for other in other_groups(linearization, model, effect):
        swaps[effect] = min(
            with_candidate(state, model, effect, other, limit),
            swaps.get(effect, model),
            key=price,
        )
    return ablation._replace(rivals=rivals, swaps=swaps)


def with_candidate(
    state: SearchState, model: FittedModel, effect: str, other: Candidate, limit: float
) -> FittedModel:
    """Return the model with a candidate in an effect's place, refitted from where it is.

    limit: as in ``search.refine``.
    """
    candidates = [other if one.effect == effect else one for one in model.candidates]
    dropped = {*model.candidate(effect).fields} - {*other.fields}
    vector = state.problem.at_start(model.vector, sorted(dropped))
    return state.fitted(candidates, vector, limit=limit)


def other_groups(linearization: Linearization, model: FittedModel, effect: str) -> list[Candidate]:
    """Return an effect with more, fewer or other parameters that are cheaper to first order.

    Others are included if they gain something beside the effect's own.
    """
    problem, now = linearization.problem, model.candidate(effect)
    own, result = set(now.fields), []
    ways = {one.fields: one for one in candidates_for(problem) if one.effect == effect}
    less = [tuple(field for field in now.fields if field not in group) for group in now.groups]
    ways |= {fields: now._replace(fields=fields) for fields in less if fields}
    for candidate in ways.values():
        more = {*candidate.fields} - own
        changed = sorted(more or own - {*candidate.fields})
        columns = [linearization.column(field) for field in changed]
        given = linearization.columns_at(model.indices, without=columns)
        price = PER_PARAMETER * len(changed)
        if not more:
            size = (model.vector - problem.start)[problem.indices_of(changed)]
            is_cheaper = size @ linearization.projected(columns, given)[0] @ size < price
        else:
            gain = linearization.gain(columns, given)
            is_cheaper = gain is not None and gain.robust > price
        if is_cheaper:
            result.append(candidate)
    return result


def select_effects(
    state: SearchState, model: FittedModel
) -> tuple[SearchState, FittedModel, dict[str, Ablation]]:
    """Return the model with unneeded effects removed and better ones swapped in, and ablations."""
    while True:
        state, linearization = state.linearized(model.vector)
        alone = [ablate(state, model, linearization, one.effect) for one in model.candidates]
        weakest = min(alone, key=lambda one: one.margin, default=None)
        if weakest is not None and weakest.margin < 0.0:
            model = weakest.without
            continue
        ablations = with_rivals(state, model, linearization, alone)
        swaps = [swap for one in ablations.values() for swap in one.swaps.values()]
        best = min((*swaps, *with_lags_anew(state, model)), key=price, default=model)
        if price(best) >= price(model) - CLEARLY_CHEAPER:
            return state, model, ablations
        model = best


def with_lags_anew(state: SearchState, model: FittedModel) -> list[FittedModel]:
    """Return the model fitted again from nominal lags if any ended where it is shortest.

    There a lag has no slope that would lead back.
    """
    problem, vector = state.problem, model.vector.copy()
    shortest = [index for index in problem.indices_of(TAUS) if vector[index] <= problem.low[index]]
    shortest = [
        index
        for index in shortest
        if index in model.indices and problem.start[index] > vector[index]
    ]
    if not shortest:
        return []
    vector[shortest] = problem.start[shortest]
    return [state.fitted(model.candidates, vector)]


def price(model: FittedModel) -> float:
    """Return a model's cost and the price of its effects."""
    return model.cost + PER_PARAMETER * model.num_priced


class Separation(NamedTuple):
    """An effect's noncentrality lambda, and what is left of it beside each rival, to first order.

    lambda: squared norm of its signature with all else that is free projected out.
    """

    noncentrality: float
    beside: Mapping[str, float]


def separation(linearization: Linearization, model: FittedModel, effect: str) -> Separation:
    """Return how clearly a log shows an effect of a model, and tells it from others."""
    problem, own = linearization.problem, model.candidate(effect)
    columns = [linearization.column(field) for field in own.fields]
    size = (model.vector - problem.start)[problem.indices_of(own.fields)]
    given = linearization.columns_at(model.indices, without=columns)

    def beside(others: list[int]) -> float:
        return float(size @ linearization.projected(columns, others)[0] @ size)

    rivals: dict[str, float] = {}
    for candidate in candidates_for(problem):
        if candidate.effect not in model.effects:
            left = beside(given + linearization.acting(linearization.columns_of(candidate)))
            rivals[candidate.effect] = min(left, rivals.get(candidate.effect, np.inf))
    return Separation(beside(given), rivals)


def equivalents(ablation: Ablation, own: Separation) -> tuple[str, ...]:
    """Return rivals that a log cannot tell from an effect: equal fit, or a difference by chance."""

    def is_equivalent(rival: str, worse: float) -> bool:
        is_lost = own.beside.get(rival, own.noncentrality) < EQUIVALENT
        return worse < EQUIVALENT or (is_lost and worse < EQUIVALENT_BY_CHANCE)

    ranked = sorted(ablation.rivals.items(), key=lambda pair: pair[1])
    return tuple(
        rival for rival, worse in ranked if rival in ablation.swaps and is_equivalent(rival, worse)
    )


class Marginal:
    """Information about some free parameters of a model, all others fitted along with them."""

    def __init__(self, linearization: Linearization, model: FittedModel, fields: Sequence[str]):
        columns = [linearization.column(field) for field in fields]
        given = linearization.columns_at(model.indices, without=columns)
        self.information, share = linearization.projected(columns, given)
        blocks = linearization.score_by_block
        self.scores = blocks[:, columns] - blocks[:, given] @ share
        self.inflation = inflation_of(self.information, self.scores)

    def covariance(self) -> np.ndarray:
        """Return the parameters' covariance, that of the information times its inflation."""
        return self.inflation * solve(self.information, np.eye(len(self.information)))

    def half_widths(self, ways: np.ndarray | None = None) -> np.ndarray:
        """Return half of each parameter's 95 % interval, or of weighted sums of parameters.

        ways: the weights of the sums, (num_sums, parameters).

        Its standard deviation is that of the information or, where it is larger, the sandwich
        estimate from the scores of blocks; Student's t for so many blocks.
        """
        ways = np.eye(len(self.information)) if ways is None else ways
        covariance = solve(self.information, ways.T).T
        used = self.scores[np.abs(self.scores).sum(axis=1) > 0.0]
        number = max(len(used), 2)
        spread = used.T @ used * number / (number - 1)
        variance = np.maximum(
            np.diag(covariance @ ways.T), np.diag(covariance @ spread @ covariance.T)
        )
        return np.sqrt(variance) * stats.t.ppf(0.975, number - 1)


class BaseChange(NamedTuple):
    """Base parameters that differ from nominal: names, information, chi2 of the difference."""

    fields: list[str]
    marginal: Marginal
    gain: float


def _is_immaterial(problem: Problem, fields: Sequence[str], model: FittedModel) -> bool:
    """Return whether a lag, drain or thrust curve differs by too little to matter.

    Rounding causes differences as large.
    """
    indices = problem.indices_of(fields)
    change = model.vector[indices] - problem.start[indices]
    if fields != THRUST_COEFFS:
        return bool(np.all(np.abs(change) < IMMATERIAL * np.abs(problem.start[indices])))
    record = problem.chunks.record
    thrust = np.asarray(collective_thrust(record.command[..., 3], record.battery_v, change))
    weight = float(problem.like.m) * float(problem.like.g)
    return (
        float(np.sqrt(np.mean(thrust[problem.counts.any(axis=(2, 3))] ** 2)))
        < IMMATERIAL_THRUST * weight
    )


def base_change(
    state: SearchState, linearization: Linearization, model: FittedModel, fields: Sequence[str]
) -> BaseChange | None:
    """Return how the log contradicts nominal base parameters; None where it hardly does."""
    problem, free = state.problem, set(state.base_indices)
    acting = [
        field
        for field, index in zip(fields, problem.indices_of(fields), strict=True)
        if index in free and linearization.acting([linearization.column(field)])
    ]
    if not acting or _is_immaterial(problem, fields, model):
        return None
    indices = problem.indices_of(acting)
    marginal = Marginal(linearization, model, acting)
    change = model.vector[indices] - problem.start[indices]
    gain = float(change @ marginal.information @ change)
    if gain / marginal.inflation < threshold(len(acting)):
        return None
    return BaseChange(acting, marginal, gain)


def base_changes(
    state: SearchState, linearization: Linearization, model: FittedModel
) -> dict[str, BaseChange]:
    """Return the causes of the base that the log shows, by name."""
    found = {
        name: base_change(state, linearization, model, fields)
        for name, fields in BASE_CAUSES.items()
    }
    return {name: one for name, one in found.items() if one is not None}


def explain_base_by_effect(
    state: SearchState, model: FittedModel
) -> tuple[SearchState, FittedModel | None]:
    """Return a model with one more effect and nominal base parameters, if it explains as much.

    A delay of all commands, say, looks like four longer lags.
    """
    state, linearization = state.linearized(model.vector)
    changes = base_changes(state, linearization, model).values()
    changed = tuple(field for one in changes for field in one.fields)
    lags = tuple(field for field in changed if field in TAUS)
    for fields in dict.fromkeys((changed, lags)):
        if fields:
            state, simpler = _best_instead(state, model, fields)
            if simpler is not None:
                return state, simpler
    return state, None


def _best_instead(
    state: SearchState, model: FittedModel, fields: Sequence[str]
) -> tuple[SearchState, FittedModel | None]:
    """Return the best model with base parameters held and at most one more effect, if better."""
    given, problem, held = state, state.problem, state.held
    state = replace(state, held=(*held, *(HeldParameter(field, "") for field in fields)))
    less = state.fitted(model.candidates, problem.at_start(model.vector, fields))
    state, nearby = state.linearized(less.vector)
    limit = model.cost + PER_PARAMETER * len(fields)
    best = less if less.cost < limit else None
    for one in score_candidates(state, nearby, less)[:MAX_REFITTED]:
        hopeless = limit + less.cost * HOPELESS
        if less.cost - one.gain.chi2 > hopeless and not one.candidate.probes:
            continue
        trial = add_effect(state, nearby, less, one, hopeless)
        cost = trial.cost + PER_PARAMETER * one.candidate.num_priced
        if cost < limit:
            state, determined = is_determined(state, trial, one.candidate.fields)
            best, limit = (trial, cost) if determined else (best, limit)
    if best is None:
        return given, None  # and its slopes, of the model without anything held
    effect = "".join(one.effect for one in best.candidates if one not in model.candidates)
    return replace(state, held=(*held, *(HeldParameter(field, effect) for field in fields))), best


def is_determined(
    state: SearchState, model: FittedModel, fields: Sequence[str]
) -> tuple[SearchState, bool]:
    """Return whether the log shows that some parameter of an effect is not neutral."""
    problem = state.problem
    indices = problem.indices_of(fields)
    change = np.abs(model.vector[indices] - problem.start[indices])
    acting = [
        field.split(".")[1] not in BY_NAME[field.split(".")[0]].search.shapes for field in fields
    ]
    state, linearization = state.linearized(model.vector)
    half_widths = Marginal(linearization, model, fields).half_widths()
    return state, bool(np.any((change > half_widths) & acting))
