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
    result = []
    for one in suspects:
        own = [found.places.index(place) for place in problem.index(one.fields)]
        others = [place for place in range(len(found.places)) if place not in own]
        before, after = dict.fromkeys(SIDES, 0.0), dict.fromkeys(SIDES, 0.0)
        for side, axes in SIDES.items():
            acting = slopes[own][..., axes, :]
            if not (problem.lanes.counts[..., axes, :].any() and np.abs(acting).max() > 0.0):
                continue
            sums = Side(problem, side, left, slopes[others])
            columns = blocks_of(acting * sums.root)
            before[side] = sums.lambda_of(columns, one.size)
            more = [dependence.columns for dependence in dependences_found if dependence.side == side]
            if more:
                more.append(blocks_of(whitened(problem, constants(flight, side), side) * sums.root))
                sums.given = np.concatenate([sums.given, *more], axis=1)
            after[side] = sums.lambda_of(columns, one.size)
        if not any(before.values()):
            continue  # it acts on neither side: the battery
        own_side = max(before, key=before.get)
        least = threshold(one.count)
        is_gone = sum(after.values()) < max(KEPT_SHARE * sum(before.values()), least)
        if is_gone or (own_side in disturbed and one.robust < DISTURBED * least):
            result.append(one.name)
    return result
