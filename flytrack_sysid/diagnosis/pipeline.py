"""From a log to a settled model: noise, search, settling."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import EFFECTS
from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.base import contradiction, simpler
from flytrack_sysid.diagnosis.candidates import BASE_CAUSES
from flytrack_sysid.diagnosis.lanes import make_lanes, thinned
from flytrack_sysid.diagnosis.linear import Outlook, cost_of
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.result import Unexplained
from flytrack_sysid.diagnosis.search import Found, base_fit, fitted, full_outlook, searched
from flytrack_sysid.diagnosis.stand_ins import Suspect, stand_ins
from flytrack_sysid.diagnosis.unexplained import look
from flytrack_sysid.diagnosis.weigh import Weighed, settle, without
from flytrack_sysid.log import FlightLog

SATURATED_SHARES = np.array([0.0, 1.0, 0.5, 0.2])  # of the step to everything at once


class Settled(NamedTuple):
    """What a log says: problem with noise, refitted base, model, its effects weighed, and the rest.

    doubtful: names of base parameters that differ only because of something unexplained.
    """

    problem: Problem
    base: Found
    found: Found
    weighed: dict[str, Weighed]
    rest: Unexplained
    doubtful: tuple[str, ...]


def saturated(problem: Problem, outlook: Outlook) -> np.ndarray:
    """Return what a model leaves with every effect at once, one step away, held back by what is known."""
    places = outlook.places
    tried = np.repeat(outlook.vector[None], len(SATURATED_SHARES), axis=0)
    tried[:, places] += SATURATED_SHARES[:, None] * outlook.step(range(len(places)))
    tried = problem.clipped(tried)
    left = problem.left(tried)
    return left[int(np.nanargmin(cost_of(problem, tried, problem.whiten(left))))]


def settled(log: FlightLog, judged: np.ndarray, model: ModelParameters) -> Settled:
    """Return what judged rows of a log say, starting from a model; inside of ``jax.enable_x64(True)``."""
    lanes = thinned(make_lanes(log, judged, np.asarray(model.tau, float), float(model.g)))
    problem = Problem(lanes, model)
    there = {*log.channels, *lanes.measured}
    problem.barred = tuple(effect.name for effect in EFFECTS if not set(effect.needs) <= there)
    problem.set_noise(noises.first_guess(lanes, problem.left(problem.start[None])[0]))
    base = base_fit(problem)
    outlook = full_outlook(problem, base.vector)
    problem.set_noise(noises.fit_noise(lanes, saturated(problem, outlook)))
    base = found = fitted(problem, (), base.vector, full_outlook(problem, base.vector))
    # A large effect hides small ones as long as its remainder is taken for noise.
    while (more := searched(problem, found)) is not found:
        outlook = full_outlook(problem, more.vector)
        problem.set_noise(noises.fit_noise(lanes, saturated(problem, outlook), problem.noise))
        found = fitted(problem, more.chosen, more.vector, full_outlook(problem, more.vector))
        base = fitted(problem, (), base.vector)
    found, weighed = settle(problem, found)
    while (other := simpler(problem, found)) is not None:
        found, weighed = settle(problem, other)
    return reviewed(problem, base, found, weighed)


def reviewed(problem: Problem, base: Found, found: Found, weighed: dict[str, Weighed]) -> Settled:
    """Return the model without names that something unknown has brought about, and what is left."""
    while True:
        rest, dependences = look(problem, found, base.vector)
        if not rest.flagged:
            return Settled(problem, base, found, weighed, rest, ())
        of_base = _suspects_of_base(problem, found)
        suspects = [*_suspects(problem, found, weighed), *of_base]
        doubtful = stand_ins(problem, found, suspects, rest, dependences)
        dropped = [name for name in doubtful if name in weighed]
        if not dropped:
            return Settled(problem, base, found, weighed, rest, tuple(doubtful))
        found, weighed = taken_back(problem, found, dropped)


def taken_back(problem: Problem, found: Found, effects: Sequence[str]) -> tuple[Found, dict[str, Weighed]]:
    """Return the model without some effects, which are not to come again, settled."""
    problem.refused = (*problem.refused, *effects)
    freed = {field for effect in effects for field in problem.held_for.pop(effect, ())}
    problem.held = tuple(field for field in problem.held if field not in freed)
    for effect in effects:
        found = without(problem, found, effect)
    return settle(problem, found)


def _suspects(problem: Problem, found: Found, weighed: dict[str, Weighed]) -> list[Suspect]:
    return [
        Suspect(
            one.effect,
            one.fields,
            (found.vector - problem.start)[problem.index(one.fields)],
            weighed[one.effect].robust,
            weighed[one.effect].count,
        )
        for one in found.chosen
    ]


def _suspects_of_base(problem: Problem, found: Found) -> list[Suspect]:
    outlook = full_outlook(problem, found.vector)
    result = []
    for name, fields in BASE_CAUSES.items():
        wrong = contradiction(problem, outlook, found, fields)
        if wrong is not None:
            places = problem.index(wrong.fields)
            size = found.vector[places] - problem.start[places]
            robust = wrong.gain / wrong.covered.inflation
            result.append(Suspect(name, tuple(wrong.fields), size, robust, len(places)))
    return result
