"""A pilot who knows the drone: cascaded control from position to sticks, on the true state.

The gains follow the plant's own lags, so that slow drones are flown gently and no hidden effect makes the
loop oscillate. The pilot knows the thrust curve without effects and integrates steady force errors in flight.
"""

import math

import numpy as np

from benchmarks.hidden.outside import FirstOrderNoise
from benchmarks.hidden.plans import Moment
from benchmarks.hidden.truth import DT_S, STICKS, Truth
from benchmarks.hidden.vectors import Vector, clip_length, norm, rotation, to_body, wrap_angle

# Each gain is a share of the inner loop's, so that no loop is faster than the one inside it.
ATTITUDE_PER_LAG, VELOCITY_PER_ATTITUDE, POSITION_PER_VELOCITY, LEARN_PER_VELOCITY = 0.4, 0.3, 0.35, 0.3
QUICKEST_ATTITUDE, QUICKEST_HEIGHT = 12.0, 5.0  # 1/s
YAW_GAIN, MOST_YAW_RATE = 2.5, 1.6  # 1/s, rad/s
MOST_TILTED = math.radians(65.0)  # of the commanded thrust
MOST_UP, MOST_DOWN = 14.0, 6.0  # m/s^2
MOST_LESSON = 2.0  # m/s, limit of the speed error in the integrator
MOST_SPEED, MOST_CORRECTION, MOST_LEARNT = 18.0, 4.0, 5.0  # m/s, m/s, m/s^2
UPRIGHT = 0.3  # cosine of the tilt beyond which the heading is undefined
TINY, LEAST_SLOPE, CUBE_POWER = 1e-9, 1.0, 3.0  # m/s^2; N per stick; of the thrust curve's last term
TREMBLE, TREMBLE_S = 0.01, 0.1  # of sticks that are held still, and its time constant, s
USUAL_TURN = 0.25  # of a stick, change that a slew limit stretches
NEWTON_STEPS = 4  # from the previous stick, which is close
FIRST_STICK = -0.2
# Manoeuvres on one stick are cut off where there is no room left to brake, and above a speed.
BRAKING, ROOM_M, FASTEST = 5.0, 4.0, 15.0  # m/s^2, m, m/s
# Near the ground the predicted height commands at least this climb.
LOOK_AHEAD_S, FLOOR_M, FLOOR_GAIN = 0.25, 0.14, 12.0


