"""Laws outside the package's list that hidden plants can have: ``benchmarks.hidden.outside`` written for JAX.

A thermal is about the world's origin, as in ``benchmarks.hidden.plant.Plant`` without a centre.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.hidden import Outside
from benchmarks.hidden.outside import HEADING_ORDERS, SCALES, TINY_SPEED, USUAL_SPEED_MS

Shape = Any


def _bump(value: jax.Array, middle: float, width: float) -> jax.Array:
    return jnp.exp(-0.5 * ((value - middle) / width) ** 2)


def _heading(to_world: jax.Array) -> jax.Array:
    return jnp.arctan2(to_world[1, 0], to_world[0, 0])


def _waves(shape: Shape, to_world: jax.Array) -> jax.Array:
    heading = _heading(to_world)
    waves = (shape[f"size_{n}"] * jnp.cos(n * heading + shape[f"phase_{n}"]) for n in HEADING_ORDERS)
    return sum(waves) / shape["largest"]


# Kind -> its signal, of shape, position, attitude and airspeed.
SIGNALS: dict[str, Callable[[Shape, jax.Array, jax.Array, jax.Array], jax.Array]] = {
    "airspeed": lambda shape, pos_w, to_world, airspeed_b: _bump(
        jnp.linalg.norm(airspeed_b), shape["speed_ms"], shape["width_ms"]
    ),
    "attitude": lambda shape, pos_w, to_world, airspeed_b: _bump(
        jnp.rad2deg(jnp.arccos(jnp.clip(to_world[2, 2], -1.0, 1.0))), shape["tilt_deg"], shape["width_deg"]
    ),
    "heading": lambda shape, pos_w, to_world, airspeed_b: _waves(shape, to_world),
    "flapping": lambda shape, pos_w, to_world, airspeed_b: airspeed_b[0] / USUAL_SPEED_MS,
    "cable": lambda shape, pos_w, to_world, airspeed_b: jnp.cos(_heading(to_world) + shape["phase"]),
    "position": lambda shape, pos_w, to_world, airspeed_b: _bump(
        jnp.linalg.norm(pos_w), 0.0, shape["radius_m"]
    ),
}


def push_of(
    outside: Outside, pos_w: jax.Array, to_world: jax.Array, airspeed_b: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return what a law adds to the specific force, (3,) m/s^2, and to the body rates, (3,) rad/s; body.

    to_world: the rotation matrix of the attitude, (3, 3).
    """
    size = outside.amplitude * SCALES[outside.channel]
    size = size * SIGNALS[outside.kind](outside.shape, pos_w, to_world, airspeed_b)
    still = jnp.zeros(3, jnp.float32)
    if outside.kind == "airspeed":
        return -size * airspeed_b / jnp.maximum(jnp.linalg.norm(airspeed_b), TINY_SPEED), still
    way = jnp.array([outside.shape[axis] for axis in "xyz"], jnp.float32)
    if outside.kind in ("position", "cable"):
        return size * (way @ to_world), still
    return (still, size * way) if outside.channel == "rate" else (size * way, still)
