"""Made-up logs of craft that stand, fly, descend and land: accelerometer and gyroscope."""

import numpy as np
from scipy.signal import lfilter

from flytrack_sysid import FlightLog
from tests.support.handout_plant import GRAVITY
from tests.support.written_logs import with_channels

STEP_S = 0.01
TAKE_OFF_S, LANDING_S, END_S = 5.0, 15.0, 20.0
IDLE, HOVER = 0.06, 0.4  # of the throttle's range
TAU_THRUST_S = 0.036
NOISE = {"w": 0.02, "f": 0.3}  # rad/s, m/s^2: idle propellers shake


def stands_flies_and_lands(seed=0):
    """Return a log that stands until TAKE_OFF_S and from LANDING_S on.

    Thrust is linear in throttle.
    """
    time = np.arange(0.0, END_S, STEP_S)
    rng = np.random.default_rng(seed)
    is_flying = (time >= TAKE_OFF_S) & (time < LANDING_S)
    rates, phases = rng.uniform(2.0, 8.0, (4, 3)), rng.uniform(0.0, 2.0 * np.pi, (4, 3))
    waves = np.sin(time[:, None, None] * rates + phases).mean(axis=2)
    throttle = np.where(is_flying, HOVER + 0.2 * waves[:, 3], IDLE * (time > 1.0))
    keep = np.exp(-STEP_S / TAU_THRUST_S)
    thrust = lfilter([1.0 - keep], [1.0, -keep], throttle)
    turns = 3.0 * waves[:, :3] * is_flying[:, None]
    force = np.zeros((len(time), 3))
    force[:, 2] = GRAVITY * np.where(is_flying, thrust / HOVER, 1.0)
    channels = {
        "u": np.column_stack([turns / np.deg2rad(500.0), 2.0 * throttle - 1.0]),
        "w": turns + NOISE["w"] * rng.standard_normal(turns.shape),
        "f": force + NOISE["f"] * rng.standard_normal(force.shape),
        "v_bat": 16.4 - 0.02 * time[:, None],
    }
    return FlightLog(time, channels, np.zeros(len(time), int))


def falls(kind, noise, terminal_speed, throttle, seed):
    """Return a flight of 10 s, a fall of 10 s that does not turn, and a flight of 10 s.

    Args:
        kind: "ballistic", without drag, or "descent", on quadratic drag, until drag carries the
            weight.
        noise: factor of NOISE.
        terminal_speed: of the descent, m/s.
        throttle: during the fall, as a fraction of its range.
        seed: of motion and noise.
    """
    flight = stands_flies_and_lands(seed=seed)
    part = flight.select((flight.time >= TAKE_OFF_S + 0.1) & (flight.time < LANDING_S - 0.1))
    num_fall = round(10.0 / STEP_S)
    thrust, time = GRAVITY * throttle / HOVER, STEP_S * np.arange(num_fall)
    felt = np.full(num_fall, thrust)
    if kind == "descent":  # the speed rises as a hyperbolic tangent
        rate = np.sqrt(GRAVITY * (GRAVITY - thrust)) / terminal_speed
        felt += (GRAVITY - thrust) * np.tanh(rate * time) ** 2
    rng = np.random.default_rng(seed + 1)
    fall = {
        "u": np.tile([0.0, 0.0, 0.0, 2.0 * throttle - 1.0], (num_fall, 1)),
        "w": noise * NOISE["w"] * rng.standard_normal((num_fall, 3)),
        "f": np.outer(felt, [0.0, 0.0, 1.0])
        + noise * NOISE["f"] * rng.standard_normal((num_fall, 3)),
        "v_bat": np.full((num_fall, 1), 16.0),
    }
    channels = {name: np.concatenate([part[name], fall[name], part[name]]) for name in fall}
    num_rows = len(channels["u"])
    return FlightLog(STEP_S * np.arange(num_rows), channels, np.zeros(num_rows, int))


def with_pose(log):
    """Return the log with level attitude and the velocity that its force integrates to."""
    acc = log["f"] - [0.0, 0.0, GRAVITY]
    is_flying = (log.time >= TAKE_OFF_S) & (log.time < LANDING_S)
    velocity = np.cumsum(acc * STEP_S * is_flying[:, None], axis=0) * is_flying[:, None]
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(log), 1))
    return with_channels(log, v=velocity, q=quat)
