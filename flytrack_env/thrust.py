"""The handout's thrust map: what a thrust action gives at a battery voltage."""

from typing import Any

from flytrack_env.quaternion import Scalar


def collective_thrust(thrust_action: Scalar, battery_v: Scalar, coeffs: Any) -> Scalar:
    """Return the thrust in N along body z for a lagged thrust action and a battery voltage.

    ``coeffs`` has shape (6,); handout, task 1, equation 3.
    """
    u, volt = thrust_action, battery_v
    polynomial = coeffs[0] + u * (coeffs[1] + u * (coeffs[2] + u * coeffs[3]))
    return polynomial + volt * (coeffs[4] + u * coeffs[5])
