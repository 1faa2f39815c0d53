"""Numbers, vectors and quaternions of hidden drones: tuples of Python floats, or of JAX scalars.

Equations are written once for both: in floats, where a pilot closes the loop, which is much faster
than with arrays of three numbers; and traced, where JAX flies many drones at once.
"""

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

Number = Any  # a Python float or a JAX scalar
Vector = tuple[Number, ...]  # x, y, z
Quaternion = tuple[Number, ...]  # w, x, y, z


def _either(plain: Callable[..., float], traced: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of Python floats or, if the first is none, of JAX scalars."""
    return lambda *values: (plain if isinstance(values[0], float) else traced)(*values)


exp = _either(math.exp, jnp.exp)
expm1 = _either(math.expm1, jnp.expm1)
tanh = _either(math.tanh, jnp.tanh)
sqrt = _either(math.sqrt, jnp.sqrt)
sin = _either(math.sin, jnp.sin)
cos = _either(math.cos, jnp.cos)
acos = _either(math.acos, jnp.arccos)
atan2 = _either(math.atan2, jnp.arctan2)
maximum = _either(max, jnp.maximum)
minimum = _either(min, jnp.minimum)


def where(condition: Any, first: Number, second: Number) -> Number:
    """Return the first number where the condition holds, else the second."""
    if isinstance(condition, (bool, np.bool_)):
        return first if condition else second
    return jnp.where(condition, first, second)


def rotation(quat: Quaternion) -> tuple[Vector, ...]:
    """Return the rows of the rotation matrix, body to world; quat: w, x, y, z of norm 1."""
    w, x, y, z = quat
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def to_world(rows: tuple[Vector, ...], vector_b: Vector) -> Vector:
    """Return a body vector in the world frame."""
    x, y, z = vector_b
    return tuple(row[0] * x + row[1] * y + row[2] * z for row in rows)


def to_body(rows: tuple[Vector, ...], vector_w: Vector) -> Vector:
    """Return a world vector in the body frame."""
    first, second, third = rows
    x, y, z = vector_w
    return (
        first[0] * x + second[0] * y + third[0] * z,
        first[1] * x + second[1] * y + third[1] * z,
        first[2] * x + second[2] * y + third[2] * z,
    )


def multiply(first: Quaternion, second: Quaternion) -> Quaternion:
    """Return the product of two quaternions."""
    w, x, y, z = first
    real, roll, pitch, yaw = second
    return (
        w * real - x * roll - y * pitch - z * yaw,
        x * real + w * roll + y * yaw - z * pitch,
        y * real + w * pitch - x * yaw + z * roll,
        z * real + w * yaw + x * pitch - y * roll,
    )


def integrate_attitude(quat: Quaternion, rates_b: Vector, step_s: float) -> Quaternion:
    """Return the attitude after a step at body rates, rad/s, to first order as in the handout."""
    new = multiply(quat, (1.0, *scale(0.5 * step_s, rates_b)))
    length = sqrt(sum(part * part for part in new))
    return tuple(part / length for part in new)


def turn(quat: Quaternion, rates_b: Vector, step_s: float) -> Quaternion:
    """Return the attitude after a time at constant body rates, rad/s, exactly."""
    rate = norm(rates_b)
    half = 0.5 * rate * step_s
    is_turning = rate > 0.0
    share = where(is_turning, sin(half) / where(is_turning, rate, 1.0), 0.0)
    return multiply(quat, (cos(half), *scale(share, rates_b)))


def add(first: Vector, second: Vector) -> Vector:
    """Return the sum of two vectors."""
    return (first[0] + second[0], first[1] + second[1], first[2] + second[2])


def scale(factor: Number, vector: Vector) -> Vector:
    """Return a vector times a number."""
    return (factor * vector[0], factor * vector[1], factor * vector[2])


def norm(vector: Vector) -> Number:
    """Return the length of a vector."""
    return sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])


def wrap_angle(angle_rad: float) -> float:
    """Return an angle in [-pi, pi]."""
    return math.remainder(angle_rad, 2.0 * math.pi)
