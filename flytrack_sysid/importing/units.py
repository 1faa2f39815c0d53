"""Conversion of units and frames to ours.

Ours: SI units; world z up, body x forward, y left, z up; quaternions (w, x, y, z), body to world. A
world with z up is ours whichever way its x points (north, east, or where the drone stood).
"""

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import nominal_parameters

GRAVITY = float(nominal_parameters().g)  # m/s^2
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
# Half a turn about x converts each to ours, and back.
TURNED = {"body": {"flu": False, "frd": True}, "world": {"z_up": False, "ned": True}}
AXES_TURNED = np.array([1.0, -1.0, -1.0])
HALF_TURN = Rotation.from_rotvec([np.pi, 0.0, 0.0])


def vector_from(vectors: np.ndarray, is_turned: bool) -> np.ndarray:
    """Return vectors (num_rows, 3) in our frame; is_turned: they were in FRD or NED axes."""
    return vectors * AXES_TURNED if is_turned else vectors


def quaternion_from(attitude: Rotation, is_body_turned: bool, is_world_turned: bool) -> np.ndarray:
    """Return our quaternions (num_rows, 4) of attitudes, each from body to world frame.

    is_body_turned: that body frame is FRD; is_world_turned: that world frame is NED.
    """
    if is_world_turned:
        attitude = HALF_TURN * attitude
    if is_body_turned:
        attitude = attitude * HALF_TURN
    quat = attitude.as_quat(scalar_first=True)
    # Signs so that neighbours are close, the first with w >= 0.
    flips = np.sum(quat[1:] * quat[:-1], axis=1) < 0.0
    first = quat[:1, 0] < 0.0
    signs = np.where(np.cumsum(np.concatenate([first, flips])) % 2 == 1, -1.0, 1.0)
    return quat * signs[:, None]
