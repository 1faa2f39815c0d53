"""What gyro and accelerometer say, against formulas in NumPy; and what of it the environment shows."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters, nominal_parameters, read_gyro, read_sensors
from flytrack_env.effects import (
    AccelerometerBias,
    AccelerometerScale,
    GyroBias,
    GyroScale,
    ImuLatency,
    ImuOffset,
    LinearDrag,
    MotorImbalance,
    Wind,
    check_parameters,
)
from flytrack_env.effects.command_delay import BUFFER_STEPS
from flytrack_env.env import FlyTrack
from flytrack_env.observations import OBSERVATION
from flytrack_env.plants import Plant, Simulator
from flytrack_env.state import ACCELERATION, QUATERNION, RATES, Action, pack, unpack, unpack_action
from flytrack_env.wrappers import DomainRandomization, NoiseParams, ObservationNoise, RandomizationParams

DT, SIMULATOR = 0.01, Simulator()
# With forces that are not thrust, and rates that are not sticks.
MODEL = nominal_parameters().with_effects(LinearDrag(0.3, 0.2, 0.1), Wind(3.0), MotorImbalance(0.01, 0.02))
GRAVITY_W = np.array([0.0, 0.0, 9.80665])
GYRO_SCALE = next(entry.scale for entry in OBSERVATION if entry.key == "rates")
SHOWN = slice(15, 18)  # where the observation has the body rates


class Flown(NamedTuple):
    """A flight: (num_steps, 3) truth of rates, rad/s, and specific force, m/s^2, and the readings."""

    start_rates: np.ndarray
    rates: np.ndarray
    force: np.ndarray
    gyro: np.ndarray
    accelerometer: np.ndarray


@jax.jit
def fly(start: jax.Array, commands: jax.Array, model: ModelParameters) -> tuple[jax.Array, ...]:
    """Return packed states (num_steps, 21) and both readings (num_steps, 3)."""

    def one(state: Any, action: jax.Array) -> tuple[Any, tuple[jax.Array, ...]]:
        after = SIMULATOR.step(state, unpack_action(action), DT, model)
        reading = read_sensors(state.drone, after.drone, after.memories, DT, model)
        return after, (pack(after.drone), jnp.stack(reading.rates_b), jnp.stack(reading.force_b))

    return jax.lax.scan(one, SIMULATOR.reset(unpack(start), model), commands)[1]


def flown(*parameters: Any, commands: Any = None, seed: int = 0, **at_start: Any) -> Flown:
    """Return a flight of random commands, or of given ones, from a random state."""
    rng = np.random.default_rng(seed)
    start = np.zeros(21, np.float32)
    start[2:6] = 5.0, *rng.normal(size=3) * 8.0
    start[QUATERNION] = Rotation.random(rng=rng).as_quat(scalar_first=True)
    start[RATES] = at_start.get("rates", rng.normal(size=3))
    start[16:20] = at_start.get("applied", rng.uniform(-0.5, 0.5, 4))
    start[20] = 24.0
    if commands is None:
        commands = rng.uniform(-1.0, 1.0, (20, 4))
    commands = np.asarray(commands, np.float32)
    found = fly(start, commands, MODEL.with_effects(*parameters))
    states, gyro, accelerometer = (np.asarray(leaf, float) for leaf in found)
    attitudes = np.concatenate([start[None, QUATERNION], states[:-1, QUATERNION]])
    to_body = Rotation.from_quat(attitudes, scalar_first=True).inv()
    force = to_body.apply(states[:, ACCELERATION] + GRAVITY_W)
    return Flown(start[RATES].astype(float), states[:, RATES], force, gyro, accelerometer)


def assert_reads(found: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-4)


def test_perfect_sensors_tell_the_truth():
    flight = flown()
    np.testing.assert_array_equal(flight.gyro, flight.rates)
    assert_reads(flight.accelerometer, flight.force)
    assert np.abs(flight.force[:, :2]).max() > 0.5  # drag is felt, gravity is not


def test_scale_then_bias_of_each_sensor():
    biases = AccelerometerBias(0.3, -0.2, 0.1), GyroBias(0.05, -0.04, 0.03)
    scales = AccelerometerScale(1.1, 0.9, 1.05), GyroScale(0.95, 1.02, 1.1)
    flight = flown(*biases, *scales)
    assert_reads(flight.accelerometer, flight.force * [1.1, 0.9, 1.05] + [0.3, -0.2, 0.1])
    assert_reads(flight.gyro, flight.rates * [0.95, 1.02, 1.1] + [0.05, -0.04, 0.03])


def test_an_accelerometer_on_an_arm_feels_the_spin():
    """At a constant yaw rate w, on an arm r along x: the centripetal r w^2, inwards."""
    spin = Action(0.0, 0.0, 1.0, -1.0)  # idle, so that the motors' imbalance does nothing
    yaw_rate = np.deg2rad(120.0)
    args = {"commands": np.tile(spin, (5, 1)), "applied": spin, "rates": (0.0, 0.0, yaw_rate)}
    for arm, felt in ((0.1, -0.1 * yaw_rate**2), (-0.05, 0.05 * yaw_rate**2)):
        flight = flown(ImuOffset(arm), **args)
        assert_reads(flight.accelerometer - flight.force, np.tile([felt, 0.0, 0.0], (5, 1)))
    along = flown(ImuOffset(0.0, 0.0, 0.1), **args)  # on the axis of rotation: nothing
    assert_reads(along.accelerometer, along.force)


def test_an_accelerometer_on_an_arm_is_swung_by_a_changing_rate():
    """From rest, yaw first turns an arm along x towards y, at r dw/dt."""
    still = (0.0, 0.0, 0.0, -1.0)
    args = {"commands": [(0.0, 0.0, 1.0, -1.0)], "applied": still, "rates": (0.0, 0.0, 0.0)}
    flight = flown(ImuOffset(0.1), **args)
    felt = (flight.accelerometer - flight.force)[0]
    assert felt[1] == pytest.approx(0.1 * flight.rates[0, 2] / DT, rel=1e-4) and felt[1] > 1.0


def test_an_arm_in_any_direction_follows_the_rigid_body():
    arm = np.array([0.05, -0.08, 0.03])
    flight = flown(ImuOffset(*arm))
    before = np.concatenate([flight.start_rates[None], flight.rates[:-1]])
    mean, change = 0.5 * (before + flight.rates), (flight.rates - before) / DT
    felt = np.cross(mean, np.cross(mean, arm)) + np.cross(change, arm)
    assert_reads(flight.accelerometer, flight.force + felt)


@pytest.mark.parametrize("steps", [0.0, 1.0, 2.0, 4.0, 0.3, 2.6])
def test_late_sensors_tell_what_was(steps):
    """Before the flight, the rates are taken to have been those of the start, the force that of its first."""
    flight = flown(ImuLatency(steps * DT))
    past = np.tile(flight.start_rates, (BUFFER_STEPS, 1)), np.tile(flight.force[0], (BUFFER_STEPS, 1))
    time = np.arange(-BUFFER_STEPS, 20)
    for found, truth, before in zip((flight.gyro, flight.accelerometer), flight[1:3], past, strict=True):
        known = np.concatenate([before, truth])
        then = [np.interp(time[BUFFER_STEPS:] - steps, time, known[:, axis]) for axis in range(3)]
        assert_reads(found, np.stack(then, axis=1))


def test_latency_beyond_what_is_remembered_is_refused():
    check_parameters(ImuLatency(0.04), DT)
    expected = r"imu_latency.latency_s: found 0.03, expected 0 to 0.02 s at steps of 0.005 s"
    with pytest.raises(ValueError, match=expected):
        check_parameters(ImuLatency(0.03), 0.005)


def test_sensors_differ_within_a_batch():
    rng = np.random.default_rng(1)
    start = jnp.zeros(21).at[9].set(1.0).at[20].set(24.0)
    commands = jnp.asarray(rng.uniform(-1.0, 1.0, (5, 4)), jnp.float32)
    biases = jnp.linspace(-0.1, 0.1, 4)
    batch = jax.vmap(lambda bias: fly(start, commands, MODEL.with_effects(GyroBias(bias)))[1])(biases)
    truth = fly(start, commands, MODEL)[1]
    np.testing.assert_allclose(batch[:, :, 0] - truth[:, 0], np.tile(biases[:, None], (1, 5)), atol=1e-6)
    np.testing.assert_array_equal(batch[:, :, 1:], np.tile(truth[:, 1:], (4, 1, 1)))


# --- The environment ------------------------------------------------------------------------------


def shown_and_true(env: Any, params: Any, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the rates that observations show and the true ones, (4, 3) rad/s, from a reset on."""
    rows = []
    observation, state = env.reset(jax.random.key(seed), params)
    for step in range(4):
        rows.append((np.asarray(observation[SHOWN]) * GYRO_SCALE, np.stack(env.drone(state).rates_b)))
        if step < 3:
            action = jnp.array([0.2, -0.1, 0.3, 0.0])
            observation, state, *_ = env.step_env(None, state, action, params)
    shown, true = zip(*rows, strict=True)
    return np.stack(shown), np.stack(true)


