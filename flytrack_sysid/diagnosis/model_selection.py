"""Select effects: drop unneeded ones, and swap rivals in that explain more."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import stats

from flytrack_env.dynamics import collective_thrust
from flytrack_env.effects import takes_motors
from flytrack_sysid.diagnosis.result import TWO_SIDED_95
from flytrack_sysid.inference.parameters import TAUS, THRUST_COEFFS, range_of
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.score_test import (
    ALL_BASE_CAUSES,
    CANDIDATES,
    Candidate,
    Linearization,
    candidates_for,
    estimate_inflation,
    solve,
    threshold,
)
from flytrack_sysid.inference.search import (
    PER_PARAMETER,
    FittedModel,
    SearchState,
    add_effect,
    score_candidates,
)

EQUIVALENT = 10.0  # of chi2: a rival that explains less by no more than this cannot be told apart
# Of chi2: where a difference below EQUIVALENT is expected, chance hardly ever makes it this large.
EQUIVALENT_BY_CHANCE = 30.0
MAX_RIVALS = 3  # of an effect that are refitted
# Rivals are refitted where first order puts them within NEARLY of chi2, or within a share of the
# gain: first order is less exact for large changes, and least exact for effects with probes.
NEARLY, NEAR_SHARE, PROBE_SHARE = 60.0, 0.15, 0.25
DRAGS = ("linear_drag", "quadratic_drag")  # laws of a force of the air, which a wind moves
MOVING_AIR = next(one for one in CANDIDATES if one.effect == "wind" and "wind.v_x" in one.fields)
# Of a craft whose motors are commanded.
LOAD_EFFECT, LOAD = "motors", ("motors.load",)
THRUST_AND_INERTIA = (*THRUST_COEFFS, *(f"motors.radius_{axis}" for axis in "xyz"))
MIN_BLOCKS = 3.0  # that tell of a parameter, effectively: Student's t of fewer is unbounded
AT_BOUND_S = 1e-6  # of a lag: a fit may come ever nearer to a bound and never touch it
CLEARLY_CHEAPER = 0.5  # of cost and price: swaps that save less would go back and forth


class Ablation(NamedTuple):
    """One effect of a model, compared with the model without it and with its rivals.

    Attributes:
        gain: of chi2 over the model without the effect, refitted.
        inflation: of that gain's variance.
        num_parameters: of its parameters, those that the log determines.
        rivals: effect -> how much worse (chi2) the model is with that one instead.
        swaps: effect -> the refitted model with that one instead, of the better rivals.
        without: the refitted model without the effect.
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
        """The robust gain less the gain that chance would reach."""
        return self.robust - threshold(self.num_parameters)


def without_effect(
    state: SearchState, model: FittedModel, effect: str, nearby: Linearization | None = None
) -> FittedModel:
    """Return the model without an effect, refitted.

    Args:
        state: of the search.
        model: with the effect.
        effect: its name.
        nearby: as in ``search.refine``.
    """
    vector = state.problem.at_start(model.vector, model.candidate(effect).fields)
    remaining = [candidate for candidate in model.candidates if candidate.effect != effect]
    return state.fitted(remaining, vector, nearby)


def ablate(
    state: SearchState, model: FittedModel, linearization: Linearization, effect: str
) -> Ablation:
    """Return the ablation of an effect of a model, without rivals.

    Args:
        state: of the search.
        model: with the effect.
        linearization: of the model, along everything.
        effect: its name.
    """
    reduced = without_effect(state, model, effect, linearization)
    columns = [linearization.column(field) for field in model.candidate(effect).fields]
    effect_gain = linearization.gain(
        columns, linearization.columns_at(model.indices, without=columns)
    )
    inflation, determined = (
        (1.0, 1) if effect_gain is None else (effect_gain.inflation, effect_gain.num_parameters)
    )
    return Ablation(reduced.cost - model.cost, inflation, determined, {}, {}, reduced)


def ablate_all(
    state: SearchState, model: FittedModel, linearization: Linearization
) -> dict[str, Ablation]:
    """Return the ablation of every effect of a model, with its rivals."""
    ablations = [
        ablate(state, model, linearization, candidate.effect) for candidate in model.candidates
    ]
    return with_rivals(state, model, linearization, ablations)


