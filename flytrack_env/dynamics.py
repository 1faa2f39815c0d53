"""The simulator's physics: lag, body rates, thrust, rigid-body translation, battery.

The equations are the handout's; effects that a model has beyond them are folded in between
(``flytrack_env.effects``). ``move`` states them once, for one drone of scalar leaves; ``step`` is
the same function on the packed (21,) vector. How they are integrated over a step is the model's
``Motion``.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env import effects
from flytrack_env.battery import Battery
from flytrack_env.effects import StepContext
from flytrack_env.fusion import compute_once
from flytrack_env.motion import Motion
from flytrack_env.quaternion import Quaternion, Scalar, Vec3
from flytrack_env.state import ACTION_SIZE, Action, Drone, pack, unpack, unpack_action
from flytrack_env.thrust import collective_thrust

SECONDS_PER_MINUTE = 60.0
HELD_S = 1e6  # s, long enough for lags and limits of the rates to settle, to float32's rounding


class ModelParameters(NamedTuple):
    """Parameters of the minimal model; the first five fields alone construct it.

    tau: (4,) s, time constants of the first-order lag of roll, pitch, yaw, thrust. thrust_coeffs:
    (6,) N, of 1, u, u^2, u^3, V, u V. max_rate: (3,) deg/s, body rate at full stick. m: kg. g:
    m/s^2. battery_drain_v_per_min: V/min. effects: parameters of the effects that the model has, in
    the order of ``flytrack_env.effects.EFFECTS``. motion: how it moves within a step, static.
    battery: between which voltages it is flown. Without effects, with the default motion and
    battery, the model is the handout's.
    """

    tau: jax.Array | np.ndarray
    thrust_coeffs: jax.Array | np.ndarray
    max_rate: jax.Array | np.ndarray
    m: Scalar
    g: Scalar
    battery_drain_v_per_min: Scalar = 1.0
    effects: tuple[Any, ...] = ()
    motion: Motion = Motion.HANDOUT
    battery: Battery = Battery()

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
    return Vec3(
        applied.roll * full_stick[0], applied.pitch * full_stick[1], applied.yaw * full_stick[2]
    )


def integrate_attitude(quat: Quaternion, rates_b: Vec3, dt: Scalar) -> Quaternion:
    """Return the attitude after ``dt``, by equation 2 of the handout.

    It is normalize(q + dt/2 q (x) [0, rates]).
    """
    turn = quat.multiply(Quaternion(0.0, *rates_b))
    half_dt = 0.5 * dt
    return Quaternion(*(q + half_dt * dq for q, dq in zip(quat, turn, strict=True))).normalize()


def turn_by(quat: Quaternion, angle_b: Vec3) -> Quaternion:
    """Return the attitude after a rotation vector, rad, body frame.

    The exponential map, to its seventh order, for the turn of a step, well below 1 rad; not
    normalised.
    """
    square = angle_b.dot(angle_b)
    cosine = 1.0 - square * (1.0 / 8.0 - square * (1.0 / 384.0 - square * (1.0 / 46080.0)))
    share = 0.5 - square * (1.0 / 48.0 - square * (1.0 / 3840.0 - square * (1.0 / 645120.0)))
    return quat.multiply(Quaternion(cosine, *angle_b.scale(share)))


def start_rates(drone: Drone, params: ModelParameters) -> Vec3:
    """Return the steady body rates, rad/s, of a drone's applied action."""
    rates_b = body_rates(drone.applied, params.max_rate)
    if not effects.acts(params.effects, "rates"):
        return rates_b
    applied, axes = drone.applied, drone.quat.axes()
    # Held this long, the rates settle to the same values under every motion.
    context = StepContext(
        drone=drone, command=applied, dt=HELD_S, applied=applied, body_axes_w=axes
    )
    memories = effects.start_memories(params.effects, drone)
    context = _with_thrust(context, params, memories)
    return effects.fold_rates(params.effects, memories, rates_b, context, ())[0]


def _with_thrust(
    context: StepContext, params: ModelParameters, memories: tuple[Any, ...]
) -> StepContext:
    """Return the context with the results of the stages air and thrust."""
    air_w = Vec3(0.0, 0.0, 0.0)
    if effects.acts(params.effects, "air"):
        air_w = compute_once(effects.fold("air", params.effects, memories, air_w, context))
    context = context._replace(air_w=air_w)
    thrust = collective_thrust(
        context.applied.thrust, context.drone.battery_v, params.thrust_coeffs
    )
    thrust = effects.fold("thrust", params.effects, memories, thrust, context)
    return context._replace(thrust_acc=compute_once(thrust / params.m))


