"""Where collected flights stay: how fast, how high, at which voltage."""

import numpy as np

from flytrack_env.state import BATTERY, BATTERY_EMPTY_V, BATTERY_FULL_V, POSITION, VELOCITY

LARGEST_SPEED = 20.0  # m/s
HEIGHTS = (10.0, 110.0)  # m
SCRIPT_HEIGHTS = (0.1, 110.0)  # m, of a script, which may want flights close to the ground
MIDDLE_V = 0.5 * (BATTERY_EMPTY_V + BATTERY_FULL_V)
FEWEST_STEPS = 2  # of a flight; shorter ones say nothing


def is_inside(states: np.ndarray, heights: tuple[float, float] = HEIGHTS) -> np.ndarray:
    """Return where states (..., 21) are within the envelope; nowhere that they are no numbers.

    heights: lowest and highest, m.
    """
    height, battery_v = states[..., POSITION][..., 2], states[..., BATTERY]
    is_slow = np.linalg.norm(states[..., VELOCITY], axis=-1) <= LARGEST_SPEED
    is_charged = (battery_v >= BATTERY_EMPTY_V) & (battery_v <= BATTERY_FULL_V)
    return is_slow & is_charged & (height >= heights[0]) & (height <= heights[1])
