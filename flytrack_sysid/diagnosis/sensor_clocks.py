"""Velocity, position and commands on the clock of the gyro, before anything asks how late poses are.

How late the motion follows the commands is the plant's lag, and no clock. But a drone that turns before it is
told to has commands from a clock that is late.
"""

from dataclasses import replace

import numpy as np

from flytrack_env.dynamics import ModelParameters
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


def with_causal_commands(log: FlightLog, model: ModelParameters) -> tuple[FlightLog, np.ndarray, list[str]]:
    """Return a log whose commands come before the turns they cause, the rows it still has, and a sentence.

    model: its mean lag of roll and pitch is what remains between commands and turns, in whole rows, where the
    commands were late.
    """
    every = np.ones(len(log), bool)
    if "w" not in log:
        return log, every, []
    turns = np.cumsum(log["w"] * usual_step(log)[:, None], axis=0)
    asked = log["u"][:, :3] * np.deg2rad(np.asarray(model.max_rate))
    lag_s, sigma_s, _, reason = offset_between(log, turns, asked)
    step_s = float(np.median(usual_step(log)))
    if reason or lag_s >= -(max(STANDARD_ERRORS * sigma_s, LEAST_S) + step_s):
        return log, every, []
    late = round((float(np.mean(np.asarray(model.tau)[:2])) - lag_s) / step_s)
    later, run = np.arange(len(log)) + late, np.cumsum(log.is_start())
    source = np.minimum(later, len(log) - 1)
    kept = (source == later) & (run[source] == run)
    log = replace(log, channels={**log.channels, "u": log["u"][source]})
    note = (
        f"the clock of the commands was about {1e3 * late * step_s:.0f} ms late: the drone turned "
        f"{-1e3 * lag_s:.0f} ms before it was told to; corrected so that the model's lag remains, which this "
        "log cannot show"
    )
    return log.select(kept), kept, [note]
