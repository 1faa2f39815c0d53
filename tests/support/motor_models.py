"""Models driven by motors, of the crafts in ``benchmarks.motor_craft``, which share no code."""

import numpy as np

from benchmarks.motor_craft import Crafts
from flytrack_env import nominal_parameters
from flytrack_env.effects import LinearDrag, Motors, RotorDrag
from flytrack_env.motion import Motion
from flytrack_env.motors import NAMES


def crafts(count=1, **changes):
    """Return crafts of 0.8 kg with 6.5 inch frames; ``changes`` replace fields."""
    frame = np.array([[-0.08, -0.1], [0.09, -0.09], [-0.08, 0.1], [0.09, 0.09]])
    places = np.concatenate([frame, np.zeros((4, 1))], axis=1)

    def each(value):
        return np.tile(np.asarray(value, float), (count, *[1] * np.ndim(value)))

    fields = {
        "mass": each(0.8),
        "inertia": each(np.diag([0.004, 0.005, 0.008])),
        "places": each(places),
        "thrust": each(np.full(4, 6.0)),
        "linear": each(0.2),
        "yaw_arm": each(0.013),
        "momentum": each(0.01),
        "up_s": each(0.025),
        "down_s": each(0.04),
        "drag": each(np.zeros(3)),
        "quadratic": each(np.zeros(3)),
        "rotor_drag": each(0.0),
        "damping": each(np.zeros(3)),
    }
    return Crafts(**{**fields, **{name: each(value) for name, value in changes.items()}})


def model_of(crafts, index=0):
    """Return the model of one of these crafts."""
    mass, inertia = crafts.mass[index], crafts.inertia[index]
    radii = np.sqrt(np.diag(inertia) / mass)
    shares = -inertia / mass / np.outer(radii, radii)
    places = crafts.places[index]
    full, linear = crafts.thrust[index], crafts.linear[index]
    # T = full (linear s + (1 - linear) s^2), s = (u + 1) / 2.
    total = 4.0 * full.max()
    square, slope = 0.25 * total * (1.0 - linear), 0.5 * total * linear
    coeffs = np.array([slope + square, slope + 2.0 * square, square, 0.0, 0.0, 0.0])
    front, rear = places[1::2], places[0::2]
    center_x, center_y = -0.5 * (front[:, 0].mean() + rear[:, 0].mean()), -places[:, 1].mean()
    motors = Motors(
        front_x=front[:, 0].mean() + center_x,
        front_y=np.ptp(front[:, 1]) / 2.0,
        rear_x=-(rear[:, 0].mean() + center_x),
        rear_y=np.ptp(rear[:, 1]) / 2.0,
        center_x=center_x,
        center_y=center_y,
        radius_x=radii[0],
        radius_y=radii[1],
        radius_z=radii[2],
        product_xy=shares[0, 1],
        product_xz=shares[0, 2],
        product_yz=shares[1, 2],
        yaw_arm=crafts.yaw_arm[index],
        rotor_momentum=crafts.momentum[index] / mass,
        up_s=crafts.up_s[index],
        down_s=crafts.down_s[index],
        damping_x=crafts.damping[index, 0] / inertia[0, 0],
        damping_y=crafts.damping[index, 1] / inertia[1, 1],
        damping_z=crafts.damping[index, 2] / inertia[2, 2],
        **dict(zip(NAMES, full / full.max(), strict=True)),
    )
    model = nominal_parameters()._replace(
        m=mass, thrust_coeffs=coeffs, motion=Motion.CONTINUOUS, battery_drain_v_per_min=0.0
    )
    return model.with_effects(
        motors, LinearDrag(*crafts.drag[index] / mass), RotorDrag(crafts.rotor_drag[index])
    )
