"""Intervals of parameters hold the truth as often as they say, from what seconds of a log say of each."""

from types import SimpleNamespace

import numpy as np
import pytest

from flytrack_sysid.diagnosis.model_selection import Marginal
from flytrack_sysid.diagnosis.score_test import Linearization

BLOCKS, FREE = 45, ("given", "first", "second")


def half_widths(scores: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Return half widths of intervals, of scores of seconds (BLOCKS, 3) and information along parameters."""
    seen = object.__new__(Linearization)
    seen.places, seen.total, seen.score_by_block = [0, 1, 2], information, scores
    seen.problem = SimpleNamespace(names=FREE)
    return Marginal(seen, SimpleNamespace(places=(0, 1, 2)), FREE[1:]).half_widths()


def test_widths_cover_when_all_parameters_are_noisier_than_said():
    rng, truth, root = np.random.default_rng(4), 0, np.random.default_rng(1).normal(size=(3, 3))
    information = 100.0 * (root @ root.T + np.eye(3))
    for _ in range(300):
        scores = rng.multivariate_normal(np.zeros(3), 4.0 * information / BLOCKS, BLOCKS)
        error = np.linalg.solve(information, scores.sum(axis=0))[1:]
        truth += np.sum(np.abs(error) < half_widths(scores, information))
    assert truth / 600 == pytest.approx(0.95, abs=0.03)
