"""Thrust that is more or less than the model says, later or askew, and a battery that sags under it."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Range, StepContext
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Action


class ThrustLagAsymmetry(NamedTuple):
    """Time constant of falling thrust over that of rising thrust, 1."""

    ratio: Scalar = 1.0


def _asymmetric(asymmetry: ThrustLagAsymmetry, memory: None, tau: Action, context: StepContext) -> Action:
    is_falling = context.acting.thrust < context.drone.applied.thrust
    return tau._replace(thrust=jnp.where(is_falling, asymmetry.ratio * tau.thrust, tau.thrust))


THRUST_LAG_ASYMMETRY = Effect(
    parameters=ThrustLagAsymmetry,
    about="Motors that spin down with another time constant than up: they are driven up and coast down.",
    ranges={"ratio": Range(0.3, 3.0, "1")},
    notable={"ratio": 0.3},
    equation=r"\tau_\text{thrust} \leftarrow \text{ratio} \cdot \tau_\text{thrust} \quad \text{where the "
    r"command is below the applied thrust}",
    source="assumption: one ratio at any thrust; motors are driven up, and coast down",
    lag=_asymmetric,
)


class ThrustScale(NamedTuple):
    """Factor on the collective thrust, 1."""

    factor: Scalar = 1.0


def _scaled(scale: ThrustScale, memory: None, thrust_n: Scalar, context: StepContext) -> Scalar:
    return scale.factor * thrust_n


THRUST_SCALE = Effect(
    parameters=ThrustScale,
    about="All thrust scaled: a payload, worn propellers, warm motors; no log tells these from mass.",
    ranges={"factor": Range(0.5, 1.5, "1")},
    notable={"factor": 0.02},
    equation=r"T \leftarrow \text{factor} \cdot T",
    source="assumption: the shape of the thrust curve stays",
    thrust=_scaled,
)


class GroundEffect(NamedTuple):
    """Share of the thrust gained on the ground, 1, and the height at which half of it is left, m.

    Of one rotor the gain is about 1/16 and the height its radius; a whole quadcopter gains more.
    """

    gain: Scalar = 0.0
    height_m: Scalar = 0.3


def _near_ground(ground: GroundEffect, memory: None, thrust_n: Scalar, context: StepContext) -> Scalar:
    heights = jnp.maximum(context.drone.pos_w.z, 0.0) / ground.height_m
    return thrust_n * (1.0 + ground.gain / (1.0 + heights * heights))


GROUND_EFFECT = Effect(
    parameters=GroundEffect,
    about="Thrust gained near the ground, which the rotors' wake cannot pass.",
    ranges={"gain": Range(-0.5, 0.5, "1"), "height_m": Range(0.05, 2.0, "m")},
    notable={"gain": 0.05},
    needs=("p",),
    equation=r"T \leftarrow T \left( 1 + \frac{\text{gain}}{1 + (z / \text{height})^2} \right)",
    source="I. C. Cheeseman, W. E. Bennett, ARC R&M 3021, 1955, to first order in (radius / 4 z)^2 = "
    "gain (height_m / z)^2, levelled off",
    shapes=("height_m",),
    thrust=_near_ground,
)


class ThrustTilt(NamedTuple):
    """Angles by which the thrust leans towards body x and body y, rad."""

    towards_x: Scalar = 0.0
    towards_y: Scalar = 0.0


def _tilted(tilt: ThrustTilt, memory: None, force_b: Vec3, context: StepContext) -> Vec3:
    thrust = context.thrust_acc
    return Vec3(force_b.x + tilt.towards_x * thrust, force_b.y + tilt.towards_y * thrust, force_b.z)


THRUST_TILT = Effect(
    parameters=ThrustTilt,
    about="A thrust axis that is not body z: bent arms, or a flight controller mounted askew.",
    ranges={name: Range(-0.2, 0.2, "rad") for name in ThrustTilt._fields},
    notable={"towards_x": 0.01, "towards_y": 0.01},
    equation=r"\mathbf{f}_b \leftarrow \mathbf{f}_b + \frac{T}{m} (\text{towards}_x, \text{towards}_y, "
    r"0)^\top",
    source="assumption: small angles, the same at any thrust",
    force=_tilted,
)


class VoltageSag(NamedTuple):
    """Voltage lost at full thrust, V."""

    at_full_v: Scalar = 0.0


def load_of(thrust_action: Scalar) -> Scalar:
    """Return the load of a thrust action in [-1, 1] as a share of the full load.

    Assumption: the current goes with the square of the stick above idle, as thrust does at first order.
    """
    stick = 0.5 * (1.0 + thrust_action)
    return stick * stick


def _sagging(sag: VoltageSag, memory: None, battery_v: Scalar, context: StepContext) -> Scalar:
    # The state has the voltage under load: only what the load changed in the step counts.
    change = load_of(context.applied.thrust) - load_of(context.drone.applied.thrust)
    return battery_v - sag.at_full_v * change


VOLTAGE_SAG = Effect(
    parameters=VoltageSag,
    about="Battery voltage that drops under load and comes back: the internal resistance of the cells.",
    ranges={"at_full_v": Range(-3.0, 6.0, "V")},
    notable={"at_full_v": 0.3},
    needs=("v_bat",),
    equation=r"V = V_\text{open} - \text{at full} \cdot \left( \frac{1 + u}{2} \right)^2",
    source="assumption: a resistance without dynamics, current with the square of the stick",
    battery=_sagging,
)
