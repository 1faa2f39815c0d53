"""Conversion of units and frames to ours.

We use SI units, a world with z up, a body with x forward, y left and z up, and quaternions (w, x,
y, z) from body to world. The direction of the world's x does not matter (north, east, or the
heading at the start).
"""

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_sysid.check.frames import HALF_TURN
from flytrack_sysid.kinematics import GRAVITY, continuous

TURN_SIGNS = np.array([1.0, -1.0, -1.0])  # of half a turn about x

PER_DEGREE = float(np.deg2rad(1.0))
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "angle": {"rad": 1.0, "deg": PER_DEGREE},
    "rate": {"rad/s": 1.0, "deg/s": PER_DEGREE},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "speed": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "acceleration": {"m/s^2": 1.0, "g": GRAVITY, "mg": 1e-3 * GRAVITY},
    "voltage": {"V": 1.0, "dV": 0.1, "cV": 1e-2, "mV": 1e-3},
}
# Half a turn about x converts the frames that are True to ours, and back.
TURNED = {"body": {"flu": False, "frd": True}, "world": {"z_up": False, "ned": True}}


def vector_from(vectors: np.ndarray, is_turned: bool) -> np.ndarray:
    """Return vectors in our frame, (num_rows, 3).

    Args:
        vectors: (num_rows, 3).
        is_turned: whether they are in FRD or NED axes.
    """
    return vectors * TURN_SIGNS if is_turned else vectors


def quaternion_from(attitude: Rotation, is_body_turned: bool, is_world_turned: bool) -> np.ndarray:
    """Return our quaternions of attitudes, (num_rows, 4).

    Args:
        attitude: from body to world frame.
        is_body_turned: whether its body frame is FRD.
        is_world_turned: whether its world frame is NED.
    """
    if is_world_turned:
        attitude = HALF_TURN * attitude
    if is_body_turned:
        attitude = attitude * HALF_TURN
    return continuous(attitude.as_quat(scalar_first=True))
