"""Where episodes start: at the start pose with noise, or anywhere along the course."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.dynamics import ModelParameters, start_rates
from flytrack_env.fusion import compute_once
from flytrack_env.quaternion import Quaternion, Scalar, Vec3
from flytrack_env.randomness import Draws
from flytrack_env.state import Action, Drone
from flytrack_env.tracks import Course, hermite_curve

# The last part of the way is left out: from there the gate could not be reached any more.
LAST_SEGMENT_FRACTION = 0.8


class ResetParams(NamedTuple):
    """Distribution of starts; every draw is uniform.

    Attributes:
        course_fraction: share of the starts that lie along the course; the others are at the start
            pose.
        start_*: half ranges around the start pose, m, degrees; the height is only raised, by 0 to
            start_height_noise.
        course_offset: half range of the offset from the curve between two gates, per axis, m.
        course_speed: speed from 0 to this along that curve, m/s, with a sideways part of 20 %.
        course_yaw_deg: half range of the yaw about the direction of that curve.
        course_tilt_deg: tilt from 0 to this towards any side.
        course_stick: half range of the applied rate actions; applied thrust from course_thrust_low
            to course_thrust_high.
        *_charge_low: battery from this to full, from 0 (empty) to 1 (full) in voltage.
    """

    course_fraction: Scalar = 0.8
    start_position_noise: Scalar = 0.3
    start_height_noise: Scalar = 0.3
    start_yaw_noise_deg: Scalar = 15.0
    start_tilt_noise_deg: Scalar = 5.0
    start_charge_low: Scalar = 0.75
    course_offset: Scalar = 0.5
    course_speed: Scalar = 16.0
    course_yaw_deg: Scalar = 90.0
    course_tilt_deg: Scalar = 60.0
    course_stick: Scalar = 0.3
    course_thrust_low: Scalar = -1.0
    course_thrust_high: Scalar = 0.8
    course_charge_low: Scalar = 0.1


SIDEWAYS_FRACTION = 0.2
MIN_HORIZONTAL = 1e-3
MIN_TANGENT = 1e-3
IDLE_THRUST = -1.0


def sample_start(
    seed: jax.Array, course: Course, params: ResetParams, model: ModelParameters
) -> tuple[Drone, jax.Array]:
    """Return a start (float32 leaves) and the index of the gate to fly first, int32.

    ``seed`` is a uint32 scalar, see ``flytrack_env.randomness``. At the start pose the drone is at
    rest with its rotors still; on the course it flies from one gate towards the next.
    """
    draws = Draws(compute_once(seed))
    is_on_course = compute_once(draws.uniform("kind", 0.0, 1.0) < params.course_fraction)

    def choose(on_course: Scalar, at_pose: Scalar) -> jax.Array:
        return jnp.where(is_on_course, on_course, at_pose)

    gate_index = jnp.where(is_on_course, draws.index("gate", course.num_gates), 0)
    stick = choose(params.course_stick, 0.0)
    applied = Action(
        draws.uniform("roll", -stick, stick),
        draws.uniform("pitch", -stick, stick),
        draws.uniform("yaw_stick", -stick, stick),
        draws.uniform(
            "thrust",
            choose(params.course_thrust_low, IDLE_THRUST),
            choose(params.course_thrust_high, IDLE_THRUST),
        ),
    )
    lowest_v = model.battery.voltage(choose(params.course_charge_low, params.start_charge_low))
    on_curve, along = _point_on_course(draws, gate_index, course)
    anchor = Vec3(*map(choose, on_curve, course.start_pos_w))
    heading = Quaternion(*map(choose, _facing(along), course.start_quat))
    drone = Drone(
        pos_w=anchor + _offset(draws, choose, params),
        vel_w=_velocity(draws, choose, along, params),
        acc_w=Vec3(0.0, 0.0, 0.0),
        quat=heading.multiply(_turn(draws, choose, params)),
        rates_b=Vec3(0.0, 0.0, 0.0),
        applied=applied,
        battery_v=draws.uniform("battery", lowest_v, model.battery.full_v),
    )
    drone = drone._replace(rates_b=start_rates(drone, model))
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), drone), gate_index


Choose = Callable[[Scalar, Scalar], jax.Array]


def _point_on_course(draws: Draws, gate_index: jax.Array, course: Course) -> tuple[Vec3, Vec3]:
    """Return a point on the way to a gate from the one before, and the unit flight direction.

    The way is a cubic Hermite curve that leaves and meets the gates along their directions of
    flight, with tangents as long as the gates are apart: about what a racing drone flies.
    """
    before = course.gate(jnp.where(gate_index == 0, course.num_gates - 1, gate_index - 1))
    gate = course.gate(gate_index)
    chord = gate.centre - before.centre
    length = chord.norm()
    leave, meet = before.forward.scale(length), gate.forward.scale(length)
    s = draws.uniform("along", 0.0, LAST_SEGMENT_FRACTION)
    point, tangent = hermite_curve(before.centre, leave, gate.centre, meet, s)
    point, tangent = compute_once((point, tangent))
    return point, compute_once(tangent.scale(1.0 / jnp.maximum(tangent.norm(), MIN_TANGENT)))


def _facing(direction: Vec3) -> Quaternion:
    """Return the level attitude that faces along a direction, the world's x if it is vertical."""
    horizontal = Vec3(direction.x, direction.y, 0.0).norm()
    is_vertical = horizontal < MIN_HORIZONTAL
    cosine = jnp.where(is_vertical, 1.0, direction.x / jnp.where(is_vertical, 1.0, horizontal))
    # Half-angle formulas; rounding can put the cosine just beyond 1.
    w = jnp.sqrt(jnp.maximum(0.5 * (1.0 + cosine), 0.0))
    z = jnp.sqrt(jnp.maximum(0.5 * (1.0 - cosine), 0.0))
    return compute_once(Quaternion(w, 0.0, 0.0, jnp.where(direction.y < 0.0, -z, z)))


def _offset(draws: Draws, choose: Choose, params: ResetParams) -> Vec3:
    """Return the offset from the curve or the start pose, m."""
    noise = choose(params.course_offset, params.start_position_noise)
    highest = choose(params.course_offset, params.start_height_noise)
    return Vec3(
        draws.uniform("offset_x", -noise, noise),
        draws.uniform("offset_y", -noise, noise),
        draws.uniform("offset_z", choose(-params.course_offset, 0.0), highest),
    )


def _velocity(draws: Draws, choose: Choose, along: Vec3, params: ResetParams) -> Vec3:
    """Return the velocity: along the curve with a part to its side, m/s; 0 at the start pose."""
    speed = draws.uniform("speed", 0.0, choose(params.course_speed, 0.0))
    sideways = speed * draws.uniform("sideways", -SIDEWAYS_FRACTION, SIDEWAYS_FRACTION)
    return along.scale(speed) + Vec3(-along.y, along.x, 0.0).scale(sideways)


def _turn(draws: Draws, choose: Choose, params: ResetParams) -> Quaternion:
    """Return the yaw and tilt away from level flight straight ahead."""
    yaw = jnp.deg2rad(choose(params.course_yaw_deg, params.start_yaw_noise_deg))
    tilt = jnp.deg2rad(choose(params.course_tilt_deg, params.start_tilt_noise_deg))
    angles = compute_once(
        (
            draws.uniform("yaw", -yaw, yaw),
            draws.uniform("tilt", 0.0, tilt),
            draws.uniform("tilt_heading", -jnp.pi, jnp.pi),
        )
    )
    return compute_once(Quaternion.from_yaw_tilt(*angles))
