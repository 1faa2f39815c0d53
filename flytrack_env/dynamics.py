"""The simulator's physics: lag, body rates, thrust, rigid-body translation, battery.

The equations are the handout's; effects that a model has beyond them are folded in between
(``flytrack_env.effects``). ``advance`` states them once, for one drone of scalar leaves; ``step`` is the
same function on the packed (21,) vector.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env import effects
from flytrack_env.effects import StepContext
from flytrack_env.fusion import compute_once
from flytrack_env.quaternion import Quaternion, Scalar, Vec3
from flytrack_env.state import ACTION_SIZE, Action, Drone, pack, unpack, unpack_action

SECONDS_PER_MINUTE = 60.0
HELD_S = 1e6  # s, long enough for lags and limits of the rates to settle, to float32's rounding


class ModelParameters(NamedTuple):
    """Parameters of the minimal model; the first five fields alone construct it.

    tau: (4,) s, time constants of the first-order lag of roll, pitch, yaw, thrust.
    thrust_coeffs: (6,) N, of 1, u, u^2, u^3, V, u V.
    max_rate: (3,) deg/s, body rate at full stick.
    m: kg. g: m/s^2. battery_drain_v_per_min: V/min. effects: parameters of the effects that the model
    has, in the order of ``flytrack_env.effects.EFFECTS``; without any, the model is the handout's.
    """

    tau: jax.Array | np.ndarray
    thrust_coeffs: jax.Array | np.ndarray
    max_rate: jax.Array | np.ndarray
    m: Scalar
    g: Scalar
    battery_drain_v_per_min: Scalar = 1.0
    effects: tuple[Any, ...] = ()

    def with_effects(self, *parameters: Any) -> "ModelParameters":
        """Return the model with effects added, or replaced where it has them.

        Raises:
            TypeError: something that is not the parameters of an effect.
        """
        return self._replace(effects=effects.merge(self.effects, *parameters))

    def effect(self, name: str) -> Any:
        """Return the parameters of an effect; neutral ones where the model does not have it.

        Raises:
            KeyError: no effect of that name.
        """
        neutral = effects.BY_NAME[name].parameters()
        return next((found for found in self.effects if type(found) is type(neutral)), neutral)


def nominal_parameters() -> ModelParameters:
    """Return a generic 1 kg racing quadcopter, before anything was identified.

    Assumption: 40 ms lags; no thrust at u = -1, growing with (u + 1), (u + 1)^2 and V (u + 1) to
    a thrust-to-weight ratio of 3.5 at 24 V and 3.1 at 22 V.
    """
    return ModelParameters(
        tau=np.array([0.04, 0.04, 0.04, 0.04], np.float32),
        thrust_coeffs=np.array([-9.36, -6.36, 3.0, 0.0, 0.98, 0.98], np.float32),
        max_rate=np.array([618.0, 618.0, 120.0], np.float32),
        m=1.0,
        g=9.80665,
    )


def collective_thrust(thrust_action: Scalar, battery_v: Scalar, coeffs: jax.Array | np.ndarray) -> Scalar:
    """Return the thrust in N along body z for a lagged thrust action and a battery voltage.

    ``coeffs`` has shape (6,); handout, task 1, equation 3.
    """
    u, volt = thrust_action, battery_v
    polynomial = coeffs[0] + u * (coeffs[1] + u * (coeffs[2] + u * coeffs[3]))
    return polynomial + volt * (coeffs[4] + u * coeffs[5])


def lag(applied: Action, command: Action, dt: Scalar, tau: Any) -> Action:
    """Return the applied action after ``dt`` seconds of first-order lag towards a held command.

    ``tau``: four time constants, s. Exact for a command held over the step; handout, equation 1.
    """
    # One by one: batched models have time constants that are no array of four.
    blend = [1.0 - jnp.exp(-dt / tau[i]) for i in range(ACTION_SIZE)]
    pairs = zip(applied, command, blend, strict=True)
    return Action(*(old + fraction * (new - old) for old, new, fraction in pairs))


def body_rates(applied: Action, max_rate: jax.Array | np.ndarray) -> Vec3:
    """Return body rates in rad/s of an applied action; ``max_rate`` has shape (3,), deg/s."""
    full_stick = jnp.deg2rad(jnp.asarray(max_rate))
    return Vec3(applied.roll * full_stick[0], applied.pitch * full_stick[1], applied.yaw * full_stick[2])


def integrate_attitude(quat: Quaternion, rates_b: Vec3, dt: Scalar) -> Quaternion:
    """Return the attitude after ``dt``: normalize(q + dt/2 q (x) [0, rates]); handout, equation 2."""
    turn = quat.multiply(Quaternion(0.0, *rates_b))
    half_dt = 0.5 * dt
    return Quaternion(*(q + half_dt * dq for q, dq in zip(quat, turn, strict=True))).normalize()


def start_rates(drone: Drone, params: ModelParameters) -> Vec3:
    """Return the steady body rates, rad/s, of a drone's applied action."""
    rates_b = body_rates(drone.applied, params.max_rate)
    if not effects.acts(params.effects, "rates"):
        return rates_b
    applied, axes = drone.applied, drone.quat.axes()
    context = StepContext(drone=drone, command=applied, dt=HELD_S, applied=applied, body_axes_w=axes)
    memories = effects.start_memories(params.effects, drone)
    context = _with_thrust(context, params, memories)
    return effects.fold("rates", params.effects, memories, rates_b, context)


