"""Body rates that end below what full stick asks for: the flight controller limits its setpoint."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import CommandContext, Effect, Range, Search
from flytrack_env.quaternion import Scalar
from flytrack_env.state import Action

CENTRED = 1e-6  # of a stick: nothing saturates there, and nothing is divided by 0
AXES = ("roll", "pitch", "yaw")


class RateSaturation(NamedTuple):
    """Share of each full stick, at its end, that turns no faster, 1.

    Attributes:
        softness: how gradually, 0 (a corner) to 1.
    """

    roll: Scalar = 0.0
    pitch: Scalar = 0.0
    yaw: Scalar = 0.0
    softness: Scalar = 0.5


def _command(
    limit: RateSaturation, memory: None, sticks: Action, context: CommandContext
) -> Action:
    def limited(stick: Scalar, lost: Scalar) -> Scalar:
        reachable = 1.0 - lost
        bend = 1.0 / (reachable * reachable) - 1.0
        size = jnp.maximum(jnp.abs(stick), CENTRED)
        corner = jnp.where(size > reachable, reachable / size, 1.0)
        gradual = 1.0 / jnp.sqrt(1.0 + bend * size * size)
        share = corner + limit.softness * (gradual - corner)
        return jnp.where(lost > 0.0, stick * share, stick)  # sticks beyond full ones stay, too

    roll, pitch, yaw = (
        limited(stick, lost) for stick, lost in zip(sticks[:3], limit[:3], strict=True)
    )
    return sticks._replace(roll=roll, pitch=pitch, yaw=yaw)


RATE_SATURATION = Effect(
    name="rate_saturation",
    parameters=RateSaturation,
    ranges={**{axis: Range(0.0, 0.9, "1") for axis in AXES}, "softness": Range(0.0, 1.0, "1")},
    notable={axis: 0.05 for axis in AXES},
    equation=r"u_i \leftarrow (1 - s) \operatorname{clip}(u_i, -L_i, L_i) + \frac{s\, u_i}"
    r"{\sqrt{1 + (L_i^{-2} - 1)\, u_i^2}}, \quad "
    r"L_i = 1 - \text{lost}_i, \quad s = \text{softness}",
    source="a corner: the rate limits of Betaflight (src/main/fc/rc.c), which clip the setpoint "
    "that the stick's curve makes; "
    "assumption: gradual limits give full stick as much as the corner does",
    hooks={"command": _command},
    search=Search(
        follows_sticks=True, shapes=("softness",), probes={axis: (0.03, 0.1, 0.3) for axis in AXES}
    ),
)
