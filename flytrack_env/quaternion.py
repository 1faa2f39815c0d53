"""Vectors and quaternions as small tuples of scalars.

Everything per drone is a scalar leaf, so that ``jax.vmap`` turns a drone into a
structure of arrays by itself: one contiguous array per component, which is what
the compiler can vectorise. Packed vectors exist at the interfaces only
(``flytrack_env.state``).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.fusion import compute_once

Scalar = jax.Array | np.ndarray | np.floating | float


class Vec3(NamedTuple):
    """Three components along x, y, z of the frame in the variable's suffix."""

    x: Scalar
    y: Scalar
    z: Scalar

    def __add__(self, other: "Vec3") -> "Vec3":  # type: ignore[override]
        return Vec3(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: "Vec3") -> "Vec3":
        return Vec3(self.x - other.x, self.y - other.y, self.z - other.z)

    def scale(self, factor: Scalar) -> "Vec3":
        """Return the vector times a scalar."""
        return Vec3(self.x * factor, self.y * factor, self.z * factor)

    def dot(self, other: "Vec3") -> Scalar:
        """Return the inner product."""
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: "Vec3") -> "Vec3":
        """Return the vector product ``self x other``."""
        return Vec3(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

    def norm(self) -> Scalar:
        """Return the length, with a zero instead of an undefined gradient at the origin."""
        squared = self.dot(self)
        is_positive = squared > 0.0
        # Guard inside the where: sqrt has an infinite slope at 0 even where it is not selected.
        return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, squared, 1.0)), 0.0)


class Quaternion(NamedTuple):
    """Unit quaternion (w, x, y, z) that rotates body-frame into world-frame components."""

    w: Scalar
    x: Scalar
    y: Scalar
    z: Scalar

    def multiply(self, other: "Quaternion") -> "Quaternion":
        """Return the Hamilton product ``self (x) other``."""
        return Quaternion(
            self.w * other.w - self.x * other.x - self.y * other.y - self.z * other.z,
            self.w * other.x + self.x * other.w + self.y * other.z - self.z * other.y,
            self.w * other.y - self.x * other.z + self.y * other.w + self.z * other.x,
            self.w * other.z + self.x * other.y - self.y * other.x + self.z * other.w,
        )

    def normalize(self) -> "Quaternion":
        """Return the quaternion scaled to unit norm."""
        squared = self.w * self.w + self.x * self.x + self.y * self.y + self.z * self.z
        # The fence keeps XLA from making this a reciprocal square root, which it does not vectorise
        # on the CPU (measured: a third of the physics).
        factor = 1.0 / compute_once(jnp.sqrt(squared))
        return Quaternion(self.w * factor, self.x * factor, self.y * factor, self.z * factor)

    def axes(self) -> tuple[Vec3, Vec3, Vec3]:
        """Return the body's x, y and z axes in the world frame: the columns of R(q)."""
        w, x, y, z = self
        return (
            Vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
            Vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
            Vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
        )

    def rotate(self, vector_b: Vec3) -> Vec3:
        """Return a body-frame vector in the world frame."""
        axis_x, axis_y, axis_z = self.axes()
        return axis_x.scale(vector_b.x) + axis_y.scale(vector_b.y) + axis_z.scale(vector_b.z)

    @staticmethod
    def from_yaw_tilt(yaw: Scalar, tilt: Scalar, tilt_heading: Scalar) -> "Quaternion":
        """Return a yaw followed by a tilt about a horizontal body axis.

        Angles in rad. ``tilt_heading`` is the body-frame direction towards which the
        thrust axis leans (0: nose down, i.e. forwards).
        """
        cos_yaw, sin_yaw = half_angle(yaw)
        cos_tilt, sin_tilt = half_angle(tilt)
        cos_half, sin_half = half_angle(tilt_heading)
        cos_heading = cos_half * cos_half - sin_half * sin_half
        sin_heading = 2.0 * sin_half * cos_half
        turn, lean = compute_once(
            (
                Quaternion(cos_yaw, 0.0, 0.0, sin_yaw),
                Quaternion(cos_tilt, -sin_heading * sin_tilt, cos_heading * sin_tilt, 0.0),
            )
        )
        return turn.multiply(lean)


def half_angle(angle: Scalar) -> tuple[Scalar, Scalar]:
    """Return cosine and sine of half an angle in [-pi, pi] rad, each within 1e-6.

    Taylor series in Horner form: a reset is drawn in every step, and the library's sine, good for
    any angle, was a quarter of the whole step.
    """
    square = 0.25 * angle * angle
    cosine: Scalar = 1.0
    sine: Scalar = 1.0
    for n in (12, 10, 8, 6, 4, 2):
        cosine = 1.0 - cosine * square * (1.0 / (n * (n - 1)))
        sine = 1.0 - sine * square * (1.0 / (n * (n + 1)))
    return cosine, 0.5 * angle * sine
