"""Whether residuals are noise: alike to nothing that came before them, and to no command.

As in the residual analysis of textbooks (L. Ljung, System Identification, 1999, section 16.6): a model that
lacks nothing leaves residuals that are white, and independent of the commands.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg, stats

LONGEST_LAG_S = 0.5
BANDS = {95: float(stats.norm.isf(0.025)), 99: float(stats.norm.isf(0.005))}  # percent -> standard deviations
HELD = 2e-3  # of the power of a command's changes: what is less than that is not asked for
FEWEST_PAIRS = 30  # of rows a lag apart


class Correlation(NamedTuple):
    """A correlation by lag, (num_lags,) each.

    lags_s: how much later the residual is. values: correlation. std: of values if there were none.
    NaN where the log has too few rows that far apart.
    """

    lags_s: np.ndarray
    values: np.ndarray
    std: np.ndarray

    def share_beyond(self, percent: int) -> float:
        """Return the share of lags, that of 0 left out, beyond a band of ``BANDS``; nan without any."""
        used = np.isfinite(self.values) & (self.lags_s != 0.0)
        beyond = np.abs(self.values[used]) > BANDS[percent] * self.std[used]
        return float(beyond.mean()) if len(beyond) else float("nan")


class Response(NamedTuple):
    """Residual after a step of a command by 1; as ``Correlation``, values and std in the residual's unit."""

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


def autocorrelation(grid: np.ndarray, step_s: float, longest_s: float = LONGEST_LAG_S) -> Correlation:
    """Return how alike a residual on slots, (num_slots,), is to itself later, from lag 0 on.

    Pairs with a lost row are left out. std: of white noise, one over the root of the number of pairs.
    """
    grid = _centred(grid)
    lags = _lags(step_s, 0.0, longest_s)
    means, pairs = _products(grid, grid, lags)
    variance = max(means[0], np.finfo(float).tiny) if np.isfinite(means[0]) else np.nan
    return Correlation(lags * step_s, means / variance, 1.0 / np.sqrt(np.maximum(pairs, 1.0)))


class Whiteness(NamedTuple):
    """Sum of squared correlations over what white noise has: 1 for white noise. p: of more by chance."""

    statistic: float
    p: float


def whiteness(correlation: Correlation) -> Whiteness:
    """Return the test of all lags at once; (nan, nan) without any.

    G. Box, D. Pierce, "Distribution of residual autocorrelations", 1970, each lag by its own pairs.
    """
    used = np.isfinite(correlation.values) & (correlation.lags_s > 0.0)
    count = int(used.sum())
    if count == 0:
        return Whiteness(np.nan, np.nan)
    total = float(np.sum((correlation.values[used] / correlation.std[used]) ** 2))
    return Whiteness(total / count, float(stats.chi2.sf(total, count)))


def _std_of_products(first: np.ndarray, later: np.ndarray, pairs: np.ndarray, step_s: float) -> np.ndarray:
    """Return the standard deviation of mean products of independent columns that each hang together.

    M. S. Bartlett, 1946: the sum over lags of the product of both autocovariances, over the pairs.
    """
    reach = _lags(step_s, 0.0, LONGEST_LAG_S)
    both = np.nan_to_num(_products(first, first, reach)[0]) * np.nan_to_num(_products(later, later, reach)[0])
    variance = max(both[0] + 2.0 * both[1:].sum(), both[0])
    return np.sqrt(variance / np.maximum(pairs, 1.0))


def cross_correlation(command: np.ndarray, grid: np.ndarray, step_s: float) -> Correlation:
    """Return how alike a residual is to a command that many seconds before it; columns on slots.

    Negative lags: the residual comes before the command, as where a pilot answers to it.
    """
    command, grid = _centred(command), _centred(grid)
    lags = _lags(step_s, -LONGEST_LAG_S, LONGEST_LAG_S)
    means, pairs = _products(command, grid, lags)
    scale = np.sqrt(np.nanmean(command**2) * np.nanmean(grid**2)) if np.isfinite(means).any() else np.nan
    scale = max(scale, np.finfo(float).tiny)
    std = _std_of_products(command, grid, pairs, step_s) / scale
    return Correlation(lags * step_s, means / scale, std)


def _following(change: np.ndarray, values: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Return what follows the changes, (num_slots,): their sum, each by its values at lags."""
    known = np.convolve(np.where(np.isfinite(change), change, 0.0), values)
    known = np.concatenate([np.zeros(max(int(lags[0]), 0)), known])[max(-int(lags[0]), 0) :]
    return np.pad(known, (0, max(len(change) - len(known), 0)))[: len(change)]


def response(change: np.ndarray, grid: np.ndarray, step_s: float, first_s: float, last_s: float) -> Response:
    """Return what a step of a command by 1 leads to in a residual; columns on slots.

    change: of the command from one slot to the next. Least squares over all changes at once, so that steps
    that follow each other within ``last_s`` are told apart; lightly held at 0, where smooth commands do not
    say. Linear in ``grid``: the responses of two parts of a residual sum up. std: from what is left then.
    """
    grid = _centred(grid)
    lags = _lags(step_s, first_s, last_s)
    means, pairs = _products(change, grid, lags)
    apart = np.arange(len(lags))
    power, _ = _products(change, change, apart)
    if not (np.isfinite(means).all() and np.isfinite(power).all() and power[0] > 0.0):
        return Response(lags * step_s, np.full(len(lags), np.nan), np.full(len(lags), np.nan))
    inverse = np.linalg.inv(linalg.toeplitz(power) + HELD * power[0] * np.eye(len(lags)))
    values = inverse @ means
    noise = _centred(grid - _following(change, values, lags))
    reach = _lags(step_s, -LONGEST_LAG_S, LONGEST_LAG_S)
    of_noise = np.nan_to_num(_products(noise, noise, reach)[0])
    further = np.arange(reach[0], reach[-1] + len(lags))
    of_changes = np.nan_to_num(_products(change, change, further)[0])
    both = np.lib.stride_tricks.sliding_window_view(of_changes, len(reach)) @ of_noise
    scatter = inverse @ linalg.toeplitz(both) @ inverse
    return Response(
        lags * step_s, values, np.sqrt(np.maximum(np.diag(scatter), 0.0) / np.maximum(pairs, 1.0))
    )
