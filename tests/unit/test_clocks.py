"""Clocks of sensors and commands: offsets are found and corrected; the plant's lag is not one."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from benchmarks.diagnosis import model_of
from benchmarks.hidden import fly, measure
from benchmarks.scaling import draw_craft
from flytrack_env.motion import Motion
from flytrack_sysid import clocks, sensors
from flytrack_sysid.clocks import on_one_clock, with_causal_commands
from flytrack_sysid.diagnosis.motion_choice import MotionEstimate, estimate_motion
from flytrack_sysid.split import held_out_rows
from tests.support.handout_plant import GRAVITY, HandoutPlant, excited
from tests.support.hidden_flights import scripted
from tests.support.made_flight import TIME_S, flight, noisy
from tests.support.written_logs import with_channels


def flight_of_fleet(number, mocap_late_s=0.0):
    """Return plant and log of a flight of craft03 of docs/results/scaling.md."""
    truth, _ = draw_craft(np.random.default_rng([61, 3]), False)
    truth, rng = replace(truth, mocap_late_s=mocap_late_s), np.random.default_rng([61, 3, number])
    return truth, measure(fly(truth, 20.0, rng), "sensors", rng)


def rms(errors):
    return float(np.sqrt(np.mean(errors**2)))


def test_clock_offsets_between_sensors_are_found_and_corrected(truth):
    late_s = (0.023, -0.012, 0.031)
    aligned, offsets = clocks.align_clocks(noisy(flight(TIME_S, *late_s), seed=1))
    pairs = [(offset.channel, offset.reference) for offset in offsets]
    assert pairs == [("q", "w"), ("v", "f"), ("p", "v")]
    for offset, expected in zip(offsets, late_s, strict=True):
        assert abs(offset.offset_s - expected) < 4.0 * offset.sigma_s + 1e-4, offset.describe()
        assert offset.sigma_s < 1.5e-3 and offset.verdict == "corrected"
    rows = np.searchsorted(TIME_S, aligned.time - 1e-6)
    for name, bound in (("q", 0.004), ("v", 0.03), ("p", 0.008)):
        assert rms(aligned[name] - truth[name][rows]) < bound, name


def test_outliers_do_not_move_an_offset(truth):
    log = noisy(flight(TIME_S, 0.023), seed=1)
    rng = np.random.default_rng(3)
    for name, size in (("q", 0.2), ("w", 5.0)):
        rows = rng.choice(len(log), 20, replace=False)
        log[name][rows] += size * rng.standard_normal((20, log[name].shape[1]))
    log["q"][:] /= np.linalg.norm(log["q"], axis=1, keepdims=True)
    offset = clocks.align_clocks(log)[1][0]
    assert abs(offset.offset_s - 0.023) < 4.0 * offset.sigma_s and offset.sigma_s < 1.5e-3


def test_standard_errors_are_those_of_other_draws_of_the_noise(truth):
    scores = []
    for seed in range(4):
        for offset in clocks.align_clocks(noisy(truth, seed))[1]:
            scores.append(offset.offset_s / offset.sigma_s)
    scores = np.array(scores)
    assert len(scores) == 12 and 0.5 < scores.std() < 1.6 and np.mean(np.abs(scores) > 3.0) < 0.1


def test_clocks_that_agree_are_left_and_lag_of_the_plant_is_no_offset(truth):
    later = with_channels(truth, u=np.roll(truth["u"], 20, axis=0))
    aligned, offsets = clocks.align_clocks(truth)
    assert {offset.verdict for offset in offsets} == {"not significant, left"}
    assert max(abs(offset.offset_s) for offset in offsets) < 1e-3
    np.testing.assert_array_equal(aligned["q"], truth["q"])
    assert clocks.align_clocks(later)[1] == offsets


def test_clocks_of_a_drone_at_rest_or_too_short_are_not_compared(truth):
    rest = with_channels(truth, w=0.0 * truth["w"] + 0.1)
    assert clocks.align_clocks(rest)[1][0].verdict.startswith("offset unknown: correlation")
    short = clocks.align_clocks(truth.select(slice(500)))[1]
    assert [one.verdict for one in short] == ["not compared: less than 10 s without a gap"] * 3


def test_noise_of_the_accelerometer_is_no_late_clock():
    """In 20 s of calm flight it moved velocity by 19 ms and position by 23 ms."""
    log = flight_of_fleet(12)[1]
    assert on_one_clock(log)[2] == []


LATE_S = 0.013
SECONDS, POSE_LATE_S = 40.0, 0.024  # of a hidden plant


def test_velocity_and_position_come_on_the_clock_of_the_attitude():
    truth = flight(TIME_S, LATE_S, LATE_S, LATE_S)
    for late_s in (0.0, 0.02):
        logged = noisy(flight(TIME_S, LATE_S, LATE_S + late_s, LATE_S + late_s), seed=1)
        log, is_kept, notes = on_one_clock(logged)
        assert len(log) == is_kept.sum() and len(notes) == 2 * (late_s > 0.0), notes
        for name, bound in (("v", 0.03), ("p", 0.01)):
            assert rms(log[name] - truth[name][is_kept]) < bound, name


def test_commands_stamped_after_the_turns_they_cause_are_put_before_them():
    plant = HandoutPlant()
    truth = sensors.measure(excited(plant), 1.0, GRAVITY, np.random.default_rng(2))
    for rows in (0, 3, 20):  # of which 3 are less than the plant's lag
        starts = np.cumsum(truth.is_start())
        source = np.maximum(np.arange(len(truth)) - rows, np.searchsorted(starts, starts))
        late = with_channels(truth, u=truth["u"][source])
        log, is_kept, notes = with_causal_commands(late, plant.model())
        assert len(log) == is_kept.sum() and len(notes) == (rows == 20)
        if notes:
            assert "the clock of the commands was about" in notes[0]
            shifted = [np.roll(truth["u"], -by, axis=0)[is_kept] for by in range(-4, 5)]
            errors = [np.abs(log["u"] - commands).mean() for commands in shifted]
            assert min(errors) < 0.1 * np.abs(log["u"]).mean()


def test_lateness_is_found_where_there_is_one():
    def found(late_s):
        truth, log = scripted(3, SECONDS, mocap_late_s=late_s)
        with jax.enable_x64(True):
            return estimate_motion(log, model_of(truth), np.ones(len(log), bool), Motion.EULER)

    late = found(POSE_LATE_S)
    assert 0.0 < late.sigma_s < 1e-3 and abs(late.late_s - POSE_LATE_S) < 4.0 * late.sigma_s
    assert found(0.0) == MotionEstimate(Motion.EULER, is_sure=True)


@pytest.mark.slow
def test_a_drone_on_time_is_no_simulator_however_little_the_model_explains():
    """Commands unrelated to the motion stand for a rate loop that the model lacks."""
    log = noisy(flight(TIME_S), seed=1)
    with jax.enable_x64(True):
        assert estimate_motion(
            log, HandoutPlant().model(), np.ones(len(log), bool)
        ) == MotionEstimate(Motion.CONTINUOUS)


@pytest.mark.slow
@pytest.mark.parametrize("late_s", [0.0, 0.0035])
def test_offset_within_its_errors_decides_nothing(late_s):
    """The offset of 20 s seems to be -1.7 ms, two standard errors, and lateness adds to it."""
    truth, log = flight_of_fleet(14, late_s)
    with jax.enable_x64(True):
        estimate = estimate_motion(log, model_of(truth), ~held_out_rows(log))
    assert estimate.motion is Motion.CONTINUOUS
    assert abs(estimate.late_s - late_s) <= 3.0 * estimate.sigma_s
