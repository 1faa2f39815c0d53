"""Signal-to-noise ratio of the hidden effects in a flight: a bound on what a diagnosis could reach."""

import math

import numpy as np
from scipy import signal

from benchmarks.hidden.noise import ACCELEROMETER_STD, DIGIT, GYRO_STD
from benchmarks.hidden.truth import Truth
from flytrack_sysid.log import FlightLog

NUDGE = 1e-3  # of lags, relative
SECONDS_PER_MINUTE = 60.0
FIRST_ROW = 100  # before it, lags depend on commands from before the log
SCALES = np.array([ACCELEROMETER_STD] * 3 + [GYRO_STD] * 3 + [DIGIT["v_bat"]])


def _applied(log: FlightLog, tau: np.ndarray) -> np.ndarray:
    """Return the applied action in the step to each row, (num_rows, 4), started at the first command."""
    sticks = np.vstack([log["u"][:1], log["u"][:-1]])
    step_s, columns = log.time[1] - log.time[0], []
    for column, keep in zip(sticks.T, np.exp(-step_s / tau), strict=True):
        columns.append(signal.lfilter([1.0 - keep], [1.0, -keep], column, zi=[keep * column[0]])[0])
    return np.stack(columns, axis=1)


def _terms(log: FlightLog, stick: np.ndarray) -> np.ndarray:
    """Return what the coefficients of thrust multiply, (num_rows, 6)."""
    volt = np.concatenate([log["v_bat"][:1, 0], log["v_bat"][:-1, 0]])
    return np.stack([stick**0, stick, stick**2, stick**3, volt, stick * volt], axis=1)


def _expected(truth: Truth, log: FlightLog, tau: np.ndarray) -> np.ndarray:
    """Return specific force, body rates and voltage of the plant without effects, (num_rows, 7)."""
    applied = _applied(log, tau)
    expected = np.zeros((len(log), len(SCALES)))
    expected[:, 2] = _terms(log, applied[:, 3]) @ np.array(truth.coeffs) / truth.mass
    expected[:, 3:6] = np.radians(truth.max_rate) * applied[:, :3]
    expected[:, 6] = log["v_bat"][0, 0] - truth.drain / SECONDS_PER_MINUTE * log.time
    return expected


def _jacobian(truth: Truth, log: FlightLog) -> np.ndarray:
    """Return derivatives by the lags and the thrust coefficients, (columns, num_rows, 7)."""
    tau = np.array(truth.tau)
    plain, slopes = _expected(truth, log, tau), []
    for axis in range(len(tau)):
        other = np.where(np.arange(len(tau)) == axis, tau * (1.0 + NUDGE), tau)
        slopes.append((_expected(truth, log, other) - plain) / NUDGE)
    for term in _terms(log, _applied(log, tau)[:, 3]).T:
        slopes.append(np.zeros_like(plain))
        slopes[-1][:, 2] = term
    return np.stack(slopes)


def signal_to_noise(truth: Truth, log: FlightLog, is_base_known: bool = False) -> float:
    """Return how far clean accelerometer, gyro and voltage are from those of the plant without effects.

    The root of the sum of squared differences, each over the noise of ``benchmarks.hidden.noise`` (voltage:
    over its resolution): by about how many standard deviations the effects are visible to an observer who
    knows their shape. Position, velocity and attitude are not used and would show more of some effects.
    log: clean, from ``fly``. is_base_known: if False, only what other lags and another thrust curve cannot
    explain counts.
    """
    missing = np.column_stack([log["f"], log["w"], log["v_bat"]]) - _expected(truth, log, np.array(truth.tau))
    missing = (missing / SCALES)[FIRST_ROW:].ravel()
    if not is_base_known:
        design = (_jacobian(truth, log) / SCALES)[:, FIRST_ROW:].reshape(-1, len(missing)).T
        missing = missing - design @ np.linalg.lstsq(design, missing, rcond=None)[0]
    return float(math.sqrt(missing @ missing))
