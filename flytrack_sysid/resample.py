"""Resampling of channels from several clocks to one time base, without smoothing or gap filling."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

SLOW_STEP_S = 0.025  # 40 Hz: the lags of a rate loop are 10 to 50 ms
MAX_BRIDGE_STEPS = 3.0  # of a channel's usual step: longer gaps are not interpolated
SETPOINTS = ("attitude_command", "torque_command", "reference_rates", "thrust_command")
HELD = ("u", "sticks", *SETPOINTS, "own_attitude", "motors")


class Samples(NamedTuple):
    """Samples of a channel.

    Attributes:
        times: increasing, (num_rows,) s.
        values: (num_rows, n).
    """

    times: np.ndarray
    values: np.ndarray


def _brackets(times: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows before and after each time, and whether both are near, (num_at,) each.

    Both rows are near if at most three usual steps of the channel lie between them.
    """
    after = np.clip(np.searchsorted(times, at, side="left"), 1, max(len(times) - 1, 1))
    if len(times) < 2:
        return np.zeros(len(at), int), np.zeros(len(at), int), np.zeros(len(at), bool)
    max_gap_s = MAX_BRIDGE_STEPS * np.median(np.diff(times))
    is_exact = (times[after] == at) | (times[after - 1] == at)
    is_inside = (times[0] <= at) & (at <= times[-1])
    return after - 1, after, is_inside & (is_exact | (times[after] - times[after - 1] <= max_gap_s))


def interpolate(
    times: np.ndarray, values: np.ndarray, at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return linearly interpolated values, exact at the times of samples, and where they are known.

    Args:
        times: of the samples, (num_rows,) s.
        values: (num_rows, n).
        at: times to interpolate at, (num_at,) s.

    Returns:
        values: (num_at, n).
        is_known: (num_at,) bool.
    """
    before, after, is_known = _brackets(times, at)
    span = np.where(after > before, times[after] - times[before], 1.0)
    fraction = np.clip((at - times[before]) / span, 0.0, 1.0)[:, None]
    return values[before] + fraction * (values[after] - values[before]), is_known


def interpolate_quaternions(
    times: np.ndarray, quat: np.ndarray, at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternions, (num_at, 4), on the arcs between neighbours, and where they are known."""
    _, _, is_known = _brackets(times, at)
    if len(times) < 2:
        return np.tile(quat[:1], (len(at), 1)), is_known
    arcs = Slerp(times, Rotation.from_quat(quat, scalar_first=True))
    return arcs(np.clip(at, times[0], times[-1])).as_quat(scalar_first=True), is_known


def hold(times: np.ndarray, values: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the last value up to each time, as commands are held, and where it is known.

    A value is known if it is at most three usual steps of the channel old.

    Args:
        times: of the samples, (num_rows,) s.
        values: (num_rows, n).
        at: times to sample at, (num_at,) s.

    Returns:
        values: (num_at, n).
        is_known: (num_at,) bool.
    """
    last = np.searchsorted(times, at, side="right") - 1
    max_age_s = MAX_BRIDGE_STEPS * (np.median(np.diff(times)) if len(times) > 1 else np.inf)
    is_known = (last >= 0) & (at - times[np.maximum(last, 0)] <= max_age_s)
    return values[np.maximum(last, 0)], is_known


def slow_channels(samples: Mapping[str, Samples]) -> list[str]:
    """Return a sentence on each channel, except the battery, that is too slow for a rate loop."""
    sentences = []
    for name, (times, _) in samples.items():
        step_s = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        if step_s > SLOW_STEP_S and name != "v_bat":
            method = "held" if name in HELD else "interpolated"
            sentences.append(
                f"{name} at {1.0 / step_s:.3g} Hz, {method} in between: faster dynamics do not "
                "show in it"
            )
    return sentences


def on_one_base(
    samples: Mapping[str, Samples], base: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return channels at the times of a base, and where all of them are known.

    Commands are held, attitudes are interpolated on the arc, other channels linearly. The battery
    changes slowly, so its ends are held and its gaps do not matter.

    Args:
        samples: by channel.
        base: times of the rows, (num_base,) s.

    Returns:
        channels: by name, (num_base, n).
        is_known: (num_base,) bool.
    """
    channels, is_known = {}, np.ones(len(base), bool)
    for name, (times, values) in samples.items():
        if name == "v_bat":
            channels[name] = np.interp(base, times, values[:, 0])[:, None]
            continue
        resample = hold if name in HELD else interpolate_quaternions if name == "q" else interpolate
        channels[name], is_known_here = resample(times, values, base)
        is_known &= is_known_here
    return channels, is_known