def _forces(
    context: StepContext, params: ModelParameters, memories: tuple[Any, ...]
) -> tuple[Vec3, Vec3]:
    """Return acceleration, world, and specific force, body, m/s^2, with what effects add."""
    axes, thrust_acc = context.body_axes_w, context.thrust_acc
    acc_w = axes[2].scale(thrust_acc) - Vec3(0.0, 0.0, params.g)
    if not effects.acts(params.effects, "force"):
        return acc_w, Vec3(jnp.zeros_like(thrust_acc), jnp.zeros_like(thrust_acc), thrust_acc)
    still = Vec3(0.0, 0.0, 0.0)
    beside_b = compute_once(effects.fold("force", params.effects, memories, still, context))
    acc_w = acc_w + (
        axes[0].scale(beside_b.x) + axes[1].scale(beside_b.y) + axes[2].scale(beside_b.z)
    )
    return acc_w, beside_b._replace(z=beside_b.z + thrust_acc)


class Moved(NamedTuple):
    """A step: the drone after it, what effects remember then, and what they see of its end."""

    after: Drone
    memories: tuple[Any, ...]
    context: StepContext


def advance(
    drone: Drone, memories: tuple[Any, ...], command: Action, dt: Scalar, params: ModelParameters
) -> tuple[Drone, tuple[Any, ...]]:
    """Return the drone ``dt`` seconds later under a held command, and the memories of its effects.

    Commands are not clipped here. memories: as from ``effects.start_memories``.
    """
    return move(drone, memories, command, dt, params)[:2]


def move(
    drone: Drone, memories: tuple[Any, ...], command: Action, dt: Scalar, params: ModelParameters
) -> Moved:
    """Return the step of ``advance`` with what sensors need (``read_sensors``)."""
    if params.motion is Motion.CONTINUOUS:
        return _move_continuously(drone, memories, command, dt, params)
    return _move_at_once(drone, memories, command, dt, params)


def _taus(params: ModelParameters) -> Action:
    return Action(*(params.tau[i] for i in range(ACTION_SIZE)))


def _beginning(drone: Drone, command: Action, dt: Scalar, params: ModelParameters) -> StepContext:
    """Return the context of a step that begins."""
    return StepContext(
        drone=drone,
        command=command,
        dt=dt,
        motion=params.motion,
        full_stick_b=body_rates(Action(1.0, 1.0, 1.0, 0.0), params.max_rate),
        thrust_coeffs=params.thrust_coeffs,
    )


def _applied(
    drone: Drone,
    memories: tuple[Any, ...],
    dt: Scalar,
    tau: Action,
    params: ModelParameters,
    context: StepContext,
) -> tuple[Action, tuple[Any, ...]]:
    """Return the applied action after ``dt``, and the memories of effects that replace the lag."""
    lagged = lag(drone.applied, context.acting, dt, tau)
    if not effects.acts(params.effects, "respond"):
        return compute_once(lagged), memories
    return compute_once(effects.respond(params.effects, memories, lagged, context))


def _drained(drone: Drone, elapsed_s: Scalar, params: ModelParameters) -> Scalar:
    """Return the battery voltage after a time, before what effects add."""
    return drone.battery_v - params.battery_drain_v_per_min / SECONDS_PER_MINUTE * elapsed_s


def _move_at_once(
    drone: Drone, memories: tuple[Any, ...], command: Action, dt: Scalar, params: ModelParameters
) -> Moved:
    """Return the step of a simulator that takes each quantity once.

    The thrust is that of the lagged action *after* the step. The acceleration uses the attitude
    *before* it (handout, equations 1 to 4), or, semi-implicit, the attitude after it.
    """
    context = _beginning(drone, command, dt, params)

    def fold(stage: str, value: Any) -> Any:  # sees the context of the moment
        return effects.fold(stage, params.effects, memories, value, context)

    acting = fold("command", command)
    context = context._replace(acting=acting)
    tau = fold("lag", _taus(params))
    applied, memories = _applied(drone, memories, dt, tau, params, context)
    context = context._replace(applied=applied, body_axes_w=compute_once(drone.quat.axes()))
    context = _with_thrust(context, params, memories)
    rates_b = body_rates(applied, params.max_rate)
    rates_b, inputs = effects.fold_rates(params.effects, memories, rates_b, context, ())
    context = context._replace(rates_b=rates_b)
    quat = integrate_attitude(drone.quat, rates_b, dt)
    if params.motion is Motion.SEMI_IMPLICIT:
        quat = compute_once(quat)
        context = _with_thrust(
            context._replace(body_axes_w=compute_once(quat.axes())), params, memories
        )
    acc_w, force_b = _forces(context, params, memories)
    acc_w, context = compute_once(acc_w), context._replace(force_b=force_b)
    after = Drone(
        pos_w=drone.pos_w + drone.vel_w.scale(dt) + acc_w.scale(0.5 * dt * dt),
        vel_w=drone.vel_w + acc_w.scale(dt),
        acc_w=acc_w,
        quat=quat,
        rates_b=rates_b,
        applied=applied,
        battery_v=fold("battery", _drained(drone, dt, params)),
    )
    later = effects.remember(params.effects, memories, context, inputs, inputs)
    return Moved(compute_once(after), later, context)


