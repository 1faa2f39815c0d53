"""Do the clocks of the channels agree? The offset between sensors that measure the same motion.

Compared are only sensors with sensors: attitude with gyroscope, velocity with accelerometer, position with
velocity. Commands are left alone: how late the motion follows them is the plant's lag, not a clock. A slow
estimator's lag cannot be told from a late clock and is corrected with it.

Of a pair, one is the integral of the other. Both are taken as changes over the same windows of 0.1 s, so
that both are filtered alike; the offset minimises the squared difference (Gauss-Newton from the best of a
grid), and leaving out one stretch of 2 s after the other gives its uncertainty (jackknife; Efron and
Tibshirani 1993, chapter 11).
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from flytrack_sysid.importing.resample import interpolate, interpolate_quaternions
from flytrack_sysid.importing.units import GRAVITY
from flytrack_sysid.log import GAP_STEPS, FlightLog, usual_step
from flytrack_sysid.windows import LEAST_CORRELATION

LARGEST_OFFSET_S = 0.25  # beyond it, loggers are broken rather than late
WINDOW_S = 0.1  # long against the noise of a sample, short against manoeuvres
GRID_S = 0.01  # below it, the cost has one minimum: motion of a drone is slower
ROUNDS = 5  # of Gauss-Newton; it converges in two
BLOCK_S = 2.0  # errors further apart than this have little in common
FEWEST_BLOCKS = 5
SIGNIFICANT = 3.0  # standard errors
CORRECTED, LEFT = "corrected", "significant, left as asked"
LEAST_STEPS = 0.1  # of the log's step: smaller offsets change less than the step itself does


class ClockOffset(NamedTuple):
    """How late one channel's clock is against another's.

    channel, reference: of ``CHANNELS``. offset_s: what ``channel`` shows at t happened at t - offset_s, s.
    sigma_s: its standard error, s. correlation: of the changes that both show. verdict: what was done.
    """

    channel: str
    reference: str
    offset_s: float
    sigma_s: float
    correlation: float
    verdict: str

    def left(self) -> "ClockOffset":
        """Return the same with nothing corrected."""
        return self._replace(verdict=LEFT) if self.verdict == CORRECTED else self

    def describe(self) -> str:
        """Return one line on the offset, in ms."""
        pair = f"clock of {self.channel} against {self.reference}"
        if np.isnan(self.offset_s):
            return f"{pair}: {self.verdict}"
        late = f"{1e3 * self.offset_s:+.2f} ms late, standard error {1e3 * self.sigma_s:.2f} ms"
        return f"{pair}: {late}, correlation {self.correlation:.3f}: {self.verdict}"


class _Piece(NamedTuple):
    """A stretch without gaps: windows' first and last times, what grew over them, its rate over time."""

    starts: np.ndarray
    ends: np.ndarray
    grown: np.ndarray
    rate: Callable[[np.ndarray], np.ndarray]
    integral: Callable[[np.ndarray], np.ndarray]
    block: np.ndarray

    def differences(self, offset_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what grew, what the rate says at an offset, and its slope by the offset, all centred."""
        starts, ends = self.starts - offset_s, self.ends - offset_s
        summed = self.integral(ends) - self.integral(starts)
        slope = self.rate(starts) - self.rate(ends)
        return tuple(values - values.mean(axis=0) for values in (self.grown, summed, slope))


def _turned(log: FlightLog) -> np.ndarray:
    attitude = Rotation.from_quat(log["q"], scalar_first=True)
    turns_b = (attitude[:-1].inv() * attitude[1:]).as_rotvec()
    return np.concatenate([np.zeros((1, 3)), np.cumsum(turns_b, axis=0)])


def _acceleration(log: FlightLog) -> np.ndarray:
    force_w = Rotation.from_quat(log["q"], scalar_first=True).apply(log["f"])
    return force_w - np.array([0.0, 0.0, GRAVITY])


# Channel, reference, what must be there, and both as functions of the log. In this order: each reference
# is right by then.
PAIRS = (
    ("q", "w", ("q", "w"), _turned, lambda log: log["w"]),
    ("v", "f", ("v", "f", "q"), lambda log: log["v"], _acceleration),
    ("p", "v", ("p", "v"), lambda log: log["p"], lambda log: log["v"]),
)


def _stretches(log: FlightLog) -> list[slice]:
    """Return the rows of each stretch that no gap and no segment's end interrupts."""
    is_gap = np.diff(log.time) > GAP_STEPS * usual_step(log)[:-1]
    edges = np.flatnonzero(np.append(is_gap | log.is_start()[1:], True)) + 1
    return [slice(start, end) for start, end in pairwise([0, *edges])]


def _pieces(log: FlightLog, sums: np.ndarray, rates: np.ndarray) -> list[_Piece]:
    pieces, num_blocks = [], 0
    for rows in _stretches(log):
        time = log.time[rows]
        is_start = (time - time[0] >= LARGEST_OFFSET_S) & (time[-1] - time >= LARGEST_OFFSET_S + WINDOW_S)
        starts = time[is_start]
        if len(starts) < 2:
            continue
        line = make_interp_spline(time, sums[rows], k=1)
        rate = make_interp_spline(time, rates[rows], k=1)
        block = ((starts - starts[0]) // BLOCK_S).astype(int) + num_blocks
        num_blocks = block[-1] + 1
        ends = starts + WINDOW_S
        pieces.append(_Piece(starts, ends, line(ends) - line(starts), rate, rate.antiderivative(), block))
    return pieces


def _cost(pieces: list[_Piece], offset_s: float) -> float:
    parts = (piece.differences(offset_s) for piece in pieces)
    return sum(float(np.sum((grown - summed) ** 2)) for grown, summed, _ in parts)


def _sums(pieces: list[_Piece], offset_s: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return Gauss-Newton's numerator and denominator of each block, (num_blocks,), and the correlation."""
    top, bottom, products = [], [], np.zeros(3)
    for piece in pieces:
        grown, summed, slope = piece.differences(offset_s)
        _, block = np.unique(piece.block, return_inverse=True)  # none is empty, however long the gaps
        top.append(np.bincount(block, np.sum(slope * (grown - summed), axis=1)))
        bottom.append(np.bincount(block, np.sum(slope**2, axis=1)))
        products += [np.sum(grown * summed), np.sum(grown**2), np.sum(summed**2)]
    correlation = products[0] / np.sqrt(products[1] * products[2]) if products[1:].all() else 0.0
    return np.concatenate(top), np.concatenate(bottom), float(correlation)


def _offset(log: FlightLog, sums: np.ndarray, rates: np.ndarray) -> tuple[float, float, float, str]:
    """Return offset, standard error, correlation, and why there is none (empty if there is)."""
    unknown = np.nan, np.nan, np.nan
    pieces = _pieces(log, sums, rates)
    if sum(piece.block[-1] - piece.block[0] + 1 for piece in pieces) < FEWEST_BLOCKS:
        return *unknown, f"not compared: less than {FEWEST_BLOCKS * BLOCK_S:g} s without a gap"
    # Windows keep a margin of the largest offset from the ends of what is known; the grid stays within.
    grid = np.arange(-LARGEST_OFFSET_S + GRID_S, LARGEST_OFFSET_S - GRID_S / 2, GRID_S)
    best = int(np.argmin([_cost(pieces, offset) for offset in grid]))
    if best in (0, len(grid) - 1):
        return *unknown, f"not compared: they agree at no offset within {LARGEST_OFFSET_S:g} s"
    offset = float(grid[best])
    for _ in range(ROUNDS):
        top, bottom, correlation = _sums(pieces, offset)
        if bottom.sum() == 0.0 or correlation < LEAST_CORRELATION:
            return (
                *unknown,
                f"not compared: correlation {correlation:.2f}: they do not show one motion clearly",
            )
        offset = float(np.clip(offset + top.sum() / bottom.sum(), grid[0], grid[-1]))
    top, bottom, correlation = _sums(pieces, offset)
    if np.any(bottom.sum() - bottom <= 0.0):
        return *unknown, f"not compared: all motion is within {BLOCK_S:g} s"
    left_out = (top.sum() - top) / (bottom.sum() - bottom)
    count = len(left_out)
    sigma = float(np.sqrt((count - 1) / count * np.sum((left_out - left_out.mean()) ** 2)))
    return offset, sigma, correlation, ""


def shifted(log: FlightLog, channel: str, offset_s: float) -> FlightLog:
    """Return the log with one channel read ``offset_s`` later; rows where that is not known are left out."""
    values = np.array(log[channel], float)
    is_known = np.zeros(len(log), bool)
    bounds = np.append(np.flatnonzero(log.is_start()), len(log))
    look_up = interpolate_quaternions if channel == "q" else interpolate
    for start, end in pairwise(bounds):
        rows = slice(start, end)
        values[rows], is_known[rows] = look_up(log.time[rows], log[channel][rows], log.time[rows] + offset_s)
    return replace(log, channels={**log.channels, channel: values}).select(is_known)


def align_clocks(log: FlightLog) -> tuple[FlightLog, tuple[ClockOffset, ...]]:
    """Return a log with its sensors on one clock, and what was found of each pair that can be compared.

    Offsets above three standard errors and a tenth of the log's step are corrected, by reading the channel
    later (in between samples: on the straight line or shortest arc); others are reported and left. Rates
    and specific force count as one clock, with the commands: nothing in a log says otherwise.
    """
    found = []
    for channel, reference, needed, sums, rates in PAIRS:
        if any(name not in log for name in needed):
            continue
        offset, sigma, correlation, verdict = _offset(log, sums(log), rates(log))
        step = float(np.median(usual_step(log)))
        if not verdict and (abs(offset) <= SIGNIFICANT * sigma or abs(offset) <= LEAST_STEPS * step):
            verdict = "not significant, left"
        elif not verdict:
            log, verdict = shifted(log, channel, offset), CORRECTED
        found.append(ClockOffset(channel, reference, offset, sigma, correlation, verdict))
    return log, tuple(found)
