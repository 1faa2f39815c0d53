"""Parts of the diagnosis: its noise filter, its lanes, and what it does with logs that say too little."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.diagnosis import model_of
from benchmarks.hidden import draw_base, fly, measure
from flytrack_env.effects import CommandDelay, LinearDrag, SecondOrderRates
from flytrack_env.effects.command_delay import LONGEST_STEPS
from flytrack_sysid.diagnosis import DiagnosisError, diagnose, joined
from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.diagnose import unused_channels
from flytrack_sysid.diagnosis.lanes import LANE_S, LEAD_IN_S, NUM_AXES, make_lanes
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.report import verdict_of
from flytrack_sysid.diagnosis.search import SearchState
from flytrack_sysid.parameters import DRAIN
from flytrack_sysid.record import make_record
from flytrack_sysid.residuals import predict_rows

SECONDS, DT_S = 40.0, 0.01
RATE = 100  # rows a second
BATTERY = NUM_AXES - 1  # it has no direct channel
# Of the sensors, rad/s, m/s^2, rad, m/s, V; and of gusts that shake both sides.
DIRECT = np.repeat([0.1, 1.5, 1.0], [3, 3, 1])
LEVEL = np.repeat([0.01, 0.05, 0.01], [3, 3, 1])
DISTURBANCE = np.repeat([0.1, 1.5, 1e-3], [3, 3, 1])
WANDER, TAU_S = 0.1 * LEVEL, 0.3


@pytest.fixture(scope="module")
def flown():
    """A hidden plant without effects, and what its sensors log."""
    rng = np.random.default_rng(3)
    truth = draw_base(rng)
    return truth, measure(fly(truth, "scripted", SECONDS, rng), "sensors", rng)


@pytest.fixture(scope="module")
def lanes(flown):
    """All rows of that log."""
    truth, log = flown
    return make_lanes(log, np.ones(len(log), bool), np.array(truth.tau), truth.gravity)


@pytest.fixture(scope="module")
def disturbed(lanes):
    """Residuals of white sensors and a disturbance that the drone feels, (rows, lanes, NUM_AXES, 2)."""
    rng, keep = np.random.default_rng(4), np.exp(-DT_S / TAU_S)
    count = 1 + int(lanes.row.max())
    fresh = rng.standard_normal((count, NUM_AXES))
    acting = [fresh[0]]
    for row in fresh[1:]:
        acting.append(keep * acting[-1] + np.sqrt(1.0 - keep**2) * row)
    acting = DISTURBANCE * np.array(acting)
    walk = WANDER * np.sqrt(DT_S) * rng.standard_normal((count, NUM_AXES))
    level = np.cumsum(acting * DT_S + walk, axis=0) + LEVEL * rng.standard_normal((count, NUM_AXES))
    direct = acting + DIRECT * rng.standard_normal((count, NUM_AXES))
    series = np.stack([direct, np.diff(level, axis=0, prepend=level[:1])], axis=-1)
    return series[lanes.row] * lanes.is_joined[..., None, None]


def true_noise() -> noises.Noise:
    """Return the noise that those residuals have."""
    ones = np.ones(NUM_AXES)
    return noises.Noise(DIRECT, LEVEL, WANDER, DISTURBANCE, TAU_S * ones, ones)


def whitened(lanes, left, noise: noises.Noise) -> np.ndarray:
    """Return innovations; not a number where nothing counts."""
    with jax.enable_x64(True):
        gains = noises.make_gains(noise, noises.step_to(lanes), lanes.is_known, lanes.counts)
        found = np.array(noises.innovations(gains, left, lanes.counts))
    found[~lanes.counts] = np.nan
    return found


def correlation(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the mean product over rows and lanes where both are there; 0 where none are."""
    product = first * second
    return np.nansum(product, axis=(0, 1)) / np.maximum(np.isfinite(product).sum(axis=(0, 1)), 1)


def test_innovations_are_white_and_of_variance_one(lanes, disturbed):
    found = whitened(lanes, disturbed, true_noise())
    counting = lanes.counts.any(axis=(0, 1))
    assert counting.sum() == 2 * NUM_AXES - 1
    sigmas = 5.0 / np.sqrt(lanes.counts.sum(axis=(0, 1))[counting])
    assert np.all(np.abs(correlation(found, found)[counting] - 1.0) < np.sqrt(2.0) * sigmas)
    for lag in (1, 2, 10):
        assert np.all(np.abs(correlation(found[lag:], found[:-lag])[counting]) < sigmas)
    assert np.all(np.abs(correlation(found[..., 0], found[..., 1])[:BATTERY]) < sigmas[0])


