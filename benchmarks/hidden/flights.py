"""Flights of plants with hidden effects as clean logs, and the hidden effects of the sensors."""

import numpy as np

from benchmarks.hidden.pilot import Pilot
from benchmarks.hidden.plans import Moment, plan
from benchmarks.hidden.plant import Plant, Start
from benchmarks.hidden.truth import DT_S, Truth
from benchmarks.hidden.vectors import Vector
from flytrack_sysid.log import FlightLog

FLOOR_M, FASTEST = 0.1, 20.0  # m, m/s: the envelope of a flight
SETTLE_S = 2.0  # of hover before the log begins: the pilot learns what is steady
OPEN_V = (23.2, 24.0)  # of the battery at the start, without load
HOVER_STICK = -0.3
TRIES = 8
XYZ = ("x", "y", "z")
CHANNELS = {"u": 4, "p": 3, "v": 3, "a": 3, "f": 3, "q": 4, "w": 3, "v_bat": 1}


class CrashError(RuntimeError):
    """No attempt at a flight stayed within the envelope."""


def fly(truth: Truth, kind: str, seconds: float, rng: np.random.Generator) -> FlightLog:
    """Return the clean log of a flight, float64, one segment, a row per 10 ms.

    Channels u, p, v, a, f, q, w and v_bat; f and w are accelerometer and gyro, with the hidden effects of the
    sensors and without noise. A flight below 0.1 m or beyond 20 m/s is flown again, higher and slower.
    kind: of ``FLIGHT_KINDS``.

    Raises:
        ValueError: an unknown kind.
        CrashError: eight attempts left the envelope.
    """
    seed = rng.integers(2**63)
    for caution in range(TRIES):
        rows = _attempt(truth, kind, seconds, np.random.default_rng(seed), caution)
        height, speed = rows["p"][:, 2].min(), np.linalg.norm(rows["v"], axis=1).max()
        if height >= FLOOR_M and speed <= FASTEST:
            break
    else:
        raise CrashError(
            f"{kind} flight of {truth.text()}: found {height:.2f} m and {speed:.1f} m/s after {TRIES} tries, "
            f"expected {FLOOR_M} m or more and {FASTEST} m/s or less"
        )
    rows["f"], rows["w"] = imu_readings(truth, rows["f"], rows["w"])
    settled = round(SETTLE_S / DT_S)
    rows = {name: values[settled:] for name, values in rows.items()}
    count = len(rows["p"])
    return FlightLog(np.arange(count) * DT_S, rows, np.zeros(count, int), f"{kind} flight")


def _attempt(
    truth: Truth, kind: str, seconds: float, rng: np.random.Generator, caution: int
) -> dict[str, np.ndarray]:
    """Return the channels of one attempt, including the time to settle."""
    moments = plan(kind, seconds, rng, caution)
    settling = [moments[0]._replace(vel_w=(0.0, 0.0, 0.0), acc_w=(0.0, 0.0, 0.0))] * round(SETTLE_S / DT_S)
    start = Start(moments[0].pos_w, moments[0].heading, float(rng.uniform(*OPEN_V)), HOVER_STICK)
    plant = Plant(truth, start, rng, seconds + SETTLE_S, _centre(truth, moments))
    pilot, rows = Pilot(truth, rng), []
    for moment in [*settling, *moments]:
        sticks = pilot.command(plant, moment)
        rows.append(
            (
                *sticks,
                *plant.pos_w,
                *plant.vel_w,
                *plant.acc_w,
                *plant.force_b,
                *plant.quat,
                *plant.rates_b,
                plant.battery_v,
            )
        )
        plant.step(sticks)
    columns = np.split(np.array(rows), np.cumsum(list(CHANNELS.values()))[:-1], axis=1)
    return dict(zip(CHANNELS, columns, strict=True))


def _centre(truth: Truth, moments: list[Moment]) -> Vector:
    """Return where an effect of position is centred: a point of the planned path."""
    share = truth.outside.shape.get("at_share", 0.0) if truth.outside is not None else 0.0
    return moments[int(share * (len(moments) - 1))].pos_w


def _vector(truth: Truth, name: str, neutral: float) -> np.ndarray:
    values = truth.effects.get(name, {})
    return np.array([values.get(axis, neutral) for axis in XYZ])


def _delayed(values: np.ndarray, latency_s: float) -> np.ndarray:
    """Return values delayed by a latency, (num_rows, n); linear between rows."""
    rows = np.arange(len(values), dtype=float)
    return np.stack([np.interp(rows - latency_s / DT_S, rows, column) for column in values.T], axis=1)


def imu_readings(truth: Truth, force_b: np.ndarray, rates_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return accelerometer and gyro, (num_rows, 3), m/s^2 and rad/s.

    force_b, rates_b: of the centre of mass, a row per 10 ms. Applied in this order: lever arm
    f + w x (w x r) + dw/dt x r of an IMU at r ("imu_offset", m), scale, bias, latency ("imu_latency", s).
    """
    offset_b = _vector(truth, "imu_offset", 0.0)
    spin_b = np.diff(rates_b, axis=0, prepend=rates_b[:1]) / DT_S
    force_b = force_b + np.cross(rates_b, np.cross(rates_b, offset_b)) + np.cross(spin_b, offset_b)
    force_b = _vector(truth, "accelerometer_scale", 1.0) * force_b + _vector(truth, "accelerometer_bias", 0.0)
    rates_b = _vector(truth, "gyro_scale", 1.0) * rates_b + _vector(truth, "gyro_bias", 0.0)
    latency_s = truth.effects.get("imu_latency", {}).get("latency_s", 0.0)
    return _delayed(force_b, latency_s), _delayed(rates_b, latency_s)
