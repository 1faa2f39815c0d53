"""What a log could show of a truth: lambda of each hidden effect, and beside its closest rival.

From the clean log (the same rows, no noise) and the sensors' true noise: the residual of a model that lacks
an effect is then the effect's signature, whatever its law, and minus twice the log likelihood its squared
length. All else is fitted again, each rival in the effect's place too.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from benchmarks.hidden.noise import STD
from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.diagnosis.candidates import CANDIDATES
from flytrack_sysid.diagnosis.lanes import NUM_AXES, make_lanes
from flytrack_sysid.diagnosis.noise import floors_of
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.search import Found, begun, fitted, full_outlook, scores
from flytrack_sysid.diagnosis.weigh import weigh
from flytrack_sysid.log import FlightLog

# Attitude noise turns the thrust that is fed in: m/s of velocity in a second, as a random walk.
WANDER = STD["q"] * 10.0 * np.sqrt(0.01)
NO_DISTURBANCE, ANY_TAU, COUPLED = np.log(1e-3), np.log(0.3), 0.0


class Known(NamedTuple):
    """What a log could show of an effect: lambda, beside its closest rival, and that rival."""

    lambda_: float
    lambda_sep: float
    rival: str


def true_noise(problem: Problem) -> np.ndarray:
    """Return the noise of ``benchmarks.hidden.noise`` as the diagnosis has it, (6, NUM_AXES)."""
    direct = np.repeat([STD["w"], STD["f"], 1.0], [3, 3, 1])
    level = np.repeat([STD["q"], STD["v"], floors_of(problem.lanes)[1, -1]], [3, 3, 1])
    wander = np.repeat([1e-3 * STD["q"], WANDER, 1e-3], [3, 3, 1]) / level
    rest = np.repeat([[NO_DISTURBANCE], [ANY_TAU], [COUPLED]], NUM_AXES, axis=1)
    return np.stack([np.log(direct), np.log(level), np.log(wander), *rest])


def clean_problem(clean: FlightLog, log: FlightLog, judged: np.ndarray, model: ModelParameters) -> Problem:
    """Return the problem of the clean rows that a measured log kept, with the sensors' true noise."""
    kept = clean.select(np.isin(np.round(clean.time, 6), np.round(log.time, 6)))
    problem = Problem(make_lanes(kept, judged, np.asarray(model.tau, float), float(model.g)), model)
    problem.set_noise(true_noise(problem))
    return problem


def with_all(problem: Problem, effects: Mapping[str, object]) -> Found:
    """Return the model with all true effects that fits the clean log best, whichever is fitted in first."""
    base = fitted(problem, (), problem.start)
    known_ones = [name for name in effects if any(one.effect == name for one in CANDIDATES)]
    tried = [_one_by_one(problem, base, known_ones, first) for first in known_ones]
    return min(tried, key=lambda found: found.cost, default=base)


def _one_by_one(problem: Problem, found: Found, effects: Sequence[str], first: str) -> Found:
    waiting = list(effects)
    while waiting:
        outlook = full_outlook(problem, found.vector)
        ranked = [one for one in scores(problem, outlook, found) if one.candidate.effect in waiting]
        if not ranked:
            break
        best = max(ranked, key=lambda one: (one.candidate.effect == first, one.gain.chi2))
        waiting.remove(best.candidate.effect)
        chosen = (*found.chosen, best.candidate)
        found = fitted(problem, chosen, begun(problem, outlook, found, best), outlook)
    return found


def known(
    clean: FlightLog,
    log: FlightLog,
    judged: np.ndarray,
    model: ModelParameters,
    effects: Mapping[str, object],
) -> dict[str, Known]:
    """Return, by hidden effect, what the judged rows of a log could show of it."""
    with jax.enable_x64(True):
        problem = clean_problem(clean, log, judged, model)
        found = with_all(problem, effects)
        outlook = full_outlook(problem, found.vector)
        result = {}
        for one in found.chosen:
            weight = weigh(problem, found, outlook, one.effect)
            rival = min(weight.rivals, key=weight.rivals.get, default="")
            beside = min(weight.rivals.get(rival, weight.gain), weight.gain)
            result[one.effect] = Known(weight.gain, max(beside, 0.0), rival)
    return result


def removed(
    clean: FlightLog, model: ModelParameters, base: ModelParameters, extended: ModelParameters
) -> tuple[float, float]:
    """Return the share of a clean flight's explainable error that an extended model removes, and that error.

    base: refitted, without effects. The error is the rms whitened residual of that, 1 is the noise.
    """
    with jax.enable_x64(True):
        lanes = make_lanes(clean, np.ones(len(clean), bool), np.asarray(model.tau, float), float(model.g))
        problem = Problem(lanes, model)
        every = [Problem(lanes, one).start for one in (base, extended)]
        left = problem.left(np.stack(every))
    size = np.array([STD["w"]] * 3 + [STD["f"]] * 3)
    counts = lanes.counts[..., :6, 0]
    power = [float(np.mean(np.square(one[..., :6, 0] / size)[counts])) for one in left]
    return 1.0 - power[1] / max(power[0], 1e-300), float(np.sqrt(power[0]))
