"""The handout's thrust map: what a thrust action gives at a battery voltage."""

from typing import Any

import numpy as np

from flytrack_env.quaternion import Scalar

THRUST_ACTIONS = np.linspace(-1.0, 1.0, 201)


def collective_thrust(thrust_action: Scalar, battery_v: Scalar, coeffs: Any) -> Scalar:
    """Return the thrust in N along body z for a lagged thrust action and a battery voltage.

    ``coeffs`` has shape (6,); handout, task 1, equation 3.
    """
    u, volt = thrust_action, battery_v
    polynomial = coeffs[0] + u * (coeffs[1] + u * (coeffs[2] + u * coeffs[3]))
    return polynomial + volt * (coeffs[4] + u * coeffs[5])


def hover_action(coeffs: Any, weight_n: float, battery_v: float) -> float:
    """Return the thrust action that carries a weight, by the thrust map alone; 1 if none does.

    Args:
        coeffs: of the thrust map, (6,).
        weight_n: mass times gravity, N.
        battery_v: voltage under load, V.
    """
    thrusts_n = collective_thrust(THRUST_ACTIONS, battery_v, np.asarray(coeffs, float))
    rising_n = np.maximum.accumulate(
        np.asarray(thrusts_n)
    )  # a fitted curve may dip at its lower end
    return float(np.interp(weight_n, rising_n, THRUST_ACTIONS))
