"""From a log to a settled model: noise, search, settling."""

from typing import NamedTuple

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.lanes import make_lanes
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.refine import cost_of
from flytrack_sysid.diagnosis.search import MOST_EFFECTS, Found, add_best, base_fit, fitted, full_outlook
from flytrack_sysid.diagnosis.result import Unexplained
from flytrack_sysid.diagnosis.unexplained import look, stand_ins
from flytrack_sysid.diagnosis.weigh import Weighed, settle, without
from flytrack_sysid.log import FlightLog

SATURATED_SHARES = np.array([0.0, 1.0, 0.5, 0.25, 0.1])


class Settled(NamedTuple):
    """What a log says: the problem with its noise, the refitted base, the model, its effects weighed, and the rest."""

    problem: Problem
    base: Found
    found: Found
    weighed: dict[str, Weighed]
    rest: Unexplained


def saturated(problem: Problem, vector: np.ndarray) -> np.ndarray:
    """Return the model with every effect at once, one step from a vector, held back by what is known."""
    outlook = full_outlook(problem, vector)
    places = outlook.places
    tried = np.repeat(vector[None], len(SATURATED_SHARES), axis=0)
    tried[:, places] += SATURATED_SHARES[:, None] * outlook.step(range(len(places)))
    tried = problem.clipped(tried)
    return tried[int(np.nanargmin(cost_of(problem, tried)))]


def settled(log: FlightLog, judged: np.ndarray, model: ModelParameters) -> Settled:
    """Return what judged rows of a log say, starting from a model; inside of ``jax.enable_x64(True)``."""
    lanes = make_lanes(log, judged, np.asarray(model.tau, float), float(model.g))
    problem = Problem(lanes, model)
    problem.set_noise(noises.first_guess(problem.left(problem.start[None])[0], lanes.counts))
    base = base_fit(problem)
    full = saturated(problem, base.vector)
    problem.set_noise(noises.fit_noise(lanes, problem.left(full[None])[0]))
    base = found = base_fit(problem)
    while len(found.chosen) < MOST_EFFECTS:
        more = add_best(problem, found)
        if more is None:
            break
        found = more
    if found.chosen:
        full = saturated(problem, found.vector)
        problem.set_noise(noises.fit_noise(lanes, problem.left(full[None])[0], problem.noise))
        found, base = fitted(problem, found.chosen, found.vector), base_fit(problem)
    found, weighed = settle(problem, found)
    while True:
        rest, dependences = look(problem, found, base.vector)
        dropped = stand_ins(problem, found, weighed, rest, dependences) if rest.flagged else []
        if not dropped:
            return Settled(problem, base, found, weighed, rest)
        for effect in dropped:
            found = without(problem, found, effect)
        found, weighed = settle(problem, found)
