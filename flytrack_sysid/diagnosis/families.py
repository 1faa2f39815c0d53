"""Families of laws that give the same response to the sticks, or to the motors.

A response that a model lacks only in part can be put together from several laws. While something in
it is unexplained, the laws of a family trade places: flights of one craft had other names, while
times to half response and the stick of the hover mostly agreed (``benchmarks.repeatability``). A
name then stands for its family.
"""

from collections.abc import Iterable
from dataclasses import replace

from flytrack_sysid.diagnosis.result import Cause, Unexplained
from flytrack_sysid.inference.parameters import TAUS

# With the side of the residuals, as in ``unexplained.SIDES``.
FAMILIES = (
    ("rate", (*TAUS[:3], "command_delay", "second_order_rates", "rate_slew_limit", "imu_latency")),
    ("force", (TAUS[3], "command_delay", "thrust_lag_asymmetry")),
    ("force", ("thrust_curve", "thrust_scale", "voltage_sag")),  # of a thrust that is held
)
FAMILIES_OF_MOTORS = (
    ("rate", ("motor_lag", "command_delay", "imu_latency")),
    ("force", ("motor_lag", "command_delay")),
    FAMILIES[-1],
)


def with_families(
    causes: Iterable[Cause], unexplained: Unexplained, has_motors: bool
) -> tuple[Cause, ...]:
    """Return causes with their families, where something on the family's side is unexplained.

    Args:
        has_motors: whether the commands are those of motors.
    """
    sides = {name.partition(":")[0] for name in unexplained.shares}
    known = FAMILIES_OF_MOTORS if has_motors else FAMILIES
    families = [members for side, members in known if side in sides]
    result = []
    for cause in causes:
        own = [name for members in families if cause.effect in members for name in members]
        family = tuple(name for name in dict.fromkeys(own) if name != cause.effect)
        result.append(replace(cause, family=family))
    return tuple(result)
