"""The equations of the shipped plant: the handout's drone, and the air around it.

Independent of the simulator on purpose: a model that is fitted to this plant must not share a line
with it. World frame z up, body frame x forward and z along the thrust, quaternions w, x, y, z from
body to world. Forces are per kilogram, hence accelerations, m/s^2.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

STATE_SIZE = 21
ACTION_SIZE = 4
DT_S = 0.01
SECONDS_PER_MINUTE = 60.0


class PlantParameters(NamedTuple):
    """Everything that makes one plant differ from another; the air's effects vanish at 0.

    Attributes:
        mass: kg.
        gravity: m/s^2.
        battery_drain: V/min.
        lag: (4,) s, time constants of roll, pitch, yaw, thrust.
        max_rate: (3,) deg/s, body rates at full stick.
        thrust: (6,) N, of 1, u, u^2, u^3, V, u V.
        body_drag: (3,) 1/m, quadratic drag along body x, y, z.
        rotor_drag: s/m, in-plane drag per thrust and per airspeed.
        translational_lift: 1, share of thrust gained at high in-plane airspeed.
        translational_speed: m/s, airspeed at which half of that is gained; > 0.
        ground_radius: m, radius of the one rotor that stands for all four near the ground.
    """

    mass: float
    gravity: float
    battery_drain: float
    lag: tuple[float, float, float, float]
    max_rate: tuple[float, float, float]
    thrust: tuple[float, float, float, float, float, float]
    body_drag: tuple[float, float, float]
    rotor_drag: float
    translational_lift: float
    translational_speed: float
    ground_radius: float


def lagged_action(applied: jax.Array, command: jax.Array, lag: jax.Array) -> jax.Array:
    """Return the applied action (4,) after one step towards a held command (4,).

    ``lag``: (4,) s. Exact solution of a first-order lag; handout, task 1, equation 1.
    """
    return applied + (1.0 - jnp.exp(-DT_S / lag)) * (command - applied)


def quaternion_product(left: jax.Array, right: jax.Array) -> jax.Array:
    """Return the Hamilton product of two quaternions (4,)."""
    scalar = left[0] * right[0] - jnp.sum(left[1:] * right[1:])
    vector = left[0] * right[1:] + right[0] * left[1:] + jnp.cross(left[1:], right[1:])
    return jnp.concatenate([scalar[None], vector])


def turned(attitude: jax.Array, rates_b: jax.Array) -> jax.Array:
    """Return the attitude (4,) after one step at body rates (3,), rad/s; handout, equation 2."""
    spin = jnp.concatenate([jnp.zeros(1, rates_b.dtype), rates_b])
    moved = attitude + 0.5 * DT_S * quaternion_product(attitude, spin)
    return moved / jnp.sqrt(jnp.sum(moved * moved))


def rotation_matrix(attitude: jax.Array) -> jax.Array:
    """Return the matrix (3, 3) that takes body vectors to the world, of a unit quaternion (4,)."""
    w, x, y, z = attitude
    return jnp.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def static_thrust(thrust_action: jax.Array, volt: jax.Array, coeffs: jax.Array) -> jax.Array:
    """Return the thrust in N in still air far from the ground; never negative.

    ``thrust_action`` is the lagged one in [-1, 1], ``volt`` the battery voltage, ``coeffs`` (6,) N.
    Handout, equation 3; propellers of fixed pitch that only spin one way cannot pull down.
    """
    u = thrust_action
    terms = jnp.stack([jnp.ones_like(u), u, u * u, u * u * u, volt, u * volt])
    return jnp.maximum(jnp.sum(coeffs * terms), 0.0)


def translational_lift_factor(
    airspeed_b: jax.Array, gain: jax.Array, half_speed: jax.Array
) -> jax.Array:
    """Return the factor on thrust of flying edgewise: 1 at rest, 1 + gain far above half_speed.

    ``airspeed_b``: (3,) m/s. ``half_speed``: m/s. A saturating fit of momentum theory: a rotor that
    meets fresh air induces less of its own (Leishman, Principles of Helicopter Aerodynamics, 2.14).
    """
    edgewise_squared = airspeed_b[0] ** 2 + airspeed_b[1] ** 2
    return 1.0 + gain * edgewise_squared / (edgewise_squared + half_speed**2)


def ground_effect_factor(height: jax.Array, radius: jax.Array) -> jax.Array:
    """Return the factor on thrust of the ground below: 1 / (1 - (radius / 4 height)^2).

    Both in m. Heights below one radius count as one radius, where the formula ends (at most 16/15).
    Cheeseman and Bennett, The Effect of the Ground on a Helicopter Rotor, ARC R&M 3021, 1955.
    """
    # The tiny height keeps 0 / 0 away when a plant has no ground effect.
    ratio = radius / (4.0 * jnp.maximum(height, jnp.maximum(radius, 1e-6)))
    return 1.0 / (1.0 - ratio**2)


def body_drag(airspeed_b: jax.Array, coeffs: jax.Array) -> jax.Array:
    """Return the quadratic drag of frame and arms, (3,) m/s^2 in the body frame.

    ``airspeed_b``: (3,) m/s. ``coeffs``: (3,) 1/m, density * area * drag coefficient / (2 mass) of
    each side. Each axis on its own: the cross-flow principle for bluff bodies.
    """
    return -coeffs * jnp.abs(airspeed_b) * airspeed_b


def rotor_drag(airspeed_b: jax.Array, specific_thrust: jax.Array, coeff: jax.Array) -> jax.Array:
    """Return the in-plane drag of the turning rotors, (3,) m/s^2 in the body frame.

    ``airspeed_b``: (3,) m/s. ``specific_thrust``: m/s^2. ``coeff``: s/m. Blade flapping and induced
    drag, linear in airspeed and in thrust; as in Faessler, Franchi and Scaramuzza, Differential
    Flatness of Quadrotor Dynamics Subject to Rotor Drag, RA-L 2018, with the thrust kept.
    """
    in_plane = airspeed_b * jnp.array([1.0, 1.0, 0.0], airspeed_b.dtype)
    return -coeff * specific_thrust * in_plane


def acceleration(x: jax.Array, thrust_action: jax.Array, parameters: PlantParameters) -> jax.Array:
    """Return the acceleration of the centre of mass, (3,) m/s^2 in the world, gravity included.

    ``x``: the state (21,) before the step; ``thrust_action``: the lagged one after it. No wind: the
    airspeed is the velocity.
    """
    to_world = rotation_matrix(x[9:13])
    airspeed_b = jnp.sum(to_world * x[3:6, None], axis=0)
    newton = static_thrust(thrust_action, x[20], parameters.thrust)
    newton *= translational_lift_factor(
        airspeed_b, parameters.translational_lift, parameters.translational_speed
    )
    newton *= ground_effect_factor(x[2], parameters.ground_radius)
    specific_thrust = newton / parameters.mass
    force_b = body_drag(airspeed_b, parameters.body_drag)
    force_b += rotor_drag(airspeed_b, specific_thrust, parameters.rotor_drag)
    force_b += specific_thrust * jnp.array([0.0, 0.0, 1.0], x.dtype)
    gravity_w = parameters.gravity * jnp.array([0.0, 0.0, -1.0], x.dtype)
    return jnp.sum(to_world * force_b, axis=1) + gravity_w


def step(x: jax.Array, u: jax.Array, parameters: PlantParameters) -> jax.Array:
    """Return the state 0.01 s later: (21,), (4,) float32 -> (21,) float32, as in the handout.

    Commands are clipped to [-1, 1]. Nothing is remembered beside the state.
    """
    parameters = PlantParameters(*(jnp.asarray(field, jnp.float32) for field in parameters))
    applied = lagged_action(x[16:20], jnp.clip(u, -1.0, 1.0), parameters.lag)
    rates_b = jnp.deg2rad(parameters.max_rate) * applied[:3]
    accel_w = acceleration(x, applied[3], parameters)
    position_w = x[0:3] + x[3:6] * DT_S + accel_w * (0.5 * DT_S**2)
    velocity_w = x[3:6] + accel_w * DT_S
    volt = x[20] - parameters.battery_drain * (DT_S / SECONDS_PER_MINUTE)
    attitude = turned(x[9:13], rates_b)
    return jnp.concatenate(
        [position_w, velocity_w, accel_w, attitude, rates_b, applied, volt[None]]
    )
