"""Four motors on a frame: their order, how they spin up, and how their thrusts turn a craft.

Motors stand in the order of Betaflight's "Quad X": rear right, front right, rear left, front left.
The functions take numbers, or arrays of all motors.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from flytrack_env.quaternion import Scalar

NAMES = ("rear_right", "front_right", "rear_left", "front_left")
# What a stronger motor turns: left rotors roll to the right, rear rotors pitch down, and propellers
# that turn as Betaflight's do by default ("props in") yaw. An axis a row.
SIGNS = np.array([[-1.0, -1.0, 1.0, 1.0], [1.0, -1.0, 1.0, -1.0], [1.0, -1.0, -1.0, 1.0]])
QUARTER = 0.25  # of the thrust map is each motor's


def reached(lag_s: Scalar, dt: Scalar) -> Scalar:
    """Return the share of the way to a held command that a motor goes in ``dt`` s."""
    return 1.0 - jnp.exp(-dt / lag_s)


def moment(thrusts: Sequence[Any], levers: Sequence[Any]) -> Any:
    """Return the sum over motors of thrusts times levers."""
    # Sum by sum: XLA makes a product of matrices of a reduction, which no kernel has.
    return sum(thrusts[motor] * levers[motor] for motor in range(len(NAMES)))
