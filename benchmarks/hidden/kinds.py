"""Kinds of flights: the plans that they follow.

==============  ===================================================================================
kind            what is flown
==============  ===================================================================================
scripted        everything: legs of 0 to 18 m/s, low passes, waves on one stick, flips, thrust steps
race            fast through waypoints, the nose ahead, no manoeuvre on purpose
hover           one place, one heading, small corrections
hover_headings  one place, several headings
slow            legs of 0.5 to 3 m/s
==============  ===================================================================================
"""

import math
from collections.abc import Callable

import numpy as np

from benchmarks.hidden.manoeuvres import HIGH_M, SLOWER, cycle, leg
from benchmarks.hidden.plans import Moment, Rng, Sketch, steps_of
from benchmarks.hidden.truth import DT_S
from benchmarks.hidden.vectors import wrapped

HOVER_M, RACE_M, SLOW_M = (1.5, 8.0), (1.5, 5.0), (1.5, 6.0)  # heights
CORRECTION_M, CORRECTION_S = 0.25, 0.8  # of small moves in a hover
RACE_SPEEDS, SLOW_SPEEDS = (7.0, 16.0), (0.5, 3.0)  # m/s
WAYPOINTS_M = 25.0  # their spread, horizontally
MOST_SIDEWAYS = 13.0  # m/s^2, of a race's turns
SPEEDING_UP, RACE_CLIMB = 6.0, 1.5  # m/s^2, m/s
TURN_GAIN, SLOWEST_TURN = 3.0, 3.0  # 1/s; m/s, below which turns are no quicker
NEAR_S, CHASE_S = 0.3, (3.0, 6.0)  # to a waypoint that counts as met; how long one is flown at
BEGIN_S, STILL_S = 0.5, (2.0, 4.5)  # of hover before something begins, and between moves
SLOW_HOLD_S, SLOW_TURNING = (2.0, 4.0), 0.3  # s, rad/s
START_SPREAD_M = 5.0
HIGHER_M = 1.5  # per try, of all heights of kinds that are flown low all the time


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


def _hover_headings(sketch: Sketch, seconds: float) -> None:
    while len(sketch) * DT_S < seconds:
        sketch.wait(sketch.rng.uniform(*STILL_S))
        sketch.turn_to(sketch.rng.uniform(-math.pi, math.pi))


def _slow(sketch: Sketch, seconds: float) -> None:
    rng = sketch.rng
    while len(sketch) * DT_S < seconds:
        leg(sketch, rng.uniform(*SLOW_SPEEDS), rng.uniform(*SLOW_HOLD_S), rng.normal(0.0, SLOW_TURNING))
        sketch.wait(BEGIN_S)
        sketch.climb_to(HIGHER_M * sketch.caution + rng.uniform(*SLOW_M))


def _race(sketch: Sketch, seconds: float) -> None:
    """Steer at waypoints with limited turns; the next one when the last is near or cannot be met."""
    rng = sketch.rng
    slower = SLOWER**sketch.caution
    way, speed, waypoint, wanted, left = sketch.heading, 0.0, None, 0.0, 0
    while len(sketch) * DT_S < seconds:
        if waypoint is None or left == 0 or math.dist(waypoint[:2], sketch.pos_w[:2]) < speed * NEAR_S:
            place = rng.normal(0.0, WAYPOINTS_M, 2).clip(-2.0 * WAYPOINTS_M, 2.0 * WAYPOINTS_M)
            height = HIGHER_M * sketch.caution + rng.uniform(*RACE_M)
            waypoint, wanted = (*place.tolist(), height), slower * rng.uniform(*RACE_SPEEDS)
            left = steps_of(rng.uniform(*CHASE_S))
        left -= 1
        x, y, z = (there - here for there, here in zip(waypoint, sketch.pos_w, strict=True))
        speed += max(-SPEEDING_UP * DT_S, min(SPEEDING_UP * DT_S, wanted - speed))
        turn = slower * MOST_SIDEWAYS / max(speed, SLOWEST_TURN)
        error = wrapped(math.atan2(y, x) - way)
        change = max(-turn, min(turn, TURN_GAIN * error)) * DT_S
        way += change
        sketch.add((speed * math.cos(way), speed * math.sin(way), max(-RACE_CLIMB, min(RACE_CLIMB, z))), way)


FLIGHT_KINDS: dict[str, tuple[tuple[float, float], Callable[[Sketch, float], None]]] = {
    "scripted": (HIGH_M, _scripted),
    "race": (RACE_M, _race),
    "hover": (HOVER_M, _hover),
    "hover_headings": (HOVER_M, _hover_headings),
    "slow": (SLOW_M, _slow),
}


def plan(kind: str, seconds: float, rng: Rng, caution: int = 0) -> list[Moment]:
    """Return the plan of a flight, a moment per 10 ms.

    caution: how often it has been flown too low or too fast already.

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
