"""What the effects of lag, rate loop, thrust and battery do, against their equations by hand."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.effects import (
    CommandDelay,
    GroundEffect,
    MotorImbalance,
    RateCrossCoupling,
    RateExpo,
    RateSaturation,
    RateSlewLimit,
    SecondOrderRates,
    ThrustLagAsymmetry,
    ThrustTilt,
    TranslationalLift,
    VoltageSag,
    Wind,
    YawReaction,
)
from flytrack_env.effects.translational_lift import HALF_SPEED
from flytrack_env.plants import Simulator
from flytrack_env.state import pack, unpack, unpack_action

DT, SIMULATOR, NOMINAL = 0.01, Simulator(), nominal_parameters()
FULL_STICK = np.deg2rad(618.0)


@jax.jit
def fly(start: jax.Array, commands: jax.Array, model: ModelParameters) -> jax.Array:
    """Return the packed states after each command, (num_steps, 21)."""

    def one(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
        state = SIMULATOR.step(state, unpack_action(action), DT, model)
        return state, pack(SIMULATOR.drone(state))

    return jax.lax.scan(one, SIMULATOR.reset(unpack(start), model), commands)[1]


def flown(parameters: Any, commands: Any, **at_start: Any) -> np.ndarray:
    """Return a flight from rest, high up and level, with an effect; ``at_start``: vel_w, height, applied."""
    start = np.zeros(21, np.float32)
    start[2] = at_start.get("height", 1e3)
    start[3:6] = at_start.get("vel_w", (0.0, 0.0, 0.0))
    start[9], start[20] = 1.0, 24.0
    start[16:20] = at_start.get("applied", (0.0, 0.0, 0.0, 0.0))
    effects = (
        parameters if isinstance(parameters, tuple) and not hasattr(parameters, "_fields") else (parameters,)
    )
    commands = np.asarray(commands, np.float32)
    return np.asarray(fly(start, commands, NOMINAL.with_effects(*effects)), float)


def held(num_steps: int = 40, **sticks: float) -> np.ndarray:
    command = np.zeros((num_steps, 4))
    for name, value in sticks.items():
        command[:, ("roll", "pitch", "yaw", "thrust").index(name)] = value
    return command


def lift_ratio(parameters: Any, **at_start: Any) -> float:
    """Return the vertical specific force of the first step with an effect over that without."""
    force = [flown(effect, held(1), **at_start)[0, 8] + 9.80665 for effect in (parameters, ())]
    return force[0] / force[1]


@pytest.mark.parametrize(("speed", "share"), [(0.0, 0.0), (HALF_SPEED, 0.5), (3 * HALF_SPEED, 0.9)])
def test_translational_lift_grows_with_airspeed_in_the_rotors_plane(speed, share):
    lift = TranslationalLift(0.2)
    assert lift_ratio(lift, vel_w=(speed, 0.0, 5.0)) == pytest.approx(1.0 + 0.2 * share, rel=1e-5)
    in_wind = (lift, Wind(v_y=-speed))
    assert lift_ratio(in_wind, vel_w=(0.0, 0.0, 0.0)) == pytest.approx(1.0 + 0.2 * share, rel=1e-5)


def test_a_late_command_falls_when_it_arrives():
    delay, late_s = 2, 0.02
    commands = np.concatenate([held(20, thrust=0.6), held(20, thrust=-0.6)])
    asymmetry = ThrustLagAsymmetry(2.0)
    late = flown((CommandDelay(late_s), asymmetry), commands)[:, 19]
    np.testing.assert_allclose(late[delay:], flown(asymmetry, commands)[:-delay, 19], atol=1e-6)


def test_ground_effect_is_cheeseman_and_bennetts_from_two_radii_on():
    radius = 0.2
    for height in (2 * radius, 4 * radius, 20 * radius):
        theirs = 1.0 / (1.0 - (radius / (4 * height)) ** 2)
        found = lift_ratio(GroundEffect(1 / 16, radius), height=height)
        assert found - 1.0 == pytest.approx(theirs - 1.0, rel=0.25)
    assert lift_ratio(GroundEffect(0.2, radius), height=0.0) == pytest.approx(1.2, rel=1e-4)
    assert lift_ratio(GroundEffect(0.2, radius), height=radius) == pytest.approx(1.1, rel=1e-4)


def test_thrust_tilt_pushes_sideways_in_proportion_to_thrust():
    for thrust in (-0.5, 0.5):
        applied = (0.0, 0.0, 0.0, thrust)
        acc_w = flown(ThrustTilt(0.02, -0.01), held(1, thrust=thrust), applied=applied)[0, 6:9]
        np.testing.assert_allclose(acc_w[:2] / (acc_w[2] + 9.80665), [0.02, -0.01], rtol=1e-4)


def test_thrust_falls_with_another_lag_than_it_rises():
    tau, ratio = float(NOMINAL.tau[3]), 2.0
    rising = flown(ThrustLagAsymmetry(ratio), held(5, thrust=1.0))[:, 19]
    falling = flown(ThrustLagAsymmetry(ratio), held(5, thrust=-1.0))[:, 19]
    time = DT * np.arange(1, 6)
    np.testing.assert_allclose(rising, 1 - np.exp(-time / tau), rtol=1e-5)
    np.testing.assert_allclose(falling, np.exp(-time / (ratio * tau)) - 1, rtol=1e-5)


def test_sag_comes_and_goes_with_the_load():
    commands = np.concatenate([held(100, thrust=1.0), held(100, thrust=-1.0)])
    idle = (0.0, 0.0, 0.0, -1.0)
    sagged = flown(VoltageSag(1.5), commands, applied=idle)[:, 20] - flown((), commands, applied=idle)[:, 20]
    assert sagged[99] == pytest.approx(-1.5, abs=1e-3) and sagged[-1] == pytest.approx(0.0, abs=1e-3)
    assert sagged.min() >= -1.5 - 1e-3


@pytest.mark.parametrize("stick", [-1.0, -0.5, 0.25, 1.0])
def test_stick_curves_at_rest(stick):
    applied = (stick, 0.0, 0.0, 0.0)
    expo = flown(RateExpo(0.4), held(1, roll=stick), applied=applied)[0, 13]
    assert expo == pytest.approx(FULL_STICK * (0.6 * stick + 0.4 * stick**3), rel=1e-5)
    saturated = flown(RateSaturation(0.4, 0.0), held(1, roll=stick), applied=applied)[0, 13]
    assert saturated == pytest.approx(FULL_STICK * np.clip(stick, -0.6, 0.6), rel=1e-5)


def test_slew_limit_bounds_the_angular_acceleration_and_arrives():
    rates = flown(RateSlewLimit(0.01), held(60, pitch=1.0))[:, 14]
    assert np.diff(rates, prepend=0.0).max() <= DT / 0.01 * (1 + 1e-5)
    assert rates[-1] == pytest.approx(FULL_STICK, rel=1e-4)


@pytest.mark.parametrize("damping", [0.3, 1.0, 2.0])
def test_rates_obey_the_differential_equation_of_a_second_order(damping):
    """From rest, to the sticks that the first lag leaves: scipy's own simulation of a held input."""
    lag_s = 0.05
    frequency = 2.0 * damping / lag_s
    plain = flown((), held(60, roll=0.5))[:, 13]
    slope = np.array([[0.0, 1.0], [-(frequency**2), -2.0 * damping * frequency]])
    servo = (slope, np.array([[0.0], [frequency**2]]), np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    held_inputs = signal.cont2discrete(servo, DT, method="zoh")
    expected = signal.dlsim(held_inputs, np.append(plain, plain[-1]))[1][1:, 0]
    found = flown(SecondOrderRates(lag_s, damping), held(60, roll=0.5))[:, 13]
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-4)
    assert (found.max() > 1.02 * plain[-1]) == (damping < 0.7)


