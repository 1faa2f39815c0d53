"""Validation finds no error in the truth, and puts other models' errors where they belong."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytrack_env.dynamics import nominal_parameters
from flytrack_env.effects import CommandDelay, QuadraticDrag
from flytrack_env.state import STATE_SIZE, unpack
from flytrack_sysid.inference.free_flight import QUANTITIES
from flytrack_sysid.inference.one_step import columns, predict
from flytrack_sysid.inference.record import MAX_DOUBT, fill_gaps
from flytrack_sysid.log import log_of_states
from flytrack_sysid.sensors import specific_force_b
from flytrack_sysid.split import held_out_rows
from flytrack_sysid.steps import MAX_PER_AXIS
from flytrack_sysid.validate import validate
from flytrack_sysid.validation_report import text_of
from tests.support.simulated_flights import fly as simulated

DT = 0.01
NUM_ROWS = 300
HOVER = -0.25
TRUTH = nominal_parameters()._replace(tau=np.array([0.02, 0.03, 0.06, 0.045], np.float32))


def scripts():
    """Return starts (5, 21) and commands (5, num_rows, 4): stick steps, thrust, fast flight."""
    time = np.arange(NUM_ROWS) * DT
    commands = np.zeros((5, NUM_ROWS, 4))
    commands[..., 3] = HOVER + 0.02 * np.sin(5.0 * time)
    for axis in range(3):
        for at, value in ((0.8, 0.4), (1.0, -0.4), (1.2, 0.0), (1.8, 0.1 * (axis + 2)), (2.1, 0.0)):
            commands[axis, time >= at, axis] = value
    commands[3, :, 3] = np.sin(7.0 * time)
    commands[4, :, 0] = 0.1 * np.sin(9.0 * time)
    starts = np.zeros((5, 21))
    starts[:, 2], starts[:, 9], starts[:, 19] = 50.0, 1.0, HOVER
    starts[:, 20] = [23.9, 22.1, 23.0, 23.4, 22.6]
    starts[4, 3:6], starts[2, 3] = (12.0, 3.0, 0.5), 4.0
    return starts, commands


def fly(truth):
    """Return the log of the script's flights on a model, in float64."""
    flights = []
    with jax.enable_x64(True):
        for start, commands in zip(*scripts(), strict=True):
            # No Python float: beside a model of float32 it would be one, too.
            rows = simulated(unpack(jnp.asarray(start)), commands, truth, np.float64(DT))
            flights.append((np.concatenate([start[None], rows[:-1, :STATE_SIZE]]), commands))
    return log_of_states(flights, DT, "test.npz")


@pytest.fixture(scope="module")
def log():
    return fly(TRUTH)


@pytest.fixture(scope="module")
def exact(log):
    return validate(TRUTH, log)


def nrmse(validation):
    """Return the NRMSE of every judged channel."""
    return {name: error.nrmse for name, error in validation.one_step.channels.items()}


def test_truth_has_no_error(exact):
    assert set(exact.one_step.channels) == {"p", "v", "q", "w", "a"}
    assert max(nrmse(exact).values()) < 1e-6
    assert exact.one_step.channels["q"].angle_rms_deg < 1e-6
    assert [rollout.num_starts for rollout in exact.rollouts] == [60, 55, 50, 40, 20]
    for rollout in exact.rollouts:
        assert max(spread.p95 for spread in rollout.errors.values()) < 1e-5
    assert exact.thrust.total_rms_n < 1e-5
    assert max(step.rms for step in exact.steps) < 1e-5
    assert exact.notes == ()


def test_the_largest_steps_are_found(exact):
    for segment, axis in enumerate(("roll", "pitch", "yaw")):
        steps = [step for step in exact.steps if step.axis == axis]
        first = steps[0]
        assert len(steps) == MAX_PER_AXIS and first.segment == segment
        assert (first.command_before, first.command_after) == (0.4, -0.4)
        assert first.time_s == pytest.approx(1.0)
        assert first.since_step[[0, -1]] == pytest.approx([-0.09, 0.4])


def test_wrong_lag_shows_in_rates_and_steps_only_of_its_axis(log):
    slow = validate(TRUTH._replace(tau=np.array([0.02, 0.06, 0.06, 0.045])), log)
    by_axis = slow.one_step.channels["w"].mse_by_axis
    assert by_axis[1] > 1e-3 and max(by_axis[0], by_axis[2]) < 1e-9
    assert {step.axis for step in slow.steps if step.rms > 0.1} == {"pitch"}
    assert slow.thrust.total_rms_n < 1e-5
    assert slow.rollouts[2].errors["attitude"].p95 > 0.5


