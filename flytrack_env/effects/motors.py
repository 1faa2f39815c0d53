"""A rigid body driven by four motors: commands are the motors', and rates follow from torques."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import (
    CommandContext,
    Effect,
    ForceContext,
    Memory,
    Range,
    Search,
)
from flytrack_env.fusion import compute_once
from flytrack_env.motors import NAMES, QUARTER, SIGNS, moment, reached
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Action, Drone
from flytrack_env.thrust import collective_thrust

NUM_SUBSTEPS = 6  # of a step, a whole number in each half: 600 Hz at 100 Hz


class Motors(NamedTuple):
    """The craft. Without a frame (``front_y`` of 0) there are no motors, and sticks command.

    With it, a command is not roll, pitch, yaw and thrust, but the outputs of the motors rear right,
    front right, rear left and front left, from -1 (off) to 1 (full). Each motor gives a quarter of
    the model's thrust map. Inertia is over the mass, as no log shows them apart.

    Attributes:
        front_x, front_y: of the front motors, ahead and aside of the frame's origin, m.
        rear_x, rear_y: of the rear motors, behind and aside of it, m.
        center_x, center_y: where the centre of mass is ahead and left of the origin, m.
        radius_x, radius_y, radius_z: radii of gyration about the body's axes, m: the roots of the
            moments of inertia over the mass.
        product_xy, product_xz, product_yz: products of inertia, over those of both radii.
        yaw_arm: torque of a propeller over its thrust, m; below 0, propellers turn the other way
            than by Betaflight's default.
        rotor_momentum: angular momentum of a rotor at full command, over the mass, m^2/s; below 0,
            as for ``yaw_arm``.
        up_s, down_s: lag of a motor that speeds up, and of one that slows down.
        damping_x, damping_y, damping_z: torque against the rate, over it and the moment of inertia,
            1/s.
        load: mass at the centre of mass beyond the model's, as a share of it; it has no inertia.
        rear_right, front_right, rear_left, front_left: thrust of a motor as a share of what it
            should be.
    """

    front_x: Scalar = 0.0
    front_y: Scalar = 0.0
    rear_x: Scalar = 0.0
    rear_y: Scalar = 0.0
    center_x: Scalar = 0.0
    center_y: Scalar = 0.0
    radius_x: Scalar = 0.1
    radius_y: Scalar = 0.1
    radius_z: Scalar = 0.14
    product_xy: Scalar = 0.0
    product_xz: Scalar = 0.0
    product_yz: Scalar = 0.0
    yaw_arm: Scalar = 0.015
    rotor_momentum: Scalar = 0.0
    up_s: Scalar = 0.03
    down_s: Scalar = 0.03
    damping_x: Scalar = 0.0
    damping_y: Scalar = 0.0
    damping_z: Scalar = 0.0
    load: Scalar = 0.0
    rear_right: Scalar = 1.0
    front_right: Scalar = 1.0
    rear_left: Scalar = 1.0
    front_left: Scalar = 1.0

    @property
    def health(self) -> tuple[Scalar, ...]:
        """Of the motors, in their order."""
        return self.rear_right, self.front_right, self.rear_left, self.front_left

    @property
    def levers(self) -> tuple[Vec3, ...]:
        """The moment of each motor over its thrust, m."""
        return tuple(
            Vec3(left * aside - self.center_y, self.center_x - ahead, self.yaw_arm * turn)
            for ahead, aside, left, turn in zip(
                (-self.rear_x, self.front_x) * 2,
                (self.rear_y, self.front_y) * 2,
                SIGNS[0].tolist(),
                SIGNS[2].tolist(),
                strict=True,
            )
        )


class Spinning(NamedTuple):
    """The speeds of the motors as shares of that at full command, in their order."""

    speeds: tuple[Scalar, ...]


class Inertia(NamedTuple):
    """The symmetric inertia over the mass, m^2, or its inverse; by rows of the upper triangle."""

    xx: Scalar
    xy: Scalar
    xz: Scalar
    yy: Scalar
    yz: Scalar
    zz: Scalar

    @classmethod
    def of(cls, motors: Motors) -> "Inertia":
        """Return the inertia of a craft."""
        x, y, z = motors.radius_x, motors.radius_y, motors.radius_z
        products = motors.product_xy * x * y, motors.product_xz * x * z, motors.product_yz * y * z
        return cls(x * x, -products[0], -products[1], y * y, -products[2], z * z)

    def times(self, vector: Vec3) -> Vec3:
        """Return the product with a vector."""
        rows = (self.xx, self.xy, self.xz), (self.xy, self.yy, self.yz), (self.xz, self.yz, self.zz)
        return Vec3(*(Vec3(*row).dot(vector) for row in rows))

    def inverse(self) -> "Inertia":
        """Return the inverse, by minors."""
        minors = Inertia(
            self.yy * self.zz - self.yz * self.yz,
            self.xz * self.yz - self.xy * self.zz,
            self.xy * self.yz - self.xz * self.yy,
            self.xx * self.zz - self.xz * self.xz,
            self.xy * self.xz - self.xx * self.yz,
            self.xx * self.yy - self.xy * self.xy,
        )
        determinant = self.xx * minors.xx + self.xy * minors.xy + self.xz * minors.xz
        return Inertia(*(minor / determinant for minor in minors))


class Turn(NamedTuple):
    """What a substep moves: body rates, rad/s, speeds of the motors and their thrusts, N."""

    rates_b: Vec3
    speeds: tuple[Scalar, ...]
    thrusts: tuple[Scalar, ...]


class SubstepInputs(NamedTuple):
    """What the substeps under one command share.

    Attributes:
        commands: of the motors, 0 to 1.
        health: of the motors.
        up: share of the way to its command that a motor speeds up in a substep.
        down: share of the way that it slows down.
        levers: of the motors, over the mass, m/kg.
        momentum: of a rotor at full command over the mass, m^2/s.
        inertia: of the craft over its mass.
        inverse: of that.
        drag: torque over the mass against the rates, m^2/s.
        thrust_coeffs: of the thrust map.
        battery_v: V.
        dt: of a substep, s.
    """

    commands: tuple[Scalar, ...]
    health: tuple[Scalar, ...]
    up: Scalar
    down: Scalar
    levers: tuple[Vec3, ...]
    momentum: Scalar
    inertia: Inertia
    inverse: Inertia
    drag: Vec3
    thrust_coeffs: tuple[Scalar, ...]
    battery_v: Scalar
    dt: Scalar

    @classmethod
    def of(cls, motors: Motors, context: CommandContext) -> "SubstepInputs":
        """Return the inputs of a craft under a command."""
        inertia, dt = Inertia.of(motors), context.dt / NUM_SUBSTEPS
        return cls(
            commands=tuple(0.5 * (command + 1.0) for command in context.command),
            health=motors.health,
            up=reached(motors.up_s, dt),
            down=reached(motors.down_s, dt),
            levers=tuple(lever.scale(1.0 / context.mass) for lever in motors.levers),
            momentum=motors.rotor_momentum,
            inertia=inertia,
            inverse=inertia.inverse(),
            drag=Vec3(
                inertia.xx * motors.damping_x,
                inertia.yy * motors.damping_y,
                inertia.zz * motors.damping_z,
            ),
            thrust_coeffs=tuple(context.thrust_coeffs[index] for index in range(6)),
            battery_v=context.drone.battery_v,
            dt=dt,
        )


def start(motors: Motors, drone: Drone) -> Spinning:
    """Return the memory of an episode that begins: all motors give the applied thrust."""
    del motors
    return Spinning((0.5 * (drone.applied.thrust + 1.0),) * len(NAMES))


def action_of(speed: Scalar) -> Scalar:
    """Return the thrust action at which a motor of this speed is steady."""
    return 2.0 * speed - 1.0


def compute_thrusts(
    speeds: tuple[Scalar, ...], health: tuple[Scalar, ...], battery_v: Scalar, thrust_coeffs: Any
) -> tuple[Scalar, ...]:
    """Return the thrusts of the motors, N."""
    return tuple(
        QUARTER * share * collective_thrust(action_of(speed), battery_v, thrust_coeffs)
        for speed, share in zip(speeds, health, strict=True)
    )


def _substep(state: Turn, inputs: SubstepInputs) -> Turn:
    """Return the state a substep later under the same commands."""
    before, dt = state.speeds, inputs.dt
    speeds = tuple(
        speed + jnp.where(command > speed, inputs.up, inputs.down) * (command - speed)
        for speed, command in zip(before, inputs.commands, strict=True)
    )
    thrusts = compute_thrusts(speeds, inputs.health, inputs.battery_v, inputs.thrust_coeffs)
    means = [0.5 * (one + two) for one, two in zip(state.thrusts, thrusts, strict=True)]
    torque = Vec3(*(moment(means, axis) for axis in zip(*inputs.levers, strict=True)))
    # Rotors turn against the torque on their craft.
    first, last = (-inputs.momentum * moment(each, SIGNS[2].tolist()) for each in (before, speeds))
    torque = torque._replace(z=torque.z - (last - first) / dt)
    rotors = 0.5 * (first + last)

    def change(rates_b: Vec3) -> Vec3:
        momentum = inputs.inertia.times(rates_b)
        momentum = momentum._replace(z=momentum.z + rotors)
        drag = Vec3(*(part * rate for part, rate in zip(inputs.drag, rates_b, strict=True)))
        return inputs.inverse.times(torque - drag - rates_b.cross(momentum))

    middle_b = state.rates_b + change(state.rates_b).scale(0.5 * dt)
    return Turn(state.rates_b + change(middle_b).scale(dt), speeds, thrusts)


def _is_there(motors: Motors) -> Any:
    return motors.front_y > 0.0


def as_commanded(motors: Motors, drone: Drone) -> Drone:
    """Return a drone whose applied action is that of all motors at its thrust, if there are any."""
    applied = (jnp.where(_is_there(motors), drone.applied.thrust, one) for one in drone.applied)
    return drone._replace(applied=Action(*applied))


def _respond(
    motors: Motors, memory: Spinning, lagged: Action, context: CommandContext
) -> tuple[Action, Spinning]:
    """Return the applied action and the memory at the end of a span in which commands act."""
    begin, end = context.span
    num_substeps = round(NUM_SUBSTEPS * (end - begin))
    full, now = context.full_stick_b, context.drone.applied
    inputs = compute_once(SubstepInputs.of(motors, context))
    rates_b = Vec3(now.roll * full.x, now.pitch * full.y, now.yaw * full.z)
    thrusts = compute_thrusts(memory.speeds, inputs.health, inputs.battery_v, inputs.thrust_coeffs)
    moved = Turn(rates_b, memory.speeds, thrusts)
    for _ in range(num_substeps):
        moved = compute_once(_substep(moved, inputs))
    roll, pitch, yaw = (rate / of_full for rate, of_full in zip(moved.rates_b, full, strict=True))
    response = Action(roll, pitch, yaw, action_of(0.25 * sum(moved.speeds)))
    pairs = zip(response, lagged, strict=True)
    applied = Action(*(jnp.where(_is_there(motors), *pair) for pair in pairs))
    return applied, Spinning(moved.speeds)


def _thrust(motors: Motors, memory: Spinning, thrust: Scalar, context: ForceContext) -> Scalar:
    """Return the sum of the motors' thrusts, over the share by which the craft is heavier."""
    each = compute_thrusts(
        memory.speeds, motors.health, context.drone.battery_v, context.thrust_coeffs
    )
    return jnp.where(_is_there(motors), sum(each) / (1.0 + motors.load), thrust)


