"""Nonlinear fits of a few parameters of a problem."""

from collections.abc import Sequence

import numpy as np

from flytrack_sysid.diagnosis.linear import Outlook, prior_information
from flytrack_sysid.diagnosis.problem import BATCH, Problem

MOST_ROUNDS = 12
ENOUGH = 0.05  # of minus twice the log likelihood
SHARES = 0.6 ** np.arange(1, BATCH + 1)  # of a step that did not help


def cost_of(problem: Problem, vectors: np.ndarray) -> np.ndarray:
    """Return squares of models and what is known beforehand, (count,)."""
    known = prior_information(problem) * (vectors - problem.start) ** 2
    return problem.squares(vectors) + known.sum(axis=1)


def refine(
    problem: Problem, vector: np.ndarray, places: Sequence[int], rounds: int = MOST_ROUNDS
) -> tuple[np.ndarray, float]:
    """Return the model of least cost along some places, from a vector, and its cost.

    Gauss-Newton; a step that does not help is shortened.
    """
    places = list(places)
    outlook = Outlook(problem, vector, places, ())
    for _ in range(rounds):
        tried = outlook.vector.copy()
        tried[places] += outlook.step(range(len(places)))
        then = Outlook(problem, problem.clipped(tried[None])[0], places, ())
        if not then.cost < outlook.cost:
            shorter = np.repeat(outlook.vector[None], len(SHARES), axis=0)
            shorter[:, places] += SHARES[:, None] * outlook.step(range(len(places)))
            shorter = problem.clipped(shorter)
            costs = cost_of(problem, shorter)
            if not np.nanmin(costs) < outlook.cost - ENOUGH:
                break
            then = Outlook(problem, shorter[int(np.nanargmin(costs))], places, ())
        gained = outlook.cost - then.cost
        outlook = then
        if gained < ENOUGH:
            break
    return outlook.vector, outlook.cost
