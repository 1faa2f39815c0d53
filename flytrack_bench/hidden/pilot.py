"""A pilot who knows the drone, and flight plans made of legs and manoeuvres.

The pilot is cascaded control from position to sticks, on the true state. The gains follow the
plant's own lags, so that slow drones are flown gently and no hidden effect makes the loop
oscillate. The pilot knows the thrust curve without effects and integrates steady force errors in
flight.

A plan does not depend on the plant, so where it leads is known before the flight. It has
everything: legs of 0 to 18 m/s, low passes, waves on one stick, flips, thrust steps.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flytrack_bench.hidden import DT_S, STICKS, HiddenDrone, Truth
from flytrack_bench.hidden.draws import log_uniform
from flytrack_bench.hidden.drone import Sticks
from flytrack_bench.hidden.laws import FirstOrderNoise
from flytrack_bench.hidden.vectors import Vector, norm, rotation, to_body, wrap_angle

Rng = np.random.Generator
CLIMB, TURN_RATE = 5.0, math.radians(70.0)  # m/s, rad/s: what a plan asks for
SMOOTH_S = 0.4  # over which a plan's velocity and heading are smoothed
# Manoeuvres. Amplitudes of rate sticks: in a minute, each axis gets one of each row. Beyond QUICK,
# pulses are short.
AMPLITUDES, QUICK = ((0.1, 0.2), (0.35, 0.6), (1.0,)), 0.6
PULSE_S, QUICK_PULSE_S = (0.15, 0.3), (0.08, 0.16)  # a full stick turns by 90 degrees in 0.15 s
CHIRP_S, CHIRP_FROM_HZ, CHIRP_HZ_PER_S = 1.3, 1.2, (3.0, 8.0)
RECOVER_S, AFTER_FLIP_S, AFTER_STEPS_S, AFTER_LOW_S = 1.0, 1.6, 0.8, 0.4
JUMP_S, JUMP_STICK, FLIP_S, FLIP_STICK = 0.2, 0.6, (0.45, 0.62), (-0.6, -0.1)
# Thrust steps: sticks and durations; the higher, the shorter, to end near the same speed.
STEPS_UP, STEPS_DOWN, HELD_DOWN_S = (0.1, 1.0), (-1.0, -0.4), 0.3
HELD_UP_S, SHORTER_S, UNEVEN = 0.45, 0.3, (0.8, 1.2)  # the middle one per unit of stick
HOMEWARD_M, HOMEWARD_SPREAD = 30.0, 0.4  # from the origin, where legs lead back; rad
SPEEDING_UP, MAX_NOSE_RATE = 7.0, 1.0  # m/s^2, rad/s
HIGH_M = (16.0, 24.0)  # where manoeuvres on one stick are flown
HIGH_SPEEDS, HIGH_HOLD_S, HIGH_TURNING = (2.0, 18.0), (0.4, 1.2), 0.5  # m/s, s, rad/s
LOW_SPEEDS, LOW_HOLD_S, LOW_TURNING = (0.5, 12.0), (0.5, 1.2), 0.3
LOW_M, SINK_M, SINK_S, SETTLE_S = (0.15, 1.0), 0.7, 0.8, 0.7  # the last metre is sunk slowly
LOWER_M, SLOWER = 0.2, 0.9  # changes of low heights and of speeds per repeated attempt
YAW_TURN = (1.2, math.pi)  # rad
BEGIN_S = 0.5  # of hover before something begins
START_SPREAD_M = 5.0
HIGHER_M = 1.5  # of the start, per repeated attempt
# Each gain is a share of the inner loop's, so that no loop is faster than the one inside it.
ATTITUDE_PER_LAG, VELOCITY_PER_ATTITUDE = 0.4, 0.3
POSITION_PER_VELOCITY, LEARN_PER_VELOCITY = 0.35, 0.3
QUICKEST_ATTITUDE, QUICKEST_HEIGHT = 12.0, 5.0  # 1/s
YAW_GAIN, MAX_YAW_RATE = 2.5, 1.6  # 1/s, rad/s
MAX_TILTED = math.radians(65.0)  # of the commanded thrust
MAX_UP, MAX_DOWN = 14.0, 6.0  # m/s^2
MAX_INTEGRATED_ERROR = 2.0  # m/s, limit of the speed error in the integrator
MAX_SPEED, MAX_CORRECTION, MAX_LEARNT = 18.0, 4.0, 5.0  # m/s, m/s, m/s^2
UPRIGHT = 0.3  # cosine of the tilt beyond which the heading is undefined
TINY, MIN_SLOPE = 1e-9, 1.0  # m/s^2; N per stick
TREMBLE, TREMBLE_S = 0.01, 0.1  # of sticks that are held still, and its time constant, s
USUAL_TURN = 0.25  # of a stick, change that a slew limit stretches
NEWTON_STEPS = 4  # from the previous stick, which is close
FIRST_STICK = -0.2
# Manoeuvres on one stick are cut off where there is no room left to brake, and above a speed.
BRAKING, ROOM_M, FASTEST = 5.0, 4.0, 15.0  # m/s^2, m, m/s
# Near the ground the predicted height commands at least this climb.
LOOK_AHEAD_S, FLOOR_M, FLOOR_GAIN = 0.25, 0.14, 12.0


AUTOMATIC = np.full(4, np.nan)  # no stick is moved by hand


class Moment(NamedTuple):
    """The target at one time, world: m, m/s, m/s^2, rad.

    Attributes:
        sticks: (4,), those moved by hand; nan where the pilot flies.
    """

    pos_w: np.ndarray
    vel_w: np.ndarray
    acc_w: np.ndarray
    heading: float
    sticks: np.ndarray


class Sketch:
    """A plan under construction: velocities, headings and sticks, a row per 10 ms.

    Attributes:
        caution: number of earlier attempts that were too low or too fast.
    """

    def __init__(self, rng: Rng, start_w: np.ndarray, heading: float, caution: int):
        self.rng, self.caution = rng, caution
        self.start_w, self.pos_w, self.heading = start_w, start_w, heading
        self._rows: list[np.ndarray] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(
        self, vel_w: ArrayLike, heading: float | None = None, sticks: np.ndarray = AUTOMATIC
    ) -> None:
        """Append a moment; the heading is kept if not given."""
        self.heading = self.heading if heading is None else heading
        vel_w = np.asarray(vel_w)
        self._rows.append(np.concatenate([vel_w, [self.heading], sticks]))
        self.pos_w = self.pos_w + vel_w * DT_S

    def wait(self, seconds: float) -> None:
        """Append a hover."""
        for _ in range(steps_of(seconds)):
            self.add(np.zeros(3))

    def turn_to(self, heading: float) -> None:
        """Append a hover that turns to a heading the shorter way."""
        turn = wrap_angle(heading - self.heading)
        first, steps = self.heading, max(1, steps_of(abs(turn) / TURN_RATE))
        for step in range(steps):
            self.add(np.zeros(3), first + turn * (step + 1) / steps)

    def climb_to(self, height_m: float) -> None:
        """Append a climb or descent."""
        climb = height_m - self.pos_w[2]
        steps = max(1, steps_of(abs(climb) / CLIMB))
        for _ in range(steps):
            self.add((0.0, 0.0, climb / steps / DT_S))

    def hands_on(self, sticks: np.ndarray) -> None:
        """Append moments with sticks (num_rows, 4) moved by hand; nan where the pilot flies."""
        for row in sticks:
            self.add(np.zeros(3), sticks=row)

    def moments(self, seconds: float) -> list[Moment]:
        """Return the first moments of the plan, with smoothed velocities and headings."""
        width = steps_of(SMOOTH_S)
        kernel = np.hanning(width + 2)[1:-1]
        rows, sticks = np.split(np.array(self._rows), [4], axis=1)
        padded = np.concatenate([np.tile(rows[0] * [0, 0, 0, 1], (width, 1)), rows])
        smooth = [np.convolve(column, kernel / kernel.sum())[width:] for column in padded.T]
        vel_w, heading = np.stack(smooth[:3], axis=1)[: len(rows)], smooth[3]
        pos_w = self.start_w + np.cumsum(vel_w, axis=0) * DT_S
        acc_w = np.gradient(vel_w, DT_S, axis=0)
        return [
            Moment(pos_w[i], vel_w[i], acc_w[i], float(heading[i]), sticks[i])
            for i in range(steps_of(seconds))
        ]


def steps_of(seconds: float) -> int:
    """Return the number of steps of 10 ms in a time."""
    return round(seconds / DT_S)


def leg(sketch: Sketch, speed: float, hold_s: float, turning: float) -> None:
    """Append a leg: accelerate to a speed, hold it, brake.

    The direction turns at ``turning``, rad/s. A leg that begins far away leads home.

    The nose points anywhere and turns slowly.
    """
    rng = sketch.rng
    x, y, _ = sketch.pos_w
    way = rng.uniform(-math.pi, math.pi)
    if math.hypot(x, y) > HOMEWARD_M:
        way = math.atan2(-y, -x) + rng.normal(0.0, HOMEWARD_SPREAD)
    sketch.turn_to(sketch.heading + rng.uniform(-1.0, 1.0) * math.pi * rng.integers(2))
    nose = rng.uniform(-1.0, 1.0) * MAX_NOSE_RATE
    ramp = max(1, steps_of(speed / SPEEDING_UP))
    shares = np.concatenate(
        [np.linspace(0, 1, ramp), np.ones(steps_of(hold_s)), np.linspace(1, 0, ramp)]
    )
    for share in shares.tolist():
        way += turning * DT_S
        vel_w = (share * speed * math.cos(way), share * speed * math.sin(way), 0.0)
        sketch.add(vel_w, sketch.heading + nose * DT_S)


def wave(axis: int, amplitude: float, rng: Rng) -> np.ndarray:
    """Return sticks, (num_rows, 4), with a doublet, chirp or short pulse on one rate stick.

    The other two rate sticks are centred.
    """
    name, sign = rng.choice(["doublet", "chirp", "pulses"]), rng.choice([-1.0, 1.0])
    if name == "chirp":
        time = np.arange(steps_of(CHIRP_S)) * DT_S
        cycles = CHIRP_FROM_HZ * time + 0.5 * rng.uniform(*CHIRP_HZ_PER_S) * time**2
        shape = np.cos(2.0 * np.pi * cycles)
    else:
        steps = steps_of(rng.uniform(*(QUICK_PULSE_S if amplitude >= QUICK else PULSE_S)))
        gap = 0 if name == "doublet" else steps
        shape = np.concatenate([np.ones(steps), np.zeros(gap), -np.ones(steps), np.zeros(gap)])
    sticks = np.zeros((len(shape), 4))
    sticks[:, axis], sticks[:, 3] = sign * amplitude * shape, np.nan
    return sticks


def manoeuvre(sketch: Sketch, axis: int, amplitude: float) -> None:
    """Append a wave on one rate stick, and time to recover."""
    sketch.hands_on(wave(axis, amplitude, sketch.rng))
    sketch.wait(RECOVER_S)


def flip(sketch: Sketch) -> None:
    """Append a jump, about one turn at full stick, and time to recover."""
    rng = sketch.rng
    jump = np.full((steps_of(JUMP_S), 4), np.nan)
    turn = np.zeros((steps_of(rng.uniform(*FLIP_S)), 4))
    jump[:, 3] = JUMP_STICK
    turn[:, rng.integers(2)], turn[:, 3] = rng.choice([-1.0, 1.0]), rng.uniform(*FLIP_STICK)
    sketch.hands_on(np.concatenate([jump, turn]))
    sketch.wait(AFTER_FLIP_S)


def thrust_steps(sketch: Sketch) -> None:
    """Append steps of the thrust stick up and down, upright, and time to recover."""
    rng = sketch.rng
    sticks = []
    for up in rng.permutation([1.0, 0.0, 1.0, 0.0]).tolist():
        level = rng.uniform(*(STEPS_UP if up else STEPS_DOWN))
        seconds = rng.uniform(*UNEVEN) * (HELD_UP_S - SHORTER_S * level if up else HELD_DOWN_S)
        sticks.append(np.tile([np.nan, np.nan, np.nan, level], (steps_of(seconds), 1)))
    sketch.hands_on(np.concatenate(sticks))
    sketch.wait(AFTER_STEPS_S)


def low_pass(sketch: Sketch) -> None:
    """Append a descent, a leg near the ground, and a climb half way."""
    rng = sketch.rng
    raised = LOWER_M * sketch.caution
    height = log_uniform(*LOW_M, rng) + raised
    sketch.climb_to(height + SINK_M)
    for _ in range(steps_of(SINK_S)):
        sketch.add((0.0, 0.0, -SINK_M / SINK_S))
    sketch.wait(SETTLE_S)
    speed = SLOWER**sketch.caution * rng.uniform(*LOW_SPEEDS)
    leg(sketch, speed, rng.uniform(*LOW_HOLD_S), rng.normal(0.0, LOW_TURNING))
    sketch.wait(AFTER_LOW_S)


def fast(sketch: Sketch, low: float, high: float) -> None:
    """Append a leg of a speed between two, m/s."""
    rng = sketch.rng
    speed = SLOWER**sketch.caution * rng.uniform(low, high)
    leg(sketch, speed, rng.uniform(*HIGH_HOLD_S), rng.normal(0.0, HIGH_TURNING))


def yaw_turn(sketch: Sketch) -> None:
    """Append a turn of the nose."""
    sketch.turn_to(sketch.heading + sketch.rng.choice([-1.0, 1.0]) * sketch.rng.uniform(*YAW_TURN))


def cycle(sketch: Sketch) -> None:
    """Append 50 to 60 s: manoeuvres and legs at height, two low passes among them."""
    rng = sketch.rng
    waves = [(axis, float(rng.choice(row))) for axis in range(3) for row in AMPLITUDES]
    first, last = HIGH_SPEEDS
    middle = 0.5 * (first + last)
    blocks: list[Callable[[Sketch], None]] = [
        *(partial(manoeuvre, axis=axis, amplitude=size) for axis, size in waves),
        *(
            partial(fast, low=low, high=high)
            for low, high in ((middle, last), (first, middle), (first, last))
        ),
        *(thrust_steps, thrust_steps, flip, yaw_turn),
    ]
    blocks = [blocks[number] for number in rng.permutation(len(blocks))]
    half = len(blocks) // 2
    for number, block in enumerate(blocks):
        if number == half:
            low_pass(sketch)
            low_pass(sketch)
            sketch.climb_to(rng.uniform(*HIGH_M))
        block(sketch)


def plan(seconds: float, rng: Rng, caution: int = 0) -> list[Moment]:
    """Return the plan of a flight, a moment per 10 ms.

    Args:
        caution: number of earlier attempts that were too low or too fast.
    """
    start_w = np.append(rng.uniform(-START_SPREAD_M, START_SPREAD_M, 2), 0.0)
    start_w[2] = HIGHER_M * caution + rng.uniform(*HIGH_M)
    sketch = Sketch(rng, start_w, float(rng.uniform(-math.pi, math.pi)), caution)
    sketch.wait(BEGIN_S)
    while len(sketch) * DT_S < seconds:
        cycle(sketch)
    return sketch.moments(seconds)


def clip_length(vector: np.ndarray, most: float) -> np.ndarray:
    """Return a vector shortened to a length, if it is longer."""
    length = norm(vector.tolist())
    return vector if length <= most else most / length * vector


class Pilot:
    """Computes stick commands for the moments of a plan."""

    def __init__(self, truth: Truth, rng: np.random.Generator):
        self._truth = truth
        self._full_rates = tuple(math.radians(rate) for rate in truth.max_rate)
        effects = truth.effects
        delay = effects.get("command_delay", {}).get("delay_s", 0.0) + max(DT_S, truth.step_s)
        loop = effects.get("second_order_rates", {})
        ringing = max(
            (loop[f"{axis}_s"] / loop[f"{axis}_damping"] for axis in STICKS if loop), default=0.0
        )
        slew = USUAL_TURN * max(effects.get("rate_slew_limit", {}).values(), default=0.0)
        slow_fall = max(1.0, effects.get("thrust_lag_asymmetry", {}).get("ratio", 1.0))
        turn_lag = max(truth.tau[:3]) + delay + ringing + slew
        self._attitude = min(QUICKEST_ATTITUDE, ATTITUDE_PER_LAG / turn_lag)
        self._level = VELOCITY_PER_ATTITUDE * self._attitude
        self._upright = min(QUICKEST_HEIGHT, ATTITUDE_PER_LAG / (slow_fall * truth.tau[3] + delay))
        self._gains = np.array([self._level, self._level, self._upright])
        self._learnt_w = np.zeros(3)
        self._tremble = FirstOrderNoise(TREMBLE_S, rng, len(truth.tau))
        self._stick, self._is_cut_off = FIRST_STICK, False

    def command(self, drone: HiddenDrone, moment: Moment) -> Sticks:
        """Return sticks in [-1, 1] for the plant's state at a moment of the plan."""
        by_hand = moment.sticks
        has_hand = not np.isnan(by_hand).all()
        self._is_cut_off = has_hand and (self._is_cut_off or self._is_unsafe(drone))
        is_free = not has_hand or self._is_cut_off
        automatic = np.array(
            self._sticks(drone, self._force(drone, moment, is_free), moment.heading)
        )
        automatic += TREMBLE * np.array(self._tremble.step(DT_S))
        sticks = automatic if is_free else np.where(np.isnan(by_hand), automatic, by_hand)
        return tuple(sticks.clip(-1.0, 1.0).tolist())

    def _is_unsafe(self, drone: HiddenDrone) -> bool:
        falling = max(0.0, -drone.vel_w[2])
        low = drone.pos_w[2] - falling * falling / (2.0 * BRAKING) < ROOM_M
        return low or norm(drone.vel_w) > FASTEST

    def _force(self, drone: HiddenDrone, moment: Moment, is_free: bool) -> Vector:
        """Return the wanted specific force, world, m/s^2."""
        gains = self._gains
        away = POSITION_PER_VELOCITY * gains * (moment.pos_w - drone.pos_w)
        wanted = clip_length(away, MAX_CORRECTION) + moment.vel_w
        error = clip_length(wanted, MAX_SPEED) - drone.vel_w
        acc = moment.acc_w + gains * error + self._learnt_w
        if is_free:
            lesson = (
                DT_S * LEARN_PER_VELOCITY * gains * gains * clip_length(error, MAX_INTEGRATED_ERROR)
            )
            self._learnt_w = clip_length(self._learnt_w + lesson, MAX_LEARNT)
        ahead = drone.pos_w[2] + LOOK_AHEAD_S * drone.vel_w[2]
        if ahead < FLOOR_M:
            acc[2] += FLOOR_GAIN * self._upright * (FLOOR_M - ahead)
        up = self._truth.gravity + max(-MAX_DOWN, min(MAX_UP, float(acc[2])))
        acc[2] = 0.0
        side = clip_length(acc, up * math.tan(MAX_TILTED)).tolist()
        return (side[0], side[1], up)

    def _sticks(self, drone: HiddenDrone, force_w: Vector, heading: float) -> Sticks:
        """Return sticks that turn the thrust towards a force, and the nose towards a heading."""
        rows = rotation(drone.quat)
        x, y, z = to_body(rows, force_w)
        across = math.hypot(x, y)
        angle = self._attitude * math.atan2(across, z) / max(across, TINY)
        yaw = 0.0
        if rows[2][2] > UPRIGHT:
            error = wrap_angle(heading - math.atan2(rows[1][0], rows[0][0]))
            yaw = max(-MAX_YAW_RATE, min(MAX_YAW_RATE, YAW_GAIN * error))
        rates = (-angle * y, angle * x, yaw)
        sticks = tuple(rate / full for rate, full in zip(rates, self._full_rates, strict=True))
        return (*sticks, self._thrust_stick(max(z, 0.0) * self._truth.mass, drone.battery_v))

    def _thrust_stick(self, thrust_n: float, battery_v: float) -> float:
        """Return the stick for a thrust by the curve without effects, by Newton's method."""
        _, linear, square, cube, _, both = self._truth.coeffs
        stick = self._stick
        for _ in range(NEWTON_STEPS):
            slope = linear + both * battery_v + stick * (2.0 * square + 3.0 * cube * stick)
            stick += (thrust_n - self._truth.thrust(stick, battery_v)) / max(slope, MIN_SLOPE)
            stick = max(-1.0, min(1.0, stick))
        self._stick = stick
        return stick
