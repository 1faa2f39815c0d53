"""Step responses from overlapping steps, and intervals that allow for correlated rows."""

import numpy as np

from flytrack_sysid.diagnosis.statistics import (
    bin_edges,
    binned_means,
    step_response,
)

DT_S = 0.01


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
