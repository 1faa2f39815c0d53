"""Motors that spin down with another time constant than up: they are driven up and coast down."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import CommandContext, Effect, Range
from flytrack_env.quaternion import Scalar
from flytrack_env.state import Action


class ThrustLagAsymmetry(NamedTuple):
    """Time constant of falling thrust over that of rising thrust, 1."""

    ratio: Scalar = 1.0


def _lag(
    asymmetry: ThrustLagAsymmetry, memory: None, tau: Action, context: CommandContext
) -> Action:
    is_falling = context.command.thrust < context.drone.applied.thrust
    return tau._replace(thrust=jnp.where(is_falling, asymmetry.ratio * tau.thrust, tau.thrust))


THRUST_LAG_ASYMMETRY = Effect(
    name="thrust_lag_asymmetry",
    parameters=ThrustLagAsymmetry,
    ranges={"ratio": Range(0.3, 3.0, "1")},
    notable={"ratio": 0.3},
    equation=r"\tau_\text{thrust} \leftarrow \text{ratio} \cdot \tau_\text{thrust} \quad "
    r"\text{where the command is below the applied thrust}",
    source="assumption: one ratio at any thrust; motors are driven up, and coast down",
    hooks={"lag": _lag},
)
