"""A made-up flight with known truth, as sensors with clocks of their own would log it."""

import numpy as np
from scipy.spatial.transform import Rotation, RotationSpline

from flytrack_sysid import FlightLog
from tests.support.handout_plant import GRAVITY

TIME_S = 0.01 * np.arange(2000)
CRUISE_W = np.array([1.0, -0.5, 0.0])  # mean velocity of the flight, world, m/s


def motion(seed, time, num_integrals=0):
    """Return smooth motion of three axes, (num_rows, 3), or an integral over time of it.

    It is a sum of sines of 0.3 to 2.5 Hz.
    """
    rng = np.random.default_rng(seed)
    rates, phases = rng.uniform(2.0, 15.0, (3, 5)), rng.uniform(0.0, 2.0 * np.pi, (3, 5))
    angles = time[:, None, None] * rates + phases - 0.5 * np.pi * num_integrals
    return (np.sin(angles) / rates**num_integrals).sum(axis=2)


def flight(time, late_q_s=0.0, late_v_s=0.0, late_p_s=0.0):
    """Return the log of a made-up flight; q, v and p may be written down late."""
    knots = np.arange(time[0] - 1.0, time[-1] + 1.0, 0.01)
    attitude = RotationSpline(knots, Rotation.from_euler("xyz", motion(1, knots, 1)))
    force_w = motion(2, time) + np.array([0.0, 0.0, GRAVITY])
    channels = {
        "u": np.column_stack([motion(3, time), motion(4, time)[:, 0]]) / 6.0,
        "p": motion(2, time - late_p_s, 2) + CRUISE_W * (time - late_p_s)[:, None],
        "v": motion(2, time - late_v_s, 1) + CRUISE_W,
        "f": attitude(time).inv().apply(force_w),
        "q": attitude(time - late_q_s).as_quat(scalar_first=True),
        "w": attitude(time, 1),
        "v_bat": 16.0 - time[:, None] / 60.0,
    }
    return FlightLog(time, channels, np.zeros(len(time), int))


def noisy(log, seed, factor=1.0):
    """Return a log as sensors would have it, with a factor of the usual noise."""
    rng = np.random.default_rng(seed)
    sizes = {"w": 0.05, "f": 0.5, "v": 0.02, "p": 0.005, "q": 0.002}
    channels = {
        name: values + factor * sizes.get(name, 0.0) * rng.standard_normal(values.shape)
        for name, values in log.channels.items()
    }
    channels["q"] /= np.linalg.norm(channels["q"], axis=1, keepdims=True)
    return FlightLog(log.time, channels, log.segment)
