"""A pinhole camera: where points, lines and polygons of the world are on the picture."""

import numpy as np

from flytrack_env.scene import UP_W

NEAR_PLANE_M = 0.15  # what is nearer to the camera is cut away


def unit(vector: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    """Return a vector (3,) at length 1, or the fallback where it has none."""
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-6 else fallback


class Camera:
    """A camera that stays upright.

    Args:
        eye_w: (3,), world, m.
        forward_w: (3,), unit vector, world.
        centre_px: (2,), pixels.
        focal_px: pixels.
    """

    def __init__(
        self, eye_w: np.ndarray, forward_w: np.ndarray, centre_px: np.ndarray, focal_px: float
    ):
        right = unit(np.cross(forward_w, UP_W), np.array([0.0, -1.0, 0.0]))
        self.eye_w, self.forward_w = eye_w, forward_w
        self.centre_px, self.focal_px = centre_px, focal_px
        self.axes = np.stack([right, np.cross(forward_w, right), forward_w])

    def look(self, points_w: np.ndarray) -> np.ndarray:
        """Return points (..., 3), world, in the camera's frame: right, down, away; m."""
        return (points_w - self.eye_w) @ self.axes.T

    def pixels(self, points_c: np.ndarray) -> np.ndarray:
        """Return the pixels (..., 2) of points (..., 3) in its frame, all in front of it."""
        return self.centre_px + self.focal_px * points_c[..., :2] / points_c[..., 2:]

    def horizon_px(self) -> float:
        """Return the height of the horizon on the picture, pixels from its top."""
        level = max(float(np.hypot(self.forward_w[0], self.forward_w[1])), 1e-3)
        return float(self.centre_px[1] + self.focal_px * self.forward_w[2] / level)

    def polygon(self, points_c: np.ndarray) -> list[float]:
        """Return the visible part of a polygon or line (n, 3), camera's frame.

        It is x, y, x, y, ... in pixels; empty if all of it is behind the camera.
        """
        depths = points_c[:, 2].tolist()
        if max(depths) < NEAR_PLANE_M:
            return []
        if min(depths) < NEAR_PLANE_M:
            points_c = _cut(points_c)
        return self.pixels(points_c).ravel().tolist()


def _cut(points_c: np.ndarray) -> np.ndarray:
    """Return the part (m, 3) in front of the nearest plane of a polygon (n, 3) that crosses it."""
    kept = []
    for start, end in zip(points_c, np.roll(points_c, -1, axis=0), strict=True):
        is_seen = start[2] >= NEAR_PLANE_M
        if is_seen:
            kept.append(start)
        if is_seen != (end[2] >= NEAR_PLANE_M):
            kept.append(start + (NEAR_PLANE_M - start[2]) / (end[2] - start[2]) * (end - start))
    return np.array(kept)