def test_the_observation_shows_the_gyro():
    bias = (0.1, -0.2, 0.3)
    env = FlyTrack(model=nominal_parameters().with_effects(GyroBias(*bias), AccelerometerBias(1.0)))
    shown, true = shown_and_true(env, env.default_params)
    np.testing.assert_allclose(shown, true + bias, atol=1e-5)
    noiseless = ObservationNoise(env)
    params = noiseless.default_params
    params = params.replace(wrappers={"observation_noise": NoiseParams(0.0, 0.0, 0.0, 0.0)})
    np.testing.assert_allclose(shown_and_true(noiseless, params)[0], shown, atol=1e-5)


def test_the_observation_is_late_with_a_late_gyro():
    env = FlyTrack(model=nominal_parameters().with_effects(ImuLatency(DT)))
    shown, true = shown_and_true(env, env.default_params)
    np.testing.assert_allclose(shown, true[[0, 0, 1, 2]], atol=1e-5)
    assert np.abs(np.diff(true, axis=0)).min() > 1e-3


def test_a_drone_without_effects_on_its_gyro_is_shown_as_it_is():
    env = FlyTrack(model=nominal_parameters().with_effects(AccelerometerBias(1.0), ImuOffset(0.1)))
    plain = FlyTrack()
    for seed in range(3):
        found, expected = (shown_and_true(each, each.default_params, seed) for each in (env, plain))
        np.testing.assert_array_equal(found, expected)


