"""Sensors: noise, quantisation and lost rows of a measured flight log."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_sysid.kinematics import attitude_of
from flytrack_sysid.log import FlightLog

# Standard deviations at level 1; gyro and accelerometer are those of a drone with running motors.
GYRO_NOISE = 0.1  # rad/s
ACCELEROMETER_NOISE = 1.5  # m/s^2
VELOCITY_NOISE = 0.05  # m/s
POSITION_NOISE = 0.01  # m
ATTITUDE_NOISE_DEG = 0.5
# Quantisation of the log, at any level: 16 bits over +-2000 deg/s and +-16 g; mm/s, mm, 10 mV.
GYRO_STEP = 4000.0 / 2**16 * np.pi / 180.0  # rad/s
ACCELEROMETER_STEP = 32.0 * 9.80665 / 2**16  # m/s^2
VELOCITY_STEP, POSITION_STEP, QUATERNION_STEP, BATTERY_STEP = 1e-3, 1e-3, 1e-4, 0.01
LOST_ROWS = 0.02  # fraction of the rows, at level 1


def specific_force_b(log: FlightLog, gravity: float) -> np.ndarray:
    """Return the specific force of the step to each row, (num_rows, 3) m/s^2.

    It is in the body axes before the step. In the first row of a segment, where no step is known,
    it is in the body axes of the row itself.

    Args:
        log: with attitude and acceleration.
        gravity: m/s^2.
    """
    row_before = np.arange(len(log)) - np.where(log.is_start(), 0, 1)
    attitude = Rotation.from_quat(log["q"][row_before], scalar_first=True)
    return attitude.inv().apply(log["a"] + np.array([0.0, 0.0, gravity]))


def measure(log: FlightLog, level: float, gravity: float, rng: np.random.Generator) -> FlightLog:
    """Return a log as sensors would measure it: noisy, quantised, with lost rows.

    Accelerations become an accelerometer's specific force. The applied action, which is not
    measured, is absent.

    Args:
        log: simulated states.
        level: 1 for the noise of this module, 0 for none.
        gravity: m/s^2.
        rng: of noise and lost rows.
    """

    def noisy(values: np.ndarray, noise: float, step: float) -> np.ndarray:
        return step * np.round((values + level * noise * rng.standard_normal(values.shape)) / step)

    attitude = attitude_of(log)
    turn = np.deg2rad(level * ATTITUDE_NOISE_DEG) * rng.standard_normal((len(log), 3))
    quat = (attitude * Rotation.from_rotvec(turn)).as_quat(scalar_first=True)
    quat = QUATERNION_STEP * np.round(quat / QUATERNION_STEP)
    channels = {
        "u": log["u"],
        "p": noisy(log["p"], POSITION_NOISE, POSITION_STEP),
        "v": noisy(log["v"], VELOCITY_NOISE, VELOCITY_STEP),
        "f": noisy(specific_force_b(log, gravity), ACCELEROMETER_NOISE, ACCELEROMETER_STEP),
        "q": quat / np.linalg.norm(quat, axis=1, keepdims=True),
        "w": noisy(log["w"], GYRO_NOISE, GYRO_STEP),
        "v_bat": noisy(log["v_bat"], 0.0, BATTERY_STEP),
    }
    is_kept = rng.random(len(log)) >= level * LOST_ROWS
    return replace(log, channels=channels).select(is_kept)
