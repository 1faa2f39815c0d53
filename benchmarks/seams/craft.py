"""A quadcopter of motors, rate loop, drag and battery, integrated at 1 ms in plain Python.

Motors are those of Betaflight's "Quad X", propellers in: 1 rear right, clockwise seen from above;
2 front right, counter-clockwise; 3 rear left, counter-clockwise; 4 front left, clockwise. A motor
that turns clockwise yaws the craft counter-clockwise, which is positive.
"""

from math import cos, sin, sqrt
from typing import NamedTuple

import numpy as np

GRAVITY = 9.80665  # m/s^2
STEP_S = 0.001
FULL_CELL_V, SAG_V, DRAIN_V = 4.15, 0.35, 0.5  # a cell: full, drop at full thrust, drop over a pack
PACK_S = 100.0  # of full thrust in a pack
MAX_YAW = 0.2  # of the yaw moment: more would leave little for roll and pitch
# Contribution of motors 1 to 4 to the moment about body x, y, z.
MOMENT_SIGNS = np.array([[-1, -1, 1, 1], [1, -1, 1, -1], [1, -1, -1, 1]])


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
        inertia: moments over that about z: x, y.
        motor_lag: s.
    """

    mass: float
    max_rate: tuple[float, float, float]
    lags: tuple[float, float, float, float]
    hover: float
    thrust_to_weight: float
    voltage: tuple[float, float]
    linear: float
    drag: tuple[float, float, float]
    authority: tuple[float, float, float]
    inertia: tuple[float, float]
    motor_lag: float

    def output_for(self, thrust: float) -> float:
        """Return the motor output, 0..1, for a fraction of full thrust: the inverse thrust curve.

        It also relates throttle, 0..1, and total thrust.
        """
        linear, square = self.linear, 1.0 - self.linear
        return (sqrt(linear * linear + 4.0 * square * max(thrust, 0.0)) - linear) / (2.0 * square)


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
        max_rate=tuple(rng.uniform(300.0, 900.0, 3)),
        lags=tuple(lags),
        hover=0.0,
        thrust_to_weight=thrust_to_weight,
        voltage=(cells * (FULL_CELL_V - SAG_V - DRAIN_V), cells * FULL_CELL_V),
        linear=rng.uniform(0.1, 0.9),
        drag=tuple(rng.uniform(0.1, 0.6, 3)),
        authority=tuple(0.5 * thrust_to_weight * GRAVITY * lever / gyration**2),
        inertia=tuple(gyration[:2] ** 2 / gyration[2] ** 2),
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

    p: tuple[float, ...]
    v: tuple[float, ...]
    q: tuple[float, ...]
    w: tuple[float, ...]
    f: tuple[float, ...]
    throttle: float
    outputs: tuple[float, ...]
    motors: tuple[float, ...]
    used: float
    v_bat: float


def at_rest(craft: Craft, p: np.ndarray, heading: float, used: float) -> State:
    """Return the state of a craft that hovers level; heading: rad."""
    throttle = 0.5 * (craft.hover + 1.0)
    return State(
        p=tuple(p),
        v=(0.0, 0.0, 0.0),
        q=(cos(0.5 * heading), 0.0, 0.0, sin(0.5 * heading)),
        w=(0.0, 0.0, 0.0),
        f=(0.0, 0.0, GRAVITY),
        throttle=throttle,
        outputs=(throttle,) * 4,
        motors=(throttle,) * 4,
        used=used,
        v_bat=craft.voltage[1],
    )


def hold(craft: Craft, state: State, u: np.ndarray, wind: np.ndarray, steps: int) -> State:
    """Hold a command for some milliseconds; plain floats, since NumPy would take ten times longer.

    Args:
        craft: that flies.
        state: at the beginning.
        u: command of roll, pitch, yaw and thrust, -1..1.
        wind: velocity of the air, world, m/s.
        steps: of ``STEP_S``.

    Returns:
        State at the end.
    """
    (px, py, pz), (vx, vy, vz), (qw, qx, qy, qz), (wx, wy, wz) = state[:4]
    f, throttle, outputs, (m1, m2, m3, m4), used, v_bat = state[4:]
    wind_x, wind_y, wind_z = wind.tolist()
    aim_x, aim_y, aim_z = (np.deg2rad(craft.max_rate) * u[:3]).tolist()
    aim_throttle = 0.5 * (float(u[3]) + 1.0)
    (lag_x, lag_y, lag_z, lag_thrust), linear, square = craft.lags, craft.linear, 1.0 - craft.linear
    (drag_x, drag_y, drag_z), (can_x, can_y, can_z) = craft.drag, craft.authority
    (inertia_x, inertia_y), full_lift = craft.inertia, craft.thrust_to_weight * GRAVITY
    blend_throttle = STEP_S / (lag_thrust - craft.motor_lag)
    blend_motor, output_for = STEP_S / craft.motor_lag, craft.output_for
    cells_v = craft.voltage[1] / FULL_CELL_V
    for _ in range(steps):
        t1, t2 = m1 * (linear + square * m1), m2 * (linear + square * m2)
        t3, t4 = m3 * (linear + square * m3), m4 * (linear + square * m4)
        thrust = 0.25 * (t1 + t2 + t3 + t4)
        used += thrust * STEP_S
        v_bat = cells_v * (FULL_CELL_V - SAG_V * thrust - DRAIN_V * used / PACK_S)
        strength = (v_bat / craft.voltage[1]) ** 2
        # Rate loop: an acceleration of error over lag; then the mixer, which shifts outputs to keep
        # their differences (Betaflight's airmode).
        throttle += (aim_throttle - throttle) * blend_throttle
        roll = 0.5 * (aim_x - wx) / (lag_x * can_x * strength)
        pitch = 0.5 * (aim_y - wy) / (lag_y * can_y * strength)
        yaw = min(max(0.5 * (aim_z - wz) / (lag_z * can_z * strength), -MAX_YAW), MAX_YAW)
        o1, o2, o3, o4 = (
            yaw + pitch - roll,
            -yaw - pitch - roll,
            pitch + roll - yaw,
            yaw + roll - pitch,
        )
        low, high = min(o1, o2, o3, o4), max(o1, o2, o3, o4)
        shrink = min(1.0, 1.0 / (high - low + 1e-9))
        base = throttle * (linear + square * throttle)
        base = min(max(base, -low * shrink), 1.0 - high * shrink)
        outputs = (
            output_for(base + shrink * o1),
            output_for(base + shrink * o2),
            output_for(base + shrink * o3),
            output_for(base + shrink * o4),
        )
        m1 += (outputs[0] - m1) * blend_motor
        m2 += (outputs[1] - m2) * blend_motor
        m3 += (outputs[2] - m3) * blend_motor
        m4 += (outputs[3] - m4) * blend_motor
        # Rotation: thrust differences and gyroscopic moments.
        dwx = 0.5 * can_x * strength * (t3 + t4 - t1 - t2) + (inertia_y - 1.0) / inertia_x * wy * wz
        dwy = 0.5 * can_y * strength * (t1 + t3 - t2 - t4) + (1.0 - inertia_x) / inertia_y * wz * wx
        dwz = 0.5 * can_z * strength * (t1 + t4 - t2 - t3) + (inertia_x - inertia_y) * wx * wy
        half = 0.5 * STEP_S
        hx, hy, hz = (wx + half * dwx) * half, (wy + half * dwy) * half, (wz + half * dwz) * half
        wx, wy, wz = wx + STEP_S * dwx, wy + STEP_S * dwy, wz + STEP_S * dwz
        qw, qx, qy, qz = (
            qw - qx * hx - qy * hy - qz * hz,
            qx + qw * hx + qy * hz - qz * hy,
            qy + qw * hy + qz * hx - qx * hz,
            qz + qw * hz + qx * hy - qy * hx,
        )
        norm = 1.0 / sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
        qw, qx, qy, qz = qw * norm, qx * norm, qy * norm, qz * norm
        # Translation: thrust along body z, and drag of the body's speed through the air.
        xx, xy, xz = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy)
        yx, yy, yz = 2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx)
        zx, zy, zz = 2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)
        ax, ay, az = vx - wind_x, vy - wind_y, vz - wind_z
        fx = -drag_x * (xx * ax + yx * ay + zx * az)
        fy = -drag_y * (xy * ax + yy * ay + zy * az)
        fz = full_lift * strength * thrust - drag_z * (xz * ax + yz * ay + zz * az)
        f = (fx, fy, fz)
        px, py, pz = px + half * vx, py + half * vy, pz + half * vz
        vx += STEP_S * (xx * fx + xy * fy + xz * fz)
        vy += STEP_S * (yx * fx + yy * fy + yz * fz)
        vz += STEP_S * (zx * fx + zy * fy + zz * fz - GRAVITY)
        px, py, pz = px + half * vx, py + half * vy, pz + half * vz
    return State(
        p=(px, py, pz),
        v=(vx, vy, vz),
        q=(qw, qx, qy, qz),
        w=(wx, wy, wz),
        f=f,
        throttle=throttle,
        outputs=outputs,
        motors=(m1, m2, m3, m4),
        used=used,
        v_bat=v_bat,
    )