def with_rivals(
    state: SearchState,
    model: FittedModel,
    linearization: Linearization,
    ablations: Sequence[Ablation],
) -> dict[str, Ablation]:
    """Return ablations with their rivals, by effect.

    Args:
        state: of the search.
        model: with the effects.
        linearization: of the model, along everything.
        ablations: without rivals, in the order of the model's effects.
    """
    return {
        one.effect: _with_rivals(state, model, linearization, one.effect, ablation)
        for one, ablation in zip(model.candidates, ablations, strict=True)
    }


def _with_rivals(
    state: SearchState,
    model: FittedModel,
    linearization: Linearization,
    effect: str,
    ablation: Ablation,
) -> Ablation:
    """Return the ablation of an effect with the models that have its rivals instead."""
    reduced, gain, limit = ablation.without, ablation.gain, model.cost + NEARLY
    # Slopes of the model with the effect are good enough without it: near rivals are refitted.
    nearby = linearization.moved(reduced.vector)
    rivals: dict[str, float] = {}
    swaps: dict[str, FittedModel] = {}
    ranked = [
        scored
        for scored in score_candidates(state, nearby, reduced)
        if scored.candidate.effect != effect
    ]
    for number, scored in enumerate(ranked):
        rival = scored.candidate.effect
        rivals[rival] = gain - scored.gain.chi2
        share = PROBE_SHARE if scored.candidate.probes else NEAR_SHARE
        if number < MAX_RIVALS and rivals[rival] < max(NEARLY, share * gain):
            swaps[rival] = add_effect(state, nearby, reduced, scored, limit)
            rivals[rival] = swaps[rival].cost - model.cost
    # Without the effect, the other parameters may have moved so far that slopes do not show a rival
    # like it.
    beside = separation(linearization, model, effect).beside
    for scored in ranked:
        rival = scored.candidate.effect
        if rival not in swaps and beside.get(rival, np.inf) < EQUIVALENT:
            swaps[rival] = with_candidate(state, model, effect, scored.candidate, limit)
            rivals[rival] = swaps[rival].cost - model.cost
    return ablation._replace(rivals=rivals, swaps=swaps)


def with_candidate(
    state: SearchState, model: FittedModel, effect: str, other: Candidate, limit: float
) -> FittedModel:
    """Return the model with a candidate instead of an effect, refitted from the model's vector.

    Args:
        state: of the search.
        model: with the effect.
        effect: to replace.
        other: the candidate.
        limit: as in ``search.refine``.
    """
    candidates = [
        other if candidate.effect == effect else candidate for candidate in model.candidates
    ]
    dropped = {*model.candidate(effect).fields} - {*other.fields}
    vector = state.problem.at_start(model.vector, sorted(dropped))
    return state.fitted(candidates, vector, limit=limit)


def select_effects(
    state: SearchState, model: FittedModel
) -> tuple[SearchState, FittedModel, dict[str, Ablation]]:
    """Return the model with unneeded effects removed and better ones swapped in, and ablations."""
    while True:
        state, linearization = state.linearized(model.vector)
        effects = [candidate.effect for candidate in model.candidates]
        ablated: dict[str, Ablation] = {}
        # The weakest to first order comes first: mostly it is the only one that is not needed.
        for effect in sorted(effects, key=partial(noncentrality, linearization, model)):
            ablated[effect] = ablate(state, model, linearization, effect)
            if ablated[effect].margin < 0.0:
                break
        unneeded = [one for one in ablated.values() if one.margin < 0.0]
        if unneeded:
            model = unneeded[0].without
            continue
        ablations = with_rivals(
            state, model, linearization, [ablated[effect] for effect in effects]
        )
        swaps = [swap for one in ablations.values() for swap in one.swaps.values()]
        near = (*swaps, *with_one_less(state, linearization, model, swaps))
        best = min(near, key=price, default=model)
        if not is_cheaper(best, model):  # fits from other starts take long
            far = (*with_lags_anew(state, model), *with_moving_air(state, model))
            best = min(far, key=price, default=model)
        if not is_cheaper(best, model):
            return state, model, ablations
        model = best


