"""Base parameters that a log contradicts, and effects that explain several of them at once."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from flytrack_env.dynamics import collective_thrust
from flytrack_env.effects import BY_NAME
from flytrack_sysid.diagnosis.candidates import BASE_CAUSES
from flytrack_sysid.diagnosis.linear import Outlook, inflation_of, solve
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.search import (
    MOST_REFITTED,
    PER_PARAMETER,
    Found,
    fitted,
    full_outlook,
    scores,
    threshold,
    with_effect,
)
from flytrack_sysid.parameters import TAUS, THRUST_COEFFS

IMMATERIAL = 0.01  # of a lag or a drain
IMMATERIAL_THRUST = 0.003  # of the weight, rms over what was flown
HOPELESS = 0.01  # of the cost, above the limit to first order: not worth a fit


class Covered:
    """Information about some free parameters of a model, all others fitted along with them."""

    def __init__(self, outlook: Outlook, found: Found, fields: Sequence[str]):
        self.columns = [outlook.column(field) for field in fields]
        given = [outlook.places.index(place) for place in found.places]
        given = [column for column in given if column not in self.columns]
        across = outlook.total[np.ix_(given, self.columns)]
        share = solve(outlook.total[np.ix_(given, given)], across)
        self.information = outlook.total[np.ix_(self.columns, self.columns)] - across.T @ share
        blocks = outlook.score_by_block
        self.scores = blocks[:, self.columns] - blocks[:, given] @ share
        self.inflation = inflation_of(self.information, self.scores)

    def half_widths(self) -> np.ndarray:
        """Return half of each parameter's 95 % interval.

        Of the deviation that the information says or, where it is larger, that which scores of blocks say
        of each parameter (a sandwich estimate, with Student's t for so many blocks).
        """
        covariance = solve(self.information, np.eye(len(self.information)))
        used = self.scores[np.abs(self.scores).sum(axis=1) > 0.0]
        number = max(len(used), 2)
        spread = used.T @ used * number / (number - 1)
        variance = np.maximum(np.diag(covariance), np.diag(covariance @ spread @ covariance))
        return np.sqrt(variance) * stats.t.ppf(0.975, number - 1)


def _is_immaterial(problem: Problem, fields: Sequence[str], found: Found) -> bool:
    """Return whether a lag, drain or thrust curve differs by less than matters; rounding does as much."""
    places = problem.index(fields)
    change = found.vector[places] - problem.start[places]
    if fields != THRUST_COEFFS:
        return bool(np.all(np.abs(change) < IMMATERIAL * np.abs(problem.start[places])))
    record = problem.lanes.record
    thrust = np.asarray(collective_thrust(record.command[..., 3], record.battery_v, change))
    weight = float(problem.like.m) * float(problem.like.g)
    return float(np.sqrt(np.mean(thrust[problem.counts.any(axis=(2, 3))] ** 2))) < IMMATERIAL_THRUST * weight


class Contradiction(NamedTuple):
    """Base parameters that differ from the nominal ones: names, information, and chi2 of the difference."""

    fields: list[str]
    covered: Covered
    gain: float


def contradiction(
    problem: Problem, outlook: Outlook, found: Found, fields: Sequence[str]
) -> Contradiction | None:
    """Return how the log contradicts nominal values of base parameters; None where it does not, or hardly."""
    acting = [
        field for field in fields if field not in problem.held and outlook.acting([outlook.column(field)])
    ]
    if not acting or _is_immaterial(problem, fields, found):
        return None
    places = problem.index(acting)
    covered = Covered(outlook, found, acting)
    change = found.vector[places] - problem.start[places]
    gain = float(change @ covered.information @ change)
    if gain / covered.inflation < threshold(len(acting)):
        return None
    return Contradiction(acting, covered, gain)


def contradicted(problem: Problem, found: Found) -> list[str]:
    """Return the base parameters that a log contradicts."""
    outlook = full_outlook(problem, found.vector)
    wrong = [contradiction(problem, outlook, found, fields) for fields in BASE_CAUSES.values()]
    return [field for one in wrong if one is not None for field in one.fields]


def simpler(problem: Problem, found: Found) -> Found | None:
    """Return a model with one effect more and base parameters as they were, if it explains as much.

    A delay of all commands, say, looks like four longer lags. Those parameters are then held.
    """
    wrong = contradicted(problem, found)
    lags = [field for field in wrong if field in TAUS]
    for fields in (wrong, lags) if lags not in (wrong, []) else (wrong,):
        if not fields:
            continue
        held = problem.held
        problem.held = (*held, *fields)
        trial = _best_instead(problem, found, fields)
        if trial is not None:
            for effect in {one.effect for one in trial.chosen} - {one.effect for one in found.chosen}:
                problem.held_for[effect] = tuple(fields)
            return trial
        problem.held = held
    return None


def is_determined(problem: Problem, found: Found, fields: Sequence[str]) -> bool:
    """Return whether a log tells one of an effect's parameters, those of a model, from having no effect."""
    places = problem.index(fields)
    change = np.abs(found.vector[places] - problem.start[places])
    acting = [field.split(".")[1] not in BY_NAME[field.split(".")[0]].shapes for field in fields]
    covered = Covered(full_outlook(problem, found.vector), found, fields)
    return bool(np.any((change > covered.half_widths()) & acting))


def _best_instead(problem: Problem, found: Found, fields: Sequence[str]) -> Found | None:
    """Return the best model with one effect more while some base parameters are held, if it is better."""
    vector = found.vector.copy()
    vector[problem.index(fields)] = problem.start[problem.index(fields)]
    less = fitted(problem, found.chosen, vector)
    seen = full_outlook(problem, less.vector)
    limit = found.cost + PER_PARAMETER * len(fields)
    best = less if less.cost < limit else None
    for one in scores(problem, seen, less)[:MOST_REFITTED]:
        if less.cost - one.gain.chi2 > limit + less.cost * HOPELESS and one.candidate.probe is None:
            continue
        trial = with_effect(problem, seen, less, one)
        cost = trial.cost + PER_PARAMETER * one.candidate.price
        if cost < limit and is_determined(problem, trial, one.candidate.fields):
            best, limit = trial, cost
    return best
