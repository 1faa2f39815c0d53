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

from scipy.optimize import brentq

from benchmarks.hidden.truth import STICKS
from benchmarks.hidden.vectors import Vector, to_body

Parameters = Mapping[str, float]
Sticks = tuple[float, float, float, float]
Hook = Callable[[Any, Any], Any]
TINY, LARGE = 1e-3, 1e3  # between which the bend of a saturation is searched
LIFT_SPEED = 8.0  # m/s, airspeed at which translational lift has 1 - 1/e of its gain
AIR_VELOCITY = ("v_x", "v_y", "v_z")  # of wind, m/s


class Delay:
    """Commands that are held for a step each, and act ``delay_s`` later."""

    def __init__(self, delay_s: float, step_s: float):
        whole, self.share = divmod(delay_s / step_s, 1.0)
        self._past: deque[Sticks] = deque(maxlen=int(whole) + 2)

    def arriving(self, sticks: Sticks) -> tuple[Sticks, Sticks]:
        """Return what acts in the first ``share`` of the step in which sticks are sent, and in the rest."""
        past = self._past
        past.appendleft(sticks)
        late = past.maxlen - 2
        return past[min(late + 1, len(past) - 1)], past[min(late, len(past) - 1)]

    def mean(self, sticks: Sticks) -> Sticks:
        """Return the mean of what acts in the step."""
        older, newer = self.arriving(sticks)
        part = self.share
        return tuple((1.0 - part) * new + part * old for new, old in zip(newer, older, strict=True))


def _rate_expo(values: Parameters) -> Hook:
    """u *= (1 - expo) + expo u^2, u a rate stick; each axis has its own."""
    expos = tuple(values[axis] for axis in STICKS)

    def act(plant: Any, sticks: Sticks) -> Sticks:
        pairs = zip(sticks, expos, strict=False)
        return (*(stick * (1.0 - expo * (1.0 - stick * stick)) for stick, expo in pairs), sticks[3])

    return act


def _rate_scale(values: Parameters) -> Hook:
    """omega *= (roll, pitch, yaw)."""
    roll, pitch, yaw = values["roll"], values["pitch"], values["yaw"]
    return lambda plant, rates: (roll * rates[0], pitch * rates[1], yaw * rates[2])


def _rate_saturation(values: Parameters) -> Hook:
    """u = limit tanh(u / limit), u a rate stick; each axis lacks its own share of u at full stick.

    Not the package's law, which mixes a hard limit with a gradual one of another shape.
    """
    # At a bend x, tanh(x) / x is what is left.
    left = (1.0 - values[axis] for axis in STICKS)
    bends = [brentq(lambda x, share: math.tanh(x) - share * x, TINY, LARGE, share) for share in left]

    def act(plant: Any, sticks: Sticks) -> Sticks:
        pairs = zip(sticks, bends, strict=False)
        return (*(math.tanh(bend * stick) / bend for stick, bend in pairs), sticks[3])

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
    """omega_z += angle du/dt, u the lagged thrust stick; rad."""
    angle = values["angle"]
    return lambda plant, rates: (*rates[:2], rates[2] + angle * plant.thrust_stick_slope)


class RateLoop:
    """y'' / wn^2 + lag_s y' + y = omega, with lag_s = 2 damping / wn: an oscillator per axis.

    Exact for rates held over the step. Each axis has its own lag, s, and damping, not 1. rates_b, slopes_b: y
    and y', rad/s and rad/s^2.
    """

    def __init__(self, values: Parameters):
        self._axes = [(values[f"{axis}_damping"], values[f"{axis}_s"]) for axis in STICKS]
        self._known: dict[float, list[tuple[float, float, float, float]]] = {}
        self.rates_b: Vector = (0.0, 0.0, 0.0)
        self.slopes_b: Vector = (0.0, 0.0, 0.0)

    def follow(self, asked_b: Vector, step_s: float) -> Vector:
        """Return the body rates after a step in which these are asked for."""
        if step_s not in self._known:
            self._known[step_s] = [_response(damping, lag_s, step_s) for damping, lag_s in self._axes]
        axes = zip(self._known[step_s], asked_b, self.rates_b, self.slopes_b, strict=True)
        after = []
        for (stay, follow, pull, keep), rate, now, slope in axes:
            offset = now - rate
            after.append((rate + stay * offset + follow * slope, pull * offset + keep * slope))
        self.rates_b, self.slopes_b = zip(*after, strict=True)
        return self.rates_b


def _response(damping: float, lag_s: float, step_s: float) -> tuple[float, float, float, float]:
    """Return what stays of an offset and of a slope after a step: in the rate, and in its slope."""
    natural = 2.0 * damping / lag_s
    decay, root = natural * damping, natural * cmath.sqrt(damping * damping - 1.0)
    shrink = math.exp(-decay * step_s)
    # Both are real, whether the root is (two lags) or not (oscillation).
    even, odd = cmath.cosh(root * step_s).real, (cmath.sinh(root * step_s) / root).real
    pull = -natural * natural * shrink * odd
    return shrink * (even + decay * odd), shrink * odd, pull, shrink * (even - decay * odd)


def _rate_slew_limit(values: Parameters) -> Hook:
    """A rate stick takes a least time from centre to full, s; each axis has its own."""
    before, times_s = [0.0, 0.0, 0.0], tuple(values[f"{axis}_s"] for axis in STICKS)

    def act(plant: Any, sticks: Sticks) -> Sticks:
        meant = []
        for axis, full_s in enumerate(times_s):
            most = plant.part_s / full_s
            change = max(-most, min(most, sticks[axis] - before[axis]))
            # Where time is continuous, what is asked for on the way; a step asks for its end.
            meant.append(before[axis] + (0.5 * change if plant.is_fine else change))
            before[axis] += change
        return (*meant, sticks[3])

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


# In the order in which they act: first what a flight controller makes of the sticks, then the frame.
COMMAND_EFFECTS = {
    "rate_expo": _rate_expo,
    "rate_saturation": _rate_saturation,
    "rate_slew_limit": _rate_slew_limit,
}
RATE_EFFECTS = {
    "rate_scale": _rate_scale,
    "rate_cross_coupling": _rate_cross_coupling,
    "motor_imbalance": _motor_imbalance,
    "yaw_reaction": _yaw_reaction,
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
