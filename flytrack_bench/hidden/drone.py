"""A hidden drone's equations, and those of its effects; it moves in one of three ways.

- handout: the handout's step. Rates after the step turn the drone, the force acts in the attitude
  before it.
- semi_implicit: the same, but the force acts in the attitude after the step.
- fine: a differential equation. Delays and lags are exact for held commands; attitude, velocity and
  position follow by the midpoint rule in parts of 1 ms or less, cut where a delayed command or an
  instant of a late sensor falls. What the sensors say is true at an instant, not of a step.

An effect acts at a stage: commands, body rates, thrust, forces. Its function takes its parameters
and returns a hook, a function of the drone and the value so far: sticks (roll, pitch, yaw, thrust)
in [-1, 1], body rates in rad/s, thrust in N. Hooks of forces take the drone alone and return what
they add to the specific force, body, m/s^2. Where the package has another law for an effect of the
same name, the difference is intended: no real plant follows the package's laws.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq

from flytrack_bench.hidden.laws import (
    SCALES,
    FirstOrderNoise,
    command_hook,
    noise_hook,
    vector_hook,
)
from flytrack_bench.hidden.truth import STICKS, Truth
from flytrack_bench.hidden.vectors import (
    Number,
    Quaternion,
    Vector,
    add,
    exp,
    expm1,
    integrate_attitude,
    maximum,
    rotation,
    scale,
    tanh,
    to_body,
    to_world,
    turn,
    where,
)

Parameters = Mapping[str, float]
Sticks = tuple[Number, ...]  # roll, pitch, yaw, thrust
Hook = Callable[..., Any]
SECONDS_PER_MINUTE = 60.0
TINY, LARGE = 1e-3, 1e3  # between which the bend of a saturation is searched
LIFT_SPEED = 8.0  # m/s, airspeed at which translational lift has 1 - 1/e of its gain
AIR_VELOCITY = ("v_x", "v_y", "v_z")  # of wind, m/s
MAX_SUBSTEP_S = 0.001
SAME_S = 1e-9  # instants nearer than this are one


def _rate_expo(values: Parameters) -> Hook:
    """u *= (1 - expo) + expo u^2, u a rate stick; each axis has its own."""
    expos = tuple(values[axis] for axis in STICKS)
    return lambda drone, sticks: (
        *(u * (1.0 - expo * (1.0 - u * u)) for u, expo in zip(sticks, expos, strict=False)),
        sticks[3],
    )


def _rate_scale(values: Parameters) -> Hook:
    """omega *= (roll, pitch, yaw)."""
    roll, pitch, yaw = values["roll"], values["pitch"], values["yaw"]
    return lambda drone, rates: (roll * rates[0], pitch * rates[1], yaw * rates[2])


def _rate_saturation(values: Parameters) -> Hook:
    """u = limit tanh(u / limit), u a rate stick; each axis lacks its own share of u at full stick.

    Not the package's law, which mixes a hard limit with a gradual one of another shape.
    """
    # At a bend x, tanh(x) / x is what is left.
    left = (1.0 - values[axis] for axis in STICKS)
    bends = [
        brentq(lambda x, share: math.tanh(x) - share * x, TINY, LARGE, share) for share in left
    ]
    return lambda drone, sticks: (
        *(tanh(bend * u) / bend for u, bend in zip(sticks, bends, strict=False)),
        sticks[3],
    )


def _rate_cross_coupling(values: Parameters) -> Hook:
    """omega_z += from_roll omega_x + from_pitch omega_y."""
    from_roll, from_pitch = values["from_roll"], values["from_pitch"]
    return lambda drone, rates: (
        *rates[:2],
        rates[2] + from_roll * rates[0] + from_pitch * rates[1],
    )


def _motor_imbalance(values: Parameters) -> Hook:
    """omega_x += roll T/m, omega_y += pitch T/m; rad/s per m/s^2."""
    gains = (values["roll"], values["pitch"], 0.0)
    return lambda drone, rates: tuple(
        w + k * drone.thrust_acc for w, k in zip(rates, gains, strict=True)
    )


def _yaw_reaction(values: Parameters) -> Hook:
    """omega_z += angle du/dt, u the lagged thrust stick; rad."""
    angle = values["angle"]
    return lambda drone, rates: (*rates[:2], rates[2] + angle * drone.thrust_stick_slope)


class RateLoop:
    """y'' / wn^2 + lag_s y' + y = omega, with lag_s = 2 damping / wn: an oscillator per axis.

    Exact for rates held over the step. Each axis has its own lag, s, and damping.

    Attributes:
        rates_b, slopes_b: y and y', rad/s and rad/s^2.
    """

    def __init__(self, values: Parameters):
        self._axes = [(values[f"{axis}_damping"], values[f"{axis}_s"]) for axis in STICKS]
        self._responses: dict[float, list[list[list[float]]]] = {}
        self.rates_b: Vector = (0.0, 0.0, 0.0)
        self.slopes_b: Vector = (0.0, 0.0, 0.0)

    def follow(self, asked_b: Vector, step_s: float) -> Vector:
        """Return the body rates after a step in which these are asked for."""
        if step_s not in self._responses:
            self._responses[step_s] = [
                _response(damping, lag_s, step_s) for damping, lag_s in self._axes
            ]
        axes = zip(self._responses[step_s], asked_b, self.rates_b, self.slopes_b, strict=True)
        after = []
        for ((stay, follow), (pull, keep)), rate, now, slope in axes:
            offset = now - rate
            after.append((rate + stay * offset + follow * slope, pull * offset + keep * slope))
        self.rates_b, self.slopes_b = zip(*after, strict=True)
        return self.rates_b


def _response(damping: float, lag_s: float, step_s: float) -> list[list[float]]:
    """Return what stays of an offset and of a slope after a step: in the rate, and in its slope."""
    stiffness = (2.0 * damping / lag_s) ** 2
    return expm(step_s * np.array([[0.0, 1.0], [-stiffness, -stiffness * lag_s]])).tolist()


def _rate_slew_limit(values: Parameters) -> Hook:
    """A rate stick takes a least time from centre to full, s; each axis has its own."""
    before, times_s = [0.0, 0.0, 0.0], tuple(values[f"{axis}_s"] for axis in STICKS)

    def act(drone: Any, sticks: Sticks) -> Sticks:
        meant = []
        for axis, full_s in enumerate(times_s):
            most = drone.part_s / full_s
            change = max(-most, min(most, sticks[axis] - before[axis]))
            # Where time is continuous, what is asked for on the way; a step asks for its end.
            meant.append(before[axis] + (0.5 * change if drone.is_fine else change))
            before[axis] += change
        return (*meant, sticks[3])

    return act


def _thrust_scale(values: Parameters) -> Hook:
    """T *= factor."""
    return lambda drone, thrust: values["factor"] * thrust


def _translational_lift(values: Parameters) -> Hook:
    """T *= 1 + gain (1 - exp(-s^2 / (8 m/s)^2)), s the airspeed along body x and y.

    Not the package's law, which approaches the gain as a rational function.
    """
    gain = values["gain"]

    def act(drone: Any, thrust: Number) -> Number:
        x, y, _ = drone.airspeed_b
        return thrust * (1.0 - gain * expm1(-(x * x + y * y) / LIFT_SPEED**2))

    return act


def _ground_effect(values: Parameters) -> Hook:
    """T *= 1 + gain exp(-z / height_m).

    Not the package's law, which falls off with 1 / z^2.
    """
    gain, height = values["gain"], values["height_m"]
    return lambda drone, thrust: thrust * (1.0 + gain * exp(-maximum(drone.pos_w[2], 0.0) / height))


def _linear_drag(values: Parameters) -> Hook:
    """f -= (d_x v_x, d_y v_y, d_z v_z), v the airspeed in the body."""
    drag = (values["d_x"], values["d_y"], values["d_z"])
    return lambda drone: tuple(-d * v for d, v in zip(drag, drone.airspeed_b, strict=True))


def _quadratic_drag(values: Parameters) -> Hook:
    """f_i -= k_i |v_i| v_i, each axis for itself.

    The package's law with ``shared`` at 0; by default it multiplies each axis by the whole speed.
    """
    drag = (values["k_x"], values["k_y"], values["k_z"])
    return lambda drone: tuple(-k * abs(v) * v for k, v in zip(drag, drone.airspeed_b, strict=True))


def _rotor_drag(values: Parameters) -> Hook:
    """f -= h T/m (v_x, v_y, 0), v the airspeed in the body."""
    h = values["h"]
    return lambda drone: scale(-h * drone.thrust_acc, (*drone.airspeed_b[:2], 0.0))


def _thrust_tilt(values: Parameters) -> Hook:
    """f += T/m (towards_x, towards_y, 0); rad."""
    x, y = values["towards_x"], values["towards_y"]
    return lambda drone: (x * drone.thrust_acc, y * drone.thrust_acc, 0.0)


def _wind(values: Parameters) -> Hook:
    """f += R^T a; the air's velocity is part of ``drone.airspeed_b`` already."""
    push_w = tuple(values.get(name, 0.0) for name in ("a_x", "a_y", "a_z"))
    return lambda drone: to_body(drone.rows, push_w)


