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
from flytrack_env.effects.base import (
    AccelerometerContext,
    BatteryContext,
    CommandContext,
    Effects,
    ForceContext,
    Memories,
    Rates,
    RatesContext,
    StepContext,
)
from flytrack_env.fusion import compute_once
from flytrack_env.motion import Motion
from flytrack_env.quaternion import Quaternion, Scalar, Vec3
from flytrack_env.state import ACTION_SIZE, Action, Drone, pack, unpack, unpack_action
from flytrack_env.thrust import collective_thrust

SECONDS_PER_MINUTE = 60.0
FULL_STICKS = Action(1.0, 1.0, 1.0, 0.0)
VOLTAGE_TERMS = 4  # of the thrust map: from this coefficient on they multiply the voltage
HELD_S = 1e6  # s, long enough for lags and limits of the rates to settle, to float32's rounding


class ModelParameters(NamedTuple):
    """Parameters of the minimal model; the first five fields alone construct it.

    Without effects, with the default motion and battery, the model is the handout's.

    Attributes:
        tau: (4,) s, time constants of the first-order lag of roll, pitch, yaw, thrust.
        thrust_coeffs: (6,) N, of 1, u, u^2, u^3, V, u V.
        max_rate: (3,) deg/s, body rate at full stick.
        m: mass, kg.
        g: gravity, m/s^2.
        battery_drain_v_per_min: voltage that the battery loses, V/min.
        effects: parameters of the effects that the model has, in the order of
            ``flytrack_env.effects.EFFECTS``.
        motion: how it is integrated over a step, static.
        battery: between which voltages it is flown.
    """

    tau: jax.Array | np.ndarray
    thrust_coeffs: jax.Array | np.ndarray
    max_rate: jax.Array | np.ndarray
    m: Scalar
    g: Scalar
    battery_drain_v_per_min: Scalar = 1.0
    effects: Effects = ()
    motion: Motion = Motion.EULER
    battery: Battery = Battery()

    def with_effects(self, *parameters: Any) -> "ModelParameters":
        """Return the model with effects added, or replaced where it has them.

        Raises:
            TypeError: something that is not the parameters of an effect.
            ValueError: an effect of sticks beside motors that are commanded.
        """
        merged = effects.merge(self.effects, *parameters)
        effects.check_beside_motors(merged)
        return self._replace(effects=merged)

    def resized(self, mass: float, battery: Battery) -> "ModelParameters":
        """Return the model of a craft of another mass and battery that flies alike.

        Its thrust over weight is the same at the same fractions of the highest voltage. So thrust
        scales with the mass, and its dependence on the voltage with the inverse of that voltage.
        Voltages of effects scale with it, and all else of them stays.

        Args:
            mass: kg.
            battery: of the other craft.
        """
        per_volt = float(self.battery.full_v) / float(battery.full_v)
        coeffs = np.asarray(self.thrust_coeffs, float) * mass / float(self.m)
        coeffs[VOLTAGE_TERMS:] *= per_volt
        return self._replace(
            thrust_coeffs=coeffs.astype(np.float32),
            m=mass,
            battery_drain_v_per_min=float(self.battery_drain_v_per_min) / per_volt,
            battery=battery,
            effects=tuple(effects.with_voltages_times(1.0 / per_volt, one) for one in self.effects),
        )

    def effect(self, name: str) -> Any:
        """Return the parameters of an effect; neutral ones where the model does not have it.

        Raises:
            KeyError: no effect of that name.
        """
        neutral = effects.BY_NAME[name].parameters()
        return next(
            (parameters for parameters in self.effects if type(parameters) is type(neutral)),
            neutral,
        )


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


def nominal_motor_parameters() -> ModelParameters:
    """Return the same quadcopter from the motors up, with the handout's frame.

    Assumption: radii of gyration of 7, 9 and 11 cm, the drag torque of a propeller 1.5 cm of its
    thrust, motors that take 25 ms up and 35 ms down.
    """
    motors = effects.Motors(
        front_x=0.15,
        front_y=0.09,
        rear_x=0.15,
        rear_y=0.14,
        radius_x=0.07,
        radius_y=0.09,
        radius_z=0.11,
        yaw_arm=0.015,
        rotor_momentum=0.01,
        up_s=0.025,
        down_s=0.035,
        damping_x=0.5,
        damping_y=0.5,
        damping_z=0.3,
    )
    return nominal_parameters()._replace(motion=Motion.CONTINUOUS).with_effects(motors)


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
    memories = effects.start_memories(params.effects, drone)
    held = Action(0.0, 0.0, 0.0, 0.0)
    # Held this long, the rates settle to the same values under every motion.
    at_once = params._replace(motion=Motion.EULER)
    return _rates(drone, memories, drone.applied, held, HELD_S, at_once)[-1]