def is_cheaper(model: FittedModel, other: FittedModel) -> bool:
    """Return whether a model costs clearly less than another, with the price of its parameters."""
    return price(model) < price(other) - CLEARLY_CHEAPER


def with_one_less(
    state: SearchState,
    linearization: Linearization,
    model: FittedModel,
    swaps: Sequence[FittedModel],
) -> list[FittedModel]:
    """Return models that have one effect less than a swap as likely as the model.

    Two effects may do what one rival does alone. A swap of either is no likelier then, and beside
    the rival the other one hardly shows.

    Args:
        state: of the search.
        linearization: of the model, along everything.
        model: with the effects.
        swaps: refitted models with a rival instead of an effect.
    """
    trials = []
    for swap in swaps:
        if swap.cost >= model.cost + EQUIVALENT:
            continue
        nearby = linearization.moved(swap.vector)
        trials += [
            without_effect(state, swap, kept.effect, nearby)
            for kept in swap.candidates
            if kept.effect in model.effects
            and noncentrality(nearby, swap, kept.effect) < threshold(len(kept.fields))
        ]
    return trials


def with_lags_anew(state: SearchState, model: FittedModel) -> list[FittedModel]:
    """Return the model refitted from other lags, if any lag ended at its lower bound.

    There a lag has no slope that leads back. Lags of the base start anew from nominal, a time of an
    effect from the mean of the effect's other times.
    """
    problem, vector = state.problem, model.vector.copy()
    is_lowest = vector - problem.low <= AT_BOUND_S
    starts = {index: problem.start[index] for index in problem.parameter_indices(TAUS)}
    for candidate in model.candidates:
        times = [one.field for one in candidate.probes if range_of(one.field).unit == "s"]
        lags = problem.parameter_indices(times)
        others = [vector[index] for index in lags if not is_lowest[index]]
        starts |= dict.fromkeys(lags, np.mean(others)) if others else {}
    stuck = [
        index
        for index, value in starts.items()
        if index in model.indices and is_lowest[index] and value > vector[index]
    ]
    if not stuck:
        return []
    vector[stuck] = [starts[index] for index in stuck]
    return [state.fitted(model.candidates, vector)]


def with_moving_air(state: SearchState, model: FittedModel) -> list[FittedModel]:
    """Return a model of drag and a steady push, refitted with each law of drag and moving air.

    Without drag a wind is a push, and where it is found first it stays one. Beside the wrong law of
    drag that is a local minimum: neither the law nor the wind can be swapped alone.
    """
    by_name = {candidate.effect: candidate for candidate in model.candidates}
    is_push = "wind" in by_name and by_name["wind"].fields != MOVING_AIR.fields
    if not is_push or by_name.keys().isdisjoint(DRAGS):
        return []
    rest = [one for one in model.candidates if one.effect not in ("wind", *DRAGS)]
    gone = [field for one in model.candidates if one not in rest for field in one.fields]
    reduced = state.fitted(rest, state.problem.at_start(model.vector, gone))
    state, linearization = state.linearized(reduced.vector)
    still = [
        add_effect(state, linearization, reduced, scored)
        for scored in score_candidates(state, linearization, reduced)
        if scored.candidate.effect in DRAGS
    ]
    return [state.fitted(one.joined_by(MOVING_AIR), one.vector) for one in still]