def test_the_noise_of_residuals_is_found_again(lanes, disturbed):
    with jax.enable_x64(True):
        found = jax.tree.map(np.asarray, noises.noise_of(noises.fit_noise(lanes, disturbed)))
    moving = slice(0, BATTERY)
    np.testing.assert_allclose(found.direct[moving], DIRECT[moving], rtol=0.08)
    np.testing.assert_allclose(found.level, LEVEL, rtol=0.15)
    np.testing.assert_allclose(found.disturbance[moving], DISTURBANCE[moving], rtol=0.3)
    np.testing.assert_allclose(np.log(found.tau[moving] / TAU_S), 0.0, atol=np.log(2.0))
    assert np.all(found.coupling[moving] > 0.6)


def test_lanes_hold_every_row_once_behind_what_leads_in(flown, lanes):
    _, log = flown
    record = make_record(log)
    own = lanes.row[LEAD_IN_S * RATE :].T.ravel()
    np.testing.assert_array_equal(own[own >= 0], np.arange(1 + np.flatnonzero(record.source_row >= 0)[-1]))
    np.testing.assert_array_equal(lanes.row[: LEAD_IN_S * RATE, 1:], lanes.row[LANE_S * RATE :, :-1])
    assert not lanes.counts[: LEAD_IN_S * RATE].any()
    measured = np.append(record.source_row, -1)[lanes.row] >= 0
    assert (
        not lanes.counts[~measured].any() and lanes.counts[measured & (lanes.row > 0)][:, 0, 1].mean() > 0.4
    )


def test_lanes_are_only_where_something_is_judged(flown):
    truth, log = flown
    judged = (log.time > 7.0) & (log.time < 19.0) | (log.time > 33.0)
    lanes = make_lanes(log, judged, np.array(truth.tau), truth.gravity)
    own, lead_in = lanes.row[LEAD_IN_S * RATE :], lanes.row[: LEAD_IN_S * RATE]
    rows = own[own >= 0]
    assert len(np.unique(rows)) == len(rows)
    record = make_record(log)
    source = record.source_row
    wanted = np.flatnonzero((source >= 0) & judged[source])
    assert np.isin(wanted, rows).all()
    counting = own[lanes.counts[LEAD_IN_S * RATE :].any(axis=(2, 3))]
    assert np.isin(counting, wanted).all()
    assert own.shape[1] == 6  # 12 s and 7 s, in stretches of five, and one that fills up
    assert (np.diff(lead_in[:, :5], axis=0) == 1).all()  # flown for real, also where it is not judged


def test_lanes_agree_with_one_long_replay(flown, lanes):
    truth, log = flown
    model = model_of(truth).with_effects(
        CommandDelay(0.013), SecondOrderRates(0.01, 0.01, 0.01), LinearDrag(0.3, 0.3, 0.1)
    )
    with jax.enable_x64(True):
        problem = Problem.of(lanes, model)
        left = problem.residuals(problem.start[None])[0]
        like = jax.tree.map(lambda leaf: np.asarray(leaf, float), model)
        record = make_record(log)
        predicted = jax.tree.map(np.asarray, jax.jit(predict_rows)(like, record, record.begins))
    before = Rotation.from_quat(np.roll(record.quat, 1, axis=0), scalar_first=True)
    source = record.source_row
    expected = {
        (0, 0): before.apply(log["w"][source] - predicted.rates_b),
        (3, 0): before.apply(log["f"][source] - predicted.force_b),
        (3, 1): np.diff(record.vel_w, axis=0, prepend=record.vel_w[:1])
        - predicted.acc_w * np.roll(record.step_s, 1)[:, None],
    }
    for (axis, channel), one in expected.items():
        axes = slice(axis, axis + 3)
        counts = lanes.counts[..., axes, channel]
        # In multiples of the noise; what came before the lead-in is forgotten to a millionth of full stick.
        error = (left[..., axes, channel] - one[lanes.row]) / (DIRECT, LEVEL)[channel][axes]
        assert counts[LEAD_IN_S * RATE].any() and np.abs(error[counts]).max() < 1e-3


def test_a_log_without_turns_is_refused(flown):
    log = replace(flown[1].without("w", "q"), source="flight.csv")
    with pytest.raises(
        DiagnosisError, match=r"flight\.csv: found channels .*v_bat.*expected w \(gyro\) or q"
    ):
        diagnose(log)


@pytest.mark.parametrize("held_out", [np.zeros(3, bool), np.zeros((5, 1), bool), 1, np.zeros(5)])
def test_held_out_rows_of_another_shape_are_refused(flown, held_out):
    log = flown[1].select(slice(0, 5))
    with pytest.raises(DiagnosisError, match=r"held_out: found .* expected bool of \(5,\)"):
        diagnose(log, held_out=held_out)