def _rates(
    drone: Drone,
    memories: Memories,
    applied: Action,
    applied_slope: Action,
    elapsed_s: Scalar,
    params: ModelParameters,
    first_rates: Rates = (),
) -> Rates:
    """Return the body rates of an applied action before each effect, and after all of them.

    Args:
        drone: at the beginning of the step.
        first_rates: the result there, where this is later.
    """
    rates_b = body_rates(applied, params.max_rate)
    if not effects.acts(params.effects, "rates"):
        return (rates_b,) * (len(params.effects) + 1)
    force = _force_context(drone, memories, applied, drone.quat.axes(), params)
    context = RatesContext(force, applied_slope, elapsed_s, params.motion, rates_b)
    return effects.fold_rates(params.effects, memories, context, first_rates)


def _force_context(
    drone: Drone,
    memories: Memories,
    applied: Action,
    body_axes_w: tuple[Vec3, Vec3, Vec3],
    params: ModelParameters,
) -> ForceContext:
    """Return what the stage force sees: the results of the stages air and thrust."""
    air_w = Vec3(0.0, 0.0, 0.0)
    if effects.acts(params.effects, "air"):
        air_w = compute_once(effects.fold("air", params.effects, memories, air_w, drone))
    airspeed_w = drone.vel_w - air_w
    airspeed_b = Vec3(*(axis.dot(airspeed_w) for axis in body_axes_w))
    thrust = collective_thrust(applied.thrust, drone.battery_v, params.thrust_coeffs)
    context = ForceContext(
        drone, applied, body_axes_w, airspeed_b, thrust / params.m, params.thrust_coeffs
    )
    thrust = effects.fold("thrust", params.effects, memories, thrust, context)
    return context._replace(thrust_acc=compute_once(thrust / params.m))


def _forces(
    context: ForceContext, memories: Memories, params: ModelParameters
) -> tuple[Vec3, Vec3]:
    """Return acceleration, world, and specific force, body, m/s^2, with what effects add."""
    axes, thrust_acc = context.body_axes_w, context.thrust_acc
    acc_w = axes[2].scale(thrust_acc) - Vec3(0.0, 0.0, params.g)
    if not effects.acts(params.effects, "force"):
        return acc_w, Vec3(jnp.zeros_like(thrust_acc), jnp.zeros_like(thrust_acc), thrust_acc)
    zero = Vec3(0.0, 0.0, 0.0)
    beside_b = compute_once(effects.fold("force", params.effects, memories, zero, context))
    acc_w = acc_w + (
        axes[0].scale(beside_b.x) + axes[1].scale(beside_b.y) + axes[2].scale(beside_b.z)
    )
    return acc_w, beside_b._replace(z=beside_b.z + thrust_acc)


class Moved(NamedTuple):
    """A step: the drone after it, what effects remember then, and what an accelerometer reads."""

    after: Drone
    memories: Memories
    context: AccelerometerContext


def advance(
    drone: Drone, memories: Memories, command: Action, dt: Scalar, params: ModelParameters
) -> tuple[Drone, Memories]:
    """Return the drone ``dt`` seconds later under a held command, and the memories of its effects.

    Commands are not clipped here.

    Args:
        memories: as from ``effects.start_memories``.
    """
    return move(drone, memories, command, dt, params)[:2]


def move(
    drone: Drone, memories: Memories, command: Action, dt: Scalar, params: ModelParameters
) -> Moved:
    """Return the step of ``advance`` with what sensors need (``read_sensors``)."""
    if params.motion is Motion.CONTINUOUS:
        return _move_continuously(drone, memories, command, dt, params)
    return _move_at_once(drone, memories, command, dt, params)


class _Response(NamedTuple):
    """How the actuators respond in a span of a step.

    Attributes:
        applied: the action at its end, with the memories of effects that replace the lag.
        acting: the command that acts.
        tau: its lag, s.
    """

    applied: Action
    memories: Memories
    acting: Action
    tau: Action


