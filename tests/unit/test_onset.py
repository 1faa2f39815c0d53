"""Statistics of a diagnosis on made-up scores: onsets and ends within a log, and intervals."""

from types import SimpleNamespace

import numpy as np
import pytest

from flytrack_sysid.diagnosis.model_selection import Marginal
from flytrack_sysid.diagnosis.onset import is_one_flight, windowed_gains
from flytrack_sysid.inference.score_test import Linearization, change_threshold
from flytrack_sysid.log import FlightLog

BLOCKS, TRIMMED = 60, 0.1
GIVEN, OWN = [0, 1], [2, 3]
AFTER = (np.arange(BLOCKS) >= np.arange(6, 55)[:, None]).astype(
    float
)  # a tenth is left on each side


def scores(rng):
    """Return scores and information of blocks with four columns."""
    slopes = rng.standard_normal((BLOCKS, 30, 4)) @ np.array(
        [[1.0, 0.3, 0.5, 0.0], [0.0, 1.0, 0.0, 0.4], [0.0, 0.0, 1.0, 0.2], [0.0, 0.0, 0.0, 1.0]]
    )
    left = rng.standard_normal((BLOCKS, 30))
    return np.einsum("brc,br->bc", slopes, left), np.swapaxes(slopes, 1, 2) @ slopes


def test_changes_are_found_by_chance_as_rarely_as_the_threshold_says():
    rng = np.random.default_rng(1)
    largest = np.array(
        [windowed_gains(*scores(rng), GIVEN, OWN, AFTER)[0].max() for _ in range(600)]
    )
    share = np.mean(largest > change_threshold(len(OWN), TRIMMED, chance=0.05))
    assert 0.015 < share < 0.07  # the tail is that of a change at any instant, not at whole seconds
    assert change_threshold(1) > 20.0 and change_threshold(3) > change_threshold(1)


def test_a_slow_drift_gains_more_as_a_drift_than_as_a_step():
    rng = np.random.default_rng(3)
    score, information = scores(rng)
    ramp = np.arange(BLOCKS) / BLOCKS
    score += information[:, 2] * ramp[:, None]
    gains, steps = windowed_gains(
        score, information, [0, 1, 2], [2], np.concatenate([AFTER, ramp[None]])
    )
    assert gains[-1] > gains[:-1].max()
    assert steps[-1, 0] == pytest.approx(1.0, abs=0.3)


def test_only_logs_of_one_clock_can_show_when():
    channels = {"u": np.zeros((4, 4))}
    for time, expected in (([0.0, 1.0, 5.0, 6.0], True), ([0.0, 1.0, 0.0, 1.0], False)):
        assert (
            is_one_flight(FlightLog(np.array(time), channels, np.array([0, 0, 1, 1]))) is expected
        )


FREE = ("given", "first", "second")


def half_widths(scores, by_block):
    """Return half widths of intervals from scores (BLOCKS, 3) and information of seconds."""
    seen = object.__new__(Linearization)
    seen.indices, seen.score_by_block, seen.by_block = [0, 1, 2], scores, by_block
    seen.total = by_block.sum(axis=0)
    seen.problem = SimpleNamespace(names=FREE)
    return Marginal(seen, SimpleNamespace(indices=(0, 1, 2)), FREE[1:]).half_widths()


@pytest.mark.parametrize("busy", [BLOCKS, 4])
def test_widths_cover_when_all_parameters_are_noisier_than_said(busy):
    """Also where a few seconds tell nearly all that the log tells."""
    rng, truth, root = np.random.default_rng(4), 0, np.random.default_rng(1).normal(size=(3, 3))
    information = 100.0 * (root @ root.T + np.eye(3))
    share = np.where(np.arange(BLOCKS) < busy, 1.0, 0.01)
    share /= share.sum()
    draws = rng.multivariate_normal(np.zeros(3), 4.0 * information, (300, BLOCKS))
    for scores in draws * np.sqrt(share)[:, None]:
        error = np.linalg.solve(information, scores.sum(axis=0))[1:]
        at_fit = scores - share[:, None] * scores.sum(axis=0)
        truth += np.sum(np.abs(error) < half_widths(at_fit, share[:, None, None] * information))
    assert truth / 600 == pytest.approx(0.95, abs=0.03)