def test_another_plant_reports_rates_of_its_own():
    class Bare(Plant):
        """The simulator without a gyro."""

        reset, step, drone = Simulator.reset, Simulator.step, Simulator.drone

    env = FlyTrack(model=nominal_parameters().with_effects(GyroBias(0.5)), plant=Bare())
    shown, true = shown_and_true(env, env.default_params)
    np.testing.assert_allclose(shown, true, atol=1e-5)


def test_gyros_can_be_drawn():
    env = DomainRandomization(FlyTrack())
    ranges = RandomizationParams(low=(GyroBias(-0.3, -0.3, None),), high=(GyroBias(0.3, 0.3, None),))
    params = env.default_params.replace(wrappers={"domain_randomization": ranges})
    drawn = []
    for seed in range(3):
        shown, true = shown_and_true(env, params, seed)
        bias = env.model(env.reset(jax.random.key(seed), params)[1], params).effect("gyro_bias")
        np.testing.assert_allclose(shown - true, np.tile(np.array(bias), (4, 1)), atol=1e-5)
        drawn.append(np.array(bias))
    assert np.ptp(drawn, axis=0)[:2].min() > 0.0 and not np.any(np.stack(drawn)[:, 2])


def test_the_gyro_alone_reads_the_same():
    model = MODEL.with_effects(GyroBias(0.1), ImuLatency(0.007))
    before = SIMULATOR.reset(unpack(jnp.zeros(21).at[9].set(1.0)), model)
    after = SIMULATOR.step(before, Action(1.0, 1.0, 1.0, 0.0), DT, model)
    both = read_sensors(before.drone, after.drone, after.memories, DT, model)
    alone = read_gyro(after.drone, after.memories, DT, model)
    np.testing.assert_array_equal(both.rates_b, alone)
    assert np.abs(np.array(alone) - np.array(after.drone.rates_b)).max() > 0.05