def held_for_load(state: SearchState, model: FittedModel) -> tuple[SearchState, FittedModel] | None:
    """Return a state and a model with a load in place of other thrust and inertia, if as likely.

    A load at the centre of mass is exactly a smaller thrust with smaller inertias. These are free
    in the base, so that the load alone gains nothing beside them. They are held at nominal then.

    Args:
        state: of the search, of a craft whose motors are commanded.
        model: of its effects.
    """
    problem = state.problem
    load = next(one for one in candidates_for(problem) if one.fields == LOAD)
    is_held = not {*THRUST_AND_INERTIA}.isdisjoint(state.held)  # loaded, or a torque is not seen
    if is_held or LOAD_EFFECT in state.refused or not model.lacks(load):
        return None
    state, linearization = state.linearized(model.vector)
    changed = [one.fields for one in base_changes(state, linearization, model).values()]
    if sum(not {*THRUST_AND_INERTIA}.isdisjoint(fields) for fields in changed) < 2:
        return None
    thrust = [
        commanded_thrust(problem, one[problem.parameter_indices(THRUST_COEFFS)]).sum()
        for one in (problem.start, model.vector)
    ]
    if min(thrust) <= 0.0:
        return None
    held = replace(state, held=(*state.held, *THRUST_AND_INERTIA), linearization=None)
    vector = problem.at_start(model.vector, THRUST_AND_INERTIA)
    vector[problem.parameter_indices(LOAD)] = thrust[0] / thrust[1] - 1.0
    loaded = held.fitted(model.joined_by(load), problem.clipped(vector))
    limit = model.cost + PER_PARAMETER * len(THRUST_AND_INERTIA)
    return (held, loaded) if loaded.cost < limit else None


def has_load(model: FittedModel) -> bool:
    """Return whether a model has a load."""
    return any({*LOAD} <= {*candidate.fields} for candidate in model.candidates)


def price(model: FittedModel) -> float:
    """Return a model's cost and the price of its effects."""
    return model.cost + PER_PARAMETER * model.num_priced


class Separation(NamedTuple):
    """How clearly a log shows an effect, to first order.

    Attributes:
        noncentrality: lambda, the squared norm of the effect's signature with all other free
            parameters projected out.
        beside: rival -> what is left of the noncentrality with that rival projected out, too.
    """

    noncentrality: float
    beside: Mapping[str, float]


def noncentrality(
    linearization: Linearization, model: FittedModel, effect: str, beside: Sequence[int] = ()
) -> float:
    """Return lambda of ``Separation`` of an effect, with further columns projected out, too."""
    problem, fields = linearization.problem, model.candidate(effect).fields
    columns = [linearization.column(field) for field in fields]
    size = (model.vector - problem.start)[problem.parameter_indices(fields)]
    given = linearization.columns_at(model.indices, without=columns)
    return float(size @ linearization.projected(columns, [*given, *beside])[0] @ size)


def separation(linearization: Linearization, model: FittedModel, effect: str) -> Separation:
    """Return how clearly a log shows an effect of a model, alone and beside its rivals."""
    rivals: dict[str, float] = {}
    for candidate in candidates_for(linearization.problem):
        if candidate.effect not in model.effects:
            columns = linearization.acting(linearization.columns_of(candidate))
            left = noncentrality(linearization, model, effect, columns)
            rivals[candidate.effect] = min(left, rivals.get(candidate.effect, np.inf))
    return Separation(noncentrality(linearization, model, effect), rivals)


def equivalents(ablation: Ablation, effect_separation: Separation) -> tuple[str, ...]:
    """Return rivals that a log cannot tell from an effect: equal fit, or a difference by chance."""

    def is_equivalent(rival: str, worse: float) -> bool:
        is_hidden = (
            effect_separation.beside.get(rival, effect_separation.noncentrality) < EQUIVALENT
        )
        return worse < EQUIVALENT or (is_hidden and worse < EQUIVALENT_BY_CHANCE)

    ranked = sorted(ablation.rivals.items(), key=lambda item: item[1])
    return tuple(
        rival for rival, worse in ranked if rival in ablation.swaps and is_equivalent(rival, worse)
    )


