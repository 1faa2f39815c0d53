"""Nonlinear fits of a few parameters of a problem."""

from collections.abc import Sequence

import numpy as np

from flytrack_sysid.diagnosis.linear import Outlook, cost_of
from flytrack_sysid.diagnosis.problem import FEW, Problem

MOST_ROUNDS = 30
ENOUGH = 0.05  # of minus twice the log likelihood
SHARES = np.array([1.0, 0.5, 0.2, 0.05])[:FEW]  # of a step, tried at once
STALE = 30.0  # of minus twice the log likelihood: after so much gain slopes are taken anew


def refine(
    problem: Problem, vector: np.ndarray, places: Sequence[int], nearby: Outlook | None = None
) -> tuple[np.ndarray, float]:
    """Return the model of least cost along some places, from a vector, and its cost.

    Gauss-Newton. Slopes are kept while little is gained: a residual costs a tenth of them. nearby: an
    outlook whose slopes serve at first.
    """
    places = list(places)
    if nearby is None:
        outlook = Outlook(problem, problem.slopes(vector, places))
    else:
        outlook = nearby.narrowed(places).moved(vector, _white(problem, vector[None])[0])
    since, is_fresh = outlook.cost, nearby is None
    for _ in range(MOST_ROUNDS):
        tried = np.repeat(outlook.vector[None], len(SHARES), axis=0)
        tried[:, places] += SHARES[:, None] * outlook.step_inside()
        tried = problem.clipped(tried)
        white = _white(problem, tried)
        costs = cost_of(problem, tried, white)
        best = int(np.nanargmin(np.where(np.isfinite(costs), costs, np.inf)))
        gained = outlook.cost - costs[best]
        if gained > 0.0:
            outlook = outlook.moved(tried[best], white[best])
            is_fresh = False
        if gained < ENOUGH:
            if is_fresh or since - outlook.cost < STALE:
                break
            outlook = Outlook(problem, problem.slopes(outlook.vector, places))
            since, is_fresh = outlook.cost, True
    return outlook.vector, float(outlook.cost)


def _white(problem: Problem, vectors: np.ndarray) -> np.ndarray:
    return problem.whiten(problem.left(vectors))
