"""Families of laws that give the same response to the sticks.

A response that a model lacks only in part can be put together from several laws. While something in
it is unexplained, the laws of a family trade places: flights of one craft had other names, while
times to half response mostly agreed (``benchmarks.repeatability``). A name then stands for its
family.
"""

from collections.abc import Iterable
from dataclasses import replace

from flytrack_sysid.diagnosis.result import Cause, Unexplained
from flytrack_sysid.inference.parameters import TAUS

FAMILIES = {  # by the side of the residuals, as in ``unexplained.SIDES``
    "rate": (*TAUS[:3], "command_delay", "second_order_rates", "rate_slew_limit", "imu_latency"),
    "force": (TAUS[3], "command_delay", "thrust_lag_asymmetry"),
}


def with_families(causes: Iterable[Cause], unexplained: Unexplained) -> tuple[Cause, ...]:
    """Return causes with their families, where something on the family's side is unexplained."""
    sides = {name.partition(":")[0] for name in unexplained.shares}
    families = [members for side, members in FAMILIES.items() if side in sides]
    result = []
    for cause in causes:
        own = [name for members in families if cause.effect in members for name in members]
        family = tuple(name for name in dict.fromkeys(own) if name != cause.effect)
        result.append(replace(cause, family=family))
    return tuple(result)
