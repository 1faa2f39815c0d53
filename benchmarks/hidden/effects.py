"""The hidden effects' equations, by the stage at which they act: commands, body rates, thrust, forces.

A function here takes an effect's parameters and returns a hook, a function of the plant and the value so far:
sticks (roll, pitch, yaw, thrust) in [-1, 1], body rates in rad/s, thrust in N. Hooks of forces take the plant
alone and return what they add to the specific force, body, m/s^2. Where the package has another law for an
effect of the same name, the difference is intended: no real plant follows the package's laws.
"""

import cmath
import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from benchmarks.hidden.truth import DT_S
from benchmarks.hidden.vectors import Vector, to_body

Parameters = Mapping[str, float]
Sticks = tuple[float, float, float, float]
Hook = Callable[[Any, Any], Any]
MOST_STEPS = 8  # commands that a delay remembers
BISECTIONS = 60  # halve an interval down to rounding
LIFT_SPEED = 8.0  # m/s, airspeed at which translational lift has 1 - 1/e of its gain
AIR_VELOCITY = ("v_x", "v_y", "v_z")  # of wind, m/s


def _command_delay(values: Parameters) -> Hook:
    """u(t) = u(t - delay_s), averaged over the step."""
    whole, part = divmod(values["delay_s"] / DT_S, 1.0)
    late, past = int(whole), deque(maxlen=MOST_STEPS)

    def act(plant: Any, sticks: Sticks) -> Sticks:
        past.appendleft(sticks)
        newer = past[min(late, len(past) - 1)]
        older = past[min(late + 1, len(past) - 1)]
        return tuple((1.0 - part) * new + part * old for new, old in zip(newer, older, strict=True))

    return act


def _rate_expo(values: Parameters) -> Hook:
    """omega *= (1 - expo) + expo u^2, u the lagged stick."""
    expo = values["expo"]

    def act(plant: Any, rates: Vector) -> Vector:
        return tuple(
            rate * (1.0 - expo * (1.0 - stick * stick))
            for rate, stick in zip(rates, plant.applied[:3], strict=True)
        )

    return act


def _rate_scale(values: Parameters) -> Hook:
    """omega *= (roll, pitch, yaw)."""
    roll, pitch, yaw = values["roll"], values["pitch"], values["yaw"]
    return lambda plant, rates: (roll * rates[0], pitch * rates[1], yaw * rates[2])


def _rate_saturation(values: Parameters) -> Hook:
    """omega = limit tanh(omega / limit), per axis; at full stick the share ``lost`` of it is missing.

    Not the package's law, which mixes a hard limit with a gradual one of another shape.
    """
    low, high = 0.0, 1.0
    # In x = 1 / (limit as a share of full stick): tanh(x) / x falls from 1.
    while math.tanh(high) / high > 1.0 - values["lost"]:
        high *= 2.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        is_low = math.tanh(middle) / middle > 1.0 - values["lost"]
        low, high = (middle, high) if is_low else (low, middle)
    inverse = high

    def act(plant: Any, rates: Vector) -> Vector:
        return tuple(
            full / inverse * math.tanh(inverse * rate / full)
            for rate, full in zip(rates, plant.full_rates, strict=True)
        )

    return act


def _rate_cross_coupling(values: Parameters) -> Hook:
    """omega_z += from_roll omega_x + from_pitch omega_y."""
    from_roll, from_pitch = values["from_roll"], values["from_pitch"]
    return lambda plant, rates: (*rates[:2], rates[2] + from_roll * rates[0] + from_pitch * rates[1])


def _motor_imbalance(values: Parameters) -> Hook:
    """omega_x += roll T/m, omega_y += pitch T/m; rad/s per m/s^2."""
    gains = (values["roll"], values["pitch"], 0.0)
    return lambda plant, rates: tuple(w + k * plant.thrust_acc for w, k in zip(rates, gains, strict=True))


def _yaw_reaction(values: Parameters) -> Hook:
    """omega_z += angle du/dt, u the lagged thrust action; rad."""
    gain = values["angle"] / DT_S
    return lambda plant, rates: (
        *rates[:2],
        rates[2] + gain * (plant.applied[3] - plant.applied_before[3]),
    )


