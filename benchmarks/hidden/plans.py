"""What a pilot is to fly: plans of flights, put together from legs and manoeuvres.

A plan does not depend on the plant, so where it leads is known before the flight. Its kinds:

- scripted: everything: legs of 0 to 18 m/s, low passes, waves on one stick, flips, thrust steps;
- hover: one place, one heading, small corrections.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from benchmarks.hidden.truth import DT_S
from benchmarks.hidden.vectors import Vector, wrap_angle

Rng = np.random.Generator
CLIMB, TURN_RATE = 5.0, math.radians(70.0)  # m/s, rad/s: what a plan asks for
SMOOTH_S = 0.4  # over which a plan's velocity and heading are smoothed
# Manoeuvres.
# Amplitudes of rate sticks: in a minute, each axis gets one of each row. Beyond QUICK, pulses are short.
AMPLITUDES, QUICK = ((0.1, 0.2), (0.35, 0.6), (1.0,)), 0.6
PULSE_S, QUICK_PULSE_S = (0.15, 0.3), (0.08, 0.16)  # a full stick turns by 90 degrees in 0.15 s
CHIRP_S, CHIRP_FROM_HZ, CHIRP_HZ_PER_S = 1.3, 1.2, (3.0, 8.0)
RECOVER_S, AFTER_FLIP_S, AFTER_STEPS_S, AFTER_LOW_S = 1.0, 1.6, 0.8, 0.4
JUMP_S, JUMP_STICK, FLIP_S, FLIP_STICK = 0.2, 0.6, (0.45, 0.62), (-0.6, -0.1)
# Thrust steps: sticks and durations; the higher, the shorter, to end near the same speed.
STEPS_UP, STEPS_DOWN, HELD_DOWN_S = (0.1, 1.0), (-1.0, -0.4), 0.3
HELD_UP_S, SHORTER_S, UNEVEN = 0.45, 0.3, (0.8, 1.2)  # the middle one per unit of stick
HOMEWARD_M, HOMEWARD_SPREAD = 30.0, 0.4  # from the origin, where legs lead back; rad
SPEEDING_UP, MOST_NOSE_RATE = 7.0, 1.0  # m/s^2, rad/s
HIGH_M = (16.0, 24.0)  # where manoeuvres on one stick are flown
HIGH_SPEEDS, HIGH_HOLD_S, HIGH_TURNING = (2.0, 18.0), (0.4, 1.2), 0.5  # m/s, s, rad/s
LOW_SPEEDS, LOW_HOLD_S, LOW_TURNING = (0.5, 12.0), (0.5, 1.2), 0.3
LOW_M, SINK_M, SINK_S, SETTLE_S = (0.15, 1.0), 0.7, 0.8, 0.7  # the last metre is sunk slowly
LOWER_M, SLOWER = 0.2, 0.9  # changes of low heights and of speeds per repeated attempt
YAW_TURN = (1.2, math.pi)  # rad
# Kinds of flights.
HOVER_M = (1.5, 8.0)  # heights
CORRECTION_M, CORRECTION_S = 0.25, 0.8  # of small moves in a hover
BEGIN_S, STILL_S = 0.5, (2.0, 4.5)  # of hover before something begins, and between moves
START_SPREAD_M = 5.0
HIGHER_M = 1.5  # per repeated attempt, for kinds that are flown low throughout


class Moment(NamedTuple):
    """The target at one time: m, m/s, m/s^2, rad, world; sticks moved by hand, None where the pilot flies."""

    pos_w: Vector
    vel_w: Vector
    acc_w: Vector
    heading: float
    sticks: tuple[float | None, ...] | None


class Sketch:
    """A plan under construction: velocities, headings and sticks, a row per 10 ms.

    caution: number of earlier attempts that were too low or too fast.
    """

    def __init__(self, rng: Rng, start_w: Vector, heading: float, caution: int):
        self.rng, self.caution = rng, caution
        self.start_w, self.pos_w, self.heading = start_w, start_w, heading
        self._velocities: list[Vector] = []
        self._headings: list[float] = []
        self._sticks: list[tuple[float | None, ...] | None] = []

    def __len__(self) -> int:
        return len(self._velocities)

    def add(self, vel_w: Vector, heading: float | None = None, sticks: tuple | None = None) -> None:
        """Append a moment; the heading is kept if not given."""
        self.heading = self.heading if heading is None else heading
        self._velocities.append(vel_w)
        self._headings.append(self.heading)
        self._sticks.append(sticks)
        self.pos_w = tuple(p + v * DT_S for p, v in zip(self.pos_w, vel_w, strict=True))

    def wait(self, seconds: float) -> None:
        """Append a hover."""
        for _ in range(steps_of(seconds)):
            self.add((0.0, 0.0, 0.0))

    def turn_to(self, heading: float) -> None:
        """Append a hover that turns to a heading the shorter way."""
        way = wrap_angle(heading - self.heading)
        first, steps = self.heading, max(1, steps_of(abs(way) / TURN_RATE))
        for step in range(steps):
            self.add((0.0, 0.0, 0.0), first + way * (step + 1) / steps)

    def climb_to(self, height_m: float) -> None:
        """Append a climb or descent."""
        way = height_m - self.pos_w[2]
        steps = max(1, steps_of(abs(way) / CLIMB))
        for _ in range(steps):
            self.add((0.0, 0.0, way / steps / DT_S))

    def hands_on(self, sticks: np.ndarray) -> None:
        """Append moments with sticks (num_rows, 4) moved by hand; nan where the pilot flies."""
        for row in sticks.tolist():
            given = tuple(None if math.isnan(stick) else stick for stick in row)
            self.add((0.0, 0.0, 0.0), None, given)

    def moments(self, seconds: float) -> list[Moment]:
        """Return a plan of this length with smoothed velocities and headings."""
        count = steps_of(seconds)
        if len(self) < count:
            self.wait((count - len(self)) * DT_S)
        width = steps_of(SMOOTH_S)
        kernel = np.hanning(width + 2)[1:-1]
        rows = np.column_stack([np.array(self._velocities), np.array(self._headings)])
        padded = np.concatenate([np.tile(rows[0] * [0, 0, 0, 1], (width, 1)), rows])
        smooth = np.stack(
            [np.convolve(column, kernel / kernel.sum())[width : width + len(rows)] for column in padded.T],
            axis=1,
        )
        vel_w, heading = smooth[:, :3], smooth[:, 3]
        pos_w = np.array(self.start_w) + np.cumsum(vel_w, axis=0) * DT_S
        acc_w = np.gradient(vel_w, DT_S, axis=0)
        columns = (pos_w, vel_w, acc_w)
        rows = zip(*(map(tuple, column[:count].tolist()) for column in columns), strict=True)
        rest = zip(heading[:count].tolist(), self._sticks, strict=False)
        return [Moment(*row, *other) for row, other in zip(rows, rest, strict=True)]


def steps_of(seconds: float) -> int:
    """Return the number of steps of 10 ms in a time."""
    return round(seconds / DT_S)


def leg(sketch: Sketch, speed: float, hold_s: float, turning: float) -> None:
    """Append a leg: accelerate to a speed, hold it, brake; the direction turns, rad/s, and leads home.

    The nose points anywhere and turns slowly.
    """
    rng = sketch.rng
    x, y, _ = sketch.pos_w
    way = rng.uniform(-math.pi, math.pi)
    if math.hypot(x, y) > HOMEWARD_M:
        way = math.atan2(-y, -x) + rng.normal(0.0, HOMEWARD_SPREAD)
    sketch.turn_to(sketch.heading + rng.uniform(-1.0, 1.0) * math.pi * rng.integers(2))
    nose = rng.uniform(-1.0, 1.0) * MOST_NOSE_RATE
    ramp = max(1, steps_of(speed / SPEEDING_UP))
    shares = np.concatenate([np.linspace(0, 1, ramp), np.ones(steps_of(hold_s)), np.linspace(1, 0, ramp)])
    for share in shares.tolist():
        way += turning * DT_S
        vel_w = (share * speed * math.cos(way), share * speed * math.sin(way), 0.0)
        sketch.add(vel_w, sketch.heading + nose * DT_S)


def wave(axis: int, amplitude: float, rng: Rng) -> np.ndarray:
    """Return a doublet, chirp or short pulse on one rate stick, the other two centred, (num_rows, 4)."""
    name, sign = rng.choice(["doublet", "chirp", "pulses"]), rng.choice([-1.0, 1.0])
    if name == "chirp":
        time = np.arange(steps_of(CHIRP_S)) * DT_S
        shape = np.cos(2.0 * np.pi * (CHIRP_FROM_HZ * time + 0.5 * rng.uniform(*CHIRP_HZ_PER_S) * time**2))
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
    jump, turn = np.full((steps_of(JUMP_S), 4), np.nan), np.zeros((steps_of(rng.uniform(*FLIP_S)), 4))
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
    height = math.exp(rng.uniform(*np.log(LOW_M))) + raised
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


def _scripted(sketch: Sketch, seconds: float) -> None:
    sketch.wait(BEGIN_S)
    while len(sketch) * DT_S < seconds:
        cycle(sketch)


def _hover(sketch: Sketch, seconds: float) -> None:
    rng = sketch.rng
    while len(sketch) * DT_S < seconds:
        sketch.wait(rng.uniform(*STILL_S))
        move = rng.uniform(-1.0, 1.0, 3) * CORRECTION_M
        # Back towards where the hover began, so that corrections do not wander off.
        there = np.array(sketch.start_w) + move
        speed = tuple(((there - sketch.pos_w) / CORRECTION_S).tolist())
        for _ in range(steps_of(CORRECTION_S)):
            sketch.add(speed)


FLIGHT_KINDS: dict[str, tuple[tuple[float, float], Callable[[Sketch, float], None]]] = {
    "scripted": (HIGH_M, _scripted),
    "hover": (HOVER_M, _hover),
}


def plan(kind: str, seconds: float, rng: Rng, caution: int = 0) -> list[Moment]:
    """Return the plan of a flight, a moment per 10 ms.

    caution: number of earlier attempts that were too low or too fast.

    Raises:
        ValueError: if there is no such kind.
    """
    if kind not in FLIGHT_KINDS:
        raise ValueError(f"kind: found {kind!r}, expected one of {', '.join(FLIGHT_KINDS)}")
    heights, draw = FLIGHT_KINDS[kind]
    start_w = (
        *rng.uniform(-START_SPREAD_M, START_SPREAD_M, 2).tolist(),
        HIGHER_M * caution + float(rng.uniform(*heights)),
    )
    sketch = Sketch(rng, start_w, float(rng.uniform(-math.pi, math.pi)), caution)
    draw(sketch, seconds)
    return sketch.moments(seconds)
