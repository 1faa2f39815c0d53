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


def stands_flies_and_lands(step_s=STEP_S, seed=0):
    """Return a log that stands until TAKE_OFF_S and from LANDING_S on.

    Thrust is linear in throttle.
    """
    time = np.arange(0.0, END_S, step_s)
    rng = np.random.default_rng(seed)
    is_flying = (time >= TAKE_OFF_S) & (time < LANDING_S)
    rates, phases = rng.uniform(2.0, 8.0, (4, 3)), rng.uniform(0.0, 2.0 * np.pi, (4, 3))
    waves = np.sin(time[:, None, None] * rates + phases).mean(axis=2)
    throttle = np.where(is_flying, HOVER + 0.2 * waves[:, 3], IDLE * (time > 1.0))
    keep = np.exp(-step_s / TAU_THRUST_S)
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


def falls(
    kind,
    noise=1.0,
    terminal_speed=12.0,
    throttle=0.0,
    seed=0,
):
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
    thrust, speed, felt = GRAVITY * throttle / HOVER, 0.0, np.zeros(num_fall)
    for row in range(num_fall):
        drag = GRAVITY * (speed / terminal_speed) ** 2 if kind == "descent" else 0.0
        felt[row] = thrust + drag
        speed += STEP_S * (GRAVITY - felt[row])
    rng = np.random.default_rng(seed + 1)
    fall = {
        "u": np.tile([0.0, 0.0, 0.0, 2.0 * throttle - 1.0], (num_fall, 1)),
        "w": noise * NOISE["w"] * rng.standard_normal((num_fall, 3)),
        "f": noise * NOISE["f"] * rng.standard_normal((num_fall, 3))
        + felt[:, None] * [0.0, 0.0, 1.0],
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
