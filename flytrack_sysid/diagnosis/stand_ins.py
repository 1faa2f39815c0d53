"""Names that stand in for something that no list has: what a veto takes back."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flytrack_sysid.diagnosis.problem import Problem, blocks_of
from flytrack_sysid.diagnosis.regressors import SIDES, constants
from flytrack_sysid.diagnosis.result import Unexplained
from flytrack_sysid.diagnosis.search import Found, threshold
from flytrack_sysid.diagnosis.sides import Side, flight_of, seen, whitened
from flytrack_sysid.diagnosis.unexplained import Dependence

DISTURBED = 3.0  # times the usual threshold, for names on a side where something unknown acts
KEPT_SHARE = 0.1  # of an effect's lambda, beside what the rest depends on: less, and it stood in for that


class Suspect(NamedTuple):
    """A name and what it stands for: parameters, by how much they differ, gain over its inflation, count."""

    name: str
    fields: tuple[str, ...]
    size: np.ndarray
    robust: float
    count: int


def stand_ins(
    problem: Problem,
    found: Found,
    suspects: Sequence[Suspect],
    rest: Unexplained,
    dependences_found: Sequence[Dependence],
) -> list[str]:
    """Return names that stand in for something that no list has.

    Their gain is gone beside smooth functions of what the rest depends on (with the constants of those,
    which a wind, say, would be), or is small where something unknown disturbs the same side.
    """
    left, slopes = seen(problem, found)
    flight = flight_of(problem, found)
    disturbed = {name.split(":")[0] for name in rest.shares}

    def lambdas(one: Suspect, side: str) -> tuple[float, float]:
        """Return a suspect's lambda on a side, and beside what the rest depends on."""
        axes = SIDES[side]
        own = [found.places.index(place) for place in problem.index(one.fields)]
        acting = slopes[own][..., axes, :]
        if not (problem.lanes.counts[..., axes, :].any() and np.abs(acting).max() > 0.0):
            return 0.0, 0.0
        sums = Side(problem, side, left, np.delete(slopes, own, axis=0))
        columns = blocks_of(acting * sums.root)
        before = sums.lambda_of(columns, one.size)
        more = [dependence.columns for dependence in dependences_found if dependence.side == side]
        if more:
            more.append(blocks_of(whitened(problem, constants(flight, side), side) * sums.root))
            sums.given = np.concatenate([sums.given, *more], axis=1)
        return before, sums.lambda_of(columns, one.size)

    result = []
    for one in suspects:
        by_side = {side: lambdas(one, side) for side in SIDES}
        before, after = (sum(values) for values in zip(*by_side.values(), strict=True))
        if before == 0.0:
            continue  # it acts on neither side: the battery
        own_side = max(by_side, key=lambda side: by_side[side][0])
        least = threshold(one.count)
        is_gone = after < max(KEPT_SHARE * before, least)
        if is_gone or (own_side in disturbed and one.robust < DISTURBED * least):
            result.append(one.name)
    return result
