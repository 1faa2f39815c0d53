"""Flights of plants with hidden effects, as clean logs."""

import numpy as np

from benchmarks.hidden.kinds import plan
from benchmarks.hidden.pilot import Pilot
from benchmarks.hidden.plans import Moment
from benchmarks.hidden.plant import Plant, Start
from benchmarks.hidden.readings import readings
from benchmarks.hidden.truth import DT_S, Truth
from benchmarks.hidden.vectors import Vector
from flytrack_sysid.log import FlightLog

FLOOR_M, FASTEST = 0.1, 20.0  # m, m/s: what a flight has to stay above and below
SETTLE_S = 2.0  # of hover before the log begins: the pilot learns what is steady
OPEN_V = (23.2, 24.0)  # of the battery at the start, without load
HOVER_STICK = -0.3
TRIES = 8
CHANNELS = {"u": 4, "p": 3, "v": 3, "a": 3, "f": 3, "q": 4, "w": 3, "v_bat": 1}


class CrashError(RuntimeError):
    """No try of a flight stayed above the ground and below the largest speed."""


def fly(truth: Truth, kind: str, seconds: float, rng: np.random.Generator) -> FlightLog:
    """Return the clean log of a flight, float64, one segment, a row per 10 ms.

    Channels u, p, v, a, f, q, w and v_bat; f and w are what accelerometer and gyro say, with the hidden
    effects of the sensors and without noise. The flight stays 0.1 m above ground and within 20 m/s: if not,
    the pilot tries again, higher where it was low and slower. kind: of ``kinds.FLIGHT_KINDS``.

    Raises:
        ValueError: if there is no such kind.
        CrashError: if eight tries leave the envelope.
    """
    seed = rng.integers(2**63)
    for caution in range(TRIES):
        rows = _flown(truth, kind, seconds, np.random.default_rng(seed), caution)
        height, speed = rows["p"][:, 2].min(), np.linalg.norm(rows["v"], axis=1).max()
        if height >= FLOOR_M and speed <= FASTEST:
            break
    else:
        raise CrashError(
            f"{kind} flight of {truth.text()}: found {height:.2f} m and {speed:.1f} m/s after {TRIES} tries, "
            f"expected {FLOOR_M} m or more and {FASTEST} m/s or less"
        )
    rows["f"], rows["w"] = readings(truth, rows["f"], rows["w"])
    settled = round(SETTLE_S / DT_S)
    rows = {name: values[settled:] for name, values in rows.items()}
    count = len(rows["p"])
    return FlightLog(np.arange(count) * DT_S, rows, np.zeros(count, int), f"{kind} flight")


def _flown(
    truth: Truth, kind: str, seconds: float, rng: np.random.Generator, caution: int
) -> dict[str, np.ndarray]:
    """Return the channels of one try, the time to settle included."""
    moments = plan(kind, seconds, rng, caution)
    settling = [moments[0]._replace(vel_w=(0.0, 0.0, 0.0), acc_w=(0.0, 0.0, 0.0))] * round(SETTLE_S / DT_S)
    # As if drained by the time to settle already, which the log leaves out.
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
    """Return where an effect of position is: on the way that is planned."""
    share = truth.outside.shape.get("at_share", 0.0) if truth.outside is not None else 0.0
    return moments[int(share * (len(moments) - 1))].pos_w
