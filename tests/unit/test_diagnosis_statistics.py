"""Correlations and intervals that allow for lost rows, and for rows that are correlated."""

import numpy as np
import pytest
from scipy import signal

from flytrack_sysid.diagnosis.statistics import (
    BANDS,
    autocorrelation,
    bin_edges,
    binned_means,
    on_slots,
    step_response,
)
from flytrack_sysid.diagnosis.traces import BETWEEN_FLIGHTS

DT_S = 0.01


def rows_of(num_rows: int, lost: float, rng) -> tuple[np.ndarray, np.ndarray]:
    """Return slots of rows of two flights with some lost, and which of an even series they are."""
    kept = np.flatnonzero(rng.random(num_rows) >= lost)
    return kept + np.where(kept < num_rows // 2, 0, BETWEEN_FLIGHTS), kept


@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_white_noise_is_white(lost):
    rng = np.random.default_rng(1)
    slot, kept = rows_of(6000, lost, rng)
    counts = rng.random(len(kept)) < 0.95
    grid = on_slots(0.3 + rng.standard_normal(6000)[kept], slot, counts)
    found = autocorrelation(grid, DT_S)
    assert found.values[0] == pytest.approx(1.0) and found.lags_s[-1] == pytest.approx(0.5)
    assert np.mean(np.abs(found.values[1:]) > BANDS[99] * found.std[1:]) < 0.06


@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_correlated_noise_is_not_white(lost):
    rng = np.random.default_rng(2)
    slot, kept = rows_of(6000, lost, rng)
    series = signal.lfilter([1.0], [1.0, -0.6], rng.standard_normal(6000))
    found = autocorrelation(on_slots(series[kept], slot, np.ones(len(kept), bool)), DT_S)
    np.testing.assert_allclose(found.values[1:5], 0.6 ** np.arange(1, 5), atol=0.06)
    assert np.all(found.values[1:5] > BANDS[99] * found.std[1:5])


def test_response_tells_overlapping_steps_apart():
    rng = np.random.default_rng(4)
    change = np.where(rng.random(6000) < 0.1, rng.standard_normal(6000), 0.0)
    change = np.convolve(change, [1.0, -0.8])[: len(change)]  # every step is soon taken back
    kernel = np.array([0.0, -3.0, -2.0, -1.0, -0.5])
    grid = np.convolve(change, kernel)[: len(change)] + 0.3 * rng.standard_normal(len(change))
    grid[rng.random(len(grid)) < 0.02] = np.nan
    found = step_response(change, grid, DT_S, -0.05, 0.3)
    expected = np.zeros(len(found.lags_s))
    expected[5:10] = kernel
    np.testing.assert_allclose(found.values, expected, atol=0.25)
    inside = np.abs(found.values - expected) < 3.0 * found.std
    assert inside.mean() > 0.8 and found.std.max() < 0.2


def test_intervals_of_bins_allow_for_correlated_rows():
    rng = np.random.default_rng(7)
    block = np.repeat(np.arange(200), 50)
    values = np.repeat(rng.standard_normal(200), 50) + rng.standard_normal(10_000)
    regressor = rng.random(10_000)
    edges = bin_edges(regressor)
    found = binned_means(regressor, values, block, edges)
    alone = binned_means(regressor, values, np.arange(10_000), edges)
    assert len(found.at) == 15 and np.all(found.ends95 > 1.3 * alone.ends95)
    np.testing.assert_allclose(alone.ends95, 1.96 * np.sqrt(2.0 / (10_000 / 15)), rtol=0.25)


def test_bins_with_few_rows_are_joined():
    regressor = np.concatenate([np.linspace(-0.1, 0.1, 2000), np.linspace(0.1, 1.0, 60)])
    rows = np.histogram(regressor, bin_edges(regressor))[0]
    assert len(rows) > 3 and rows.min() >= 20
