"""Effects that gain enough where they were fitted, and are not to be named all the same."""

from flytrack_env.effects import BY_NAME
from flytrack_sysid.diagnosis.causes import held_out_gain
from flytrack_sysid.diagnosis.limits import BASE_ONLY
from flytrack_sysid.diagnosis.pipeline import Settled
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.search import threshold
from flytrack_sysid.diagnosis.weigh import Weighed

# A choice among many effects finds what fits the noise of one log: whatever gains less than so many
# thresholds has to gain something where it was not fitted, too.
BARELY = 2.0
SOMETHING = 1.0  # of chi2: rows that would not show so much say nothing
# No law of a force is exact to 5 % of what it says, 1/400 of what it explains: as little as that beside
# another is what that one's law leaves, not an effect of its own.
OF_LAW = 0.0025


def unfounded(result: Settled, judge: Problem) -> list[str]:
    """Return effects of a settled model that are barely seen and not again, or remainders of larger laws.

    judge: held-out rows.
    """
    return [
        effect
        for effect, weight in result.weighed.items()
        if is_remainder(effect, result.weighed) or _is_seen_once(weight, judge, result)
    ]


def is_remainder(effect: str, weighed: dict[str, Weighed]) -> bool:
    """Return whether an effect explains next to nothing beside another law of a force."""
    if not _is_law_of_force(effect):
        return False
    largest = max(weight.gain for name, weight in weighed.items() if _is_law_of_force(name))
    return weighed[effect].gain < OF_LAW * largest


def _is_law_of_force(effect: str) -> bool:
    one = BY_NAME[effect]
    acts = one.thrust is not None or one.air is not None or one.force is not None
    return acts and effect not in BASE_ONLY  # a factor is no law that could be wrong


def _is_seen_once(weight: Weighed, judge: Problem, result: Settled) -> bool:
    if weight.robust >= BARELY * threshold(weight.count):
        return False
    gain, expected = held_out_gain(judge, weight.less.vector, result.found.vector)
    return gain < 0.0 and expected > SOMETHING