# By stage, in the order in which they act: first what a flight controller makes of the sticks, then
# the frame. Laws and noise that turn the drone have a stage of their own, "turn".
EFFECTS: dict[str, dict[str, Callable[[Parameters], Hook]]] = {
    "command": {
        "rate_expo": _rate_expo,
        "rate_saturation": _rate_saturation,
        "rate_slew_limit": _rate_slew_limit,
    },
    "rate": {
        "rate_scale": _rate_scale,
        "rate_cross_coupling": _rate_cross_coupling,
        "motor_imbalance": _motor_imbalance,
        "yaw_reaction": _yaw_reaction,
    },
    "thrust": {
        "thrust_scale": _thrust_scale,
        "translational_lift": _translational_lift,
        "ground_effect": _ground_effect,
    },
    "force": {
        "linear_drag": _linear_drag,
        "quadratic_drag": _quadratic_drag,
        "rotor_drag": _rotor_drag,
        "thrust_tilt": _thrust_tilt,
        "wind": _wind,
    },
}


class Start(NamedTuple):
    """The start of a flight, at rest in the air.

    Attributes:
        pos_w: m.
        heading: rad.
        open_v: voltage without load, V.
    """

    pos_w: Vector
    heading: float
    open_v: float
    thrust_stick: float


class Felt(NamedTuple):
    """What an inertial sensor measures.

    Attributes:
        force_b: specific force, m/s^2.
        rates_b: body rates, rad/s.
        slopes_b: of the rates, rad/s^2.
    """

    force_b: Vector
    rates_b: Vector
    slopes_b: Vector


