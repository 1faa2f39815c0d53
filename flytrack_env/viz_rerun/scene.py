"""What does not change in a recording: axes, the course, the drones' bodies, the look of paths and plots."""

import math

import numpy as np
import rerun as rr

from flytrack_env.tracks import Track, build_course
from flytrack_env.viz_rerun.entities import Entities

CAMERA_PITCH_RAD = math.radians(40.0)
CAMERA_RAY_M = 0.3
DIRECTION_M = 1.0
SCALED_FORCE = 0.1  # m of an arrow per m/s^2
# On the screen, so that they are seen from the other end of the course.
PATH_RADIUS, PASS_RADIUS, LAP_RADIUS = (
    float(np.asarray(rr.Radius.ui_points(points))) for points in (1.5, 3.5, 5.0)
)
ARROW_RADIUS = float(np.asarray(rr.Radius.ui_points(2.5)))

# Body frame, m: x forward, y left, z up.
FRONT_LEFT, FRONT_RIGHT = (0.15, 0.09, 0.0), (0.15, -0.09, 0.0)
BACK_LEFT, BACK_RIGHT = (-0.15, 0.14, 0.0), (-0.15, -0.14, 0.0)
MOTORS_B = np.array([FRONT_LEFT, FRONT_RIGHT, BACK_LEFT, BACK_RIGHT])
ARMS_B = np.array([[FRONT_LEFT, BACK_RIGHT], [FRONT_RIGHT, BACK_LEFT]])
CAMERA_RAY_B = CAMERA_RAY_M * np.array([math.cos(CAMERA_PITCH_RAD), 0.0, math.sin(CAMERA_PITCH_RAD)])

Colour = tuple[int, int, int]
GATE_COLOUR = (255, 140, 0)
BOUNDS_COLOUR = (80, 80, 90)
CAMERA_COLOUR = (80, 200, 255)
COLOURS: tuple[Colour, ...] = (
    (120, 220, 120),
    (90, 160, 255),
    (240, 110, 200),
    (240, 220, 90),
    (100, 220, 220),
    (200, 160, 255),
)


def colour_of(index: int) -> Colour:
    """Return the colour of a flight by its place among those shown."""
    return COLOURS[index % len(COLOURS)]


def gate_corners(gates: np.ndarray, edge_m: float | np.ndarray) -> np.ndarray:
    """Return the corners of squares of that edge in the gates' local x-z planes, (N, 4, 3).

    gates: (N, >=8) with id, x, y, z, qw, qx, qy, qz, unit quaternions. edge_m: one, or (N,). World frame, m;
    in order around the square.
    """
    w, x, y, z = (gates[:, column] for column in range(4, 8))
    local_x = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=-1)
    local_z = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    half = 0.5 * np.broadcast_to(np.asarray(edge_m, float), len(gates))[:, None, None]
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    offsets = half * (signs[:, :1] * local_x[:, None] + signs[:, 1:] * local_z[:, None])
    return gates[:, None, 1:4] + offsets


def _log(recording: rr.RecordingStream, entity: str, archetype: rr.AsComponents) -> None:
    recording.log(entity, archetype, static=True, strict=True)


def log_course(recording: rr.RecordingStream, track: Track | None) -> None:
    """Log the axes, the gates (centre, frame, opening, direction of flight) and the bounds, once."""
    _log(recording, "world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    if track is None:
        return
    rows = track.rows().reshape(-1, 8)
    names = [f"gate {gate.id}" for gate in track.gates]
    centres = rr.Points3D(rows[:, 1:4], labels=names, radii=0.05, colors=GATE_COLOUR)
    _log(recording, "world/gates/centre", centres)
    edges = {"outer": [gate.frame for gate in track.gates], "inner": [gate.opening for gate in track.gates]}
    for name, edges_m in edges.items():
        corners = gate_corners(rows, np.array(edges_m))
        closed = np.concatenate([corners, corners[:, :1]], axis=1)
        _log(recording, f"world/gates/{name}", rr.LineStrips3D(closed, radii=0.02, colors=GATE_COLOUR))
    if track.gates:
        forward = np.stack(build_course(track).gates.forward, axis=-1)
        arrows = rr.Arrows3D(
            vectors=DIRECTION_M * forward, origins=rows[:, 1:4], radii=0.02, colors=GATE_COLOUR
        )
        _log(recording, "world/gates/direction", arrows)
    low, high = np.array(track.bounds_low), np.array(track.bounds_high)
    if np.isfinite(high - low).all():
        box = rr.Boxes3D(
            centers=[0.5 * (low + high)],
            half_sizes=[0.5 * (high - low)],
            fill_mode=rr.components.FillMode.MajorWireframe,
            colors=BOUNDS_COLOUR,
        )
        _log(recording, "world/bounds", box)


def log_drone(recording: rr.RecordingStream, entities: Entities, colour: Colour) -> None:
    """Log a drone's body in its own frame, and the look of its path and of what it passes, once."""
    drone = entities.drone
    _log(recording, f"{drone}/motors", rr.Points3D(MOTORS_B, radii=0.03, colors=colour))
    _log(recording, f"{drone}/arms", rr.LineStrips3D(ARMS_B, radii=0.01, colors=colour))
    ray = rr.Arrows3D(vectors=[CAMERA_RAY_B], origins=[(0.0, 0.0, 0.0)], colors=CAMERA_COLOUR)
    _log(recording, f"{drone}/camera", ray)
    for name in ("flown", "recent"):
        style = rr.LineStrips3D.from_fields(radii=PATH_RADIUS, colors=colour)
        _log(recording, f"{entities.trajectory}/{name}", style)
    _log(recording, entities.passes, rr.Points3D.from_fields(radii=PASS_RADIUS, colors=colour))
    _log(recording, entities.laps, rr.Points3D.from_fields(radii=LAP_RADIUS, colors=colour, show_labels=True))