class Marginal:
    """Information about some free parameters of a model, all others fitted along with them."""

    def __init__(self, linearization: Linearization, model: FittedModel, fields: Sequence[str]):
        columns = [linearization.column(field) for field in fields]
        given = linearization.columns_at(model.indices, without=columns)
        self.information, share = linearization.projected(columns, given)
        kept, projection = [*columns, *given], np.vstack([np.eye(len(columns)), -share])
        self.scores = linearization.score_by_block[:, kept] @ projection
        blocks = linearization.by_block[:, kept][:, :, kept]
        self.by_block = projection.T @ blocks @ projection
        self.inflation = estimate_inflation(self.information, self.scores)

    def covariance(self) -> np.ndarray:
        """Return the parameters' covariance, that of the information times its inflation."""
        return self.inflation * solve(self.information, np.eye(len(self.information)))

    def half_widths(self, weights: np.ndarray | None = None) -> np.ndarray:
        """Return half of each parameter's 95 % interval, or of weighted sums of parameters.

        The interval is that of ``covariance`` or, if wider, that of the sandwich estimate from the
        scores of blocks. Blocks differ in what they tell of a parameter: the sandwich is corrected
        for that, and its interval is of Student's t with Satterthwaite's degrees of freedom (R.
        Bell and D. McCaffrey, Survey Methodology 28, 2002).

        Args:
            weights: of the sums, (num_sums, parameters); each parameter by itself if None.
        """
        weights = np.eye(len(self.information)) if weights is None else weights
        influence = solve(self.information, weights.T)
        told = np.einsum("ps,bpq,qs->bs", influence, self.by_block, influence, optimize=True)
        told = np.maximum(told, 0.0)  # rounding
        share = told / np.maximum(told.sum(axis=0), 1e-300)
        num_blocks = np.maximum(1.0 / np.maximum(np.square(share).sum(axis=0), 1e-9), MIN_BLOCKS)
        spread = np.square(self.scores @ influence).sum(axis=0) * num_blocks / (num_blocks - 1.0)
        variance = self.inflation * np.einsum("sp,ps->s", weights, influence)
        of_blocks = np.sqrt(spread) * stats.t.ppf(0.975, num_blocks - 1.0)
        return np.asarray(np.maximum(np.sqrt(variance) * TWO_SIDED_95, of_blocks))


class BaseChange(NamedTuple):
    """Base parameters that differ from nominal.

    Attributes:
        fields: their names.
        marginal: the information about them.
        gain: chi2 of the difference.
    """

    fields: list[str]
    marginal: Marginal
    gain: float


def commanded_thrust(problem: Problem, coefficients: np.ndarray) -> np.ndarray:
    """Return the steady thrust of the commands by a thrust map, (rows, chunks) N."""
    record = problem.chunks.record
    num_sticks = 0 if takes_motors(problem.like.effects) else 3
    actions, volts = record.command[..., num_sticks:], record.battery_v[..., None]
    return np.asarray(collective_thrust(actions, volts, coefficients)).mean(axis=-1)


def thrust_over_weight(problem: Problem, coefficients: np.ndarray) -> float:
    """Return the rms over scored rows of a thrust map, as a share of the weight."""
    is_scored = problem.counts.any(axis=(2, 3))
    thrust = commanded_thrust(problem, coefficients)
    weight = float(problem.like.m) * float(problem.like.g)
    return float(np.sqrt(np.mean(thrust[is_scored] ** 2))) / weight


def base_change(
    state: SearchState, linearization: Linearization, model: FittedModel, fields: Sequence[str]
) -> BaseChange | None:
    """Return how the log contradicts nominal base parameters; None unless it clearly does."""
    problem, free = state.problem, set(state.base_indices)
    acting = [
        field
        for field, index in zip(fields, problem.parameter_indices(fields), strict=True)
        if index in free and linearization.acting([linearization.column(field)])
    ]
    if not acting:
        return None
    indices = problem.parameter_indices(acting)
    marginal = Marginal(linearization, model, acting)
    change = model.vector[indices] - problem.start[indices]
    gain = float(change @ marginal.information @ change)
    if gain / marginal.inflation < threshold(len(acting)):
        return None
    return BaseChange(acting, marginal, gain)


def base_changes(
    state: SearchState, linearization: Linearization, model: FittedModel
) -> dict[str, BaseChange]:
    """Return the changes of the base that the log shows, by name of the cause."""
    changes = {
        name: base_change(state, linearization, model, fields)
        for name, fields in ALL_BASE_CAUSES.items()
        if set(fields) <= set(state.problem.names)
    }
    return {name: change for name, change in changes.items() if change is not None}
