"""Intervals of parameters from information and from what seconds of a log say of each."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from flytrack_sysid.diagnosis.model_selection import Marginal
from flytrack_sysid.diagnosis.score_test import Linearization

BLOCKS, FREE = 45, ("given", "first", "second")


def half_widths(scores: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Return half widths of intervals, of scores of seconds (BLOCKS, 3) and information along parameters."""
    seen = object.__new__(Linearization)
    seen.places, seen.total, seen.score_by_block = [0, 1, 2], information, scores
    seen.problem = SimpleNamespace(names=FREE)
    return Marginal(seen, SimpleNamespace(places=(0, 1, 2)), FREE[1:]).half_widths()


@pytest.fixture
def information() -> np.ndarray:
    root = np.random.default_rng(1).normal(size=(3, 3))
    return 100.0 * (root @ root.T + np.eye(3))


def test_residuals_as_the_noise_says_give_the_widths_of_the_information(information):
    scores = np.random.default_rng(2).multivariate_normal(np.zeros(3), 0.25 * information / BLOCKS, BLOCKS)
    expected = stats.t.ppf(0.975, BLOCKS - 1) * np.sqrt(np.diag(np.linalg.inv(information))[1:])
    np.testing.assert_allclose(half_widths(scores, information), expected, rtol=1e-6)


def test_a_parameter_of_which_seconds_disagree_is_wider_and_no_other():
    information = 100.0 * np.eye(3)
    scores = np.random.default_rng(3).normal(size=(BLOCKS, 3)) * np.sqrt(100.0 / BLOCKS) * [0.5, 3.0, 0.5]
    first, second = half_widths(scores, information) / half_widths(0.1 * scores, information)
    assert first == pytest.approx(3.0, rel=0.25)
    assert second == pytest.approx(1.0, rel=1e-6)


def test_widths_cover_when_all_parameters_are_noisier_than_said(information):
    rng, truth = np.random.default_rng(4), 0
    for _ in range(300):
        scores = rng.multivariate_normal(np.zeros(3), 4.0 * information / BLOCKS, BLOCKS)
        error = np.linalg.solve(information, scores.sum(axis=0))[1:]
        truth += np.sum(np.abs(error) < half_widths(scores, information))
    assert truth / 600 == pytest.approx(0.95, abs=0.03)
