"""A quadcopter of motors, rate loop, drag and battery, integrated at 1 ms by JAX in float64.

Motors are those of Betaflight's "Quad X", propellers in: 1 rear right, clockwise seen from above;
2 front right, counter-clockwise; 3 rear left, counter-clockwise; 4 front left, clockwise. A motor
that turns clockwise yaws the craft counter-clockwise, which is positive.
"""

from math import cos, sin, sqrt
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation

GRAVITY = 9.80665  # m/s^2
STEP_S = 0.001
FULL_CELL_V, SAG_V, DRAIN_V = 4.15, 0.35, 0.5  # a cell: full, drop at full thrust, drop over a pack
PACK_S = 100.0  # of full thrust in a pack
MAX_YAW = 0.2  # of the yaw moment: more would leave little for roll and pitch
# Contribution of motors 1 to 4 to the moment about body x, y, z.
MOMENT_SIGNS = np.array([[-1, -1, 1, 1], [1, -1, 1, -1], [1, -1, -1, 1]])
UP = np.array([0.0, 0.0, 1.0])


class Craft(NamedTuple):
    """A quadcopter.

    Attributes:
        mass: kg.
        max_rate: body rate at full stick, deg/s: roll, pitch, yaw.
        lags: mean delay of the response to a command, s: roll, pitch, yaw, thrust.
        hover: thrust command in hover, at the middle of the battery's range.
        thrust_to_weight: at full battery.
        voltage: lowest and highest of the battery, V.
        linear: fraction of the thrust curve that is linear; the remainder is quadratic.
        drag: linear drag over mass along body x, y, z, 1/s.
        authority: angular acceleration of full thrust on two motors alone, rad/s^2: roll, pitch,
            yaw.
        inertia: moments over that about z: x, y, z.
        motor_lag: s.
    """

    mass: float
    max_rate: np.ndarray
    lags: np.ndarray
    hover: float
    thrust_to_weight: float
    voltage: tuple[float, float]
    linear: float
    drag: np.ndarray
    authority: np.ndarray
    inertia: np.ndarray
    motor_lag: float

    def output_for(self, thrust: Any) -> Any:
        """Return the motor output, 0..1, for a fraction of full thrust: the inverse thrust curve.

        It also relates throttle, 0..1, and total thrust.
        """
        linear, square = self.linear, 1.0 - self.linear
        return ((linear * linear + 4.0 * square * thrust) ** 0.5 - linear) / (2.0 * square)


def draw_craft(rng: np.random.Generator) -> Craft:
    """Draw a craft: a whoop of 30 g to a racer of 1.5 kg."""
    mass = float(np.exp(rng.uniform(np.log(0.03), np.log(1.5))))
    cells = int(np.clip(round(1.0 + 3.5 * mass ** (2 / 3) + rng.uniform(-0.5, 1.5)), 1, 6))
    thrust_to_weight = rng.uniform(2.5, 6.0)
    arm = 0.16 * mass ** (1 / 3)  # m from the centre to a motor
    gyration = arm * np.array(
        [rng.uniform(0.4, 0.5), rng.uniform(0.45, 0.6), rng.uniform(0.6, 0.8)]
    )
    lever = np.array([arm / sqrt(2), arm / sqrt(2), arm * rng.uniform(0.2, 0.3)])
    lags = rng.uniform([0.015, 0.015, 0.03, 0.015], 0.06)
    motor_lag = 0.25 * float(lags.min())  # the rate loop is critically damped or slower
    craft = Craft(
        mass=mass,
        max_rate=rng.uniform(300.0, 900.0, 3),
        lags=lags,
        hover=0.0,
        thrust_to_weight=thrust_to_weight,
        voltage=(cells * (FULL_CELL_V - SAG_V - DRAIN_V), cells * FULL_CELL_V),
        linear=rng.uniform(0.1, 0.9),
        drag=rng.uniform(0.1, 0.6, 3),
        authority=0.5 * thrust_to_weight * GRAVITY * lever / gyration**2,
        inertia=(gyration / gyration[2]) ** 2,
        motor_lag=motor_lag,
    )
    half_drained = (FULL_CELL_V - 0.5 * DRAIN_V - SAG_V / thrust_to_weight) / FULL_CELL_V
    throttle = craft.output_for(1.0 / (thrust_to_weight * half_drained**2))
    return craft._replace(hover=2.0 * throttle - 1.0)