def _respond(
    drone: Drone,
    memories: Memories,
    command: Action,
    dt: Scalar,
    span: tuple[float, float],
    params: ModelParameters,
) -> _Response:
    """Return the response to a command; drone: at the beginning of the span."""
    context = CommandContext(
        drone=drone,
        command=command,
        dt=dt,
        span=span,
        motion=params.motion,
        full_stick_b=body_rates(FULL_STICKS, params.max_rate),
        thrust_coeffs=params.thrust_coeffs,
        mass=params.m,
    )
    acting = effects.fold("command", params.effects, memories, command, context)
    context = context._replace(command=acting)
    tau = Action(*(params.tau[i] for i in range(ACTION_SIZE)))
    tau = effects.fold("lag", params.effects, memories, tau, context)
    applied = lag(drone.applied, acting, (span[1] - span[0]) * dt, tau)
    if effects.acts(params.effects, "respond"):
        applied, memories = compute_once(
            effects.respond(params.effects, memories, applied, context)
        )
    else:
        applied = compute_once(applied)
    return _Response(applied, memories, acting, tau)


def _voltage(
    drone: Drone,
    memories: Memories,
    applied: Action,
    elapsed_s: Scalar,
    params: ModelParameters,
) -> Scalar:
    """Return the battery voltage a time after the beginning of a step, at an applied action."""
    drained = drone.battery_v - params.battery_drain_v_per_min / SECONDS_PER_MINUTE * elapsed_s
    context = BatteryContext(drone.applied, applied)
    return effects.fold("battery", params.effects, memories, drained, context)


def _move_at_once(
    drone: Drone, memories: Memories, command: Action, dt: Scalar, params: ModelParameters
) -> Moved:
    """Return the step of a simulator that takes each quantity once.

    The thrust is that of the lagged action *after* the step. The acceleration uses the attitude
    *before* it (handout, equations 1 to 4), or, semi-implicit, the attitude after it.
    """
    applied, memories, acting, _ = _respond(drone, memories, command, dt, (0.0, 1.0), params)
    axes = compute_once(drone.quat.axes())
    context = _force_context(drone, memories, applied, axes, params)
    slope = Action(*((to - now) / dt for to, now in zip(applied, drone.applied, strict=True)))
    rates_b = body_rates(applied, params.max_rate)
    rates_context = RatesContext(context, slope, dt, params.motion, rates_b)
    rates = effects.fold_rates(params.effects, memories, rates_context)
    rates_b = rates[-1]
    quat = integrate_attitude(drone.quat, rates_b, dt)
    if params.motion is Motion.SEMI_IMPLICIT:
        quat = compute_once(quat)
        axes = compute_once(quat.axes())
        context = _force_context(drone, memories, applied, axes, params)
    acc_w, force_b = _forces(context, memories, params)
    acc_w = compute_once(acc_w)
    after = Drone(
        pos_w=drone.pos_w + drone.vel_w.scale(dt) + acc_w.scale(0.5 * dt * dt),
        vel_w=drone.vel_w + acc_w.scale(dt),
        acc_w=acc_w,
        quat=quat,
        rates_b=rates_b,
        applied=applied,
        battery_v=_voltage(drone, memories, applied, dt, params),
    )
    step_context = StepContext(
        drone=drone,
        command=command,
        acting=acting,
        dt=dt,
        motion=params.motion,
        rates_b=rates_b,
        force_b=force_b,
        middle_b=None,
        rate_inputs_b=(rates[0], rates[0]),
    )
    later = effects.remember(params.effects, memories, step_context, rates, rates)
    reading = AccelerometerContext(
        dt,
        rates_b=(drone.rates_b + rates_b).scale(0.5),
        angular_acc_b=(rates_b - drone.rates_b).scale(1.0 / dt),
        force_b=force_b,
    )
    return Moved(compute_once(after), later, reading)


class _Instant(NamedTuple):
    """A moment within a continuous step, by what follows from the commands alone.

    Attributes:
        rates: body rates before each effect, and after all of them.
        memories: of the effects, where those that replace the lag are at the moment.
    """

    applied: Action
    battery_v: Scalar
    rates: Rates
    memories: Memories


