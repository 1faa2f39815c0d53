"""A yaw rate that changes with thrust: propellers that spin up turn the frame the other way."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, Range, RatesContext
from flytrack_env.quaternion import Scalar, Vec3


class YawReaction(NamedTuple):
    """Yaw angle by which a change of the applied thrust action by 1 turns the drone, rad."""

    angle: Scalar = 0.0


def _rates(reaction: YawReaction, memory: None, rates_b: Vec3, context: RatesContext) -> Vec3:
    return rates_b._replace(z=rates_b.z + reaction.angle * context.applied_slope.thrust)


YAW_REACTION = Effect(
    name="yaw_reaction",
    parameters=YawReaction,
    ranges={"angle": Range(-0.2, 0.2, "rad")},
    notable={"angle": 0.02},
    equation=r"\omega_z \leftarrow \omega_z + \text{angle}\, \frac{du}{dt}",
    source="assumption: unequal spin-up of the two directions of rotation, "
    "in proportion to its speed",
    hooks={"rates": _rates},
)
