"""A cubic stick curve that the model lacks: gentle about the centre, the same at full stick."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, Range, Search, on_rate_sticks
from flytrack_env.quaternion import Scalar


class RateExpo(NamedTuple):
    """Cubic part of the stick curve of each axis, 1."""

    roll: Scalar = 0.0
    pitch: Scalar = 0.0
    yaw: Scalar = 0.0


def _curve(stick: Scalar, expo: Scalar) -> Scalar:
    return stick * (1.0 - expo + expo * (stick * stick))


RATE_EXPO = Effect(
    name="rate_expo",
    parameters=RateExpo,
    ranges={axis: Range(-0.9, 0.9, "1") for axis in RateExpo._fields},
    notable={axis: 0.05 for axis in RateExpo._fields},
    equation=r"u_i \leftarrow (1 - \text{expo}_i)\, u_i + \text{expo}_i\, u_i^3",
    source='the "expo" of radio transmitters, and of KISS and RaceFlight rates in Betaflight '
    "(src/main/fc/rc.c): the curve makes the setpoint of the rate loop, before any lag",
    hooks={"command": on_rate_sticks(_curve)},
    search=Search(follows_sticks=True),
)