FRAME = Motors._fields[:4]
CENTER = ("center_x", "center_y")
RADII = ("radius_x", "radius_y", "radius_z")
PRODUCTS = ("product_xy", "product_xz", "product_yz")
LAGS = ("up_s", "down_s")
DAMPING = ("damping_x", "damping_y", "damping_z")
NOTABLE = {
    **dict.fromkeys(DAMPING, 0.5),
    "load": 0.03,
    **dict.fromkeys(NAMES, 0.03),
}
MOTORS = Effect(
    name="motors",
    parameters=Motors,
    ranges={
        **dict.fromkeys(FRAME, Range(0.0, 1.0, "m")),
        **dict.fromkeys(CENTER, Range(-0.1, 0.1, "m")),
        **dict.fromkeys(RADII, Range(0.003, 1.0, "m")),
        **dict.fromkeys(PRODUCTS, Range(-0.4, 0.4, "1")),
        "yaw_arm": Range(-0.1, 0.1, "m"),
        "rotor_momentum": Range(-0.5, 0.5, "m^2/s"),
        **dict.fromkeys(LAGS, Range(0.001, 0.3, "s")),
        **dict.fromkeys(DAMPING, Range(-5.0, 20.0, "1/s")),
        "load": Range(-0.5, 2.0, "1"),
        **dict.fromkeys(NAMES, Range(0.0, 1.5, "1")),
    },
    notable=NOTABLE,
    equation=r"\tau_k\, \dot{s}_k + s_k = u_k, \quad T_k = \tfrac{1}{4} h_k T(s_k, V), \quad "
    r"I \dot{\omega} = \sum_k T_k\, \ell_k + J \Big(\sum_k \pm \dot{s}_k\Big) \mathbf{z} "
    r"- \omega \times (I \omega + H) - I D\, \omega",
    source="Newton and Euler; thrust and drag torque of a propeller in proportion: R. Mahony, "
    'V. Kumar, P. Corke, "Multirotor aerial vehicles", 2012, eq. 1 to 8',
    hooks={"respond": _respond, "thrust": _thrust},
    memory=Memory(start=start),
    takes_motors=True,
    search=Search(
        shapes=tuple(name for name in Motors._fields if name not in NOTABLE),
        probes={
            "load": (0.1,)
        },  # far from neutral, where outliers weigh less than their slope says
        groups=(("load",), DAMPING, *((motor,) for motor in NAMES)),
        is_setting=True,
        fitted=(*RADII, *LAGS, *CENTER),
        base_causes={
            "center_of_mass": CENTER,
            **{f"inertia_{axis}": (f"radius_{axis}",) for axis in "xyz"},
            "motor_lag": LAGS,
        },
    ),
)
