"""What a camera sees of a track, by casting rays in float64: no code of the package.

World and body: x forward, y left, z up; quaternions (w, x, y, z), body to world. The camera is at
the body's origin and looks along body x, pitched up. A gate is a square of edge ``frame`` with a
square hole of edge ``opening``, in the plane of its local x and z axes.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

POSES_AT_ONCE = 100  # so that the arrays of a mask stay within the caches


class Gates(NamedTuple):
    """Gates as arrays.

    Attributes:
        centres: (num_gates, 3), m.
        rotations: local to world, (num_gates, 3, 3).
        flown_along: 1 if flown along local y, -1 if against it, (num_gates,).
        openings, frames: edges of hole and square, (num_gates,), m.
    """

    centres: np.ndarray
    rotations: np.ndarray
    flown_along: np.ndarray
    openings: np.ndarray
    frames: np.ndarray


class Image(NamedTuple):
    """A camera: horizontal field of view and pitch, degrees, size, px, and radial distortion."""

    field_of_view_deg: float
    pitch_deg: float
    width: int
    height: int
    k1: float = 0.0
    k2: float = 0.0

    @property
    def focal(self) -> float:
        """The focal length, px."""
        return float(self.width / (2.0 * np.tan(np.radians(self.field_of_view_deg) / 2.0)))


def matrices(quaternions: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (num, 3, 3) of quaternions (num, 4)."""
    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix()


def read_gates(track: Any) -> Gates:
    """Return the gates of a track as arrays, from the numbers of its file."""
    columns = [
        np.array([getattr(gate, name) for gate in track.gates], float)
        for name in ("position", "quaternion", "direction", "opening", "frame")
    ]
    centres, quaternions, directions, openings, frames = columns
    return Gates(centres, matrices(quaternions), directions, openings, frames)


def camera_rotations(quaternions: np.ndarray, image: Image) -> np.ndarray:
    """Return the rotations camera to world, (num_poses, 3, 3)."""
    upwards = Rotation.from_euler("y", -image.pitch_deg, degrees=True)
    return matrices(quaternions) @ upwards.as_matrix()


def cast_masks(positions: np.ndarray, quaternions: np.ndarray, gates: Gates, image: Image) -> Any:
    """Return masks, (num_poses, height, width) bool: whether a pixel's ray meets a frame."""
    parts = [
        _cast(positions[i : i + POSES_AT_ONCE], quaternions[i : i + POSES_AT_ONCE], gates, image)
        for i in range(0, len(positions), POSES_AT_ONCE)
    ]
    return np.concatenate(parts)


def _cast(positions: np.ndarray, quaternions: np.ndarray, gates: Gates, image: Image) -> np.ndarray:
    columns = (np.arange(image.width) + 0.5 - image.width / 2.0) / image.focal
    lines = (np.arange(image.height) + 0.5 - image.height / 2.0) / image.focal
    across, down = np.meshgrid(columns, lines)
    rays_c = np.stack([np.ones_like(across), -across, -down], axis=-1).reshape(-1, 3)
    rays_w = rays_c @ camera_rotations(quaternions, image).transpose(0, 2, 1)
    seen = np.zeros(rays_w.shape[:-1], bool)
    for gate, centre in enumerate(gates.centres):
        to_local = gates.rotations[gate]
        rays, start = rays_w @ to_local, (positions - centre) @ to_local
        with np.errstate(divide="ignore", invalid="ignore"):
            time = -start[:, None, 1] / rays[..., 1]
            x = np.abs(start[:, None, 0] + time * rays[..., 0])
            z = np.abs(start[:, None, 2] + time * rays[..., 2])
        farther = np.maximum(x, z)
        is_on_frame = (farther <= gates.frames[gate] / 2.0) & (
            farther >= gates.openings[gate] / 2.0
        )
        seen |= is_on_frame & (time > 0.0)
    return seen.reshape(-1, image.height, image.width)


def find_corners(
    positions: np.ndarray,
    quaternions: np.ndarray,
    gates: Gates,
    indices: np.ndarray,
    image: Image,
) -> tuple[np.ndarray, np.ndarray]:
    """Return where the corners of one gate's opening are in each image.

    Args:
        positions: of the camera, (num_poses, 3), m.
        quaternions: of the body, (num_poses, 4).
        gates: of the track.
        indices: of the gate, (num_poses,).
        image: the camera.

    Returns:
        Columns right and down of the image's middle, px, (num_poses, 4, 2), as who flies through
        sees top left, top right, bottom right and bottom left; NaN behind the camera and where the
        distortion folds over. And the distance of each corner from the camera, m, (num_poses, 4).
    """
    half, along = gates.openings[indices] / 2.0, gates.flown_along[indices]
    points_w = []
    for left, up in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        # Who flies along local +y has local +x to the right.
        local = np.stack([-left * along * half, 0.0 * half, up * half], axis=-1)
        points_w.append(gates.centres[indices] + _rotate(gates.rotations[indices], local))
    offsets_w = np.stack(points_w, axis=1) - positions[:, None]
    offsets_c = offsets_w @ camera_rotations(quaternions, image)
    depth = np.where(offsets_c[..., 0] > 0.0, offsets_c[..., 0], np.nan)
    plane = -offsets_c[..., 1:] / depth[..., None]
    radius = np.linalg.norm(plane, axis=-1, keepdims=True)
    # Where the distorted radius stops growing, by walking outwards.
    walk = np.linspace(0.0, 10.0, 100_001)
    is_falling = np.diff(walk * (1.0 + image.k1 * walk**2 + image.k2 * walk**4)) <= 0.0
    limit = walk[np.argmax(is_falling)] if is_falling.any() else np.inf
    factor = 1.0 + image.k1 * radius**2 + image.k2 * radius**4
    found = np.where(radius < limit, image.focal * factor * plane, np.nan)
    return found, np.linalg.norm(offsets_w, axis=-1)


def draw_poses(seed: int, count: int, gates: Gates) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw poses about a course: half of them anywhere, half within arm's length of a gate.

    Attitudes are anything; of two thirds of the poses the camera faces the gate, so that the
    image's edges cut corners off; the nearest are 0.1 m from a corner.

    Returns:
        Positions (count, 3), m, quaternions (count, 4), and the indices of the gates (count,).
    """
    rng = np.random.default_rng(seed)
    indices = rng.integers(0, len(gates.centres), count)
    centres = gates.centres[indices]
    spread = np.where(np.arange(count) % 2, 0.8, 8.0)[:, None]
    positions = centres + spread * rng.normal(size=(count, 3))
    near = indices[::5]
    offsets = 0.1 * _unit(rng.normal(size=(len(near), 3)))
    corners = rng.choice([-1.0, 1.0], (len(near), 3)) * [0.5, 0.0, 0.5]
    corners = _rotate(gates.rotations[near], corners * gates.openings[near, None])
    positions[::5] = centres[::5] + offsets + corners
    quaternions = _unit(rng.normal(size=(count, 4)))
    heading = np.arctan2(*(centres - positions)[:, 1::-1].T) + rng.normal(0.0, 0.5, count)
    level = np.stack([np.cos(heading / 2), 0 * heading, 0 * heading, np.sin(heading / 2)], axis=-1)
    facing = _unit(level + 0.15 * rng.normal(size=level.shape))
    is_facing = (np.arange(count) % 3 > 0)[:, None]
    return positions, np.where(is_facing, facing, quaternions), indices


def _rotate(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
