"""Flights of plants with hidden effects as clean logs, and the hidden effects of the sensors."""

import numpy as np

from flytrack_bench.hidden import DT_S, HiddenDrone, Start, Truth
from flytrack_bench.hidden.drone import SAME_S
from flytrack_bench.hidden.pilot import Pilot, plan
from flytrack_sysid.log import FlightLog

FLOOR_M, FASTEST = 0.1, 20.0  # m, m/s: the envelope of a flight
SETTLE_S = 2.0  # of hover before the log begins: the pilot learns what is steady
OPEN_V = (23.2, 24.0)  # of the battery at the start, without load
HOVER_STICK = -0.3
TRIES = 8
XYZ = ("x", "y", "z")
CHANNELS = {"u": 4, "p": 3, "v": 3, "q": 4, "a": 3, "f": 3, "w": 3, "slope": 3, "v_bat": 1}


def fly(truth: Truth, seconds: float, rng: np.random.Generator) -> FlightLog:
    """Return the clean log of a flight, float64, one segment, a row per step of the truth.

    Channels u, p, v, a, f, q, w and v_bat; f and w are accelerometer and gyro, with the hidden
    effects of the sensors and without noise. A flight below 0.1 m or beyond 20 m/s is flown again,
    higher and slower.

    Raises:
        RuntimeError: eight attempts left the envelope.
    """
    seed = rng.integers(2**63)
    for caution in range(TRIES):
        rows = _attempt(truth, seconds, np.random.default_rng(seed), caution)
        height, speed = rows["p"][:, 2].min(), np.linalg.norm(rows["v"], axis=1).max()
        if height >= FLOOR_M and speed <= FASTEST:
            break
    else:
        raise RuntimeError(
            f"flight of {truth.text()}: found {height:.2f} m and {speed:.1f} m/s after "
            f"{TRIES} tries, expected {FLOOR_M} m or more and {FASTEST} m/s or less"
        )
    rows["f"], rows["w"] = imu_readings(truth, rows["f"], rows["w"], rows.pop("slope"))
    for channel in "pvq":
        rows[channel] = _delayed(truth, rows[channel], truth.mocap_late_s)
    rows["q"] /= np.linalg.norm(rows["q"], axis=1, keepdims=True)
    settled = round(SETTLE_S / truth.step_s)
    rows = {name: values[settled:] for name, values in rows.items()}
    count = len(rows["p"])
    return FlightLog(
        np.arange(count) * truth.step_s, rows, np.zeros(count, int), "scripted flight", "simulated"
    )


def _attempt(
    truth: Truth, seconds: float, rng: np.random.Generator, caution: int
) -> dict[str, np.ndarray]:
    """Return the channels of one attempt, including the time to settle."""
    moments = plan(seconds, rng, caution)
    hover = moments[0]._replace(vel_w=np.zeros(3), acc_w=np.zeros(3))
    settling = [hover] * round(SETTLE_S / DT_S)
    start_w = tuple(hover.pos_w.tolist())
    start = Start(start_w, hover.heading, float(rng.uniform(*OPEN_V)), HOVER_STICK)
    # An effect of position is centred on a point of the planned path.
    share = truth.outside.shape.get("at_share", 0.0) if truth.outside is not None else 0.0
    centre_w = tuple(moments[int(share * (len(moments) - 1))].pos_w.tolist())
    drone = HiddenDrone(truth, start, rng, seconds + SETTLE_S, centre_w, SETTLE_S)
    pilot, last = Pilot(truth, rng), -1
    rows: list[np.ndarray] = []
    planned = [*settling, *moments]
    for number in range(round(len(planned) * DT_S / truth.step_s)):
        # The pilot sends a command every 10 ms, or with every row where these are further apart.
        now = int(number * truth.step_s / DT_S + SAME_S)
        if now != last:
            sticks, last = pilot.command(drone, planned[now]), now
        state = (sticks, *drone.tracked, drone.acc_w, *drone.felt, (drone.battery_v,))
        rows.append(np.concatenate(state))
        drone.step(sticks)
    columns = np.split(np.array(rows), np.cumsum(list(CHANNELS.values()))[:-1], axis=1)
    return dict(zip(CHANNELS, columns, strict=True))


def _vector(truth: Truth, name: str, neutral: float) -> np.ndarray:
    values = truth.effects.get(name, {})
    return np.array([values.get(axis, neutral) for axis in XYZ])


def _delayed(truth: Truth, values: np.ndarray, latency_s: float) -> np.ndarray:
    """Return values delayed by a latency, (num_rows, n).

    Linear between rows; in fine motion the plant has recorded each at its instant, but for whole
    steps.
    """
    late, rows = latency_s / truth.step_s, np.arange(len(values), dtype=float)
    late = np.floor(late + SAME_S) if truth.motion == "fine" else late
    return np.stack([np.interp(rows - late, rows, column) for column in values.T], axis=1)


def imu_readings(
    truth: Truth, force_b: np.ndarray, rates_b: np.ndarray, slopes_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return accelerometer and gyro, (num_rows, 3), m/s^2 and rad/s.

    Applied in this order: lever arm f + w x (w x r) + dw/dt x r of an IMU at r ("imu_offset", m),
    scale, bias, latency ("imu_latency", s).

    Args:
        force_b, rates_b, slopes_b: of the centre of mass, a row per step; slopes are not used but
            in fine motion.
    """
    offset_b = _vector(truth, "imu_offset", 0.0)
    if truth.motion != "fine":
        slopes_b = np.diff(rates_b, axis=0, prepend=rates_b[:1]) / truth.step_s
    centripetal_b = np.cross(rates_b, np.cross(rates_b, offset_b))
    force_b = force_b + centripetal_b + np.cross(slopes_b, offset_b)
    scale, bias = (
        _vector(truth, "accelerometer_scale", 1.0),
        _vector(truth, "accelerometer_bias", 0.0),
    )
    force_b = scale * force_b + bias
    rates_b = _vector(truth, "gyro_scale", 1.0) * rates_b + _vector(truth, "gyro_bias", 0.0)
    latency_s = truth.effects.get("imu_latency", {}).get("latency_s", 0.0)
    return _delayed(truth, force_b, latency_s), _delayed(truth, rates_b, latency_s)