def test_wrong_thrust_shows_in_the_map_by_its_formula(log):
    coeffs = TRUTH.thrust_coeffs + np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.1])
    wrong = validate(TRUTH._replace(thrust_coeffs=coeffs), log)
    swept = np.flatnonzero(np.all(wrong.thrust.count > 0, axis=1))
    assert len(swept) == 1 and wrong.thrust.count.sum() == wrong.one_step.num_steps
    middles = 0.5 * (wrong.thrust.action_edges[1:] + wrong.thrust.action_edges[:-1])
    expected = -0.5 - 0.1 * 23.4 * middles
    np.testing.assert_allclose(wrong.thrust.mean_n[swept[0]], expected, atol=0.1)
    assert wrong.one_step.channels["w"].mse < 1e-9
    assert np.isnan(wrong.thrust.mean_n).any() and wrong.as_json()["thrust"]["mean_n"][0][0] is None


@pytest.mark.slow
def test_delay_is_flown_with_its_memory():
    delayed = TRUTH.with_effects(CommandDelay(0.024))
    log = fly(delayed)
    for known in (validate(delayed, log), validate(delayed, log.without("uprev"))):
        assert max(nrmse(known).values()) < 1e-6
        assert max(step.rms for step in known.steps) < 1e-5
        assert max(known.rollouts[3].errors[name].p95 for name in QUANTITIES) < 1e-5
    missing = validate(TRUTH, log)
    assert min(step.rms for step in missing.steps) > 0.05


def test_thrust_is_measured_with_an_accelerometer_without_an_acceleration(exact, log):
    channels = {**log.without("a").channels, "f": specific_force_b(log, TRUTH.g)}
    measured = replace(log, channels=channels)
    same = validate(TRUTH, measured)
    assert (exact.thrust.source, same.thrust.source) == ("a", "f")
    assert same.thrust.total_rms_n < 1e-5
    assert set(same.one_step.channels) == {"p", "v", "q", "w", "f"}


def test_without_voltage_a_middle_one_is_assumed(log):
    bare = validate(TRUTH, log.without("v_bat"))
    assert any("is taken as flown at 23 V, the middle of the model" in note for note in bare.notes)
    assert 1e-3 < nrmse(bare)["a"] < 0.2 and nrmse(bare)["w"] < 1e-6 and bare.thrust is None


def test_applied_action_is_recovered_from_commands(log):
    bare = log.without("uprev")
    prediction = predict(TRUTH, fill_gaps(bare))
    applied = columns(prediction.before.applied)
    is_settled = prediction.is_settled
    np.testing.assert_allclose(applied[is_settled], log["uprev"][is_settled], atol=2 * MAX_DOUBT)
    # exp(-t / slowest lag) of what the applied action may have been is left.
    longest = np.log(1 / MAX_DOUBT) * np.max(TRUTH.tau)
    assert np.sum(~is_settled) == 5 * np.ceil(longest / DT)
    validation = validate(TRUTH, bare)
    assert validation.one_step.num_steps == np.sum(is_settled) - 5
    assert max(nrmse(validation).values()) < 1e-2
    assert any(note.startswith("applied action (uprev)") for note in validation.notes)


def test_only_the_chosen_rows_are_judged(log):
    rows = held_out_rows(log)
    rows[320:400] = True  # a piece with rows that are not judged on both sides
    damaged = {name: values.copy() for name, values in log.channels.items()}
    for name in ("p", "v", "w", "a"):
        damaged[name][~rows] += 100.0
    validation = validate(TRUTH, replace(log, channels=damaged), rows)
    assert validation.num_judged == rows.sum() < len(log) and validation.one_step.num_steps > 100
    assert max(nrmse(validation).values()) < 1e-6
    nothing = validate(TRUTH, log, np.zeros(len(log), bool))
    assert nothing.one_step.channels == {} and nothing.thrust is None and nothing.steps == ()
    with pytest.raises(ValueError, match="rows: found int64"):
        validate(TRUTH, log, np.flatnonzero(rows))


@pytest.mark.slow
def test_model_that_runs_away_is_still_reported(log):
    absurd = validate(TRUTH.with_effects(QuadraticDrag(-400.0, -400.0, -400.0)), log)
    assert not np.isfinite(absurd.rollouts[-1].errors["position"].rms)
    numbers = json.loads(json.dumps(absurd.as_json(), allow_nan=False))
    assert numbers["rollouts"][-1]["position_m"]["rms"] is None
    assert "diverges" in text_of(absurd, "absurd.json", log)
