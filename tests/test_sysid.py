"""Identification finds the truth on the simulator, and says what is open on another plant."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import advance, collective_thrust, nominal_parameters
from flytrack_env.state import BATTERY_EMPTY_V, BATTERY_FULL_V
from flytrack_sysid import Excitation, FitError, collect, fit, validate
from flytrack_sysid.fit import lagged, specific_force_b, thrust_terms

TRUTH = nominal_parameters()._replace(
    tau=np.array([0.021, 0.034, 0.057, 0.045], np.float32),
    thrust_coeffs=np.array([-6.0, -4.0, 3.5, 0.4, 0.8, 0.9], np.float32),
)


class Truth:
    """A plant of the minimal structure with parameters that the tools are not told."""

    def reset(self, drone, model):
        return drone

    def step(self, state, command, dt, model):
        return advance(state, (), command, dt, TRUTH)[0]

    def drone(self, state):
        return state


class Dragging(Truth):
    """The same with linear drag in the world frame, 0.2 1/s."""

    def step(self, state, command, dt, model):
        after = advance(state, (), command, dt, TRUTH)[0]
        drag_w = state.vel_w.scale(-0.2)
        return after._replace(
            acc_w=after.acc_w + drag_w,
            vel_w=after.vel_w + drag_w.scale(dt),
            pos_w=after.pos_w + drag_w.scale(0.5 * dt * dt),
        )


@pytest.fixture(scope="module")
def data() -> Excitation:
    return collect(Truth(), seed=3)


def test_excitation_covers_what_it_promises(data):
    battery_v = data.states[..., 20]
    assert battery_v.min() < BATTERY_EMPTY_V + 0.1 and battery_v.max() == BATTERY_FULL_V
    assert data.next_states[..., 20].min() >= BATTERY_EMPTY_V
    assert np.abs(data.actions).max() <= 1.0
    for axis, kind in enumerate(("roll", "pitch", "yaw", "thrust")):
        moved = data.select(np.array(data.kinds) == kind)
        assert np.ptp(moved.actions[..., axis]) == pytest.approx(2.0, abs=0.05)
        others = [i for i in range(3) if i != axis]
        assert np.ptp(moved.actions[..., others]) == 0.0, "one axis at a time"
    assert set(data.kinds) == {"roll", "pitch", "yaw", "thrust", "leg"}


def test_same_seed_same_data_other_seed_other_data(data):
    np.testing.assert_array_equal(collect(Truth(), seed=3).actions, data.actions)
    assert not np.array_equal(collect(Truth(), seed=4).actions, data.actions)


def test_split_holds_out_every_kind_and_shares_nothing(data):
    training, held_out = data.split()
    assert set(held_out.kinds) == set(training.kinds) == set(data.kinds)
    assert len(training.kinds) + len(held_out.kinds) == len(data.kinds)
    assert not any((a == b).all() for a in training.states for b in held_out.states)


def test_identifies_minimal_plant_to_rounding(data):
    training, held_out = data.split()
    np.testing.assert_allclose(fit(training, with_drag=True).model.effect("linear_drag"), 0.0, atol=1e-5)
    identified = fit(training)
    assert identified.model.effects == ()
    np.testing.assert_allclose(identified.model.tau, TRUTH.tau, rtol=1e-4)
    action, battery_v = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(22, 24, 9))
    found = collective_thrust(action, battery_v, identified.model.thrust_coeffs)
    truth = collective_thrust(action, battery_v, TRUTH.thrust_coeffs)
    assert np.abs(found - truth).max() < 1e-4 * truth.max()
    validation = validate(identified.model, held_out)
    assert validation.mse["velocity"] < 1e-10 and validation.mse["rates"] < 1e-8
    assert max(validation.open_force) < 1e-3


def test_drag_stays_open_and_grows_with_speed():
    training, held_out = collect(Dragging(), seed=5).split()
    validation = validate(fit(training).model, held_out)
    by_speed = [rms for *_, rms in validation.open_force_by_speed]
    assert by_speed == sorted(by_speed) and by_speed[-1] > 1.0
    # The unexplained force is about what was hidden: 0.2 1/s times the speed.
    low, high, rms = validation.open_force_by_speed[-1]
    assert 0.2 * low * 0.5 < rms < 0.2 * high
    extended = fit(training, with_drag=True).model
    np.testing.assert_allclose(extended.effect("linear_drag"), 0.2, rtol=1e-3)
    np.testing.assert_allclose(extended.tau, TRUTH.tau, rtol=1e-3)
    assert max(validate(extended, held_out).open_force) < 1e-2


def test_lag_filter_equals_recursion():
    rng = np.random.default_rng(0)
    commands, start, tau = rng.uniform(-1, 1, (3, 40)), rng.uniform(-1, 1, 3), 0.03
    expected, applied = [], start
    for command in commands.T:
        applied = applied + (1 - np.exp(-0.01 / tau)) * (command - applied)
        expected.append(applied)
    np.testing.assert_allclose(lagged(commands, start, tau), np.array(expected).T, rtol=1e-12)


def test_thrust_terms_are_the_handouts():
    np.testing.assert_allclose(
        thrust_terms(np.array([0.5]), np.array([23.0]))[0], [1, 0.5, 0.25, 0.125, 23, 11.5]
    )


def test_specific_force_of_hover_and_tilt(data):
    # Hover, then the same force tilted by 60 degrees: along body z both are g.
    quaternions = Rotation.from_euler("x", [[0.0], [60.0]], degrees=True).as_quat(scalar_first=True)
    states, after = np.zeros((1, 2, 21)), np.zeros((1, 2, 21))
    states[0, :, 9:13] = quaternions
    thrust_w = Rotation.from_quat(quaternions, scalar_first=True).apply([0, 0, 9.80665])
    after[0, :, 6:9] = thrust_w - [0, 0, 9.80665]
    force = specific_force_b(Excitation(states, np.zeros((1, 2, 4)), after, ("leg",)), 9.80665)
    np.testing.assert_allclose(force[0], [[0.0, 0.0, 9.80665]] * 2, atol=1e-12)


def test_axis_that_never_moves_is_refused(data):
    actions = data.actions.copy()
    actions[..., 1] = 0.0
    with pytest.raises(FitError, match="pitch"):
        fit(data._replace(actions=actions))


def test_drag_without_motion_is_refused(data):
    states = data.states.copy()
    states[..., 3:6] = 0.0
    with pytest.raises(FitError, match="hardly moves"):
        fit(data._replace(states=states), with_drag=True)


def test_data_that_are_not_finite_are_refused(data):
    states = data.states.copy()
    states[0, 0, 0] = np.nan
    with pytest.raises(FitError, match="not finite"):
        fit(data._replace(states=states))
