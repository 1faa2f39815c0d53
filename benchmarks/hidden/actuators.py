"""Hidden effects of sticks, motors and rate loops, each from its own equation.

A maker takes an effect's parameters and returns a function of the plant and the value so far. Sticks: roll,
pitch, yaw, thrust, 1. Rates: body, rad/s. Where the package has another law for an effect of the same name,
the difference is wanted: no real plant follows the package's.
"""

import cmath
import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from benchmarks.hidden.truth import DT_S
from benchmarks.hidden.vectors import Vector

Parameters = Mapping[str, float]
Sticks = tuple[float, float, float, float]
Hook = Callable[[Any, Any], Any]
MOST_STEPS = 8  # of commands that a delay remembers
BISECTIONS = 60  # halve an interval down to rounding


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
    """omega = limit tanh(omega / limit), per axis; at full stick, ``lost`` of it is missing.

    Not the package's law, which mixes a hard limit and a gradual one of another shape.
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
    return lambda plant, rates: (
        rates[0],
        rates[1],
        rates[2] + from_roll * rates[0] + from_pitch * rates[1],
    )


def _motor_imbalance(values: Parameters) -> Hook:
    """omega_x += roll T/m, omega_y += pitch T/m; rad/s per m/s^2."""
    roll, pitch = values["roll"], values["pitch"]
    return lambda plant, rates: (
        rates[0] + roll * plant.thrust_acc,
        rates[1] + pitch * plant.thrust_acc,
        rates[2],
    )


def _yaw_reaction(values: Parameters) -> Hook:
    """omega_z += angle du/dt, u the lagged thrust action; rad."""
    gain = values["angle"] / DT_S
    return lambda plant, rates: (
        rates[0],
        rates[1],
        rates[2] + gain * (plant.applied[3] - plant.applied_before[3]),
    )


def _second_order_rates(values: Parameters) -> Hook:
    """y'' + 2 zeta wn y' + wn^2 y = wn^2 omega: an oscillator, exact for rates held over the step.

    wn: rad/s. zeta: other than 1.

    The package has the same law with other parameters: lag_s is 2 zeta / wn, damping is zeta.
    """
    natural, damping = values["wn"], values["zeta"]
    decay, root = natural * damping, natural * cmath.sqrt(damping * damping - 1.0)
    shrink = math.exp(-decay * DT_S)
    # Both are real, whether the root is (two lags) or not (an oscillation).
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


COMMAND_MAKERS = {"command_delay": _command_delay}
# In the order in which they act: what the flight controller asks for, then what the frame does with it.
RATE_MAKERS = {
    "rate_expo": _rate_expo,
    "rate_scale": _rate_scale,
    "rate_saturation": _rate_saturation,
    "rate_cross_coupling": _rate_cross_coupling,
    "motor_imbalance": _motor_imbalance,
    "yaw_reaction": _yaw_reaction,
    "second_order_rates": _second_order_rates,
    "rate_slew_limit": _rate_slew_limit,
}
