"""Thrust gained in edgewise flight: rotors that meet fresh air induce less of their own."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, ForceContext, Range, Search
from flytrack_env.quaternion import Scalar

# m/s, airspeed at which half of the gain is there: about the velocity that a racing quadcopter's
# rotors induce in hover. Not a parameter, because nothing depends on it while there is no gain.
HALF_SPEED = 7.0


class TranslationalLift(NamedTuple):
    """Share of the thrust gained at high airspeed in the rotors' plane, 1."""

    gain: Scalar = 0.0


def _thrust(
    lift: TranslationalLift, memory: None, thrust_n: Scalar, context: ForceContext
) -> Scalar:
    airspeed_b = context.airspeed_b
    squared = airspeed_b.x * airspeed_b.x + airspeed_b.y * airspeed_b.y
    return thrust_n * (1.0 + lift.gain * (squared / (squared + HALF_SPEED * HALF_SPEED)))


TRANSLATIONAL_LIFT = Effect(
    name="translational_lift",
    parameters=TranslationalLift,
    ranges={"gain": Range(-0.5, 0.5, "1")},
    notable={"gain": 0.05},
    equation=r"T \leftarrow T \left( 1 + \text{gain}\, "
    r"\frac{s^2}{s^2 + (7\,\text{m/s})^2} \right), \quad s = \sqrt{v_{b,x}^2 + v_{b,y}^2}",
    source="J. G. Leishman, Principles of Helicopter Aerodynamics, section 2.14, "
    "as a saturating curve",
    hooks={"thrust": _thrust},
    search=Search(needs=("v", "q")),
)
