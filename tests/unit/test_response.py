"""Times to half response, against closed forms and SciPy's step responses."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import signal
from scipy.optimize import brentq

from flytrack_env import effects
from flytrack_env.dynamics import nominal_parameters
from flytrack_sysid.response import FULL_STEP, half_response_s

TAU = np.array([0.02, 0.03, 0.04, 0.05])
# Neutral, so that all tests share one compiled program.
NEUTRAL = (
    effects.CommandDelay(),
    effects.ThrustLagAsymmetry(),
    effects.SecondOrderRates(),
    effects.RateSlewLimit(),
    effects.RateExpo(),
    effects.MotorImbalance(),
    effects.GyroScale(),
)
MODEL = nominal_parameters()._replace(tau=TAU).with_effects(*NEUTRAL)


def test_a_first_order_lag_takes_ln_2_of_its_time_constant_and_delays_add():
    assert_allclose(half_response_s(MODEL), TAU * np.log(2.0), atol=1e-5)
    late = MODEL.with_effects(
        effects.CommandDelay(0.0137, 0.021, -0.02), effects.ThrustLagAsymmetry(2.0)
    )
    assert_allclose(
        half_response_s(late), TAU * np.log(2.0) + [0.0137, 0.0137, 0.0347, 0], atol=1e-5
    )


@pytest.mark.parametrize(("lag_s", "damping"), [(0.0135, 0.23), (0.03, 2.0)])
def test_a_second_order_behind_the_lag(lag_s, damping):
    frequency = 2.0 * damping / lag_s
    both = np.polymul([TAU[1], 1.0], [1.0 / frequency**2, lag_s, 1.0])
    time, risen = signal.step(([1.0], both), T=np.linspace(0.0, 0.3, 30001))
    model = MODEL.with_effects(effects.SecondOrderRates(pitch_s=lag_s, pitch_damping=damping))
    times_s, plain_s = half_response_s(model), TAU * np.log(2.0)
    assert times_s[1] == pytest.approx(time[np.argmax(risen >= 0.5)], abs=5e-5)
    assert_allclose(times_s[[0, 2, 3]], plain_s[[0, 2, 3]], atol=1e-5)


def test_a_limit_on_acceleration_delays_large_steps_only():
    full_s, tau = 0.2, TAU[0]
    model = MODEL.with_effects(effects.RateSlewLimit(roll_s=full_s), effects.RateExpo(yaw=0.4))
    small, full = half_response_s(model), half_response_s(model, FULL_STEP)
    half = brentq(lambda t: (t - tau * (1.0 - np.exp(-t / tau))) / full_s - 0.5, 0.0, full_s)
    assert full[0] == pytest.approx(half, abs=1e-4)
    assert small[0] == pytest.approx(tau * np.log(2.0), abs=3e-4)
    assert_allclose(full[1:3], small[1:3], atol=1e-5)  # the curve comes before the lag


def test_what_turns_the_drone_anyway_and_what_its_sensors_read_do_not_matter():
    still = MODEL.with_effects(
        effects.MotorImbalance(0.01, -0.02), effects.GyroScale(1.1, 0.9, 1.0)
    )
    assert_allclose(half_response_s(still), half_response_s(MODEL), atol=1e-7)


def test_a_drone_that_does_not_answer_has_no_time():
    times_s = half_response_s(MODEL._replace(thrust_coeffs=np.zeros(6)))
    assert np.isnan(times_s[3]) and np.isfinite(times_s[:3]).all()