def _second_order_rates(values: Parameters) -> Hook:
    """y'' + 2 zeta wn y' + wn^2 y = wn^2 omega: an oscillator, exact for rates held over the step.

    wn: rad/s. zeta: not 1. The package has the same law with other parameters: lag_s is 2 zeta / wn,
    damping is zeta.
    """
    natural, damping = values["wn"], values["zeta"]
    decay, root = natural * damping, natural * cmath.sqrt(damping * damping - 1.0)
    shrink = math.exp(-decay * DT_S)
    # Both are real, whether the root is (two lags) or not (oscillation).
    even, odd = cmath.cosh(root * DT_S).real, (cmath.sinh(root * DT_S) / root).real
    stay, follow = shrink * (even + decay * odd), shrink * odd
    pull, keep = -natural * natural * shrink * odd, shrink * (even - decay * odd)
    offset, slope = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    now = [0.0, 0.0, 0.0]

    def act(plant: Any, rates: Vector) -> Vector:
        for axis, rate in enumerate(rates):
            offset[axis] = now[axis] - rate
            now[axis] = rate + stay * offset[axis] + follow * slope[axis]
            slope[axis] = pull * offset[axis] + keep * slope[axis]
        return (now[0], now[1], now[2])

    return act


def _rate_slew_limit(values: Parameters) -> Hook:
    """|omega - omega before| <= dt / inverse, per axis."""
    most, before = DT_S / values["inverse"], [0.0, 0.0, 0.0]

    def act(plant: Any, rates: Vector) -> Vector:
        for axis, rate in enumerate(rates):
            before[axis] += max(-most, min(most, rate - before[axis]))
        return (before[0], before[1], before[2])

    return act


def _thrust_scale(values: Parameters) -> Hook:
    """T *= factor."""
    return lambda plant, thrust: values["factor"] * thrust


def _translational_lift(values: Parameters) -> Hook:
    """T *= 1 + gain (1 - exp(-s^2 / (8 m/s)^2)), s the airspeed along body x and y.

    Not the package's law, which approaches the gain as a rational function.
    """
    gain = values["gain"]

    def act(plant: Any, thrust: float) -> float:
        x, y, _ = plant.airspeed_b
        return thrust * (1.0 - gain * math.expm1(-(x * x + y * y) / LIFT_SPEED**2))

    return act


def _ground_effect(values: Parameters) -> Hook:
    """T *= 1 + gain exp(-z / height_m).

    Not the package's law, which falls off with 1 / z^2.
    """
    gain, height = values["gain"], values["height_m"]
    return lambda plant, thrust: thrust * (1.0 + gain * math.exp(-max(plant.pos_w[2], 0.0) / height))


def _linear_drag(values: Parameters) -> Hook:
    """f -= (d_x v_x, d_y v_y, d_z v_z), v the airspeed in the body."""
    drag = (values["d_x"], values["d_y"], values["d_z"])
    return lambda plant: tuple(-d * v for d, v in zip(drag, plant.airspeed_b, strict=True))


def _quadratic_drag(values: Parameters) -> Hook:
    """f_i -= k_i |v_i| v_i, each axis for itself.

    The package's law with ``shared`` at 0; by default it multiplies each axis by the whole speed.
    """
    drag = (values["k_x"], values["k_y"], values["k_z"])
    return lambda plant: tuple(-k * abs(v) * v for k, v in zip(drag, plant.airspeed_b, strict=True))


def _rotor_drag(values: Parameters) -> Hook:
    """f -= h T/m (v_x, v_y, 0), v the airspeed in the body."""

    def act(plant: Any) -> Vector:
        lean = -values["h"] * plant.thrust_acc
        return (lean * plant.airspeed_b[0], lean * plant.airspeed_b[1], 0.0)

    return act


def _thrust_tilt(values: Parameters) -> Hook:
    """f += T/m (towards_x, towards_y, 0); rad."""
    x, y = values["towards_x"], values["towards_y"]
    return lambda plant: (x * plant.thrust_acc, y * plant.thrust_acc, 0.0)


def _wind(values: Parameters) -> Hook:
    """f += R^T a; the air's velocity is part of ``plant.airspeed_b`` already."""
    push_w = tuple(values.get(name, 0.0) for name in ("a_x", "a_y", "a_z"))
    return lambda plant: to_body(plant.rows, push_w)


COMMAND_EFFECTS = {"command_delay": _command_delay}
# In the order in which they act: first the flight controller, then the frame.
RATE_EFFECTS = {
    "rate_expo": _rate_expo,
    "rate_scale": _rate_scale,
    "rate_saturation": _rate_saturation,
    "rate_cross_coupling": _rate_cross_coupling,
    "motor_imbalance": _motor_imbalance,
    "yaw_reaction": _yaw_reaction,
    "second_order_rates": _second_order_rates,
    "rate_slew_limit": _rate_slew_limit,
}
THRUST_EFFECTS = {
    "thrust_scale": _thrust_scale,
    "translational_lift": _translational_lift,
    "ground_effect": _ground_effect,
}
FORCE_EFFECTS = {
    "linear_drag": _linear_drag,
    "quadratic_drag": _quadratic_drag,
    "rotor_drag": _rotor_drag,
    "thrust_tilt": _thrust_tilt,
    "wind": _wind,
}
