"""Shapes in the world, as arrays: gates' squares, the drone's parts, segments on the ground."""

from typing import NamedTuple

import numpy as np

from flytrack_env.quaternion import Scalar
from flytrack_env.tracks import Course

UP_W = np.array([0.0, 0.0, 1.0])


class Gates(NamedTuple):
    """The gates of a course in flying order, world frame, m.

    centres, forward: (n, 3); forward is the direction of flight. outer, inner: (n, 4, 3), the corners
    of frame and opening, in order around the square.
    """

    centres: np.ndarray
    forward: np.ndarray
    outer: np.ndarray
    inner: np.ndarray


def gates_of(course: Course) -> Gates:
    """Return the gates of a course as arrays."""
    frames = course.gates
    centres, forward, up = (
        np.stack([np.asarray(component, float) for component in vector], axis=-1)
        for vector in (frames.centre, frames.forward, frames.up)
    )
    left = np.cross(up, forward)

    def corners(half_edge: Scalar) -> np.ndarray:
        half = np.asarray(half_edge, float)[:, None]
        signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
        return np.stack([centres + half * (a * left + b * up) for a, b in signs], axis=1)

    return Gates(centres, forward, corners(frames.half_frame), corners(frames.half_opening))


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3), body to world, of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return np.array(
        [
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ]
    )


def unit(vector: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    """Return a vector (3,) at length 1, or the fallback where it has none."""
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-6 else fallback


def ground_grid(low: np.ndarray, high: np.ndarray, spacing_m: float) -> np.ndarray:
    """Return the lines of a grid on the floor of a box from low to high, (n, 2, 3), world, m."""
    lines = []
    for axis, other in ((0, 1), (1, 0)):
        first, last = np.ceil(low[axis] / spacing_m), np.floor(high[axis] / spacing_m)
        for place in spacing_m * np.arange(first, last + 1):
            line = np.full((2, 3), low[2])
            line[:, axis] = place
            line[:, other] = low[other], high[other]
            lines.append(line)
    return np.array(lines).reshape(-1, 2, 3)
