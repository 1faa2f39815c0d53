"""When a gain on held-out rows takes a cause back."""

import numpy as np
import pytest

from flytrack_sysid.diagnosis.causes import SHOWN, is_contradicted


@pytest.mark.parametrize(
    ("share", "contradicted"), [(1.0, False), (0.5, False), (0.2, True), (0.0, True), (-1.0, True)]
)
def test_what_is_hardly_there_is_taken_back(share, contradicted):
    expected = 1000.0  # the gain of a cause of which a share is there: 2 share - 1 of it
    assert is_contradicted((2.0 * share - 1.0) * expected, expected, inflation=1.0) == contradicted


def test_rows_that_would_not_show_it_say_nothing():
    assert not is_contradicted(-100.0, 0.9 * SHOWN, inflation=1.0)
    assert not is_contradicted(-100.0, 1.5 * SHOWN, inflation=2.0)


def test_true_causes_are_kept_in_noise():
    rng, expected = np.random.default_rng(5), 60.0
    gains = expected + 2.0 * np.sqrt(expected) * rng.standard_normal(10_000)
    assert not any(is_contradicted(gain, expected, inflation=1.0) for gain in gains)
