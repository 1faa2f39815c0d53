"""Whether each effect of a model is needed, and what could stand in its place."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from flytrack_sysid.diagnosis.candidates import CANDIDATES
from flytrack_sysid.diagnosis.linear import Outlook, solve
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.search import (
    PER_PARAMETER,
    Found,
    fitted,
    full_outlook,
    scores,
    threshold,
    with_effect,
)

SAME = 10.0  # of chi2: a rival that explains so nearly as much cannot be told apart
MOST_RIVALS = 3
NEARLY = 60.0  # of chi2, to first order: rivals that come so near are refitted
NEAR_SHARE = 0.15  # of the gain: a large change is not one of first order
PROBE_SHARE = 0.25  # of the gain: first order says less of what is looked for at probes


class Weighed(NamedTuple):
    """One effect of a model against doing without it and against its rivals.

    gain: of chi2 over the model without it, refitted. inflation: of that gain's variance. count: of its
    parameters, those that the log says something of. rivals: effect ->
    how much worse the model is with that one instead, of chi2; the better ones are refitted.
    swaps: models with the rival in the effect's place, refitted. less: the model without the effect.
    """

    gain: float
    inflation: float
    count: int
    rivals: Mapping[str, float]
    swaps: Mapping[str, Found]
    less: Found

    @property
    def robust(self) -> float:
        """The gain over its inflation."""
        return self.gain / self.inflation


def without(problem: Problem, found: Found, effect: str) -> Found:
    """Return the model without an effect, refitted."""
    vector = found.vector.copy()
    for one in found.chosen:
        if one.effect == effect:
            places = problem.index(one.fields)
            vector[places] = problem.start[places]  # neutral, or as the given model has it
    chosen = tuple(one for one in found.chosen if one.effect != effect)
    return fitted(problem, chosen, vector)


def weigh(problem: Problem, found: Found, outlook: Outlook, effect: str) -> Weighed:
    """Return what an effect of a model is worth; outlook: of the model, along everything."""
    less = without(problem, found, effect)
    # Slopes with the effect serve without it: rivals that come near are refitted.
    seen = outlook.moved(less.vector, problem.whiten(problem.left(less.vector[None]))[0])
    own = next(one for one in found.chosen if one.effect == effect)
    gain = less.cost - found.cost
    rivals: dict[str, float] = {}
    swaps: dict[str, Found] = {}
    ranked = [one for one in scores(problem, seen, less) if one.candidate.effect != effect]
    for number, one in enumerate(ranked):
        rivals[one.candidate.effect] = gain - one.gain.chi2
        share = PROBE_SHARE if one.candidate.probe is not None else NEAR_SHARE
        close = max(NEARLY, share * gain)
        if number < MOST_RIVALS and gain - one.gain.chi2 < close:
            swap = with_effect(problem, seen, less, one)
            rivals[one.candidate.effect] = swap.cost - found.cost
            swaps[one.candidate.effect] = swap
    return Weighed(gain, *_inflation(outlook, found, own.fields), rivals, swaps, less)


def _inflation(outlook: Outlook, found: Found, fields: tuple[str, ...]) -> tuple[float, int]:
    columns = [outlook.column(field) for field in fields]
    given = [outlook.places.index(place) for place in found.places]
    given = [column for column in given if column not in columns]
    gain = outlook.gain(columns, given)
    return (1.0, 1) if gain is None else (gain.inflation, gain.count)


def settle(problem: Problem, found: Found) -> tuple[Found, dict[str, Weighed]]:
    """Return the model without effects that it does not need, and with better ones in their place."""
    while True:
        outlook = full_outlook(problem, found.vector)
        weighed = {one.effect: weigh(problem, found, outlook, one.effect) for one in found.chosen}
        short = {effect: one.robust - threshold(one.count) for effect, one in weighed.items()}
        if short and min(short.values()) < 0.0:
            found = without(problem, found, min(short, key=short.get))
            continue
        better = _better(found, weighed)
        if better is None:
            return found, weighed
        found = better


def price(found: Found) -> float:
    """Return a model's cost and the price of its effects."""
    return found.cost + PER_PARAMETER * sum(one.price for one in found.chosen)


def _better(found: Found, weighed: Mapping[str, Weighed]) -> Found | None:
    """Return the best model with one effect swapped, if it is better."""
    swaps = [swap for one in weighed.values() for swap in one.swaps.values()]
    best = min(swaps, key=price, default=None)
    return best if best is not None and price(best) < price(found) - 0.5 else None


def separations(
    problem: Problem, outlook: Outlook, found: Found, effect: str
) -> tuple[float, dict[str, float]]:
    """Return an effect's lambda, and what is left of it beside each rival, to first order.

    lambda: squared norm of its signature with all else that is free projected out.
    """
    own = next(one for one in found.chosen if one.effect == effect)
    columns = [outlook.column(field) for field in own.fields]
    places = problem.index(own.fields)
    size = found.vector[places] - problem.start[places]
    given = [outlook.places.index(place) for place in found.places]
    given = [column for column in given if column not in columns]

    def beside(others: list[int]) -> float:
        across = outlook.total[np.ix_(others, columns)]
        own_information = outlook.total[np.ix_(columns, columns)]
        left = own_information - across.T @ solve(outlook.total[np.ix_(others, others)], across)
        return float(size @ left @ size)

    present = {one.effect for one in found.chosen}
    rivals: dict[str, float] = {}
    for candidate in CANDIDATES:
        if candidate.effect not in present:
            left = beside(given + outlook.acting(outlook.columns_of(candidate)))
            rivals[candidate.effect] = min(left, rivals.get(candidate.effect, np.inf))
    return beside(given), rivals