@pytest.mark.slow
def test_what_a_given_model_has_too_much_is_taken_out_again(flown):
    truth, log = flown
    model = model_of(truth)._replace(battery_drain_v_per_min=0.0)
    found = diagnose(log, model.with_effects(LinearDrag(0.2, 0.2, 0.2)))
    drag, drain = sorted(found.causes, key=lambda cause: cause.effect)[::-1]
    assert (drag.effect, drain.effect) == ("linear_drag", "battery_drain")
    for one in drag.parameters.values():
        assert one.value == pytest.approx(0.0, abs=0.02)
    assert drag.heldout_gain > 0.0 and drag.lambda_ > 100.0
    assert drain.parameters["battery_drain_v_per_min"].value == pytest.approx(truth.drain, rel=0.05)
    for one, tau in zip(found.half_response_s["extended"].values(), truth.tau, strict=True):
        half = one.ci95[1] - one.time
        assert 0.0 < half < 0.05 * tau and abs(one.time - tau * np.log(2.0)) < 1.5 * half


def test_delays_end_where_no_older_row_is_remembered(flown):
    truth, log = flown
    quick = replace(log, time=0.1 * log.time)  # 1 kHz
    lanes = make_lanes(quick, np.ones(len(log), bool), np.array(truth.tau), truth.gravity)
    problem = Problem.of(lanes, model_of(truth))
    place = problem.names.index("command_delay.delay_s")
    assert problem.high[place] == pytest.approx(LONGEST_STEPS * 0.001, rel=1e-3)


def test_channels_that_some_logs_lack_are_warned_of(flown):
    first = replace(flown[1].select(slice(0, 30)), source="folder/a.npz")
    second = replace(flown[1].select(slice(30, 50)).without("f"), source="b.npz")
    assert unused_channels([first, second]) == ["channel f is not used: b.npz has none"]
    assert unused_channels([first, first]) == []


def test_logs_are_joined_by_what_they_all_have(flown):
    first = replace(flown[1].select(slice(0, 30)), source="folder/a.npz")
    segments = np.repeat([4, 7], 10)
    second = replace(flown[1].select(slice(30, 50)).without("f"), segment=segments, source="b.npz")
    both = joined([first, second])
    assert sorted(both.channels) == sorted(set(first.channels) - {"f"}) and both.source == "a.npz + b.npz"
    np.testing.assert_array_equal(both.segment, np.repeat([0, 1, 2], [30, 10, 10]))
    np.testing.assert_array_equal(both["w"], np.concatenate([first["w"], second["w"]]))
    assert joined([first]) is first
    with pytest.raises(DiagnosisError, match="logs: found none"):
        joined([])


@pytest.mark.parametrize("missing", [(), ("v_bat",)])
def test_the_battery_drains_only_where_its_voltage_was_measured(flown, missing):
    truth, log = flown[0], flown[1].without(*missing)
    lanes = make_lanes(log, np.ones(len(log), bool), np.array(truth.tau), truth.gravity)
    state = SearchState.start(log, Problem.of(lanes, model_of(truth)))
    assert (state.problem.names.index(DRAIN) in state.base_places) == (not missing)


@pytest.mark.slow
def test_a_force_may_be_a_law_whose_channels_the_log_lacks():
    """Without velocity and attitude, drag of forward flight would look like a thrust that is tilted."""
    rng = np.random.default_rng(4)
    truth = replace(draw_base(rng), effects={"thrust_tilt": {"towards_x": 0.1, "towards_y": 0.0}})
    log = measure(fly(truth, "scripted", 20.0, rng), "sensors", rng)
    blind = diagnose(log.without("p", "v", "q"), model_of(truth))
    (cause,) = blind.causes
    assert cause.effect == "thrust_tilt" and {"linear_drag", "wind"} <= {*cause.equivalent}
    assert "tilt of the thrust axis (or " in verdict_of(blind).text


@pytest.mark.slow
def test_a_sensor_farther_off_than_any_on_the_list_is_told_and_not_named():
    rng = np.random.default_rng(6)
    truth = draw_base(rng)
    log = measure(fly(truth, "scripted", 20.0, rng), "sensors", rng)
    off = log["f"] + np.array([2.5, 0.0, 0.0])
    found = diagnose(replace(log, channels={**log.channels, "f": off}), model_of(truth))
    (cause,) = found.beyond
    assert found.causes == () and found.verdict == "unexplained" and found.unexplained.depends_on == ()
    assert cause.effect == "accelerometer_bias" and cause.beyond == "x at least 2 m/s^2"
    assert float(found.extended.effect("accelerometer_bias").x) == 0.0
    (warning,) = (one for one in found.warnings if "beyond the list" in one)
    assert warning.endswith("and is not in the extended model")