def test_yaw_turns_by_an_angle_for_each_change_of_thrust():
    yaw_rate = flown(YawReaction(0.05), held(100, thrust=1.0))[:, 15]
    assert yaw_rate.sum() * DT == pytest.approx(0.05, rel=1e-3)  # u from 0 to 1
    assert np.abs(jnp.asarray(yaw_rate[-10:])).max() < 1e-3


def test_roll_and_pitch_rates_leak_into_yaw():
    rates = flown(RateCrossCoupling(0.1, -0.2), held(20, roll=0.5, pitch=-0.4, yaw=0.3))[:, 13:16]
    plain = flown((), held(20, roll=0.5, pitch=-0.4, yaw=0.3))[:, 13:16]
    np.testing.assert_array_equal(rates[:, :2], plain[:, :2])
    np.testing.assert_allclose(rates[:, 2], plain @ [0.1, -0.2, 1.0], rtol=1e-5)


@pytest.mark.parametrize("thrust", [-0.5, 0.0, 0.8])
def test_roll_and_pitch_creep_with_thrust(thrust):
    applied = (0.0, 0.0, 0.0, thrust)
    state = flown(MotorImbalance(0.01, -0.02), held(1, thrust=thrust), applied=applied)[0]
    thrust_acc = state[8] + 9.80665  # level: all of it is up
    np.testing.assert_allclose(state[13:16], [0.01 * thrust_acc, -0.02 * thrust_acc, 0.0], rtol=1e-4)


def test_a_second_lag_does_not_remember_the_imbalance_twice():
    """Rates that settle at the bias: it goes into the lag, and comes out of it once."""
    hover = (0.0, 0.0, 0.0, -0.5)
    creeping = flown(
        (MotorImbalance(0.01), SecondOrderRates(0.03, 1.0)), held(60, thrust=-0.5), applied=hover
    )
    direct = flown(MotorImbalance(0.01), held(60, thrust=-0.5), applied=hover)
    assert creeping[0, 13] < 0.5 * direct[0, 13]
    assert creeping[-1, 13] == pytest.approx(direct[-1, 13], rel=1e-3)