class Pilot:
    """Computes stick commands for the moments of a plan."""

    def __init__(self, truth: Truth, rng: np.random.Generator):
        self._truth = truth
        self._full_rates = tuple(math.radians(rate) for rate in truth.max_rate)
        effects = truth.effects
        delay = effects.get("command_delay", {}).get("delay_s", 0.0) + max(DT_S, truth.step_s)
        loop = effects.get("second_order_rates", {})
        ringing = max((loop[f"{axis}_s"] / loop[f"{axis}_damping"] for axis in STICKS if loop), default=0.0)
        slew = USUAL_TURN * max(effects.get("rate_slew_limit", {}).values(), default=0.0)
        slow_fall = max(1.0, effects.get("thrust_lag_asymmetry", {}).get("ratio", 1.0))
        turn_lag = max(truth.tau[:3]) + delay + ringing + slew
        self._attitude = min(QUICKEST_ATTITUDE, ATTITUDE_PER_LAG / turn_lag)
        self._level = VELOCITY_PER_ATTITUDE * self._attitude
        self._upright = min(QUICKEST_HEIGHT, ATTITUDE_PER_LAG / (slow_fall * truth.tau[3] + delay))
        self._learnt_w = (0.0, 0.0, 0.0)
        self._tremble = FirstOrderNoise(TREMBLE_S, rng, len(truth.tau))
        self._stick, self._is_cut_off = FIRST_STICK, False

    def command(self, plant, moment: Moment) -> tuple[float, float, float, float]:
        """Return sticks in [-1, 1] for the plant's state at a moment of the plan."""
        has_stick = moment.sticks is not None
        self._is_cut_off = has_stick and (self._is_cut_off or self._is_unsafe(plant))
        is_free = not has_stick or self._is_cut_off
        force_w = self._force(plant, moment, is_free)
        own = tuple(
            stick + TREMBLE * shake
            for stick, shake in zip(
                self._sticks(plant, force_w, moment.heading), self._tremble.step(DT_S), strict=True
            )
        )
        if not is_free:
            own = tuple(
                mine if given is None else given for mine, given in zip(own, moment.sticks, strict=True)
            )
        return tuple(max(-1.0, min(1.0, stick)) for stick in own)

    def _is_unsafe(self, plant) -> bool:
        falling = max(0.0, -plant.vel_w[2])
        low = plant.pos_w[2] - falling * falling / (2.0 * BRAKING) < ROOM_M
        return low or norm(plant.vel_w) > FASTEST

    def _force(self, plant, moment: Moment, is_free: bool) -> Vector:
        """Return the wanted specific force, world, m/s^2."""
        gains = (self._level, self._level, self._upright)
        away = tuple(
            POSITION_PER_VELOCITY * gain * (there - here)
            for gain, there, here in zip(gains, moment.pos_w, plant.pos_w, strict=True)
        )
        wanted = tuple(a + b for a, b in zip(clip_length(away, MOST_CORRECTION), moment.vel_w, strict=True))
        error = tuple(a - b for a, b in zip(clip_length(wanted, MOST_SPEED), plant.vel_w, strict=True))
        acc = [
            a + gain * e + k for a, gain, e, k in zip(moment.acc_w, gains, error, self._learnt_w, strict=True)
        ]
        if is_free:
            learn = tuple(
                known + DT_S * LEARN_PER_VELOCITY * gain * gain * e
                for known, gain, e in zip(self._learnt_w, gains, clip_length(error, MOST_LESSON), strict=True)
            )
            self._learnt_w = clip_length(learn, MOST_LEARNT)
        ahead = plant.pos_w[2] + LOOK_AHEAD_S * plant.vel_w[2]
        if ahead < FLOOR_M:
            acc[2] += FLOOR_GAIN * self._upright * (FLOOR_M - ahead)
        up = self._truth.gravity + max(-MOST_DOWN, min(MOST_UP, acc[2]))
        side = clip_length((acc[0], acc[1], 0.0), up * math.tan(MOST_TILTED))
        return (side[0], side[1], up)

    def _sticks(self, plant, force_w: Vector, heading: float) -> tuple[float, float, float, float]:
        """Return sticks that turn the thrust towards a force, and the nose towards a heading."""
        rows = rotation(plant.quat)
        x, y, z = to_body(rows, force_w)
        across = math.hypot(x, y)
        angle = self._attitude * math.atan2(across, z) / max(across, TINY)
        yaw = 0.0
        if rows[2][2] > UPRIGHT:
            error = wrap_angle(heading - math.atan2(rows[1][0], rows[0][0]))
            yaw = max(-MOST_YAW_RATE, min(MOST_YAW_RATE, YAW_GAIN * error))
        rates = (-angle * y, angle * x, yaw)
        sticks = tuple(rate / full for rate, full in zip(rates, self._full_rates, strict=True))
        return (*sticks, self._thrust_stick(max(z, 0.0) * self._truth.mass, plant.battery_v))

    def _thrust_stick(self, thrust_n: float, battery_v: float) -> float:
        """Return the stick for a thrust by the curve without effects, by Newton's method."""
        _, linear, square, cube, _, both = self._truth.coeffs
        stick = self._stick
        for _ in range(NEWTON_STEPS):
            slope = linear + both * battery_v + stick * (2.0 * square + CUBE_POWER * cube * stick)
            stick += (thrust_n - self._truth.thrust(stick, battery_v)) / max(slope, LEAST_SLOPE)
            stick = max(-1.0, min(1.0, stick))
        self._stick = stick
        return stick
