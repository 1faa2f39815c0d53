"""Plans of flights: where a pilot wants to be at every moment, and which sticks are moved by hand.

A plan does not depend on the plant, so that it is known before the flight where it leads.
"""

import math
from typing import NamedTuple

import numpy as np

from benchmarks.hidden.truth import DT_S
from benchmarks.hidden.vectors import Vector, wrapped

Rng = np.random.Generator
CLIMB, TURN_RATE = 5.0, math.radians(70.0)  # m/s, rad/s: what a plan asks for
SMOOTH_S = 0.4  # over which a plan's velocity and heading are smoothed


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
        for _ in range(steps_of(seconds)):
            self.add((0.0, 0.0, 0.0))

    def turn_to(self, heading: float) -> None:
        """Append a hover in which the nose turns to a heading, the shorter way."""
        way = wrapped(heading - self.heading)
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
        """Append moments in which sticks (num_rows, 4) are moved by hand; nan where the pilot's own."""
        for row in sticks.tolist():
            given = tuple(None if math.isnan(stick) else stick for stick in row)
            self.add((0.0, 0.0, 0.0), None, given)

    def moments(self, seconds: float) -> list[Moment]:
        """Return the plan of this length, with smooth velocities and headings."""
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
    """Return how many steps of 10 ms a time is."""
    return round(seconds / DT_S)
