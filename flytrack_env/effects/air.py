"""What the air does: wind, drag, and thrust that is gained in fresh air."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Range, StepContext
from flytrack_env.quaternion import Scalar, Vec3

# Of translational lift: m/s, airspeed at which half of the gain is there, about the velocity that a racing
# quadcopter's rotors induce in hover. Not a parameter, because nothing depends on it while there is no gain.
HALF_SPEED = 7.0


class Wind(NamedTuple):
    """Velocity of the air, v_*, m/s, and constant specific force, a_*, m/s^2; world frame."""

    v_x: Scalar = 0.0
    v_y: Scalar = 0.0
    v_z: Scalar = 0.0
    a_x: Scalar = 0.0
    a_y: Scalar = 0.0
    a_z: Scalar = 0.0


def _moving_air(wind: Wind, memory: None, air_w: Vec3, context: StepContext) -> Vec3:
    return air_w + Vec3(wind.v_x, wind.v_y, wind.v_z)


def _push(wind: Wind, memory: None, force_b: Vec3, context: StepContext) -> Vec3:
    push_w = Vec3(wind.a_x, wind.a_y, wind.a_z)
    return force_b + Vec3(*(axis.dot(push_w) for axis in context.body_axes_w))


WIND = Effect(
    parameters=Wind,
    about="Steady wind: moving air where the model has drag, and a constant push that needs no drag. "
    "A log in which no drag was identified shows the push only; one with drag shows the "
    "velocity. The parameters are apart because their units are.",
    ranges={
        **{name: Range(-20.0, 20.0, "m/s") for name in ("v_x", "v_y", "v_z")},
        **{name: Range(-5.0, 5.0, "m/s^2") for name in ("a_x", "a_y", "a_z")},
    },
    notable={"a_x": 0.2, "a_y": 0.2, "a_z": 0.2, "v_x": 1.0, "v_y": 1.0, "v_z": 1.0},
    needs=("q",),
    equation=r"\mathbf{v}_\text{air} \leftarrow \mathbf{v}_\text{air} + \mathbf{v}, \quad \mathbf{f}_b "
    r"\leftarrow \mathbf{f}_b + R^\top \mathbf{a}",
    source="assumption: uniform and steady within a flight",
    groups=(("a_x", "a_y", "a_z"), ("v_x", "v_y", "v_z")),
    air=_moving_air,
    force=_push,
)


class TranslationalLift(NamedTuple):
    """Share of the thrust gained at high airspeed in the rotors' plane, 1."""

    gain: Scalar = 0.0


def _lifted(lift: TranslationalLift, memory: None, thrust_n: Scalar, context: StepContext) -> Scalar:
    airspeed_b = context.airspeed_b()
    squared = airspeed_b.x * airspeed_b.x + airspeed_b.y * airspeed_b.y
    return thrust_n * (1.0 + lift.gain * (squared / (squared + HALF_SPEED * HALF_SPEED)))


TRANSLATIONAL_LIFT = Effect(
    parameters=TranslationalLift,
    about="Thrust gained in edgewise flight: rotors that meet fresh air induce less of their own.",
    ranges={"gain": Range(-0.5, 0.5, "1")},
    notable={"gain": 0.05},
    needs=("v", "q"),
    equation=r"T \leftarrow T \left( 1 + \text{gain}\, \frac{s^2}{s^2 + (7\,\text{m/s})^2} \right), \quad s "
    r"= \sqrt{v_{b,x}^2 + v_{b,y}^2}",
    source="J. G. Leishman, Principles of Helicopter Aerodynamics, section 2.14, as a saturating curve",
    thrust=_lifted,
)


class LinearDrag(NamedTuple):
    """Deceleration per airspeed along body x, y, z, 1/s."""

    d_x: Scalar = 0.0
    d_y: Scalar = 0.0
    d_z: Scalar = 0.0