class _Instant(NamedTuple):
    """A moment within a continuous step, by what follows from the commands alone."""

    applied: Action
    battery_v: Scalar
    context: StepContext
    rate_inputs: tuple[Any, ...]


def _lag_within_step(
    drone: Drone, memories: tuple[Any, ...], command: Action, dt: Scalar, params: ModelParameters
) -> tuple[tuple[_Instant, _Instant, _Instant], tuple[Any, ...]]:
    """Return the beginning, middle and end of a step under a held command.

    Each has the applied action, the battery voltage and the inputs of the body rates. The lag is
    exact for commands held over half a step; of a delayed one, each half has its mean. The memories
    are those of effects that replace the lag.
    """
    beginning = _beginning(drone, command, dt, params)

    def after_half(
        span: tuple[float, float], applied: Action, memories: tuple[Any, ...]
    ) -> tuple[Action, tuple[Any, ...], Action, Action]:
        now = beginning._replace(drone=drone._replace(applied=applied), span=span)
        acting = effects.fold("command", params.effects, memories, command, now)
        now = now._replace(acting=acting)
        tau = effects.fold("lag", params.effects, memories, _taus(params), now)
        return *_applied(now.drone, memories, 0.5 * dt, tau, params, now), acting, tau

    def instant(
        applied: Action, elapsed_s: Scalar, acting: Action, tau: Action, first: tuple[Any, ...] = ()
    ) -> _Instant:
        slope = Action(*((to - now) / t for to, now, t in zip(acting, applied, tau, strict=True)))
        context = beginning._replace(
            dt=elapsed_s, acting=acting, applied=applied, applied_slope=slope
        )
        volts = effects.fold(
            "battery", params.effects, memories, _drained(drone, elapsed_s, params), context
        )
        rates_b = body_rates(applied, params.max_rate)
        if effects.acts(params.effects, "rates"):
            context = context._replace(body_axes_w=drone.quat.axes())
            context = _with_thrust(context, params, memories)
        rates_b, inputs = effects.fold_rates(params.effects, memories, rates_b, context, first)
        return _Instant(applied, volts, context._replace(rates_b=rates_b), inputs)

    half = 0.5 * dt
    middle, response, acting, tau = after_half((0.0, 0.5), drone.applied, memories)
    end, response, later, later_tau = after_half((0.5, 1.0), middle, response)
    at_first = instant(drone.applied, 0.0, acting, tau)
    inputs = at_first.rate_inputs
    found = (
        at_first,
        instant(middle, half, later, later_tau, inputs),
        instant(end, dt, later, later_tau, inputs),
    )
    return found, response


def _move_continuously(
    drone: Drone, memories: tuple[Any, ...], command: Action, dt: Scalar, params: ModelParameters
) -> Moved:
    """Return the step of a drone whose rates and force change within it.

    The attitude turns by the exponential map of the rates' mean, with the first commutator of the
    Magnus expansion (Iserles et al., Lie-group methods, 2000); the acceleration is Simpson's mean
    of the forces at the beginning, middle and end, each with the attitude and velocity of its
    moment.
    """
    instants, response = _lag_within_step(drone, memories, command, dt, params)
    rates_0, rates_m, rates_1 = (compute_once(one.context.rates_b) for one in instants)
    # Of the first half, from the parabola through the three rates.
    angle_m = (rates_0.scale(5.0) + rates_m.scale(8.0) - rates_1).scale(dt / 24.0)
    angle_1 = (rates_0 + rates_m.scale(4.0) + rates_1).scale(dt / 6.0)
    angle_1 = angle_1 + rates_0.cross(rates_1).scale(dt * dt / 12.0)
    quat_m = turn_by(drone.quat, angle_m)
    quat_1 = compute_once(turn_by(drone.quat, angle_1).normalize())

    def force_at(
        instant: _Instant, quat: Quaternion, vel_w: Vec3, elapsed_s: Scalar
    ) -> tuple[Vec3, Vec3]:
        pos_w = drone.pos_w + vel_w.scale(elapsed_s)
        there = Drone(
            pos_w,
            vel_w,
            drone.acc_w,
            quat,
            instant.context.rates_b,
            instant.applied,
            instant.battery_v,
        )
        context = instant.context._replace(drone=there, body_axes_w=compute_once(quat.axes()))
        return compute_once(_forces(_with_thrust(context, params, memories), params, memories))

    half, vel_w = 0.5 * dt, drone.vel_w
    acc_0, _ = force_at(instants[0], drone.quat, vel_w, 0.0)
    acc_m, force_m = force_at(instants[1], quat_m, vel_w + acc_0.scale(half), half)
    acc_1, force_1 = force_at(instants[2], quat_1, vel_w + acc_m.scale(dt), dt)
    acc_w = compute_once((acc_0 + acc_m.scale(4.0) + acc_1).scale(1.0 / 6.0))
    after = Drone(
        pos_w=drone.pos_w + drone.vel_w.scale(dt) + (acc_0 + acc_m.scale(2.0)).scale(dt * dt / 6.0),
        vel_w=drone.vel_w + acc_w.scale(dt),
        acc_w=acc_w,
        quat=quat_1,
        rates_b=rates_1,
        applied=instants[2].applied,
        battery_v=instants[2].battery_v,
    )
    turning = (rates_0 - rates_m.scale(4.0) + rates_1.scale(3.0)).scale(
        1.0 / dt
    )  # the parabola's slope
    context = instants[2].context._replace(
        force_b=force_1, angular_acc_b=turning, middle_rates_b=rates_m, middle_force_b=force_m
    )
    inputs = instants[0].rate_inputs, instants[2].rate_inputs
    later = effects.remember(params.effects, response, context, *inputs)
    return Moved(compute_once(after), later, context)