def _lag_within_step(
    drone: Drone, memories: Memories, command: Action, dt: Scalar, params: ModelParameters
) -> tuple[tuple[_Instant, _Instant, _Instant], _Response]:
    """Return the beginning, middle and end of a step under a held command.

    The lag is exact for commands held over half a step; of a delayed one, each half has its mean.
    The response is that of the second half.
    """

    def instant(
        applied: Action,
        elapsed_s: Scalar,
        response: _Response,
        moment: Memories,
        first_rates: Rates = (),
    ) -> _Instant:
        now = zip(response.acting, applied, response.tau, strict=True)
        slope = Action(*((target - current) / tau for target, current, tau in now))
        volts = _voltage(drone, memories, applied, elapsed_s, params)
        rates = _rates(drone, memories, applied, slope, elapsed_s, params, first_rates)
        return _Instant(applied, volts, rates, moment)

    half = 0.5 * dt
    first = _respond(drone, memories, command, dt, (0.0, 0.5), params)
    middle = drone._replace(applied=first.applied)
    second = _respond(middle, first.memories, command, dt, (0.5, 1.0), params)
    beginning = instant(drone.applied, 0.0, first, memories)
    instants = (
        beginning,
        instant(first.applied, half, second, first.memories, beginning.rates),
        instant(second.applied, dt, second, second.memories, beginning.rates),
    )
    return instants, second


def _move_continuously(
    drone: Drone, memories: Memories, command: Action, dt: Scalar, params: ModelParameters
) -> Moved:
    """Return the step of a drone whose rates and force change within it.

    The attitude turns by the exponential map of the rates' mean, with the first commutator of the
    Magnus expansion (Iserles et al., Lie-group methods, 2000); the acceleration is Simpson's mean
    of the forces at the beginning, middle and end, each with the attitude and velocity of its
    moment.
    """
    instants, response = _lag_within_step(drone, memories, command, dt, params)
    rates_0, rates_m, rates_1 = (compute_once(instant.rates[-1]) for instant in instants)
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
            instant.rates[-1],
            instant.applied,
            instant.battery_v,
        )
        axes = compute_once(quat.axes())
        context = _force_context(there, instant.memories, instant.applied, axes, params)
        return compute_once(_forces(context, instant.memories, params))

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
    first, last = instants[0].rates, instants[2].rates
    context = StepContext(
        drone=drone,
        command=command,
        acting=response.acting,
        dt=dt,
        motion=params.motion,
        rates_b=last[-1],
        force_b=force_1,
        middle_b=(rates_m, force_m),
        rate_inputs_b=(first[0], last[0]),
    )
    later = effects.remember(params.effects, response.memories, context, first, last)
    reading = AccelerometerContext(dt, last[-1], turning, force_1)
    return Moved(compute_once(after), later, reading)


def observe_rates(
    drone: Drone, memories: Memories, rates_b: Vec3, dt: Scalar, params: ModelParameters
) -> tuple[Drone, Memories]:
    """Return a drone with measured body rates, rad/s, and the memories of its effects.

    A rate loop with a memory takes up how far they are from the model's; where there is none, the
    applied action does, to first order in what effects make of it.

    Args:
        dt: since the last measurement, s.
    """
    memories, rest_b = effects.observe(params.effects, memories, rates_b - drone.rates_b, dt)
    full_stick = body_rates(FULL_STICKS, params.max_rate)
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


def read_gyro(drone: Drone, memories: Memories, dt: Scalar, params: ModelParameters) -> Vec3:
    """Return the body rates that the gyro of a drone reads, rad/s.

    Args:
        memories: of the effects, up to this drone.
        dt: s, the step between readings.
    """
    return effects.fold("gyro", params.effects, memories, drone.rates_b, dt)


def sensed(drone: Drone, memories: Memories, dt: Scalar, params: ModelParameters) -> Drone:
    """Return the drone as its sensors report it: gyro and pose; the rest is true.

    Args:
        memories: of the effects, up to this drone.
        dt: s, the step between readings.
    """
    pose = effects.fold("pose", params.effects, memories, effects.Pose.of(drone), dt)
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

    Raises:
        ValueError: if ``x`` or ``u`` has another shape, or the model has an effect with a memory,
            which the vector has no place for; ``flytrack_env.plants.Simulator`` flies that.
    """
    drone = unpack(x)
    memories = effects.start_memories(params.effects, drone)
    if any(memory is not None for memory in memories):
        raise ValueError(
            "params.effects: found one with a memory, expected none; use plants.Simulator"
        )
    return pack(advance(drone, memories, unpack_action(u), dt, params)[0])
