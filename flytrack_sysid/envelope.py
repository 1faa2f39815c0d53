"""The envelope of collected flights: speed, height and voltage."""

import numpy as np

from flytrack_env.state import BATTERY, BATTERY_EMPTY_V, BATTERY_FULL_V, POSITION, VELOCITY

LARGEST_SPEED = 20.0  # m/s
HEIGHTS = (10.0, 110.0)  # m
SCRIPT_HEIGHTS = (0.1, 110.0)  # m, of a script, which may want flights close to the ground
VOLTAGES = (BATTERY_EMPTY_V, BATTERY_FULL_V)
ANY_VOLTAGE = (0.0, np.inf)  # of other craft
MIDDLE_V = 0.5 * (BATTERY_EMPTY_V + BATTERY_FULL_V)
FEWEST_STEPS = 2  # of a flight; a shorter one shows no step


def is_inside(
    states: np.ndarray,
    heights: tuple[float, float] = HEIGHTS,
    voltages: tuple[float, float] = VOLTAGES,
) -> np.ndarray:
    """Return where states (..., 21) are within the envelope; NaN is not.

    heights: lowest and highest, m. voltages: lowest and highest, V.
    """
    height, battery_v = states[..., POSITION][..., 2], states[..., BATTERY]
    is_slow = np.linalg.norm(states[..., VELOCITY], axis=-1) <= LARGEST_SPEED
    is_charged = (battery_v >= voltages[0]) & (battery_v <= voltages[1])
    return is_slow & is_charged & (height >= heights[0]) & (height <= heights[1])
