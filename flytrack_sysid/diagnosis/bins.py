"""Means by bins of what a residual is held against, with 95 % intervals that know that rows hang together."""

from typing import NamedTuple

import numpy as np

NUM_BINS = 15
BLOCK_S = 1.0  # what lasts longer than this is not noise
SHOWN_PERCENTILES = (0.5, 99.5)  # of the regressor: single rows far out would squeeze all others
FEWEST_ROWS, LEAST_ROWS = 20, 2  # of a bin: wanted, and without which there is no scatter
FEWEST_BLOCKS = 10  # fewer say too little of their own scatter
NORMAL_95 = 1.96  # standard deviations


class Binned(NamedTuple):
    """Means by bin, (num_bins,) each; only bins with two rows or more. ends95: half of the 95 % interval."""

    at: np.ndarray
    means: np.ndarray
    ends95: np.ndarray


def edges_of(regressor: np.ndarray, num_bins: int = NUM_BINS, fewest: int = FEWEST_ROWS) -> np.ndarray:
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
    if len(edges) == 1:
        return even[[0, -1]]
    return np.array([*edges[:-1], even[-1]])  # what is left over joins the last


def binned(regressor: np.ndarray, values: np.ndarray, block: np.ndarray, edges: np.ndarray) -> Binned:
    """Return means of values by bins of a regressor; all (num_rows,), edges (num_bins + 1,).

    block: (num_rows,) int, from 0; rows of one block may hang together.
    The interval is from the scatter of sums over blocks (K.-Y. Liang, S. Zeger, 1986); where a bin has few
    blocks, it is at least that of independent rows.
    """
    count = len(edges) - 1
    number = np.searchsorted(edges, regressor, side="right") - 1
    inside = (number >= 0) & (number < count)
    number, values, block = number[inside], values[inside], block[inside]
    rows = np.bincount(number, minlength=count)
    some = np.maximum(rows, 1)
    means = np.bincount(number, values, minlength=count) / some
    at = np.bincount(number, regressor[inside], minlength=count) / some
    off = values - means[number]
    by_row = np.bincount(number, off**2, minlength=count)
    num_blocks = int(block.max(initial=-1)) + 1
    shape = (count, num_blocks)
    cell = number * num_blocks + block
    sums = np.bincount(cell, off, minlength=count * num_blocks).reshape(shape)
    blocks = (np.bincount(cell, minlength=count * num_blocks).reshape(shape) > 0).sum(axis=1)
    by_block = (sums**2).sum(axis=1)
    variance = np.where(blocks >= FEWEST_BLOCKS, by_block, np.maximum(by_block, by_row))
    kept = rows >= LEAST_ROWS
    return Binned(at[kept], means[kept], (NORMAL_95 * np.sqrt(variance) / some)[kept])
