"""Betaflight's rate loop as an effect: what the firmware does, without the firmware."""

import numpy as np
import pytest

from flytrack_env.effects import BetaflightLoop
from flytrack_env.motion import Motion
from flytrack_env.state import APPLIED_ACTION, RATES, Action
from flytrack_sysid.importing.betaflight_settings import ASSUMED, rate_loop
from flytrack_sysid.inference.parameters import base_of
from flytrack_sysid.response import half_response_s
from tests.support.simulated_flights import NOMINAL, drone_with, fly, held, padded

RACER = BetaflightLoop(23.0, 23.0, 2.7, 2.8, 0.018, 0.7)
SECOND = 100  # steps
LONGEST = 3 * SECOND
SETTINGS = {
    **{name: str(value) for name, value in BetaflightLoop()._asdict().items()},
    **ASSUMED,
    "rc_smoothing": "ON",
    "rc_smoothing_setpoint_cutoff": "0",
    "rc_smoothing_throttle_cutoff": "20",
    "rc_smoothing_auto_factor": "30",
    "rc_smoothing_auto_factor_throttle": "30",
    "iterm_relax": "RP",
}


def flown(commands, loop=RACER):
    """Return the states (steps, 37) of a craft with the loop, which hovers first."""
    model = NOMINAL._replace(motion=Motion.CONTINUOUS).with_effects(loop)
    start = drone_with(applied=Action(0.0, 0.0, 0.0, -0.22))
    return np.asarray(fly(start, padded(commands, LONGEST), model))[: len(commands)]


def test_sticks_become_rates_and_hover_stays_one():
    states = flown(held(SECOND, roll=0.3, pitch=-0.2, yaw=0.5, thrust=-0.22))
    expected = np.deg2rad(np.asarray(NOMINAL.max_rate)) * (0.3, -0.2, 0.5)
    np.testing.assert_allclose(states[-1, RATES], expected, rtol=0.03, atol=0.03)
    still = flown(held(SECOND, thrust=-0.22))
    np.testing.assert_allclose(
        still[:, APPLIED_ACTION], np.tile([0, 0, 0, -0.22], (SECOND, 1)), atol=1e-5
    )


def test_motors_that_end_trade_thrust_for_rates_and_airmode_adds_it():
    def added(thrust):
        """Return by how much full sticks change what is applied of a thrust."""
        sticks = held(8, roll=1.0, pitch=1.0, yaw=1.0, thrust=thrust), held(8, thrust=thrust)
        turning, straight = (flown(commands)[-1, APPLIED_ACTION][3] for commands in sticks)
        return turning - straight

    assert added(1.0) < -0.2 and added(-1.0) > 0.1


@pytest.mark.parametrize(
    ("change", "shows"),
    [
        ({"p_roll": 22.0, "d_roll": 15.0}, np.less),  # slower
        ({"gyro_late_s": 0.004}, np.greater),  # later, so it overshoots
        ({"anti_gravity_gain": 0.0}, np.not_equal),
        ({"sticks_hz": 0.0, "f_roll": 0.0}, np.not_equal),
    ],
)
def test_settings_show_in_the_response(change, shows):
    step = held(12, roll=0.6, thrust=0.2)
    peaks = [flown(step, loop)[:, RATES.start].max() for loop in (RACER._replace(**change), RACER)]
    assert shows(*peaks)


def test_a_weak_motor_turns_a_craft_that_climbs_until_the_integral_holds_it():
    states = flown(held(LONGEST, thrust=0.3), RACER._replace(rear_left=0.8))
    assert states[:20, RATES.start].min() < -0.05  # less thrust on the left: it rolls there
    np.testing.assert_allclose(states[-1, RATES], 0.0, atol=0.01)


def test_the_loop_takes_the_place_of_lags_in_fits():
    free = base_of(NOMINAL.with_effects(RACER))
    assert "betaflight_loop.roll_arm" in free and "betaflight_loop.p_roll" not in free
    assert "tau_roll" in base_of(NOMINAL) and "tau_roll" not in free


@pytest.mark.slow
def test_the_loop_answers_as_fast_as_a_racer():
    times = half_response_s(NOMINAL.with_effects(RACER))
    assert np.all((times > 0.005) & (times < 0.05))


def test_settings_become_the_loop_and_another_loop_is_none():
    loop = rate_loop(SETTINGS.__getitem__, 100.0)
    assert (loop.sticks_hz, loop.throttle_hz, loop.p_pitch) == (37.0, 20.0, 47.0)
    static = {"gyro_lpf1_dyn_min_hz": "0", "gyro_lpf1_static_hz": "90", "rc_smoothing": "OFF"}
    loop = rate_loop({**SETTINGS, **static, "iterm_relax": "OFF"}.__getitem__, 100.0)
    assert loop.gyro_lpf1_dyn_min_hz == loop.gyro_lpf1_dyn_max_hz == 90.0
    assert loop.sticks_hz == loop.throttle_hz == loop.iterm_relax_cutoff == 0.0
    assert rate_loop({**SETTINGS, "mixer_type": "LINEAR"}.__getitem__, 100.0) is None
