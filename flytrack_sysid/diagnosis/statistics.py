"""Statistics behind the report's plots: binned means and step responses of residuals.

All intervals allow for residuals that are correlated in time.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg

NUM_BINS = 15
BLOCK_S = 1.0  # rows further apart than this count as independent
SHOWN_PERCENTILES = (0.5, 99.5)  # of the regressor: single rows far out would squeeze all others
FEWEST_ROWS, LEAST_ROWS = 20, 2  # of a bin: wanted, and without which there is no scatter
FEWEST_BLOCKS = 10  # fewer say too little of their own scatter
LONGEST_LAG_S = 0.5
TWO_SIDED_95 = 1.959964  # standard deviations
REGULARISED = 2e-3  # of the power of a command's changes
FEWEST_PAIRS = 30  # of rows a lag apart


class Binned(NamedTuple):
    """Means by bin, (num_bins,) each; only bins with two rows or more. ends95: half of the 95 % interval."""

    at: np.ndarray
    means: np.ndarray
    ends95: np.ndarray


def bin_edges(regressor: np.ndarray, num_bins: int = NUM_BINS, fewest: int = FEWEST_ROWS) -> np.ndarray:
    """Return the edges of bins over a regressor, (at most num_bins + 1,).

    Evenly wide, but joined with the next ones where they have fewer than ``fewest`` rows.
    """
    low, high = np.percentile(regressor, SHOWN_PERCENTILES)
    even = np.linspace(low, max(high, low + np.finfo(np.float32).eps), num_bins + 1)
    edges, rows = [even[0]], 0
    for count, edge in zip(np.histogram(regressor, even)[0], even[1:], strict=True):
        rows += int(count)
        if rows >= fewest:
            edges.append(edge)
            rows = 0
    # What is left over joins the last bin.
    return even[[0, -1]] if len(edges) == 1 else np.array([*edges[:-1], even[-1]])


def binned_means(regressor: np.ndarray, values: np.ndarray, block: np.ndarray, edges: np.ndarray) -> Binned:
    """Return means of values by bins of a regressor; all (num_rows,), edges (num_bins + 1,).

    block: (num_rows,) int, from 0; rows of one block may be correlated. The interval is from the scatter of
    sums over blocks (K.-Y. Liang, S. Zeger, 1986); where a bin has few blocks, it is at least that of
    independent rows.
    """
    num_bins = len(edges) - 1
    number = np.searchsorted(edges, regressor, side="right") - 1
    inside = (number >= 0) & (number < num_bins)
    number, values, block = number[inside], values[inside], block[inside]
    rows = np.bincount(number, minlength=num_bins)
    some = np.maximum(rows, 1)
    means = np.bincount(number, values, minlength=num_bins) / some
    at = np.bincount(number, regressor[inside], minlength=num_bins) / some
    off = values - means[number]
    by_row = np.bincount(number, off**2, minlength=num_bins)
    num_blocks = int(block.max(initial=-1)) + 1
    cell, cells = number * num_blocks + block, num_bins * num_blocks
    sums = np.bincount(cell, off, minlength=cells).reshape(num_bins, -1)
    used = (np.bincount(cell, minlength=cells).reshape(num_bins, -1) > 0).sum(axis=1)
    by_block = (sums**2).sum(axis=1)
    variance = np.where(used >= FEWEST_BLOCKS, by_block, np.maximum(by_block, by_row))
    kept = rows >= LEAST_ROWS
    return Binned(at[kept], means[kept], (TWO_SIDED_95 * np.sqrt(variance) / some)[kept])


class StepResponse(NamedTuple):
    """A residual after a step of a command by 1, (num_lags,) each.

    lags_s: how much later the residual is. std: of values if there were none. NaN where the log has too few
    rows that far apart.
    """

    lags_s: np.ndarray
    values: np.ndarray
    std: np.ndarray


def on_slots(values: np.ndarray, slot: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return a column on evenly spaced slots, NaN where nothing counts; (num_slots,).

    values, slot, counts: (num_rows,), as in ``traces.Traces``.
    """
    grid = np.full(int(slot[-1] - slot[0]) + 1, np.nan)
    grid[slot - slot[0]] = np.where(counts, values, np.nan)
    return grid


def _products(first: np.ndarray, later: np.ndarray, lags: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of first times later some lags on, and the number of pairs; both (num_lags,)."""
    is_first, is_later = np.isfinite(first), np.isfinite(later)
    first, later = np.where(is_first, first, 0.0), np.where(is_later, later, 0.0)
    sums, pairs = np.empty(len(lags)), np.empty(len(lags))
    for index, lag in enumerate(lags.tolist()):
        ahead, behind = max(lag, 0), max(-lag, 0)
        one, other = slice(behind, len(first) - ahead), slice(ahead, len(first) - behind)
        sums[index] = first[one] @ later[other]
        pairs[index] = np.count_nonzero(is_first[one] & is_later[other])
    return np.where(pairs >= FEWEST_PAIRS, sums / np.maximum(pairs, 1.0), np.nan), pairs


def _centred(grid: np.ndarray) -> np.ndarray:
    return grid - np.nanmean(grid) if np.isfinite(grid).any() else grid


def _lags(step_s: float, first_s: float, last_s: float) -> np.ndarray:
    return np.arange(round(first_s / step_s), round(last_s / step_s) + 1)


def _convolved(change: np.ndarray, values: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Return the response to all changes, (num_slots,), values at lags each."""
    known = np.convolve(np.where(np.isfinite(change), change, 0.0), values)
    known = np.concatenate([np.zeros(max(int(lags[0]), 0)), known])[max(-int(lags[0]), 0) :]
    return np.pad(known, (0, max(len(change) - len(known), 0)))[: len(change)]


def step_response(
    change: np.ndarray, grid: np.ndarray, step_s: float, first_s: float, last_s: float
) -> StepResponse:
    """Return what a step of a command by 1 leads to in a residual; columns on slots.

    change: of the command from one slot to the next. Least squares over all changes at once, so that steps
    that follow each other within ``last_s`` are told apart; lightly regularised, for smooth commands. Linear
    in ``grid``: the responses of two parts of a residual sum up. std: from what is left then.
    """
    grid = _centred(grid)
    lags = _lags(step_s, first_s, last_s)
    means, pairs = _products(change, grid, lags)
    power, _ = _products(change, change, np.arange(len(lags)))
    if not (np.isfinite(means).all() and np.isfinite(power).all() and power[0] > 0.0):
        return StepResponse(lags * step_s, np.full(len(lags), np.nan), np.full(len(lags), np.nan))
    inverse = np.linalg.inv(linalg.toeplitz(power) + REGULARISED * power[0] * np.eye(len(lags)))
    values = inverse @ means
    noise = _centred(grid - _convolved(change, values, lags))
    reach = _lags(step_s, -LONGEST_LAG_S, LONGEST_LAG_S)
    of_noise = np.nan_to_num(_products(noise, noise, reach)[0])
    further = np.arange(reach[0], reach[-1] + len(lags))
    of_changes = np.nan_to_num(_products(change, change, further)[0])
    both = np.lib.stride_tricks.sliding_window_view(of_changes, len(reach)) @ of_noise
    variance = np.diag(inverse @ linalg.toeplitz(both) @ inverse)
    return StepResponse(lags * step_s, values, np.sqrt(np.maximum(variance, 0.0) / np.maximum(pairs, 1.0)))
