"""Plans of flights: where a pilot wants to be at every moment, and which sticks are moved by hand.

A plan does not depend on the plant, so that it is known before the flight where it leads.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.hidden.truth import DT_S
from benchmarks.hidden.vectors import Vector, wrapped

Rng = np.random.Generator
# Of rate sticks: on each axis, one of each row in a minute.
AMPLITUDES = ((0.1, 0.2), (0.35, 0.6), (1.0,))
BOX_M = 60.0  # about the origin, where legs turn back
# What a leg of the plan may ask for: accelerations, m/s^2, and speeds of climbing and of turning.
SPEEDING_UP, CLIMB, TURN_RATE = 7.0, 5.0, math.radians(70.0)  # m/s^2, m/s, rad/s
SMOOTH_S = 0.4  # over which a plan's velocity and heading are smoothed
HIGH_M = (16.0, 24.0)  # where manoeuvres on one stick are flown
HIGH_SPEEDS, LOW_SPEEDS = (2.0, 18.0), (0.5, 12.0)  # m/s
LOW_M = (0.15, 1.0)
LOWER_M, SLOWER = 0.2, 0.9  # what a pilot who has to fly again changes: low heights, and speeds


class Moment(NamedTuple):
    """What is wanted at one time: world, m, m/s, m/s^2, rad; sticks by hand, None where the pilot's own."""

    pos_w: Vector
    vel_w: Vector
    acc_w: Vector
    heading: float
    sticks: tuple[float | None, ...] | None


class Sketch:
    """A plan in the making: velocities, headings and sticks, a row per 10 ms.

    caution: how often this has been flown too low or too fast already.
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
        """Append a moment; without a heading, the one before is kept."""
        self.heading = self.heading if heading is None else heading
        self._velocities.append(vel_w)
        self._headings.append(self.heading)
        self._sticks.append(sticks)
        self.pos_w = tuple(p + v * DT_S for p, v in zip(self.pos_w, vel_w, strict=True))

    def wait(self, seconds: float) -> None:
        """Append a hover."""
        for _ in range(_steps(seconds)):
            self.add((0.0, 0.0, 0.0))

    def turn_to(self, heading: float) -> None:
        """Append a hover in which the nose turns to a heading, the shorter way."""
        way = wrapped(heading - self.heading)
        first, steps = self.heading, max(1, _steps(abs(way) / TURN_RATE))
        for step in range(steps):
            self.add((0.0, 0.0, 0.0), first + way * (step + 1) / steps)

    def climb_to(self, height_m: float) -> None:
        """Append a climb or descent."""
        way = height_m - self.pos_w[2]
        steps = max(1, _steps(abs(way) / CLIMB))
        for _ in range(steps):
            self.add((0.0, 0.0, way / steps / DT_S))

    def hands_on(self, sticks: np.ndarray) -> None:
        """Append moments in which sticks (num_rows, 4) are moved by hand; nan where the pilot's own."""
        for row in sticks.tolist():
            given = tuple(None if math.isnan(stick) else stick for stick in row)
            self.add((0.0, 0.0, 0.0), None, given)

    def moments(self, seconds: float) -> list[Moment]:
        """Return the plan of this length, with smooth velocities and headings."""
        count = _steps(seconds)
        if len(self) < count:
            self.wait((count - len(self)) * DT_S)
        width = _steps(SMOOTH_S)
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


def _steps(seconds: float) -> int:
    return round(seconds / DT_S)


def leg(sketch: Sketch, speed: float, hold_s: float, turning: float) -> None:
    """Append a leg: up to a speed, hold it, and brake; its direction turns, rad/s, and leads home.

    The nose points anywhere, and turns slowly.
    """
    rng = sketch.rng
    x, y, _ = sketch.pos_w
    is_far = math.hypot(x, y) > BOX_M / 2.0
    way = math.atan2(-y, -x) + rng.normal(0.0, 0.4) if is_far else rng.uniform(-math.pi, math.pi)
    sketch.turn_to(sketch.heading + rng.uniform(-1.0, 1.0) * math.pi * rng.integers(2))
    nose = rng.uniform(-1.0, 1.0)
    ramp = max(1, _steps(speed / SPEEDING_UP))
    shares = np.concatenate([np.linspace(0, 1, ramp), np.ones(_steps(hold_s)), np.linspace(1, 0, ramp)])
    for share in shares.tolist():
        way += turning * DT_S
        vel_w = (share * speed * math.cos(way), share * speed * math.sin(way), 0.0)
        sketch.add(vel_w, sketch.heading + nose * DT_S)


