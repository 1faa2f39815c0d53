"""A made-up flight with known truth, as sensors with clocks of their own would log it."""

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_sysid import FlightLog
from tests.support.handout_plant import GRAVITY


def motion(seed, time):
    """Return smooth motion of three axes, (num_rows, 3): sines of 0.3 to 2.5 Hz."""
    rng = np.random.default_rng(seed)
    rates, phases = rng.uniform(2.0, 15.0, (3, 5)), rng.uniform(0.0, 2.0 * np.pi, (3, 5))
    return np.sin(time[:, None, None] * rates + phases).sum(axis=2)


def flight(time, late_q_s=0.0, late_v_s=0.0, late_p_s=0.0):
    """Return the log of a made-up flight; q, v and p may be written down late."""
    fine = np.arange(time[0] - 1.0, time[-1] + 1.0, 1e-3)
    turns = motion(1, 0.5 * (fine[1:] + fine[:-1])) * 1e-3
    attitude = Rotation.from_rotvec(np.concatenate([np.zeros((1, 3)), turns]))
    distance = 1  # products of the last 1, 2, 4, ... turns, until they are of all
    while distance < len(fine):
        products = attitude[:-distance] * attitude[distance:]
        attitude = Rotation.concatenate([attitude[:distance], products])
        distance *= 2
    acc_w = motion(2, fine)
    vel_w = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5e-3 * (acc_w[1:] + acc_w[:-1]), axis=0)])
    pos_w = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5e-3 * (vel_w[1:] + vel_w[:-1]), axis=0)])
    force_b = attitude.inv().apply(acc_w + np.array([0.0, 0.0, GRAVITY]))

    def at(values, late_s=0.0):
        return values[np.round((time - late_s - fine[0]) * 1e3).astype(int)]

    channels = {
        "u": np.column_stack([motion(3, time) / 6.0, motion(4, time)[:, :1] / 6.0]),
        "p": at(pos_w, late_p_s),
        "v": at(vel_w, late_v_s),
        "f": at(force_b),
        "q": at(attitude.as_quat(scalar_first=True), late_q_s),
        "w": motion(1, time),
        "v_bat": 16.0 - time[:, None] / 60.0,
    }
    return FlightLog(time, channels, np.zeros(len(time), int))


TIME_S = 0.01 * np.arange(2000)


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
