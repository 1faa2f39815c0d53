"""What a log could not have shown, and what it cannot tell apart."""

import numpy as np

from flytrack_env.effects import BY_NAME, EFFECTS
from flytrack_sysid.diagnosis.candidates import CANDIDATES, Candidate
from flytrack_sysid.diagnosis.linear import Outlook, solve
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.search import Found

DETECTED = 30.0  # lambda from which a log shows an effect nearly always
SEPARATE = 20.0  # lambda beside a rival from which it tells the two apart
NOTHING = 1e-6  # of that: rounding
BASE_ONLY = ("thrust_scale",)  # told apart from the free thrust curve by no log: a cause of the base


def notable_step(problem: Problem, candidate: Candidate, field: str) -> float:
    """Return the notable change of a parameter, in the step of its column: a share of the way to a probe."""
    size = BY_NAME[candidate.effect].notable[field.split(".")[1]]
    if candidate.probe is not None and field == candidate.probe[0]:
        return size / candidate.probe[1]
    return size


def _first_way(effect: str) -> Candidate:
    """Return the way to look for an effect that is nearest to its notable size."""
    ways = [one for one in CANDIDATES if one.effect == effect]
    notable = BY_NAME[effect].notable

    def distance(way: Candidate) -> float:
        if way.probe is None:
            return 0.0
        return abs(np.log(way.probe[1] / notable[way.probe[0].split(".")[1]]))

    return min(ways, key=distance)


class Seen:
    """How well a log shows an effect: lambda of each of its parameters at its notable size."""

    def __init__(self, outlook: Outlook, given: list[int], effect: str):
        self.outlook, self.given, self.effect = outlook, given, effect
        way = _first_way(effect)
        shapes = BY_NAME[effect].shapes
        fields = [field for field in way.fields if field.split(".")[1] not in shapes]
        if way.probe is not None:  # its column comes first
            fields = [way.probe[0], *(field for field in fields if field != way.probe[0])]
            self.columns = [len(outlook.places) + outlook.probes.index(way)]
            self.columns += [outlook.column(field) for field in fields[1:]]
        else:
            self.columns = [outlook.column(field) for field in fields]
        self.fields = fields
        self.sizes = np.array([notable_step(outlook.problem, way, field) for field in fields])

    def lambdas(self, beside: list[int] | None = None) -> np.ndarray:
        """Return lambda of each parameter at its notable size, all that is free and ``beside`` taken out."""
        given = self.given + [column for column in beside or [] if column not in self.given]
        total = self.outlook.total
        found = np.zeros(len(self.columns))
        for number, column in enumerate(self.columns):
            others = [one for one in given if one != column]
            across = total[others, column]
            own = total[column, column] - across @ solve(total[np.ix_(others, others)], across)
            own -= self.outlook.prior[column]  # which is no word of the log
            found[number] = max(float(own), 0.0) * self.sizes[number] ** 2
        return found


Limit = tuple[float, str, tuple[str, ...]]


def unseen(outlook: Outlook, found: Found) -> dict[str, Limit]:
    """Return effects that the log could not have shown: smallest detectable size, unit, what looks alike.

    The size is of the parameter that is seen worst, for a lambda of 30; infinite where nothing depends on it.
    """
    given = [outlook.places.index(place) for place in found.places]
    present = {one.effect for one in found.chosen}
    result: dict[str, Limit] = {}
    for effect in EFFECTS:
        if effect.name in present or effect.name in BASE_ONLY:
            continue
        if effect.name in outlook.problem.barred:
            field = next(iter(effect.notable))
            result[effect.name] = (float("inf"), effect.ranges[field].unit, ())
            continue
        seen = Seen(outlook, given, effect.name)
        lambdas = seen.lambdas()
        worst = int(np.argmin(lambdas))
        if lambdas[worst] >= DETECTED:
            continue
        field = seen.fields[worst].split(".")[1]
        known = lambdas[worst] > DETECTED * NOTHING
        smallest = effect.notable[field] * np.sqrt(DETECTED / lambdas[worst]) if known else np.inf
        alike = look_alikes(outlook, given, seen) if lambdas[worst] > 0.0 else ()
        result[effect.name] = (float(smallest), effect.ranges[field].unit, alike)
    return result


def look_alikes(outlook: Outlook, given: list[int], seen: Seen) -> tuple[str, ...]:
    """Return effects beside which this one hardly shows any more."""
    lambdas = seen.lambdas()
    result = []
    for other in EFFECTS:
        if other.name in (seen.effect, *BASE_ONLY, *outlook.problem.barred):
            continue
        beside = seen.lambdas(Seen(outlook, given, other.name).columns)
        if np.any((beside < SEPARATE) & (beside < 0.1 * lambdas)):
            result.append(other.name)
    return tuple(result)
