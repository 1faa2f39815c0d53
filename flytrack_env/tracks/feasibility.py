"""Whether a course can be flown: a check of its geometry, before anything trains on it.

The check follows the way of ``sample_way``, on which episodes start in flight. It does not say how
fast a course can be flown, and passing it is no proof that a policy learns to.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from flytrack_env.tracks.course import build_course, sample_way
from flytrack_env.tracks.track import Track

SAMPLES_PER_WAY = 200
SAMPLES_PER_EDGE = 28  # of a frame: 0.1 m apart on the usual one
ROUNDING_M = 1e-4  # of float32 positions some hundred metres from the origin


class Limits(NamedTuple):
    """What a course must keep; lengths in m.

    Attributes:
        min_spacing, max_spacing: distance between the centres of consecutive gates. Nearer than
            that there is no room to turn; observations clip at 90 m.
        max_turn_deg: angle between a gate's direction of flight and the straight way from the gate
            before it or to the gate behind it. At 90 deg the drone turns on the spot.
        clearance: between the way and frames, floor, walls and ceiling, and between frames. The
            default is what starts in flight lie off the way (0.5 m, ``ResetParams.course_offset``)
            and a drone's radius.
        min_start_distance, max_start_turn_deg: as above, from the start to the first gate.
        start_clearance: between the start and the walls; starts are drawn 0.3 m around it.
        min_opening: inner edge of a gate.
        drone_radius: of the drone that must not touch frames.
    """

    min_spacing: float = 5.0
    max_spacing: float = 40.0
    max_turn_deg: float = 100.0
    clearance: float = 0.65
    min_start_distance: float = 3.0
    max_start_turn_deg: float = 60.0
    start_clearance: float = 0.45
    min_opening: float = 0.6
    drone_radius: float = 0.15


class Problem(NamedTuple):
    """One demand that a course does not meet.

    Attributes:
        demand: one of ``DEMANDS``.
        text: which gates, what was found, what was expected.
    """

    demand: str
    text: str


class Geometry(NamedTuple):
    """A track as float64 arrays, world, m.

    Attributes:
        centres: (N, 3).
        axes: (N, 3, 3), forward, left and up of each gate's flight frame as rows.
        half_frames: (N,).
        way: (N, SAMPLES_PER_WAY, 3), from each gate to the gate behind it.
    """

    track: Track
    centres: np.ndarray
    axes: np.ndarray
    half_frames: np.ndarray
    way: np.ndarray

    @staticmethod
    def of(track: Track) -> "Geometry":
        """Return the geometry of a track."""
        course = build_course(track)
        gates = course.gates
        axes = [np.stack(axis, axis=-1) for axis in (gates.forward, gates.left(), gates.up)]
        return Geometry(
            track=track,
            centres=np.stack(gates.centre, axis=-1).astype(float),
            axes=np.stack(axes, axis=1).astype(float),
            half_frames=np.asarray(gates.half_frame, float),
            way=sample_way(course, SAMPLES_PER_WAY),
        )

    def id(self, index: int) -> int:
        """Return the id of a gate."""
        return self.track.gates[index].id

    def pairs(self) -> list[tuple[int, int]]:
        """Return the index of every gate with that of the gate behind it."""
        return [(i, (i + 1) % len(self.centres)) for i in range(len(self.centres))]

    def in_frame(self, index: int, points: np.ndarray) -> np.ndarray:
        """Return world points (..., 3) in a gate's flight frame."""
        return (points - self.centres[index]) @ self.axes[index].T

    def distance_to_gate(self, index: int, points: np.ndarray) -> float:
        """Return how near points (..., 3) come to the square within a gate's outer edge, m."""
        local = np.abs(self.in_frame(index, points))
        local[..., 1:] = np.maximum(local[..., 1:] - self.half_frames[index], 0.0)
        return float(np.linalg.norm(local, axis=-1).min())

    def crossings(self, index: int, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where a path (M, 3) crosses a gate's plane.

        Return the offsets from the gate's centre, m, and whether the path crosses forwards, both
        (number of crossings,); an offset is the larger one of the gate's two axes, interpolated.
        """
        local = self.in_frame(index, path)
        is_beyond = local[:, 0] >= 0.0
        at = np.flatnonzero(is_beyond[1:] != is_beyond[:-1])
        before, after = local[at], local[at + 1]
        fraction = before[:, :1] / (before[:, :1] - after[:, :1])
        offset = np.abs(before + fraction * (after - before))[:, 1:].max(axis=1)
        return offset, is_beyond[at + 1]

    def gap(self, index: int, path: np.ndarray) -> float:
        """Return the distance between a path (M, 3) and a gate, m; 0 if it goes through."""
        is_through = self.crossings(index, path)[0] <= self.half_frames[index]
        return 0.0 if is_through.any() else self.distance_to_gate(index, path)

    def square(self, index: int) -> np.ndarray:
        """Return points all over a gate's outer square, (M, 3), corners included."""
        edge = np.linspace(-self.half_frames[index], self.half_frames[index], SAMPLES_PER_EDGE)
        across, along = (grid.reshape(-1, 1) for grid in np.meshgrid(edge, edge))
        return self.centres[index] + across * self.axes[index, 1] + along * self.axes[index, 2]

    def excesses(self, points: np.ndarray, margin: np.ndarray | float) -> dict[str, float]:
        """Return by side how far points (M, 3) lie beyond the bounds less a margin, m, if they do.

        Args:
            margin: one for all axes, or (3,).
        """
        below = np.array(self.track.bounds_low) + margin - points.min(axis=0)
        above = points.max(axis=0) - np.array(self.track.bounds_high) + margin
        sides = ("low x", "low y", "floor", "high x", "high y", "ceiling")
        excess = zip(sides, np.concatenate([below, above]).tolist(), strict=True)
        return {side: value for side, value in excess if value > ROUNDING_M}


def find_openings(geometry: Geometry, limits: Limits) -> Iterator[str]:
    """Yield gates that are too small."""
    for gate in geometry.track.gates:
        if gate.opening < limits.min_opening:
            yield (
                f"gate {gate.id}: opening of {gate.opening:g} m, "
                f"expected at least {limits.min_opening:g} m"
            )


def find_spacings(geometry: Geometry, limits: Limits) -> Iterator[str]:
    """Yield consecutive gates that are too near or too far apart."""
    for i, j in geometry.pairs():
        distance = float(np.linalg.norm(geometry.centres[j] - geometry.centres[i]))
        if not limits.min_spacing - ROUNDING_M <= distance <= limits.max_spacing + ROUNDING_M:
            yield (
                f"gates {geometry.id(i)} and {geometry.id(j)}: {distance:.2f} m apart, expected "
                f"{limits.min_spacing:g} to {limits.max_spacing:g} m"
            )


def angle_deg(forward: np.ndarray, chord: np.ndarray) -> float:
    """Return the angle between a unit vector and a chord, both (3,); 0 for a chord of length 0."""
    length = float(np.linalg.norm(chord))
    return math.degrees(math.acos(np.clip(forward @ chord / length, -1.0, 1.0))) if length else 0.0


def find_turns(geometry: Geometry, limits: Limits) -> Iterator[str]:
    """Yield gates that stand too much across the straight way to or from them."""
    for i, j in geometry.pairs():
        chord = geometry.centres[j] - geometry.centres[i]
        for gate, word, other in ((i, "to", j), (j, "from", i)):
            angle = angle_deg(geometry.axes[gate, 0], chord)
            if angle > limits.max_turn_deg:
                yield (
                    f"gate {geometry.id(gate)}: {angle:.0f} deg between its direction of flight "
                    f"and the straight way {word} gate {geometry.id(other)}, "
                    f"expected at most {limits.max_turn_deg:g} deg"
                )


def find_own_gates(geometry: Geometry, limits: Limits) -> Iterator[str]:
    """Yield ways that, between their gates, run into one of them or past the one they lead to."""
    for i, j in geometry.pairs():
        way = f"the way from gate {geometry.id(i)} to {geometry.id(j)}"
        for gate in (i, j):
            offset, is_forward = geometry.crossings(gate, geometry.way[i, 1:-1])
            is_hit = offset <= geometry.half_frames[gate] + limits.drone_radius
            is_missed = (gate == j) & is_forward & ~is_hit
            for how, is_such in (("meets it", is_hit), ("misses it,", is_missed)):
                if is_such.any():
                    found = f"{way} {how} {offset[is_such].min():.2f} m off its centre"
                    yield f"gate {geometry.id(gate)}: {found}, expected it through the opening only"


def find_gates_in_path(geometry: Geometry, limits: Limits) -> Iterator[str]:
    """Yield gates that stand in the way between two others."""
    for i, j in geometry.pairs():
        for other in range(len(geometry.centres)):
            if other in (i, j):
                continue
            distance = geometry.gap(other, geometry.way[i])
            if distance < limits.clearance:
                yield (
                    f"gate {geometry.id(other)}: {distance:.2f} m from the way "
                    f"from gate {geometry.id(i)} to {geometry.id(j)}, "
                    f"expected at least {limits.clearance:g} m"
                )


def find_touching_frames(geometry: Geometry, limits: Limits) -> Iterator[str]:
    """Yield gates that stand into each other."""
    squares = [geometry.square(i) for i in range(len(geometry.centres))]
    for j in range(len(squares)):
        for i in range(j):
            reach = math.sqrt(2.0) * (geometry.half_frames[i] + geometry.half_frames[j])
            if np.linalg.norm(geometry.centres[j] - geometry.centres[i]) > reach + limits.clearance:
                continue
            both = (
                geometry.distance_to_gate(j, squares[i]),
                geometry.distance_to_gate(i, squares[j]),
            )
            if min(both) < limits.clearance:
                yield (
                    f"gates {geometry.id(i)} and {geometry.id(j)}: "
                    f"frames {min(both):.2f} m apart, "
                    f"expected at least {limits.clearance:g} m"
                )


def find_out_of_bounds(geometry: Geometry, limits: Limits) -> Iterator[str]:
    """Yield ways too near the bounds, and frames that reach beyond them."""
    for i, j in geometry.pairs():
        for side, excess in geometry.excesses(geometry.way[i], limits.clearance).items():
            yield (
                f"the way from gate {geometry.id(i)} to {geometry.id(j)}: "
                f"{limits.clearance - excess:.2f} m inside the bounds ({side}), "
                f"expected at least {limits.clearance:g} m"
            )
        for side, excess in geometry.excesses(geometry.square(i), 0.0).items():
            yield (
                f"gate {geometry.id(i)}: frame {excess:.2f} m out of bounds ({side}), "
                "expected inside"
            )


def find_bad_start(geometry: Geometry, limits: Limits) -> Iterator[str]:
    """Yield what keeps the drone from flying straight from the start to the first gate."""
    start, first = np.array(geometry.track.start_position), geometry.id(0)
    chord = geometry.centres[0] - start
    distance, angle = float(np.linalg.norm(chord)), angle_deg(geometry.axes[0, 0], chord)
    if not limits.min_start_distance <= distance <= limits.max_spacing:
        yield (
            f"start: {distance:.2f} m from gate {first}, expected {limits.min_start_distance:g} to "
            f"{limits.max_spacing:g} m"
        )
    if angle > limits.max_start_turn_deg:
        yield (
            f"start: {angle:.0f} deg off the direction of flight of gate {first}, "
            f"expected in front of it, at most {limits.max_start_turn_deg:g} deg"
        )
    line = start + np.linspace(0.0, 1.0, SAMPLES_PER_WAY)[:, None] * chord
    for other in range(1, len(geometry.centres)):
        gap = geometry.gap(other, line)
        if gap < limits.clearance:
            yield (
                f"start: gate {geometry.id(other)} is {gap:.2f} m from the straight way "
                f"to gate {first}, expected at least {limits.clearance:g} m"
            )
    # No margin to floor and ceiling: the drone stands on the ground.
    margin = np.array([limits.start_clearance, limits.start_clearance, 0.0])
    for side, excess in geometry.excesses(start[None], margin).items():
        yield f"start: {excess:.2f} m too near the bounds or beyond them ({side})"


CHECKS = {
    "opening": find_openings,
    "spacing": find_spacings,
    "turn": find_turns,
    "own gate": find_own_gates,
    "path": find_gates_in_path,
    "frames": find_touching_frames,
    "bounds": find_out_of_bounds,
    "start": find_bad_start,
}
DEMANDS = tuple(CHECKS)


def find_problems(track: Track, limits: Limits | None = None) -> tuple[Problem, ...]:
    """Return everything that keeps a course from being flown; empty if it is feasible.

    Assumes straight flight from the start to the first gate, and the way of ``sample_way`` from
    there.
    """
    geometry, limits = Geometry.of(track), limits or Limits()
    return tuple(
        Problem(demand, text)
        for demand, check in CHECKS.items()
        for text in check(geometry, limits)
    )
