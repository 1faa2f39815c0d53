"""Hidden effects of thrust and of forces, each from its own equation.

A maker takes an effect's parameters. Thrust functions return N from the plant and the thrust so far; force
functions return what to add to the specific force in the body, m/s^2. Where the package has another law for
an effect of the same name, the difference is wanted.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

from benchmarks.hidden.vectors import Vector, to_body

Parameters = Mapping[str, float]
LIFT_SPEED = 8.0  # m/s, airspeed at which translational lift is at 1 - 1/e of its gain


def _thrust_scale(values: Parameters) -> Callable[[Any, float], float]:
    """T *= factor."""
    return lambda plant, thrust: values["factor"] * thrust


def _translational_lift(values: Parameters) -> Callable[[Any, float], float]:
    """T *= 1 + gain (1 - exp(-s^2 / (8 m/s)^2)), s the airspeed along body x and y.

    Not the package's law, which approaches the gain as a rational function.
    """
    gain = values["gain"]

    def act(plant: Any, thrust: float) -> float:
        x, y, _ = plant.airspeed_b
        return thrust * (1.0 - gain * math.expm1(-(x * x + y * y) / LIFT_SPEED**2))

    return act


def _ground_effect(values: Parameters) -> Callable[[Any, float], float]:
    """T *= 1 + gain exp(-z / height_m).

    Not the package's law, which falls off with 1 / z^2.
    """
    gain, height = values["gain"], values["height_m"]
    return lambda plant, thrust: thrust * (1.0 + gain * math.exp(-max(plant.pos_w[2], 0.0) / height))


def _linear_drag(values: Parameters) -> Callable[[Any], Vector]:
    """f -= (d_x v_x, d_y v_y, d_z v_z), v the airspeed in the body."""

    def act(plant: Any) -> Vector:
        x, y, z = plant.airspeed_b
        return (-values["d_x"] * x, -values["d_y"] * y, -values["d_z"] * z)

    return act


def _quadratic_drag(values: Parameters) -> Callable[[Any], Vector]:
    """f_i -= k_i |v_i| v_i, each axis for itself.

    The package's law with ``shared`` at 0; by default there the whole speed multiplies each axis.
    """

    def act(plant: Any) -> Vector:
        x, y, z = plant.airspeed_b
        return (-values["k_x"] * abs(x) * x, -values["k_y"] * abs(y) * y, -values["k_z"] * abs(z) * z)

    return act


def _rotor_drag(values: Parameters) -> Callable[[Any], Vector]:
    """f -= h T/m (v_x, v_y, 0), v the airspeed in the body."""

    def act(plant: Any) -> Vector:
        lean = -values["h"] * plant.thrust_acc
        return (lean * plant.airspeed_b[0], lean * plant.airspeed_b[1], 0.0)

    return act


def _thrust_tilt(values: Parameters) -> Callable[[Any], Vector]:
    """f += T/m (towards_x, towards_y, 0); rad."""
    return lambda plant: (
        values["towards_x"] * plant.thrust_acc,
        values["towards_y"] * plant.thrust_acc,
        0.0,
    )


def _wind(values: Parameters) -> Callable[[Any], Vector]:
    """f += R^T a; the velocity of the air is in ``plant.airspeed_b``."""
    push_w = tuple(values.get(name, 0.0) for name in ("a_x", "a_y", "a_z"))
    return lambda plant: to_body(plant.rows, push_w)


THRUST_MAKERS = {
    "thrust_scale": _thrust_scale,
    "translational_lift": _translational_lift,
    "ground_effect": _ground_effect,
}
FORCE_MAKERS = {
    "linear_drag": _linear_drag,
    "quadratic_drag": _quadratic_drag,
    "rotor_drag": _rotor_drag,
    "thrust_tilt": _thrust_tilt,
    "wind": _wind,
}
AIR_VELOCITY = ("v_x", "v_y", "v_z")  # of wind, m/s