def _linear(drag: LinearDrag, memory: None, force_b: Vec3, context: StepContext) -> Vec3:
    airspeed_b = context.airspeed_b()
    return force_b - Vec3(drag.d_x * airspeed_b.x, drag.d_y * airspeed_b.y, drag.d_z * airspeed_b.z)


LINEAR_DRAG = Effect(
    parameters=LinearDrag,
    about="Drag that grows with airspeed, per body axis: what rotors do to a racing drone first of all.",
    ranges={axis: Range(-3.0, 3.0, "1/s") for axis in LinearDrag._fields},
    notable={"d_x": 0.05, "d_y": 0.05, "d_z": 0.05},
    needs=("v", "q"),
    equation=r"\mathbf{f}_b \leftarrow \mathbf{f}_b - \operatorname{diag}(d_x, d_y, d_z)\, R^\top "
    r"(\mathbf{v} - \mathbf{v}_\text{air})",
    source='M. Faessler et al., "Differential flatness of quadrotor dynamics subject to rotor drag", eq. 2',
    force=_linear,
)


class QuadraticDrag(NamedTuple):
    """Deceleration per airspeed squared along body x, y, z, 1/m, and how far the axes share the speed, 1."""

    k_x: Scalar = 0.0
    k_y: Scalar = 0.0
    k_z: Scalar = 0.0
    shared: Scalar = 1.0


def _quadratic(drag: QuadraticDrag, memory: None, force_b: Vec3, context: StepContext) -> Vec3:
    airspeed_b = context.airspeed_b()
    whole = drag.shared * airspeed_b.norm()
    own = 1.0 - drag.shared
    coefficients = zip((drag.k_x, drag.k_y, drag.k_z), airspeed_b, strict=True)
    return force_b - Vec3(*(k * (whole + own * jnp.abs(speed)) * speed for k, speed in coefficients))


QUADRATIC_DRAG = Effect(
    parameters=QuadraticDrag,
    about="Drag that grows with the square of airspeed: the body's, at racing speeds.",
    ranges={
        **{axis: Range(-0.5, 0.5, "1/m") for axis in ("k_x", "k_y", "k_z")},
        "shared": Range(0.0, 1.0, "1"),
    },
    notable={"k_x": 0.005, "k_y": 0.005, "k_z": 0.005},
    needs=("v", "q"),
    equation=r"f_i \leftarrow f_i - k_i \left( s \lVert \mathbf{v}_b \rVert + (1 - s) |v_{b,i}| \right) "
    r"v_{b,i}, \quad \mathbf{v}_b = R^\top (\mathbf{v} - \mathbf{v}_\text{air}), \quad s = "
    r"\text{shared}",
    source="the drag equation, f = c_d A rho v^2 / 2m: of one body (shared 1), or of each axis by itself (0)",
    shapes=("shared",),
    force=_quadratic,
)


class RotorDrag(NamedTuple):
    """Share of the thrust that leans back per airspeed in the rotors' plane, s/m."""

    h: Scalar = 0.0


def _leaning(drag: RotorDrag, memory: None, force_b: Vec3, context: StepContext) -> Vec3:
    airspeed_b = context.airspeed_b()
    lean = drag.h * context.thrust_acc
    return Vec3(force_b.x - lean * airspeed_b.x, force_b.y - lean * airspeed_b.y, force_b.z)


ROTOR_DRAG = Effect(
    parameters=RotorDrag,
    about="Drag in the rotors' plane, in proportion to thrust: blades that flap lean the thrust backwards.",
    ranges={"h": Range(-0.2, 0.2, "s/m")},
    notable={"h": 0.005},
    needs=("v", "q"),
    equation=r"\mathbf{f}_b \leftarrow \mathbf{f}_b - h\, \frac{T}{m} \operatorname{diag}(1, 1, 0)\, R^\top "
    r"(\mathbf{v} - \mathbf{v}_\text{air})",
    source='R. Mahony, V. Kumar, P. Corke, "Multirotor aerial vehicles", 2012, eq. 12: blade flapping',
    force=_leaning,
)
