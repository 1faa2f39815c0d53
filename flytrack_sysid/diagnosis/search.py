"""Which effects a log shows: one after the other, each refitted together with all that was found before."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from flytrack_sysid.diagnosis.candidates import CANDIDATES, Candidate, base_places, opened
from flytrack_sysid.diagnosis.linear import PROBES, Gain, Outlook
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.refine import STALE, refine

CHANCE = 1e-4  # of a name where there is nothing, for each effect
PER_PARAMETER = 4.0  # of chi2: what one more parameter has to gain to be preferred to fewer
MOST_EFFECTS = 6
CLOSE = 0.6  # of the best gain: who comes so near to first order is refitted before one is chosen
MOST_REFITTED = 4
MOST_TURNS = 3  # of refits that come to nothing before a search ends
PROMISING = 0.7  # of the threshold, to first order
SHARE_OF_WAY = (0.02, 1.5)  # to a probe, at which a fit begins
KEPT_PROMISE = 0.6  # of a gain to first order: a fit that comes to less may have gone astray


class Found(NamedTuple):
    """A model: which effects it has (in which way each), its vector, cost, and free places."""

    chosen: tuple[Candidate, ...]
    vector: np.ndarray
    cost: float
    places: tuple[int, ...]


def threshold(count: int) -> float:
    """Return the gain of chi2 from which so many parameters are named."""
    return float(stats.chi2.isf(CHANCE, count))


def places_of(problem: Problem, chosen: Sequence[Candidate]) -> list[int]:
    """Return what is free with these effects: the base and their parameters."""
    return base_places(problem) + [place for one in chosen for place in problem.index(one.fields)]


def free_places(problem: Problem) -> list[int]:
    """Return every place that may become free: the base, and all parameters of all effects."""
    effects = [place for place, name in enumerate(problem.names) if "." in name]
    return base_places(problem) + effects


def fitted(
    problem: Problem, chosen: Sequence[Candidate], vector: np.ndarray, nearby: Outlook | None = None
) -> Found:
    """Return the model with these effects that fits best, from a vector."""
    places = places_of(problem, chosen)
    vector, cost = refine(problem, vector, places, nearby)
    return Found(tuple(chosen), vector, cost, tuple(places))


def base_fit(problem: Problem) -> Found:
    """Return the model without effects that fits best."""
    return fitted(problem, (), problem.start)


class Scored(NamedTuple):
    """A candidate and what it would gain, to first order."""

    candidate: Candidate
    gain: Gain

    @property
    def merit(self) -> float:
        """The gain over its inflation, less a price per parameter."""
        return self.gain.robust - PER_PARAMETER * self.gain.count


def scores(problem: Problem, outlook: Outlook, found: Found) -> list[Scored]:
    """Return all effects that the model does not have, by merit to first order, one way of each."""
    given = [outlook.places.index(place) for place in found.places]
    present = {one.effect for one in found.chosen}
    best: dict[str, Scored] = {}
    for candidate in CANDIDATES:
        if candidate.effect in present or candidate.effect in (*problem.barred, *problem.refused):
            continue
        gain = outlook.gain(outlook.columns_of(candidate), given)
        if gain is None or (candidate.probe is not None and gain.step[0] <= 0.0):
            continue
        scored = Scored(candidate, gain)
        if candidate.effect not in best or scored.merit > best[candidate.effect].merit:
            best[candidate.effect] = scored
    return sorted(best.values(), key=lambda scored: -scored.merit)


def full_outlook(problem: Problem, vector: np.ndarray) -> Outlook:
    """Return the outlook along everything; slopes taken last serve again for a model nearby."""
    last = problem.last_outlook
    if last is not None and last.places == free_places(problem) and last.distance(vector) < STALE:
        if last.noise is not problem.noise:
            last = Outlook(problem, last.slopes, PROBES)
        outlook = last.moved(vector, problem.whiten(problem.left(vector[None]))[0])
    else:
        others = problem.clipped(np.array([opened(problem, vector, probe) for probe in PROBES]))
        outlook = Outlook(problem, problem.slopes(vector, free_places(problem), others), PROBES)
    problem.last_outlook = outlook
    return outlook


def with_effect(problem: Problem, outlook: Outlook, found: Found, scored: Scored) -> Found:
    """Return the model with an effect more, fitted from where first order says.

    An effect that is looked for at a probe also begins at that, if it came to much less than promised.
    """
    candidate, gain = scored
    chosen = (*found.chosen, candidate)
    if candidate.probe is None:
        vector = found.vector.copy()
        vector[problem.index(candidate.fields)] += gain.step
        return fitted(problem, chosen, problem.clipped(vector[None])[0], outlook)
    best = fitted(problem, chosen, _on_the_way(problem, found, scored))
    if found.cost - best.cost < KEPT_PROMISE * gain.chi2:
        other = fitted(problem, chosen, problem.clipped(opened(problem, found.vector, candidate)[None])[0])
        best = min(best, other, key=lambda one: one.cost)
    return best


def _on_the_way(problem: Problem, found: Found, scored: Scored) -> np.ndarray:
    """Return the vector at the share of the way to a probe that explains most, all else moved along."""
    candidate, gain = scored
    vector = found.vector.copy()
    vector[list(found.places)] += gain.aside
    others = [field for field in candidate.fields if field != candidate.probe[0]]
    vector[problem.index(others)] += gain.step[1:]
    place = problem.names.index(candidate.probe[0])
    share = np.clip(gain.step[0], *SHARE_OF_WAY)
    vector[place] += share * (candidate.probe[1] - vector[place])
    return problem.clipped(vector[None])[0]


def searched(problem: Problem, found: Found) -> Found:
    """Return the model with all effects added that explain enough, the best first; the same if none does."""
    while len(found.chosen) < MOST_EFFECTS:
        more = add_best(problem, found, full_outlook(problem, found.vector))
        if more is None:
            break
        found = more
    return found


def add_best(problem: Problem, found: Found, outlook: Outlook) -> Found | None:
    """Return the model with the effect added that explains most; None where none explains enough."""
    ranked = [
        one
        for one in scores(problem, outlook, found)
        if one.gain.robust > PROMISING * threshold(one.gain.count)
    ]
    for _ in range(MOST_TURNS):
        near = [one for one in ranked[:MOST_REFITTED] if one.merit > CLOSE * ranked[0].merit]
        trials = [_tried(problem, found, outlook, one) for one in near]
        good = [trial for trial in trials if trial is not None]
        if good:
            return max(good, key=lambda pair: pair[0])[1]
        ranked = ranked[max(len(near), 1) :]
        if not ranked:
            break
    return None


def _tried(problem: Problem, found: Found, outlook: Outlook, one: Scored) -> tuple[float, Found] | None:
    """Return the merit of a model with an effect more, and the model; None if it gains too little."""
    trial = with_effect(problem, outlook, found, one)
    gain = (found.cost - trial.cost) / one.gain.inflation
    if gain <= threshold(one.gain.count):
        return None
    return gain - PER_PARAMETER * one.gain.count, trial