def wave(axis: int, amplitude: float, rng: Rng) -> np.ndarray:
    """Return a doublet, chirp or short pulse on one rate stick, the other two centred, (num_rows, 4)."""
    name, sign = rng.choice(["doublet", "chirp", "pulses"]), rng.choice([-1.0, 1.0])
    if name == "chirp":
        time = np.arange(_steps(1.3)) * DT_S
        shape = np.cos(2.0 * np.pi * (1.2 * time + 0.5 * rng.uniform(3.0, 8.0) * time**2))
    else:
        # A full stick turns by 90 degrees in 0.15 s.
        steps = _steps(rng.uniform(0.08, 0.16) if amplitude > 0.5 else rng.uniform(0.15, 0.3))
        gap = 0 if name == "doublet" else steps
        shape = np.concatenate([np.ones(steps), np.zeros(gap), -np.ones(steps), np.zeros(gap)])
    sticks = np.zeros((len(shape), 4))
    sticks[:, axis], sticks[:, 3] = sign * amplitude * shape, np.nan
    return sticks


def manoeuvre(sketch: Sketch, axis: int, amplitude: float) -> None:
    """Append a wave on one rate stick, and time to recover."""
    sketch.hands_on(wave(axis, amplitude, sketch.rng))
    sketch.wait(1.0)


def flip(sketch: Sketch) -> None:
    """Append a jump and about one turn in the air at full stick, and time to recover."""
    rng = sketch.rng
    jump, turn = np.full((_steps(0.2), 4), np.nan), np.zeros((_steps(rng.uniform(0.45, 0.62)), 4))
    jump[:, 3] = 0.6
    turn[:, rng.integers(2)], turn[:, 3] = rng.choice([-1.0, 1.0]), rng.uniform(-0.6, -0.1)
    sketch.hands_on(np.concatenate([jump, turn]))
    sketch.wait(1.6)


def thrust_steps(sketch: Sketch) -> None:
    """Append steps of the thrust stick up and down, upright, and time to recover."""
    rng = sketch.rng
    sticks = []
    for up in rng.permutation([1.0, 0.0, 1.0, 0.0]).tolist():
        level = rng.uniform(0.1, 1.0) if up else rng.uniform(-1.0, -0.4)
        # The higher a step, the shorter, so that all of them end near the same speed.
        seconds = rng.uniform(0.8, 1.2) * (0.45 - 0.3 * level if up else 0.3)
        sticks.append(np.tile([np.nan, np.nan, np.nan, level], (_steps(seconds), 1)))
    sketch.hands_on(np.concatenate(sticks))
    sketch.wait(0.8)


def low_pass(sketch: Sketch) -> None:
    """Append a descent, a leg near the ground, and a climb half way."""
    rng = sketch.rng
    raised = LOWER_M * sketch.caution
    height = math.exp(rng.uniform(*np.log(LOW_M))) + raised
    sketch.climb_to(height + 0.7)
    for _ in range(_steps(0.8)):
        sketch.add((0.0, 0.0, -0.7 / 0.8))
    sketch.wait(0.7)
    leg(
        sketch, SLOWER**sketch.caution * rng.uniform(*LOW_SPEEDS), rng.uniform(0.5, 1.2), rng.normal(0.0, 0.3)
    )
    sketch.wait(0.4)


Block = Callable[[Sketch], None]


def _fast(low: float, high: float) -> Block:
    def block(sketch: Sketch) -> None:
        rng = sketch.rng
        speed = SLOWER**sketch.caution * rng.uniform(low, high)
        leg(sketch, speed, rng.uniform(0.4, 1.2), rng.normal(0.0, 0.5))

    return block


def _yaw_turn(sketch: Sketch) -> None:
    sketch.turn_to(sketch.heading + sketch.rng.choice([-1.0, 1.0]) * sketch.rng.uniform(1.2, math.pi))


def _on_axis(axis: int, amplitude: float) -> Block:
    return lambda sketch: manoeuvre(sketch, axis, amplitude)


def cycle(sketch: Sketch) -> None:
    """Append 50 to 60 s: manoeuvres and legs at height, two low passes among them."""
    rng = sketch.rng
    waves = [(axis, float(rng.choice(row))) for axis in range(3) for row in AMPLITUDES]
    first, last = HIGH_SPEEDS
    middle = 0.5 * (first + last)
    blocks: list[Block] = [
        *(_on_axis(*one) for one in waves),
        _fast(middle, last),
        _fast(first, middle),
        _fast(first, last),
        thrust_steps,
        thrust_steps,
        flip,
        _yaw_turn,
    ]
    blocks = [blocks[number] for number in rng.permutation(len(blocks))]
    half = len(blocks) // 2
    for number, block in enumerate(blocks):
        if number == half:
            low_pass(sketch)
            low_pass(sketch)
            sketch.climb_to(rng.uniform(*HIGH_M))
        block(sketch)
