"""Sensor noise: how a flight is logged.

All kinds have the same standard deviations, quantise, and lose rows; they differ in the
distribution of errors ("heavy": Student's t with 3 degrees of freedom) and in their correlation
("coloured": AR(1)).
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import signal
from scipy.spatial.transform import Rotation

from flytrack_bench.hidden.laws import SCALES
from flytrack_sysid.log import FlightLog

# SI; q: about each axis. Laws outside the list are drawn in units of the noise in their channel.
STD = {
    "p": 0.01,
    "v": 0.05,
    "f": SCALES["force"],
    "q": np.deg2rad(0.5),
    "w": SCALES["rate"],
    "v_bat": 0.0,
}
# Resolution of a logged number: m, m/s, m/s^2, 1, rad/s, V; 16 bits over 32 g and 4000 deg/s.
BITS = 2**16
DIGIT = {
    "p": 1e-3,
    "v": 1e-3,
    "f": 32.0 * 9.80665 / BITS,
    "q": 1e-4,
    "w": np.deg2rad(4000.0) / BITS,
    "v_bat": 1e-2,
}
LOST_ROWS = 0.02  # share
DEGREES_OF_FREEDOM = 3  # the fewest whole ones with a finite standard deviation
SPREAD = np.sqrt(DEGREES_OF_FREEDOM / (DEGREES_OF_FREEDOM - 2))  # that deviation
COLOURS = (0.5, 0.95)  # coefficients of AR(1) that are drawn, per column

Draw = Callable[[tuple[int, int], np.random.Generator], np.ndarray]


def _coloured(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Return stationary AR(1) noise, each column with its own coefficient."""
    columns = []
    for fresh in rng.standard_normal(shape).T:
        keep = rng.uniform(*COLOURS)
        gain = np.sqrt(1.0 - keep**2)
        # The filter starts in its stationary distribution.
        column, _ = signal.lfilter([gain], [1.0, -keep], fresh, zi=[keep * rng.standard_normal()])
        columns.append(column)
    return np.stack(columns, axis=1)


NOISES: dict[str, Draw] = {
    "sensors": lambda shape, rng: rng.standard_normal(shape),
    "heavy": lambda shape, rng: rng.standard_t(DEGREES_OF_FREEDOM, shape) / SPREAD,
    "coloured": _coloured,
}


def measure(log: FlightLog, noise: str, rng: np.random.Generator) -> FlightLog:
    """Return a flight as sensors log it: noisy, quantised, with rows lost, without acceleration.

    Args:
        noise: of ``NOISES``; "none" only drops the acceleration, which no sensor measures.
    """
    if noise == "none":
        return log.without("a")
    channels = {"u": log["u"]}
    for name, std in STD.items():
        values, digit = log[name], DIGIT[name]
        errors = std * NOISES[noise]((len(log), 3 if name == "q" else values.shape[1]), rng)
        if name == "q":
            attitude = Rotation.from_quat(values, scalar_first=True) * Rotation.from_rotvec(errors)
            quat = digit * np.round(attitude.as_quat(scalar_first=True) / digit)
            channels[name] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
        else:
            channels[name] = digit * np.round((values + errors) / digit)
    is_kept = rng.random(len(log)) >= LOST_ROWS
    return replace(log, channels=channels).select(is_kept)
