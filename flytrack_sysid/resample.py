"""Samples of several clocks on one time base, without smoothing or filling of gaps."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

SLOW_STEP_S = 0.025  # 40 Hz: the lags of a rate loop are 10 to 50 ms
MAX_BRIDGE_STEPS = 3.0  # of a channel's usual step: longer gaps are not interpolated
SETPOINTS = ("attitude_command", "torque_command", "reference_rates", "thrust_command")
HELD = ("u", *SETPOINTS, "own_attitude", "motors")


class Samples(NamedTuple):
    """Times, s, increasing, and values (num_rows, n) of a channel."""

    times: np.ndarray
    values: np.ndarray


def _brackets(times: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows before and after each time, and whether both are near, (num_at,) each.

    Near: at most three usual steps of the channel lie between the two rows.
    """
    after = np.clip(np.searchsorted(times, at, side="left"), 1, max(len(times) - 1, 1))
    if len(times) < 2:
        return np.zeros(len(at), int), np.zeros(len(at), int), np.zeros(len(at), bool)
    longest = MAX_BRIDGE_STEPS * np.median(np.diff(times))
    is_exact = (times[after] == at) | (times[after - 1] == at)
    is_inside = (times[0] <= at) & (at <= times[-1])
    return after - 1, after, is_inside & (is_exact | (times[after] - times[after - 1] <= longest))


def interpolate(
    times: np.ndarray, values: np.ndarray, at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return linearly interpolated values (num_at, n) and where they are known, (num_at,) bool.

    values: (num_rows, n). Exact at a sample's own time.
    """
    before, after, is_known = _brackets(times, at)
    span = np.where(after > before, times[after] - times[before], 1.0)
    fraction = np.clip((at - times[before]) / span, 0.0, 1.0)[:, None]
    return values[before] + fraction * (values[after] - values[before]), is_known


def interpolate_quaternions(
    times: np.ndarray, quat: np.ndarray, at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternions (num_at, 4) on the arcs between neighbours, and where they are known."""
    _, _, is_known = _brackets(times, at)
    if len(times) < 2:
        return np.tile(quat[:1], (len(at), 1)), is_known
    arcs = Slerp(times, Rotation.from_quat(quat, scalar_first=True))
    return arcs(np.clip(at, times[0], times[-1])).as_quat(scalar_first=True), is_known


def hold(times: np.ndarray, values: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the last of the values (num_rows, n) up to each time, and where it is known.

    Commands act like this.

    Known: not older than three usual steps of the channel. Returns (num_at, n), (num_at,) bool.
    """
    last = np.searchsorted(times, at, side="right") - 1
    longest = MAX_BRIDGE_STEPS * (np.median(np.diff(times)) if len(times) > 1 else np.inf)
    is_known = (last >= 0) & (at - times[np.maximum(last, 0)] <= longest)
    return values[np.maximum(last, 0)], is_known


def slow_channels(samples: Mapping[str, Samples]) -> list[str]:
    """Return a sentence on each channel but the battery that is too slow for a rate loop."""
    found = []
    for name, (times, _) in samples.items():
        step_s = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        if step_s > SLOW_STEP_S and name != "v_bat":
            how = "held" if name in HELD else "interpolated"
            found.append(
                f"{name} at {1.0 / step_s:.3g} Hz, {how} in between: faster dynamics do not show "
                "in it"
            )
    return found


def on_one_base(
    samples: Mapping[str, Samples], base: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return channels (num_base, n) at the times of the base, and where all of them are known.

    The latter is (num_base,) bool.

    Commands are held, attitudes interpolated on the arc, others linearly. The battery changes
    slowly: its ends are held, and gaps do not matter.
    """
    channels, is_known = {}, np.ones(len(base), bool)
    for name, (times, values) in samples.items():
        if name == "v_bat":
            channels[name] = np.interp(base, times, values[:, 0])[:, None]
            continue
        look_up = hold if name in HELD else interpolate_quaternions if name == "q" else interpolate
        channels[name], is_there = look_up(times, values, base)
        is_known &= is_there
    return channels, is_known
