"""Adaptation: plausible models, the way to them, what is refused, and what is said."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from baselines.purejaxrl_ppo import CheckpointError, load_checkpoint
from baselines.purejaxrl_ppo.checkpoint import SHIPPED
from flytrack_env import nominal_parameters
from flytrack_env.battery import Battery
from flytrack_env.dynamics import step
from flytrack_env.effects import (
    WIND,
    CommandDelay,
    LearnedLaw,
    LinearDrag,
    Motors,
    QuadraticDrag,
    VoltageSag,
)
from flytrack_env.effects.actual_rates import ActualRates
from flytrack_env.effects.betaflight_rates import BetaflightRates
from flytrack_env.effects.grammar import Factor, Law, Term
from flytrack_env.model_file import model_as_json
from flytrack_env.motion import Motion
from flytrack_env.thrust import collective_thrust
from flytrack_loop import adapt as adapting
from flytrack_loop.adapt import FlightResults, Settings, adapt, describe_adapted, embed
from flytrack_sysid import LogError
from flytrack_sysid.diagnosis import Cause, Diagnosis, Unexplained
from flytrack_sysid.diagnosis.plausible import find_plausible_models
from flytrack_sysid.diagnosis.result import Estimated, Joint, NotIdentifiable
from flytrack_sysid.importing.betaflight_settings import GENERIC
from flytrack_sysid.inference.parameters import (
    THRUST_COEFFS,
    names_of,
    without_neutral_effects,
)
from tests.support.evaluated import write_checkpoint
from tests.support.handout_plant import HandoutPlant, excited
from tests.support.written_logs import with_channels

NOMINAL = nominal_parameters()
DRAG = NOMINAL.with_effects(LinearDrag(0.3, 0.2, 0.1))
CAUSE = Cause("linear_drag", (), "force", {}, 100.0, 30.0, 100.0, 90.0)
STICKS = np.linspace(-1.0, 1.0, 9)
FULL_V = 24.0


def thrust(coeffs, stick):
    """Return the thrust of a map at full voltage."""
    return collective_thrust(stick, FULL_V, coeffs)


def diagnosis(extended, joint=Joint(), causes=(CAUSE,), unexplained=Unexplained()):  # noqa: B008
    rest = (NOMINAL, NOMINAL, extended, {}, "log.npz", "0" * 64)
    return Diagnosis("causes_found", causes, unexplained, (), {}, *rest, joint=joint)


def with_unseen_sag(found, smallest_v):
    """Return a diagnosis whose log shows a sag of some volts at least; None: a notable one."""
    limits = [] if smallest_v is None else [NotIdentifiable("voltage_sag", smallest_v, "V", (), "")]
    return replace(found, not_identifiable=tuple(limits))


def seen_at(sticks, std_n):
    """Return the covariance of a thrust map that was fitted at some sticks and 24 V."""
    rows = np.stack([thrust(coeffs, sticks) for coeffs in np.eye(6)], axis=1)
    return np.linalg.inv(rows.T @ rows / std_n**2 + 1e-6 * np.eye(6))


def drawn_by(draw, count):
    """Return that many draws."""
    return jax.vmap(draw)(jax.random.split(jax.random.key(1), count))


def test_only_thrust_that_was_flown_is_the_logs():
    flown = np.linspace(0.6, 1.0, 9)
    truth = np.asarray(NOMINAL.thrust_coeffs, float)
    # N, of 1, u, u^2, u^3: 0.01 N at the sticks that were flown, and -23 N at the lower end.
    fitted = truth + 4.0 * np.array([-0.48, 1.88, -2.4, 1.0, 0.0, 0.0])
    assert np.abs(thrust(fitted, STICKS) - thrust(truth, STICKS)).max() > 5.0
    extended = DRAG._replace(thrust_coeffs=1.1 * fitted)
    models = find_plausible_models(diagnosis(extended, Joint(THRUST_COEFFS, seen_at(flown, 0.05))))
    mean = np.asarray(models.model.thrust_coeffs, float)
    assert_allclose(thrust(mean, flown), thrust(1.1 * fitted, flown), atol=0.2)
    assert_allclose(thrust(mean, STICKS), 1.1 * thrust(truth, STICKS), atol=1.5)
    drawn = drawn_by(models.draw, 400)
    maps = np.asarray(drawn.thrust_coeffs, float)
    spread = np.std([thrust(coeffs, STICKS) for coeffs in maps], axis=0)
    assert spread[-1] < 0.1 < 0.5 < spread[0] < 5.0
    assert_allclose(drawn.effects[0].d_x, 0.3, rtol=1e-6)  # known exactly here


def test_draws_have_the_covariance_of_the_log_and_stay_in_range():
    names = ("tau_roll", "linear_drag.d_x", "linear_drag.d_y")
    covariance = np.array([[1e-6, 0.0, 0.0], [0.0, 4e-4, 3e-4], [0.0, 3e-4, 4e-4]])
    models = find_plausible_models(diagnosis(DRAG, Joint(names, covariance)))
    drawn = drawn_by(models.draw_vector, 4000)
    values = np.asarray(drawn, float)[:, [names_of(DRAG).index(name) for name in names]]
    assert_allclose(values.mean(axis=0), [NOMINAL.tau[0], 0.3, 0.2], atol=2e-3)
    assert_allclose(np.cov(values.T), covariance, atol=3e-5)
    late = Joint(("command_delay.delay_s",), np.array([[1e-4]]))
    wide = find_plausible_models(diagnosis(NOMINAL.with_effects(CommandDelay(0.005)), late))
    delays_s = drawn_by(wide.draw, 50).effects[0].delay_s
    assert delays_s.min() == 0.0 < 0.02 < delays_s.max()


@pytest.mark.parametrize("cause, drain", [("battery_drain", 9.0), ("linear_drag", 1.0)])
def test_a_drain_that_no_cause_names_is_that_of_the_model(cause, drain):
    joint = Joint(("battery_drain_v_per_min",), np.array([[0.25]]))
    extended = DRAG._replace(battery_drain_v_per_min=9.0)
    models = find_plausible_models(
        diagnosis(extended, joint, (CAUSE, replace(CAUSE, effect=cause)))
    )
    assert models.model.battery_drain_v_per_min == drain
    drawn = drawn_by(models.draw, 50)
    assert (np.std(drawn.battery_drain_v_per_min) > 0.1) == (cause == "battery_drain")


@pytest.mark.parametrize("smallest_v, most_v", [(None, 0.7), (0.8, 1.6), (np.inf, 2.5)])
def test_a_sag_that_the_log_need_not_have_shown_is_drawn(smallest_v, most_v):
    models = find_plausible_models(with_unseen_sag(diagnosis(DRAG), smallest_v))
    drawn = drawn_by(models.draw, 400)
    sags_v = drawn.effect("voltage_sag").at_full_v
    assert_allclose((sags_v == 0.0).mean(), 0.5, atol=0.1)  # a load gives no voltage
    assert 0.4 * most_v < sags_v.max() < most_v
    assert_allclose(without_neutral_effects(models.model).effects, DRAG.effects, rtol=1e-6)


def test_a_named_sag_without_limits_is_about_the_models():
    joint = Joint(("voltage_sag.at_full_v",), np.array([[0.01]]))
    told = Estimated(5.0, (-np.inf, np.inf), "V")
    cause = replace(CAUSE, effect="voltage_sag", parameters={"at_full_v": told})
    models = find_plausible_models(
        diagnosis(DRAG.with_effects(VoltageSag(5.0)), joint, (CAUSE, cause))
    )
    assert abs(models.model.effect("voltage_sag").at_full_v) < 0.05


def test_a_named_sag_is_as_uncertain_as_told():
    """The joint covariance says 0.1 V, the interval of the cause 0.5 V, as does the prior."""
    names = ("linear_drag.d_x", "voltage_sag.at_full_v")
    joint = Joint(names, np.array([[1e-4, 5e-4], [5e-4, 0.01]]))
    told = Estimated.around(1.0, 1.96 * 0.5, "V")
    cause = replace(CAUSE, effect="voltage_sag", parameters={"at_full_v": told})
    models = find_plausible_models(
        diagnosis(DRAG.with_effects(VoltageSag(1.0)), joint, (CAUSE, cause))
    )
    drawn = drawn_by(models.draw_vector, 4000)
    order = names_of(models.like)
    drag, sag = (np.asarray(drawn, float)[:, order.index(name)] for name in names)
    assert_allclose(models.mean[order.index(names[1])], 0.5, atol=0.01)
    is_inside = (sag > 0.0) & (drag > 0.0)
    slope = np.polyfit(sag[is_inside], drag[is_inside], 1)[0]
    assert_allclose(slope, 0.05, atol=0.005)  # the drag goes with the sag as the log says
    assert_allclose(np.percentile(sag, [50.0, 84.0]), [0.5, 0.85], atol=0.05)


def test_a_model_in_the_structure_of_another_flies_as_it_did():
    model = NOMINAL.with_effects(QuadraticDrag(0.01, 0.02, 0.03))
    structure = DRAG.with_effects(QuadraticDrag(), WIND.parameters(1.0, 2.0))
    embedded = embed(model, structure)
    assert jax.tree.structure(embedded) == jax.tree.structure(structure)
    state = np.zeros(21, np.float32)
    state[[2, 3, 4, 9, 20]] = 5.0, 4.0, -3.0, 1.0, 23.5
    command = jnp.array([0.3, -0.2, 0.1, 0.4])
    models = (model, embedded, structure)
    after = [np.asarray(step(state, command, 0.01, flown)) for flown in models]
    assert_array_equal(after[0], after[1])
    assert np.abs(after[0] - after[2]).max() > 1e-4


def test_a_craft_replaces_the_policys_battery_mass_and_settings_but_for_what_was_fitted():
    battery = Battery(full_v=16.8, empty_v=15.4, fitted_low_v=15.4, fitted_high_v=16.8)
    small = adapting.as_craft(NOMINAL, NOMINAL._replace(m=0.6, battery=battery))
    assert (small.m, small.battery) == (0.6, battery)
    assert adapting.as_craft(NOMINAL, NOMINAL._replace(battery=Battery(24.0, 22.0))) is NOMINAL
    policy_model = NOMINAL.with_effects(BetaflightRates(0.3, 0.3, 0.3), LinearDrag(0.3, 0.2, 0.1))
    craft = adapting.as_craft(policy_model, NOMINAL.with_effects(ActualRates(0.5, 0.5, 0.5)))
    assert {type(effect) for effect in craft.effects} == {ActualRates, LinearDrag}
    flown = NOMINAL.with_effects(GENERIC._replace(roll_arm=33.0))
    assert adapting.as_craft(flown, NOMINAL.with_effects(GENERIC)) is flown
    other = NOMINAL.with_effects(GENERIC._replace(p_roll=50.0))
    assert adapting.as_craft(flown, other).effects == other.effects
    with pytest.raises(ValueError, match="commanded by motors, expected one by sticks"):
        adapting.as_craft(NOMINAL, NOMINAL.with_effects(Motors()))


@pytest.fixture(scope="module")
def log():
    log = excited(HandoutPlant())
    return log.select(log.segment < 6)


BAD_LOGS = {
    "a hover": (
        lambda log: with_channels(log, u=log["u"] * [0.05, 0.05, 1.0, 1.0]),
        "u_roll, u_pitch: found at most 0.0.* expected 0.1 or more.*hover",
    ),
    "crashes": (
        lambda log: replace(log, segment=np.arange(len(log)) // 45),
        "found .* flights of 0.45 s at most, 0 s in all .* expected 3 s or more: crashes",
    ),
    "another craft": (
        lambda log: with_channels(log, v_bat=log["v_bat"] * 0.6),
        "another craft than the policy's: .*; the battery has 13.* V in this log, the model's 22",
    ),
}


@pytest.mark.parametrize("kind", BAD_LOGS)
def test_a_log_of_no_race_of_this_craft_is_refused_before_work(kind, log, monkeypatch):
    monkeypatch.setattr(adapting, "diagnose", pytest.fail)
    change, message = BAD_LOGS[kind]
    with pytest.raises(LogError, match=message):
        adapt(change(log), load_checkpoint("champion"))


def test_a_policy_of_another_observation_is_refused(log, tmp_path, monkeypatch):
    monkeypatch.setattr(adapting, "diagnose", pytest.fail)
    other = write_checkpoint(tmp_path / "history.safetensors", "FlyTrackActionHistory-v0")
    with pytest.raises(CheckpointError, match="a policy of FlyTrackActionHistory-v0, expected one"):
        adapt(log, load_checkpoint(other))


def test_a_log_that_agrees_leaves_the_policy_as_it_is(log, monkeypatch):
    consistent = diagnosis(NOMINAL, causes=())
    monkeypatch.setattr(adapting, "diagnose", lambda *_, **__: consistent)
    monkeypatch.setattr(adapting, "improve", pytest.fail)
    champion = load_checkpoint("champion")
    adapted = adapt(log, champion, accept=True)
    assert adapted.checkpoint is champion and not adapted.is_new
    assert "Nothing to adapt to" in describe_adapted(adapted)


def test_what_was_learnt_from_an_earlier_log_is_forgotten():
    champion = load_checkpoint("champion")
    square = Factor("airspeed", "power", (2.0, 0.0))
    law = Law((Term("force", "air", (square,), (0.01, 0.0, 0.0), (0.001, 0.0, 0.0)),))
    learnt = model_as_json(DRAG.with_effects(LearnedLaw(1.0, 0.0, law)))
    policy = champion._replace(meta={**champion.meta, "model": learnt})
    assert [type(one) for one in adapting.read_policy_model(policy).effects] == [LinearDrag]


def test_another_motion_within_a_step_is_a_difference():
    moving = NOMINAL._replace(motion=Motion.CONTINUOUS)
    assert adapting.is_different(diagnosis(moving, causes=()), NOMINAL)
    assert not adapting.is_different(diagnosis(moving, causes=()), moving)


def judged(finish, lap_s):
    is_complete = np.arange(100) < finish
    return FlightResults(is_complete, np.where(is_complete, lap_s, np.nan))


@pytest.mark.parametrize(
    "lap_s, finish, is_new", [(3.9, 100, True), (5.0, 100, False), (3.9, 50, False)]
)
def test_the_old_policy_is_kept_where_the_new_one_is_worse(lap_s, finish, is_new, monkeypatch):
    champion = load_checkpoint("champion")
    model = adapting.read_policy_model(champion)
    models = find_plausible_models(diagnosis(model))
    flights = iter([judged(100, 3.7), judged(90, 4.2), judged(100, 3.7), judged(finish, lap_s)])
    monkeypatch.setattr(adapting, "polish", lambda env, policy, *_: policy.params)
    monkeypatch.setattr(adapting, "judge", lambda *_: (next(flights), next(flights)))
    adapted = adapting.improve(
        champion, model, models, diagnosis(model), 0, Settings(), lambda unit: lambda *_: None
    )
    text = describe_adapted(adapted)
    assert adapted.is_new == is_new
    assert "costs the old policy 10% of the flights and +0.500 s a lap" in text
    assert ("96.3% to 100.0% of flights finish" in text) == is_new
    assert ("the old one is kept" in text) != is_new
    assert (adapted.checkpoint is champion) != is_new


def test_the_settings_of_a_craft_are_there_from_the_start(log, monkeypatch):
    """A rate loop that is there by half has no half of its response."""
    champion = load_checkpoint("champion")
    policy_model = adapting.read_policy_model(champion)
    craft = NOMINAL._replace(max_rate=np.float32([500.0, 500.0, 200.0])).with_effects(GENERIC)
    nominal = adapting.as_craft(policy_model, craft)
    assert_array_equal(nominal.max_rate, craft.max_rate)
    assert_array_equal(nominal.tau, policy_model.tau)
    faster = nominal.with_effects(GENERIC._replace(roll_arm=2.0 * GENERIC.roll_arm))
    result = replace(diagnosis(faster), nominal=nominal)
    diagnosed, moved = [], []

    def polish(env, policy, seed, settings, moving, report):
        moved.extend(moving(jax.random.key(0), way) for way in (0.0, 0.5, 1.0))
        return policy.params

    def diagnose(log, model, report):
        diagnosed.append(model)
        return result

    monkeypatch.setattr(adapting, "diagnose", diagnose)
    monkeypatch.setattr(adapting, "polish", polish)
    monkeypatch.setattr(adapting, "judge", lambda *_: (judged(100, 3.7), judged(90, 4.2)))
    adapt(log, champion, accept=True, craft=craft)
    assert diagnosed[0].effect("betaflight_loop") == GENERIC
    arms = [float(model.effect("betaflight_loop").roll_arm) for model in moved]
    assert_allclose(arms, np.array([1.0, 1.5, 2.0]) * GENERIC.roll_arm, rtol=1e-6)


def test_shipped_policies_have_names_and_a_file_of_the_name_comes_first(tmp_path, monkeypatch):
    for name, path in SHIPPED.items():
        assert load_checkpoint(name).path == path
    write_checkpoint(tmp_path / "robust")
    monkeypatch.chdir(tmp_path)
    assert load_checkpoint("robust").config.hidden_sizes == (8,)
