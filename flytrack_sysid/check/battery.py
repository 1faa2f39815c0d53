"""The battery's voltage: what packs have, and that it falls in flight."""

import numpy as np

from flytrack_sysid.check.explain import Change
from flytrack_sysid.check.pairs import AGREES, CONTRADICTS, STILL, Pair
from flytrack_sysid.kinematics import jackknife_error, segments_of
from flytrack_sysid.log import FlightLog

LIKELY_V, HIGHEST_V = (2.5, 70.0), 100.0
UNITS = (1000.0, 100.0, 10.0)
BLOCK_S = 2.0
MIN_BLOCKS = 5  # 10 s: a flight of 3 s among those measured ends with a risen voltage
# Standard errors of the slope. Of the 25 measured flights above 10 s that log a voltage, none
# rises; 20 fall by more than this.
SLOPE_ERRORS = 5.0
MIN_CHANGE = 0.003  # of the voltage: less is that of its resolution


def battery_changes(log: FlightLog) -> list[tuple[Change, ...]]:
    """Return units of the battery's voltage that a pack may have, as alternatives."""
    median_v = float(np.median(log["v_bat"])) if "v_bat" in log else 0.0
    low, high = LIKELY_V
    units = [unit for unit in UNITS if low <= median_v / unit <= high]
    if median_v <= HIGHEST_V or not units:
        return [()]
    return [(Change("v_bat", "scale", unit),) for unit in units]


def compare_battery(log: FlightLog) -> tuple[Pair, ...]:
    """Return whether the voltage falls with time, as a pair; () if none is logged.

    The voltage is regressed on the time and on the thrust command, by which it sags, with a
    constant for each segment. A jackknife over blocks gives the standard error of its slope.
    """
    if "v_bat" not in log:
        return ()
    durations = np.diff(log.time, prepend=log.time[0])
    durations[log.is_start()] = 0.0
    elapsed_s = np.cumsum(durations)
    block = (elapsed_s / BLOCK_S).astype(int)
    values = np.column_stack([log.time, log.throttle, log["v_bat"][:, 0]])
    for rows in segments_of(log):
        values[rows] -= values[rows].mean(axis=0)
    products = np.stack(
        [values[block == number].T @ values[block == number] for number in np.unique(block)]
    )
    without = products.sum(axis=0) - products
    slope = _slope(products.sum(axis=0))
    sigma = jackknife_error(np.array([_slope(one) for one in without]))
    change = slope * elapsed_s[-1] / float(np.median(np.abs(log["v_bat"])) or 1.0)
    is_clear = abs(slope) > SLOPE_ERRORS * sigma and abs(change) > MIN_CHANGE
    verdict = STILL
    if len(without) >= MIN_BLOCKS and is_clear:
        verdict = AGREES if slope < 0.0 else CONTRADICTS
    return (Pair("v_bat and t", verdict, (), (), float("nan"), float("nan")),)


def _slope(products: np.ndarray) -> float:
    """Return the slope over time, by products of time, thrust command and voltage, (3, 3)."""
    return float((np.linalg.pinv(products[:2, :2]) @ products[:2, 2])[0])
