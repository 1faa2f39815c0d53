"""The check of a course's geometry: the shipped ones pass, and every way of breaking one is found."""

import math
from collections.abc import Callable
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


def change_gate(track: tracks.Track, index: int, **fields: Any) -> tracks.Track:
    """Return a track with other fields of one gate."""
    gates = list(track.gates)
    gates[index] = replace(gates[index], **fields)
    return replace(track, gates=tuple(gates))


def point_on_way(track: tracks.Track, way: int, share: float) -> tuple[float, ...]:
    """Return a point between two gates."""
    samples = tracks.sample_way(tracks.build_course(track), 1001)[way]
    return tuple(samples[round(1000 * share)].tolist())


def test_unbroken_ring_is_feasible() -> None:
    assert tracks.find_problems(ring()) == ()


@pytest.mark.parametrize("name", tracks.available_tracks())
def test_shipped_tracks_are_feasible(name: str) -> None:
    assert tracks.find_problems(tracks.load_track(name)) == ()


def near_gate(track: tracks.Track) -> tracks.Track:
    """Gate 11 moves to 3 m behind gate 10."""
    return change_gate(track, 1, position=(RADIUS, 3.0, HEIGHT))


def gate_in_path(track: tracks.Track) -> tracks.Track:
    """Gate 13 moves into the way from gate 10 to 11, and stands across it."""
    return change_gate(track, 3, position=point_on_way(track, 0, 0.505), quaternion=yaw_of(120.0))


def touching_gate(track: tracks.Track) -> tracks.Track:
    """Gate 13 moves beside gate 10: no path, but their frames are 0.2 m apart."""
    return change_gate(track, 3, position=(RADIUS + 2.9, 0.0, HEIGHT), quaternion=track.gates[0].quaternion)


# What breaks the ring, the demand that it breaks, and what the message says of it.
BREAKS: dict[str, tuple[Callable[[tracks.Track], tracks.Track], str, str]] = {
    "small opening": (
        lambda track: change_gate(track, 2, opening=0.5),
        "opening",
        "gate 12: opening of 0.5 m, expected at least 0.6 m",
    ),
    "too near": (near_gate, "spacing", "gates 10 and 11: 3.00 m apart, expected 5 to 40 m"),
    "too far": (lambda track: ring(41.0), "spacing", "gates 15 and 10: 41.00 m apart, expected 5 to 40 m"),
    "reversed: to": (
        lambda track: change_gate(track, 2, direction=-1.0),
        "turn",
        "gate 12: 150 deg between its direction of flight and the straight way to gate 13, expected at "
        "most 100 deg",
    ),
    "next gate from behind": (
        lambda track: change_gate(track, 2, direction=-1.0),
        "own gate",
        "gate 12: the way from gate 11 to 12 ",
    ),
    # 8 m beside gate 10, 0.3 m ahead, and flown the same way: its plane is crossed at once, far to the side.
    "past the next gate": (
        lambda track: change_gate(
            track, 1, position=(RADIUS - 8.0, 0.3, HEIGHT), quaternion=track.gates[0].quaternion
        ),
        "own gate",
        "gate 11: the way from gate 10 to 11 misses it",
    ),
    "in the path": (
        gate_in_path,
        "path",
        "gate 13: 0.00 m from the way from gate 10 to 11, expected at least 0.65 m",
    ),
    "touching": (touching_gate, "frames", "gates 10 and 13: frames 0.20 m apart, expected at least 0.65 m"),
    "frame outside": (
        lambda track: replace(track, bounds_high=(10.5, 15.0, 7.0)),
        "bounds",
        "gate 10: frame 0.85 m out of bounds (high x), expected inside",
    ),
    "start behind": (
        lambda track: replace(track, start_position=(RADIUS, 5.0, HEIGHT)),
        "start",
        "start: 180 deg off the direction of flight of gate 10, expected in front of it, at most 60 deg",
    ),
    "start behind another gate": (
        lambda track: change_gate(
            track, 3, position=(RADIUS + 1.0, -2.5, HEIGHT), quaternion=track.gates[0].quaternion
        ),
        "start",
        "start: gate 13 is 0.00 m from the straight way to gate 10, expected at least 0.65 m",
    ),
    "start at the wall": (
        lambda track: replace(track, bounds_low=(-15.0, -5.2, 0.0)),
        "start",
        "start: 0.25 m too near the bounds or beyond them (low y)",
    ),
}


@pytest.mark.parametrize("case", BREAKS)
def test_every_break_is_found_and_named(case: str) -> None:
    breaking, demand, text = BREAKS[case]
    problems = tracks.find_problems(breaking(ring()))
    assert [p for p in problems if p.demand == demand and p.text.startswith(text)], problems


def test_every_demand_has_a_break() -> None:
    assert {demand for _, demand, _ in BREAKS.values()} == set(tracks.DEMANDS)


# Field, the value that the FlyTrack course just keeps, the one that it breaks, and the demand.
EDGES = [
    ("min_spacing", 7.21, 7.22, "spacing"),
    ("max_spacing", 13.61, 13.60, "spacing"),
    ("max_turn_deg", 60.2, 60.1, "turn"),
    ("min_start_distance", 6.22, 6.23, "start"),
    ("max_start_turn_deg", 11.6, 11.5, "start"),
    ("start_clearance", 5.0, 5.01, "start"),
    ("min_opening", 1.5, 1.51, "opening"),
]


@pytest.mark.parametrize(("field", "kept", "broken", "demand"), EDGES)
def test_limits_bind_where_they_say(field: str, kept: float, broken: float, demand: str) -> None:
    track = tracks.load_track("flytrack")
    assert tracks.find_problems(track, tracks.Limits()._replace(**{field: kept})) == ()
    assert {p.demand for p in tracks.find_problems(track, tracks.Limits()._replace(**{field: broken}))} == {
        demand
    }


def test_default_clearances_are_what_starts_need() -> None:
    radius, starts = EnvParams.drone_radius, ResetParams()
    limits = tracks.Limits()
    assert limits.drone_radius == radius
    assert limits.clearance == pytest.approx(starts.course_offset + radius)
    assert limits.start_clearance == pytest.approx(starts.start_position_noise + radius)
