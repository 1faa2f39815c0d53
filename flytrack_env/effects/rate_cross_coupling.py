"""Roll and pitch that leak into yaw: a gyro or frame that is not square, unequal propellers."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, Range, RatesContext, Search
from flytrack_env.quaternion import Scalar, Vec3


class RateCrossCoupling(NamedTuple):
    """Shares of the roll and of the pitch rate that leak into the yaw rate, 1."""

    from_roll: Scalar = 0.0
    from_pitch: Scalar = 0.0


def _rates(coupling: RateCrossCoupling, memory: None, rates_b: Vec3, context: RatesContext) -> Vec3:
    leak = coupling.from_roll * rates_b.x + coupling.from_pitch * rates_b.y
    return rates_b._replace(z=rates_b.z + leak)


RATE_CROSS_COUPLING = Effect(
    name="rate_cross_coupling",
    parameters=RateCrossCoupling,
    ranges={axis: Range(-0.3, 0.3, "1") for axis in RateCrossCoupling._fields},
    notable={"from_roll": 0.03, "from_pitch": 0.03},
    equation=r"\omega_z \leftarrow \omega_z + \text{from roll} \cdot \omega_x "
    r"+ \text{from pitch} \cdot \omega_y",
    source="assumption: in proportion, and into yaw only, the axis with the least authority",
    hooks={"rates": _rates},
    search=Search(follows_sticks=True),
)