class State(NamedTuple):
    """What a craft does at a moment.

    Attributes:
        p: position, world, m.
        v: velocity, world, m/s.
        q: attitude, (w, x, y, z), body to world.
        w: body rates, rad/s.
        f: specific force, body, m/s^2.
        throttle: after its filter, 0..1.
        outputs: of the mixer to motors 1 to 4, 0..1.
        motors: after their lag, 0..1.
        used: seconds of full thrust since the battery was full.
        v_bat: V.
    """

    p: Any
    v: Any
    q: Any
    w: Any
    f: Any
    throttle: Any
    outputs: Any
    motors: Any
    used: Any
    v_bat: Any

    @property
    def attitude(self) -> Rotation:
        """The rotation from body to world."""
        return Rotation.from_quat(jnp.roll(self.q, -1))


def at_rest(craft: Craft, p: np.ndarray, heading: float, used: float) -> State:
    """Return the state of a craft that hovers level; heading: rad."""
    throttle = 0.5 * (craft.hover + 1.0)
    return State(
        p=p,
        v=np.zeros(3),
        q=np.array([cos(0.5 * heading), 0.0, 0.0, sin(0.5 * heading)]),
        w=np.zeros(3),
        f=np.array([0.0, 0.0, GRAVITY]),
        throttle=throttle,
        outputs=np.full(4, throttle),
        motors=np.full(4, throttle),
        used=used,
        v_bat=craft.voltage[1],
    )


@jax.jit
def advance(craft: Craft, state: State, u: Any, wind: Any, steps: Any) -> State:
    """Hold a command for some milliseconds; works under ``jit``.

    Args:
        craft: that flies.
        state: at the beginning.
        u: command of roll, pitch, yaw and thrust, -1..1.
        wind: velocity of the air, world, m/s.
        steps: of ``STEP_S``.

    Returns:
        State at the end.
    """
    aim_w, aim_throttle = jnp.deg2rad(craft.max_rate) * u[:3], 0.5 * (u[3] + 1.0)
    linear, square, inertia = craft.linear, 1.0 - craft.linear, craft.inertia
    cells_v, half_s = craft.voltage[1] / FULL_CELL_V, 0.5 * STEP_S

    def step(_: int, x: State) -> State:
        thrusts = x.motors * (linear + square * x.motors)
        thrust = thrusts.mean()
        used = x.used + thrust * STEP_S
        v_bat = cells_v * (FULL_CELL_V - SAG_V * thrust - DRAIN_V * used / PACK_S)
        strength = (v_bat / craft.voltage[1]) ** 2
        authority = craft.authority * strength
        # Rate loop: an acceleration of error over lag; then the mixer, which shifts outputs to keep
        # their differences (Betaflight's airmode).
        throttle = x.throttle + (aim_throttle - x.throttle) * STEP_S / (
            craft.lags[3] - craft.motor_lag
        )
        moment = 0.5 * (aim_w - x.w) / (craft.lags[:3] * authority)
        moment = moment.at[2].set(jnp.clip(moment[2], -MAX_YAW, MAX_YAW))
        differences = moment @ MOMENT_SIGNS
        low, high = differences.min(), differences.max()
        shrink = jnp.minimum(1.0, 1.0 / (high - low + 1e-9))
        base = throttle * (linear + square * throttle)
        base = jnp.clip(base, -low * shrink, 1.0 - high * shrink)
        outputs = craft.output_for(jnp.maximum(base + shrink * differences, 0.0))
        # Rotation: thrust differences and gyroscopic moments.
        gyroscopic = jnp.cross(x.w, inertia * x.w) / inertia
        turning = 0.5 * authority * (MOMENT_SIGNS @ thrusts) - gyroscopic
        turn, (real, imaginary) = (x.w + half_s * turning) * half_s, (x.q[0], x.q[1:])
        q = jnp.append(
            real - imaginary @ turn, imaginary + real * turn + jnp.cross(imaginary, turn)
        )
        after = x._replace(q=q / jnp.linalg.norm(q))
        # Translation: thrust along body z, and drag of the body's speed through the air.
        lift = craft.thrust_to_weight * GRAVITY * strength * thrust
        f = lift * UP - craft.drag * after.attitude.inv().apply(x.v - wind)
        v = x.v + STEP_S * (after.attitude.apply(f) - GRAVITY * UP)
        return after._replace(
            p=x.p + half_s * (x.v + v),
            v=v,
            w=x.w + STEP_S * turning,
            f=f,
            throttle=throttle,
            outputs=outputs,
            motors=x.motors + (outputs - x.motors) * STEP_S / craft.motor_lag,
            used=used,
            v_bat=v_bat,
        )

    return jax.lax.fori_loop(0, steps, step, jax.tree.map(jnp.asarray, state))


def hold(craft: Craft, state: State, u: np.ndarray, wind: np.ndarray, steps: int) -> State:
    """Hold a command as ``advance`` does, in float64."""
    with jax.enable_x64(True):
        return jax.tree.map(np.array, advance(craft, state, u, wind, steps))