def _with_thrust(context: StepContext, params: ModelParameters, memories: tuple[Any, ...]) -> StepContext:
    """Return the context with the results of the stages air and thrust."""
    air_w = Vec3(0.0, 0.0, 0.0)
    if effects.acts(params.effects, "air"):
        air_w = compute_once(effects.fold("air", params.effects, memories, air_w, context))
    context = context._replace(air_w=air_w)
    thrust = collective_thrust(context.applied.thrust, context.drone.battery_v, params.thrust_coeffs)
    thrust = effects.fold("thrust", params.effects, memories, thrust, context)
    return context._replace(thrust_acc=compute_once(thrust / params.m))


def _forces(context: StepContext, params: ModelParameters, memories: tuple[Any, ...]) -> tuple[Vec3, Vec3]:
    """Return the acceleration, world, and the specific force, body, m/s^2: thrust and what effects add."""
    axes, thrust_acc = context.body_axes_w, context.thrust_acc
    acc_w = axes[2].scale(thrust_acc) - Vec3(0.0, 0.0, params.g)
    if not effects.acts(params.effects, "force"):
        return acc_w, Vec3(jnp.zeros_like(thrust_acc), jnp.zeros_like(thrust_acc), thrust_acc)
    still = Vec3(0.0, 0.0, 0.0)
    beside_b = compute_once(effects.fold("force", params.effects, memories, still, context))
    acc_w = acc_w + (axes[0].scale(beside_b.x) + axes[1].scale(beside_b.y) + axes[2].scale(beside_b.z))
    return acc_w, beside_b._replace(z=beside_b.z + thrust_acc)


def advance(
    drone: Drone, memories: tuple[Any, ...], command: Action, dt: Scalar, params: ModelParameters
) -> tuple[Drone, tuple[Any, ...]]:
    """Return the drone ``dt`` seconds later under a held command, and the memories of its effects.

    The acceleration uses the attitude *before* the step and the thrust of the lagged action
    *after* it (handout, equations 1 to 4). Commands are not clipped here. memories: as from
    ``effects.start_memories``.
    """
    context = StepContext(drone=drone, command=command, dt=dt)

    def fold(stage: str, value: Any) -> Any:  # sees the context of the moment
        return effects.fold(stage, params.effects, memories, value, context)

    acting = fold("command", command)
    context = context._replace(acting=acting)
    tau = fold("lag", Action(*(params.tau[i] for i in range(ACTION_SIZE))))
    applied = compute_once(lag(drone.applied, acting, dt, tau))
    context = context._replace(applied=applied, body_axes_w=compute_once(drone.quat.axes()))
    context = _with_thrust(context, params, memories)
    rates_b = fold("rates", body_rates(applied, params.max_rate))
    context = context._replace(rates_b=rates_b)
    acc_w, force_b = _forces(context, params, memories)
    acc_w, context = compute_once(acc_w), context._replace(force_b=force_b)
    after = Drone(
        pos_w=drone.pos_w + drone.vel_w.scale(dt) + acc_w.scale(0.5 * dt * dt),
        vel_w=drone.vel_w + acc_w.scale(dt),
        acc_w=acc_w,
        quat=integrate_attitude(drone.quat, rates_b, dt),
        rates_b=rates_b,
        applied=applied,
        battery_v=fold("battery", drone.battery_v - params.battery_drain_v_per_min / SECONDS_PER_MINUTE * dt),
    )
    return compute_once(after), effects.remember(params.effects, memories, context)


class Reading(NamedTuple):
    """What the sensors read after a step: body rates, rad/s, and specific force, m/s^2, body frame."""

    rates_b: Vec3
    force_b: Vec3


def read_gyro(drone: Drone, memories: tuple[Any, ...], dt: Scalar, params: ModelParameters) -> Vec3:
    """Return the body rates that the gyro of a drone reads, rad/s.

    memories: of the effects, up to this drone. dt: s, the step between readings.
    """
    context = StepContext(
        drone=drone, command=drone.applied, dt=dt, applied=drone.applied, rates_b=drone.rates_b
    )
    return effects.fold("gyro", params.effects, memories, drone.rates_b, context)


def read_sensors(
    before: Drone, after: Drone, memories: tuple[Any, ...], dt: Scalar, params: ModelParameters
) -> Reading:
    """Return the readings of gyro and accelerometer after a step of ``dt`` seconds.

    The true specific force is that of the step, in the body frame before it, as in ``advance``.
    memories: of the effects, *after* the step.
    """
    axes = before.quat.axes()
    force_w = after.acc_w + Vec3(0.0, 0.0, params.g)
    force_b = compute_once(Vec3(*(axis.dot(force_w) for axis in axes)))
    context = StepContext(
        drone=before,
        command=after.applied,
        dt=dt,
        applied=after.applied,
        body_axes_w=axes,
        rates_b=after.rates_b,
        force_b=force_b,
    )
    return Reading(
        rates_b=read_gyro(after, memories, dt, params),
        force_b=effects.fold("accelerometer", params.effects, memories, force_b, context),
    )


def step(x: jax.Array, u: jax.Array, dt: Scalar, params: ModelParameters) -> jax.Array:
    """Return the handout's next state: (21,), (4,), s -> (21,); differentiable in everything.

    Raises:
        ValueError: if ``x`` or ``u`` has another shape, or the model has an effect with a memory, which
            the vector has no place for; ``flytrack_env.plants.Simulator`` flies that.
    """
    drone = unpack(x)
    memories = effects.start_memories(params.effects, drone)
    if any(memory is not None for memory in memories):
        raise ValueError("params.effects: found one with a memory, expected none; use plants.Simulator")
    return pack(advance(drone, memories, unpack_action(u), dt, params)[0])
