"""A cubic stick curve that the model does not know: gentle about the centre, the same at full stick."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, Range, StepContext
from flytrack_env.quaternion import Scalar, Vec3


class RateExpo(NamedTuple):
    """Cubic part of the stick curve, 1."""

    expo: Scalar = 0.0


def _rates(curve: RateExpo, memory: None, rates_b: Vec3, context: StepContext) -> Vec3:
    sticks = context.applied[:3]
    linear = 1.0 - curve.expo
    return Vec3(*(r * (linear + curve.expo * (u * u)) for r, u in zip(rates_b, sticks, strict=True)))


RATE_EXPO = Effect(
    name="rate_expo",
    parameters=RateExpo,
    ranges={"expo": Range(-0.9, 0.9, "1")},
    notable={"expo": 0.05},
    equation=r"\omega_i = \omega_{\max,i} \left( (1 - \text{expo})\, u_i + \text{expo}\, u_i^3 \right)",
    source='the "expo" of radio transmitters; assumption: the same on all axes, behind the lag',
    rates=_rates,
)
