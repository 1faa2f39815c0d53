"""Models driven by motors, of the crafts in ``benchmarks.motor_craft``, which share no code."""

import numpy as np

from benchmarks.motor_craft import Crafts
from benchmarks.motors import nominal_model
from flytrack_env.effects import LinearDrag, RotorDrag
from flytrack_env.motors import NAMES


def crafts(**changes):
    """Return one craft of 0.8 kg with a 6.5 inch frame; ``changes`` replace fields."""
    fields = {
        "mass": 0.8,
        "inertia": np.diag([0.004, 0.005, 0.008]),
        "places": [[-0.08, -0.1, 0.0], [0.09, -0.09, 0.0], [-0.08, 0.1, 0.0], [0.09, 0.09, 0.0]],
        "thrust": np.full(4, 6.0),
        "linear": 0.2,
        "yaw_arm": 0.013,
        "momentum": 0.01,
        "up_s": 0.025,
        "down_s": 0.04,
    } | changes
    return Crafts(**{name: np.array([value], float) for name, value in fields.items()})


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
