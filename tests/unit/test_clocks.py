"""Offsets between sensors' clocks: found, corrected, and never made of the plant's lag."""

import numpy as np

from flytrack_sysid import FlightLog, clocks
from tests.support.made_flight import TIME_S, flight, noisy


def test_clock_offsets_between_sensors_are_found_and_corrected(truth):
    late_s = (0.023, -0.012, 0.031)
    aligned, found = clocks.align_clocks(noisy(flight(TIME_S, *late_s), seed=1))
    assert [(one.channel, one.reference) for one in found] == [("q", "w"), ("v", "f"), ("p", "v")]
    for one, expected in zip(found, late_s, strict=True):
        assert abs(one.offset_s - expected) < 4.0 * one.sigma_s + 1e-4, one.describe()
        assert one.sigma_s < 1.5e-3 and one.verdict == "corrected"
    rows = np.searchsorted(TIME_S, aligned.time - 1e-6)
    for name, bound in (("q", 0.004), ("v", 0.03), ("p", 0.008)):
        assert np.sqrt(np.mean((aligned[name] - truth[name][rows]) ** 2)) < bound, name


def test_outliers_do_not_move_an_offset(truth):
    log = noisy(flight(TIME_S, 0.023), seed=1)
    rng = np.random.default_rng(3)
    for name, size in (("q", 0.2), ("w", 5.0)):
        rows = rng.choice(len(log), 20, replace=False)
        log[name][rows] += size * rng.standard_normal((20, log[name].shape[1]))
    log["q"][:] /= np.linalg.norm(log["q"], axis=1, keepdims=True)
    found = clocks.align_clocks(log)[1][0]
    assert abs(found.offset_s - 0.023) < 4.0 * found.sigma_s and found.sigma_s < 1.5e-3


def test_standard_errors_are_those_of_other_draws_of_the_noise(truth):
    found = [one for seed in range(4) for one in clocks.align_clocks(noisy(truth, seed))[1]]
    scores = np.array([one.offset_s / one.sigma_s for one in found])
    assert len(scores) == 12 and 0.5 < scores.std() < 1.6 and np.mean(np.abs(scores) > 3.0) < 0.1


def test_clocks_that_agree_are_left_and_lag_of_the_plant_is_no_offset(truth):
    later = FlightLog(truth.time, {**truth.channels, "u": np.roll(truth["u"], 20, axis=0)}, truth.segment)
    aligned, found = clocks.align_clocks(truth)
    assert all(one.verdict == "not significant, left" and abs(one.offset_s) < 1e-3 for one in found)
    np.testing.assert_array_equal(aligned["q"], truth["q"])
    assert clocks.align_clocks(later)[1] == found


def test_clocks_of_a_drone_at_rest_or_too_short_are_not_compared(truth):
    rest = FlightLog(truth.time, {**truth.channels, "w": 0.0 * truth["w"] + 0.1}, truth.segment)
    assert "not compared: correlation" in clocks.align_clocks(rest)[1][0].verdict
    short = clocks.align_clocks(truth.select(slice(500)))[1]
    assert [one.verdict for one in short] == ["not compared: less than 10 s without a gap"] * 3
