"""Velocity and position on the clock of the attitude, before anything asks how late poses are as a whole."""

import numpy as np

from flytrack_sysid.clocks import PAIRS, offset_between, read_later
from flytrack_sysid.log import FlightLog, usual_step

STANDARD_ERRORS, LEAST_S = 5.0, 0.005


def on_one_clock(log: FlightLog) -> tuple[FlightLog, np.ndarray, list[str]]:
    """Return a log, which of its rows it still has, (num_rows,) bool, and a sentence on each clock corrected.

    Velocity is compared with the accelerometer as attitude is with the gyro: half a step of a simulator, and
    a latency of both inertial sensors, are no clocks apart. Position is compared with velocity.
    """
    pose_s, notes, kept = 0.0, [], np.ones(len(log), bool)
    slack_s = 0.5 * float(np.median(usual_step(log)))  # a simulator's force may be that of half a step before
    for channel, reference, needed, sums, rates in PAIRS:
        if any(name not in log for name in needed):
            continue
        seen = log if reference != "f" else read_later(log, ("q",), pose_s)[0]
        offset_s, sigma_s, _, reason = offset_between(seen, sums(seen), rates(seen))
        if channel == "q":
            pose_s = 0.0 if reason else offset_s
            continue
        late_s = offset_s - (pose_s if reference == "f" else 0.0)
        if reason or abs(late_s) <= max(STANDARD_ERRORS * sigma_s, LEAST_S) + slack_s:
            continue
        log, is_known = read_later(log, (channel,), late_s)
        kept &= is_known
        other = "attitude" if reference == "f" else "velocity"
        name = {"v": "velocity", "p": "position"}[channel]
        notes.append(f"the clock of {name} was {1e3 * late_s:.0f} ms late against that of {other}: corrected")
    return (log.select(kept), kept, notes) if notes else (log, kept, [])