class Tracked(NamedTuple):
    """What motion capture sees: m, m/s, body to world."""

    pos_w: Vector
    vel_w: Vector
    quat: Quaternion


class Part(NamedTuple):
    """A part of a step.

    Attributes:
        is_new: whether the delayed command has arrived before it.
        is_felt, is_tracked: whether the inertial sensor or motion capture reads at its end.
    """

    length_s: float
    is_new: bool
    is_felt: bool
    is_tracked: bool


class HiddenDrone:
    """A drone in flight; attributes are its state, updated by ``step``.

    Attributes:
        pos_w, vel_w, acc_w: m, m/s, m/s^2.
        quat: body to world.
        rows: of the matrix in which the force acted.
        rates_b: rad/s.
        force_b: specific force, m/s^2.
        applied: lagged sticks.
        thrust_stick_slope: of the last of them, 1/s.
        battery_v, open_v: V, under load and without.
        thrust_acc: thrust over mass, m/s^2.
        airspeed_b: m/s.
        time_s: s.
        past: commands that a delay remembers, the latest first, once has_flown.
        felt, tracked: what the sensors report of this step; in fine motion, at a late sensor's
            instant in it.
    """

    def __init__(
        self,
        truth: Truth,
        start: Start,
        rng: np.random.Generator,
        duration_s: float = 60.0,
        centre_w: Vector = (0.0, 0.0, 0.0),
        settle_s: float = 0.0,
    ):
        """Place the drone at a start.

        Args:
            duration_s, centre_w: of the flight, for effects outside the list.
            settle_s: before its log.
        """
        self.truth, self.duration_s, self.centre_w = truth, duration_s, centre_w
        self.pos_w, self.vel_w, self.acc_w = start.pos_w, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        half = 0.5 * start.heading
        self.quat: Quaternion = (math.cos(half), 0.0, 0.0, math.sin(half))
        self.rates_b: Vector = (0.0, 0.0, 0.0)
        self.rows = rotation(self.quat)
        self.force_b, self.airspeed_b, self.thrust_acc = (
            (0.0, 0.0, truth.gravity),
            (0.0, 0.0, 0.0),
            0.0,
        )
        self.applied: Sticks = (0.0, 0.0, 0.0, start.thrust_stick)
        self.thrust_stick_slope = 0.0
        self.full_rates = tuple(math.radians(rate) for rate in truth.max_rate)
        self.is_fine, self.part_s = truth.motion == "fine", truth.step_s
        self._sag_v = truth.effects.get("voltage_sag", {}).get("at_full_v", 0.0)
        self.open_v, self.time_s = start.open_v, 0.0
        self._onset_s = -math.inf if truth.onset_s is None else truth.onset_s + settle_s
        self.battery_v = self.loaded_v()
        self._air_w = tuple(truth.effects.get("wind", {}).get(name, 0.0) for name in AIR_VELOCITY)
        self.turning_b: Vector = (0.0, 0.0, 0.0)
        self.felt = Felt(self.force_b, self.rates_b, self.rates_b)
        self.tracked = Tracked(self.pos_w, self.vel_w, self.quat)
        asymmetry = truth.effects.get("thrust_lag_asymmetry", {}).get("ratio", 1.0)
        self._taus = (*truth.tau, asymmetry * truth.tau[3])
        self._collect_hooks(rng)
        self._parts = self._planned_parts()
        steps = {truth.step_s, *(0.5 * part.length_s for part in self._parts)}
        self._shares = {
            step: tuple(-math.expm1(-step / tau) for tau in self._taus) for step in steps
        }

    def _collect_hooks(self, rng: np.random.Generator) -> None:
        """Collect the hooks of each stage, in the order of its table."""
        effects, outside, gust = self.truth.effects, self.truth.outside, self.truth.gust
        self._hooks = {
            stage: [
                self._from_onset(make(effects[name]))
                for name, make in makers.items()
                if name in effects
            ]
            for stage, makers in EFFECTS.items()
        }
        self._hooks["turn"] = []
        self._noises: list[FirstOrderNoise] = []
        delay_s = effects.get("command_delay", {}).get("delay_s", 0.0)
        whole, self._late_share = divmod(delay_s / self.truth.step_s, 1.0)
        self.past: tuple[Sticks, ...] = ((0.0, 0.0, 0.0, 0.0),) * (int(whole) + 2)
        self.has_flown: Any = False
        loop = effects.get("second_order_rates")
        self._loop = RateLoop(loop) if loop else None
        if outside is not None and outside.kind == "command":
            self._hooks["command"].insert(0, command_hook(outside, self.truth))
        elif outside is not None and outside.kind == "stochastic":
            size = outside.amplitude * SCALES[outside.channel]
            self._add_noise(outside.shape["time_constant_s"], size, outside.channel, rng)
        elif outside is not None:
            stage = "turn" if outside.channel == "rate" else "force"
            self._hooks[stage].append(vector_hook(outside))
        if gust is not None:
            self._add_noise(gust.time_constant, gust.std, "force", rng)
            self._add_noise(gust.time_constant, gust.rate_std, "rate", rng)

    def _add_noise(
        self, time_constant_s: float, size: float, channel: str, rng: np.random.Generator
    ) -> None:
        process, is_rate = FirstOrderNoise(time_constant_s, rng), channel == "rate"
        if size:
            self._noises.insert(0 if is_rate else len(self._noises), process)
            stage = "turn" if is_rate else "force"
            self._hooks[stage].append(noise_hook(process, size, channel))

    def _from_onset(self, hook: Hook) -> Hook:
        """Return a hook that acts from the onset on."""
        if self.truth.onset_s is None:
            return hook

        def act(drone: Any, *value: Any) -> Any:
            if drone.time_s >= self._onset_s:
                return hook(drone, *value)
            return value[0] if value else (0.0, 0.0, 0.0)

        return act

    def _planned_parts(self) -> list[Part]:
        """Return the parts of a step of fine motion."""
        step_s, effects = self.truth.step_s, self.truth.effects
        arrives_s = self._late_share * step_s
        felt_s = step_s - effects.get("imu_latency", {}).get("latency_s", 0.0) % step_s
        tracked_s = step_s - self.truth.mocap_late_s % step_s
        parts, begin = [], 0.0
        for end in sorted({arrives_s, felt_s, tracked_s, step_s}):
            if end - begin < SAME_S:
                continue
            count = math.ceil((end - begin) / MAX_SUBSTEP_S - SAME_S)
            is_felt, is_tracked = (abs(end - instant) < SAME_S for instant in (felt_s, tracked_s))
            plain = Part((end - begin) / count, begin > arrives_s - SAME_S, False, False)
            parts += [plain] * (count - 1) + [
                plain._replace(is_felt=is_felt, is_tracked=is_tracked)
            ]
            begin = end
        return parts

    def loaded_v(self) -> Number:
        """Return the battery's voltage under the load of the applied thrust stick."""
        return self.open_v - self._sag_v * (0.5 + 0.5 * self.applied[3]) ** 2

    def step(self, sticks: Sticks) -> None:
        """Fly from one row of the log to the next under a command in [-1, 1]."""
        if self.is_fine:
            self._step_finely(sticks)
            return
        step_s = self.truth.step_s
        self._pass_noise(step_s)
        older, newer = self._arriving(sticks)
        part = self._late_share
        mean = tuple((1.0 - part) * new + part * old for new, old in zip(newer, older, strict=True))
        self._lag(self._fold("command", mean), step_s)
        before = self.quat
        asked = self._asked(before)
        if self._loop is not None:
            asked = self._loop.follow(asked, step_s)
        rates = self._add("turn", asked)
        self.quat = integrate_attitude(before, rates, step_s)
        if self.truth.motion == "semi_implicit":
            self._see(self.quat)
        self.force_b, self.rates_b = self._force(), rates
        self._accelerate(step_s)
        self._pass_time(step_s)
        self.felt = Felt(self.force_b, rates, (0.0, 0.0, 0.0))
        self.tracked = Tracked(self.pos_w, self.vel_w, self.quat)

    def _step_finely(self, sticks: Sticks) -> None:
        older, newer = self._arriving(sticks)
        for part_s, is_new, is_felt, is_tracked in self._parts:
            acting = newer if is_new else older
            begin = self._rates_now(acting) if is_felt else None
            middle = self._glide(acting, part_s)
            if begin is not None:
                self._feel(begin, middle, self._rates_now(acting), part_s)
            if is_tracked:
                self.tracked = Tracked(self.pos_w, self.vel_w, self.quat)

    def _arriving(self, sticks: Sticks) -> tuple[Sticks, Sticks]:
        """Return the sticks that act in the first ``_late_share`` of a step, and in its rest.

        Args:
            sticks: sent in this step; those of the first step act as if they had been held before.
        """
        self.past = tuple(
            tuple(where(self.has_flown, old, new) for old, new in zip(command, sticks, strict=True))
            for command in (sticks, *self.past[:-1])
        )
        self.has_flown = True
        return self.past[-1], self.past[-2]

    def _feel(self, begin: Vector, middle: Vector, end: Vector, part_s: float) -> None:
        """Set what an inertial sensor feels now, at the end of a part with these body rates."""
        if self._loop is not None:
            slopes = self._loop.slopes_b
        else:  # of a parabola, at its end
            slopes = scale(1.0 / part_s, add(add(begin, scale(-4.0, middle)), scale(3.0, end)))
        self.felt = Felt(self._force(), end, slopes)
        self.force_b, self.rates_b = self.felt[:2]

    def _glide(self, sticks: Sticks, part_s: float) -> Vector:
        """Advance by a part of a step with the midpoint rule; return the rates in its middle."""
        half_s, pos_w, vel_w, quat = 0.5 * part_s, self.pos_w, self.vel_w, self.quat
        self.part_s = part_s
        self._pass_noise(part_s)
        sticks = self._fold("command", sticks)
        self._lag(sticks, half_s)
        self._pass_time(half_s)
        self.pos_w, self.vel_w = (
            add(pos_w, scale(half_s, vel_w)),
            add(vel_w, scale(half_s, self.acc_w)),
        )
        rates = self._asked(turn(quat, self.turning_b, half_s))
        if self._loop is not None:
            before = self._loop.rates_b
            rates = scale(0.5, add(before, self._loop.follow(rates, part_s)))
        self.turning_b = rates = self._add("turn", rates)
        self.force_b, self.pos_w, self.vel_w = self._force(), pos_w, vel_w
        self._accelerate(part_s)
        self.quat = turn(quat, rates, part_s)
        self._lag(sticks, half_s)
        self._pass_time(half_s)
        return rates

    def _rates_now(self, sticks: Sticks) -> Vector:
        """Return the body rates at this instant, while a command acts."""
        self._set_slope(sticks)
        asked = self._asked(self.quat)
        return self._add("turn", asked if self._loop is None else self._loop.rates_b)

    def _pass_noise(self, step_s: float) -> None:
        for process in self._noises:
            process.step(step_s)

    def _pass_time(self, step_s: float) -> None:
        self.open_v -= self.truth.drain / SECONDS_PER_MINUTE * step_s
        self.battery_v = self.loaded_v()
        self.time_s += step_s

    def _fold(self, stage: str, value: Any) -> Any:
        """Return what the hooks of a stage make of a value, one after the other."""
        for hook in self._hooks[stage]:
            value = hook(self, value)
        return value

    def _add(self, stage: str, vector_b: Vector) -> Vector:
        """Return a vector with what the hooks of a stage add to it."""
        for hook in self._hooks[stage]:
            vector_b = add(vector_b, hook(self))
        return vector_b

    def _lag(self, command: Sticks, step_s: float) -> None:
        before, (*rates, rising, falling) = self.applied, self._shares[step_s]
        shares = (*rates, where(command[3] < before[3], falling, rising))
        pairs = zip(before, command, shares, strict=True)
        self.applied = tuple(stick + share * (asked - stick) for stick, asked, share in pairs)
        if self.is_fine:
            self._set_slope(command)
        else:
            self.thrust_stick_slope = (self.applied[3] - before[3]) / step_s

    def _set_slope(self, command: Sticks) -> None:
        """Set how fast the applied thrust stick moves at this instant."""
        away = command[3] - self.applied[3]
        self.thrust_stick_slope = away / where(away >= 0.0, self._taus[3], self._taus[4])

    def _see(self, quat: Quaternion) -> None:
        """Set what depends on an attitude: airspeed and thrust."""
        self.rows = rotation(quat)
        self.airspeed_b = to_body(self.rows, add(self.vel_w, scale(-1.0, self._air_w)))
        thrust = self.truth.thrust(self.applied[3], self.battery_v)
        self.thrust_acc = self._fold("thrust", thrust) / self.truth.mass

    def _asked(self, quat: Quaternion) -> Any:
        """Return the body rates that an inner loop follows, in an attitude."""
        self._see(quat)
        full, stick = self.full_rates, self.applied
        return self._fold("rate", (full[0] * stick[0], full[1] * stick[1], full[2] * stick[2]))

    def _force(self) -> Vector:
        """Return the specific force in the attitude that was seen last."""
        return self._add("force", (0.0, 0.0, self.thrust_acc))

    def _accelerate(self, step_s: float) -> None:
        self.acc_w = add(to_world(self.rows, self.force_b), (0.0, 0.0, -self.truth.gravity))
        moved = add(self.pos_w, scale(step_s, self.vel_w))
        self.pos_w = add(moved, scale(0.5 * step_s * step_s, self.acc_w))
        self.vel_w = add(self.vel_w, scale(step_s, self.acc_w))