def observe_rates(
    drone: Drone, memories: tuple[Any, ...], rates_b: Vec3, dt: Scalar, params: ModelParameters
) -> tuple[Drone, tuple[Any, ...]]:
    """Return a drone with measured body rates, rad/s, and the memories of its effects.

    A rate loop with a memory takes up how far they are from the model's; where there is none, the
    applied action does, to first order in what effects make of it. dt: since the last measurement,
    s.
    """
    memories, rest_b = effects.observe(params.effects, memories, rates_b - drone.rates_b, dt)
    full_stick = body_rates(Action(1.0, 1.0, 1.0, 0.0), params.max_rate)
    applied = drone.applied._replace(
        roll=drone.applied.roll + rest_b.x / full_stick.x,
        pitch=drone.applied.pitch + rest_b.y / full_stick.y,
        yaw=drone.applied.yaw + rest_b.z / full_stick.z,
    )
    return drone._replace(rates_b=rates_b, applied=applied), memories


class Reading(NamedTuple):
    """The sensors' readings after a step, body frame: rates, rad/s, and specific force, m/s^2."""

    rates_b: Vec3
    force_b: Vec3


def read_gyro(drone: Drone, memories: tuple[Any, ...], dt: Scalar, params: ModelParameters) -> Vec3:
    """Return the body rates that the gyro of a drone reads, rad/s.

    memories: of the effects, up to this drone. dt: s, the step between readings.
    """
    context = StepContext(
        drone=drone,
        command=drone.applied,
        dt=dt,
        motion=params.motion,
        applied=drone.applied,
        rates_b=drone.rates_b,
    )
    return effects.fold("gyro", params.effects, memories, drone.rates_b, context)


def sensed(drone: Drone, memories: tuple[Any, ...], dt: Scalar, params: ModelParameters) -> Drone:
    """Return the drone as its sensors report it: gyro and pose; the rest is true.

    memories: of the effects, up to this drone. dt: s, the step between readings.
    """
    pose = effects.Pose(drone.pos_w, drone.vel_w, drone.quat)
    context = StepContext(drone=drone, command=drone.applied, dt=dt, motion=params.motion)
    pose = effects.fold("pose", params.effects, memories, pose, context)
    return drone._replace(**pose._asdict(), rates_b=read_gyro(drone, memories, dt, params))


def read_sensors(moved: Moved, params: ModelParameters) -> Reading:
    """Return the readings of gyro and accelerometer after a step.

    The true specific force is that of the step, in the body frame whose attitude its force had; of
    a continuous step that at its end.
    """
    after, memories, context = moved
    return Reading(
        rates_b=read_gyro(after, memories, context.dt, params),
        force_b=effects.fold("accelerometer", params.effects, memories, context.force_b, context),
    )


def step(x: jax.Array, u: jax.Array, dt: Scalar, params: ModelParameters) -> jax.Array:
    """Return the handout's next state: (21,), (4,), s -> (21,); differentiable in everything.

    Raises: ValueError: if ``x`` or ``u`` has another shape, or the model has an effect with a
            memory, which the vector has no place for; ``flytrack_env.plants.Simulator`` flies that.
    """
    drone = unpack(x)
    memories = effects.start_memories(params.effects, drone)
    if any(memory is not None for memory in memories):
        raise ValueError(
            "params.effects: found one with a memory, expected none; use plants.Simulator"
        )
    return pack(advance(drone, memories, unpack_action(u), dt, params)[0])
