"""The check of a course's geometry: the shipped ones pass, and every way of breaking one is found."""

import math
from dataclasses import replace
from typing import Any

import pytest

from flytrack_env import tracks
from flytrack_env.params import EnvParams
from flytrack_env.resets import ResetParams

NUM_GATES, RADIUS, HEIGHT = 6, 10.0, 2.0


def yaw_of(heading_deg: float) -> tuple[float, float, float, float]:
    """Return the attitude of a gate that is flown along a heading with direction +1."""
    half = math.radians(heading_deg - 90.0) / 2.0
    return (math.cos(half), 0.0, 0.0, math.sin(half))


def ring(radius: float = RADIUS, num_gates: int = NUM_GATES) -> tracks.Track:
    """Return gates on a circle, flown anticlockwise, gate 0 at (radius, 0); starts 5 m before it."""
    gates = []
    for i in range(num_gates):
        angle = 2.0 * math.pi * i / num_gates
        centre = (radius * math.cos(angle), radius * math.sin(angle), HEIGHT)
        gates.append(tracks.Gate(10 + i, centre, yaw_of(math.degrees(angle) + 90.0), 1.0, 1.5, 2.7))
    wall = radius + 5.0
    return tracks.Track(
        "ring", tuple(gates), (radius, -5.0, 0.1), yaw_of(180.0), (-wall, -wall, 0.0), (wall, wall, 7.0)
    )


def changed(index: int, **fields: Any) -> tracks.Track:
    """Return the ring with other fields of one gate."""
    gates = list(RING.gates)
    gates[index] = replace(gates[index], **fields)
    return replace(RING, gates=tuple(gates))


RING = ring()
ALIKE = {"quaternion": RING.gates[0].quaternion}  # flown the same way as gate 10
ON_WAY = tuple(tracks.sample_way(tracks.build_course(RING), 1001)[0][505].tolist())  # from gate 10 to 11


def test_unbroken_ring_is_feasible() -> None:
    assert tracks.find_problems(RING) == ()


@pytest.mark.parametrize("name", tracks.available_tracks())
def test_shipped_tracks_are_feasible(name: str) -> None:
    assert tracks.find_problems(tracks.load_track(name)) == ()


# What the message says of a break of the ring, the course, and the demand that it breaks.
BREAKS = {
    "gate 12: opening of 0.5 m, expected at least 0.6 m": (changed(2, opening=0.5), "opening"),
    "gates 10 and 11: 3.00 m apart, expected 5 to 40 m": (
        changed(1, position=(RADIUS, 3, HEIGHT)),
        "spacing",
    ),
    "gates 15 and 10: 41.00 m apart, expected 5 to 40 m": (ring(41.0), "spacing"),
    "gate 12: 150 deg between its direction of flight and the straight way to gate 13, expected at most 100 "
    "deg": (changed(2, direction=-1.0), "turn"),
    "gate 12: the way from gate 11 to 12 ": (changed(2, direction=-1.0), "own gate"),  # from behind
    # 8 m beside gate 10, 0.3 m ahead, and flown the same way: its plane is crossed at once, far to the side.
    "gate 11: the way from gate 10 to 11 misses it": (
        changed(1, position=(RADIUS - 8.0, 0.3, HEIGHT), **ALIKE),
        "own gate",
    ),
    "gate 13: 0.00 m from the way from gate 10 to 11, expected at least 0.65 m": (
        changed(3, position=ON_WAY, quaternion=yaw_of(120.0)),  # across it
        "path",
    ),
    "gates 10 and 13: frames 0.20 m apart, expected at least 0.65 m": (
        changed(3, position=(RADIUS + 2.9, 0.0, HEIGHT), **ALIKE),
        "frames",
    ),
    "gate 10: frame 0.85 m out of bounds (high x), expected inside": (
        replace(RING, bounds_high=(10.5, 15.0, 7.0)),
        "bounds",
    ),
    "start: 180 deg off the direction of flight of gate 10, expected in front of it, at most 60 deg": (
        replace(RING, start_position=(RADIUS, 5.0, HEIGHT)),
        "start",
    ),
    "start: gate 13 is 0.00 m from the straight way to gate 10, expected at least 0.65 m": (
        changed(3, position=(RADIUS + 1.0, -2.5, HEIGHT), **ALIKE),
        "start",
    ),
    "start: 0.25 m too near the bounds or beyond them (low y)": (
        replace(RING, bounds_low=(-15.0, -5.2, 0.0)),
        "start",
    ),
}


@pytest.mark.parametrize("text", BREAKS)
def test_every_break_is_found_and_named(text: str) -> None:
    track, demand = BREAKS[text]
    problems = tracks.find_problems(track)
    assert [p for p in problems if p.demand == demand and p.text.startswith(text)], problems


def test_every_demand_has_a_break() -> None:
    assert {demand for _, demand in BREAKS.values()} == set(tracks.DEMANDS)


def test_limits_of_ones_own_replace_the_defaults() -> None:
    found = tracks.find_problems(RING, tracks.Limits(min_opening=1.51))
    assert len(found) == NUM_GATES and {problem.demand for problem in found} == {"opening"}


def test_default_clearances_are_what_starts_need() -> None:
    radius, starts = EnvParams.drone_radius, ResetParams()
    limits = tracks.Limits()
    assert limits.drone_radius == radius
    assert limits.clearance == pytest.approx(starts.course_offset + radius)
    assert limits.start_clearance == pytest.approx(starts.start_position_noise + radius)
