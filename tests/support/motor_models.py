"""Models driven by motors, of the crafts in ``benchmarks.motor_craft``, which share no code."""

import numpy as np

from benchmarks.motor_craft import Crafts
from benchmarks.motors import nominal_model
from flytrack_env.effects import LinearDrag, RotorDrag
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


def model_of(crafts):
    """Return the model of the first of these crafts, with all that its nominal one lacks."""
    mass, inertia, full = crafts.mass[0], crafts.inertia[0], crafts.thrust[0]
    model = nominal_model(crafts._replace(thrust=np.full((1, 4), full.max())))
    radii = np.sqrt(np.diag(inertia) / mass)
    products = -inertia / mass / np.outer(radii, radii)
    damping = crafts.damping[0] / np.diag(inertia)
    motors = model.effect("motors")._replace(
        product_xy=products[0, 1],
        product_xz=products[0, 2],
        product_yz=products[1, 2],
        damping_x=damping[0],
        damping_y=damping[1],
        damping_z=damping[2],
        **dict(zip(NAMES, full / full.max(), strict=True)),
    )
    return model.with_effects(
        motors, LinearDrag(*crafts.drag[0] / mass), RotorDrag(crafts.rotor_drag[0])
    )
