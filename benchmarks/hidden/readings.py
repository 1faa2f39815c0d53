"""What gyro and accelerometer say of a flight: hidden effects of the sensors, without noise."""

import numpy as np

from benchmarks.hidden.truth import DT_S, Truth

XYZ = ("x", "y", "z")


def _vector(truth: Truth, name: str, neutral: float) -> np.ndarray:
    values = truth.effects.get(name, {})
    return np.array([values.get(axis, neutral) for axis in XYZ])


def _later(values: np.ndarray, latency_s: float) -> np.ndarray:
    """Return what rows would be if each showed what was true a while before; linear between rows."""
    rows = np.arange(len(values), dtype=float)
    return np.stack([np.interp(rows - latency_s / DT_S, rows, column) for column in values.T], axis=1)


def readings(truth: Truth, force_b: np.ndarray, rates_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the accelerometer's and the gyro's values, (num_rows, 3), m/s^2 and rad/s.

    force_b, rates_b: of the centre of mass, a row per 10 ms. In this order: f + w x (w x r) + dw/dt x r of
    an IMU at r ("imu_offset", m), scale, bias, and latency of both sensors ("imu_latency", s).
    """
    offset_b = _vector(truth, "imu_offset", 0.0)
    spin_b = np.diff(rates_b, axis=0, prepend=rates_b[:1]) / DT_S
    force_b = force_b + np.cross(rates_b, np.cross(rates_b, offset_b)) + np.cross(spin_b, offset_b)
    force_b = _vector(truth, "accelerometer_scale", 1.0) * force_b + _vector(truth, "accelerometer_bias", 0.0)
    rates_b = _vector(truth, "gyro_scale", 1.0) * rates_b + _vector(truth, "gyro_bias", 0.0)
    latency_s = truth.effects.get("imu_latency", {}).get("latency_s", 0.0)
    return _later(force_b, latency_s), _later(rates_b, latency_s)
