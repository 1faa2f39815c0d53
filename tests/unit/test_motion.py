"""How a model moves within a step: continuous motion against a hidden plant's in fine parts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_bench.hidden import HiddenDrone, Truth, drone
from flytrack_env import effects
from flytrack_env.dynamics import move
from flytrack_env.motion import Motion
from flytrack_env.state import Action, unpack
from tests.support.hidden_flights import LOW_START, flown_in_floats, state_of
from tests.support.simulated_flights import UNEVEN, fly, padded

DRAG = effects.LinearDrag(0.3, 0.2, 0.1)
ARM_B = np.array([0.02, -0.01, 0.03])
SECONDS = 0.6
COMMAND_S = 0.02  # how long the pilot holds a command
PLAIN = UNEVEN._replace(motion=Motion.CONTINUOUS)
DRAGGED = PLAIN.with_effects(DRAG, effects.YawReaction(0.05))
LOOP = DRAGGED.with_effects(effects.SecondOrderRates(*[0.02] * 3, *[0.6] * 3))
FULL = LOOP.with_effects(effects.CommandDelay(0.013))
# Neutral effects change nothing (tests/contract/test_effects.py), so that all models have these.
NEUTRAL = (
    effects.LinearDrag(),
    effects.YawReaction(),
    effects.SecondOrderRates(),
    effects.CommandDelay(),
    effects.ImuOffset(),
    effects.ImuLatency(),
)
LONGEST = 600  # steps
START = np.array(
    [0, 0, 5, 3, -2, 1, 0, 0, 0, 0.9, 0.1, -0.3, 0.3, 0, 0, 0, 0.1, -0.2, 0.3, 0.2, 23.5]
)
START[9:13] /= np.linalg.norm(START[9:13])
START[13:16] = np.radians(PLAIN.max_rate) * START[16:19]
AT_REST = state_of(HiddenDrone(Truth(*PLAIN[:2]), LOW_START, np.random.default_rng(0)))


def held_commands():
    """Return the pilot's commands, (num_holds, 4); the first is what ``AT_REST`` has applied."""
    commands = np.random.default_rng(5).uniform(-0.9, 0.9, (round(SECONDS / COMMAND_S), 4))
    commands[0] = AT_REST[16:20]
    return commands


def flown(model, dt, start=START):
    """Return states (num_steps, 21), gyro and accelerometer (num_steps, 3), at steps of ``dt``.

    All flights have one length and the same effects: one program is compiled for a motion.
    """
    commands = np.repeat(held_commands(), round(COMMAND_S / dt), axis=0)
    full = model.with_effects(*NEUTRAL, *model.effects)
    with jax.enable_x64(True):
        rows = np.asarray(fly(unpack(jnp.asarray(start)), padded(commands, LONGEST), full, dt))[
            : len(commands)
        ]
    return rows[:, :21], rows[:, 21:24], rows[:, 24:27]


def reference(model):
    """Return position, velocity, attitude and specific force, body, at every 20 ms.

    Those of a hidden plant in parts of 0.1 ms, which shares no code with the package.
    """
    laws = {effects.effect_of(law).name: law._asdict() for law in model.effects}
    arrays = (tuple(map(float, values)) for values in PLAIN[:3])
    numbers = (PLAIN.battery_drain_v_per_min, PLAIN.m, PLAIN.g)
    truth = Truth(*arrays, *numbers, laws, motion="fine", step_s=COMMAND_S)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(drone, "MAX_SUBSTEP_S", 1e-4)
        flight = flown_in_floats(truth, held_commands(), LOW_START)
    return tuple(flight[name] for name in "pvqf")


def errors(model, dt, exact):
    """Return the largest errors of position, velocity, attitude and specific force."""
    every = round(COMMAND_S / dt)
    states, _, forces_b = (rows[every - 1 :: every] for rows in flown(model, dt, AT_REST))
    quats = states[:, 9:13] * np.sign(np.sum(states[:, 9:13] * exact[2], axis=1, keepdims=True))
    measured = (states[:, :3], states[:, 3:6], quats, forces_b)
    return np.array([np.abs(ours - true).max() for ours, true in zip(measured, exact, strict=True)])


# Largest errors of position, m, velocity, m/s, attitude and specific force, m/s^2, at steps of 10
# ms; and how many times smaller they are at 5 ms. A delay ends anywhere within a step: its error
# shrinks unevenly.
@pytest.mark.parametrize(
    ("model", "most", "least_order"),
    [
        pytest.param(DRAGGED, (1e-5, 5e-5, 5e-6, 2e-4), 3.0, marks=pytest.mark.slow),
        pytest.param(LOOP, (1e-3, 3e-3, 1e-3, 2e-3), 3.0, marks=pytest.mark.slow),
        (FULL, (3e-4, 1.5e-3, 1e-3, 0.05), 1.0),
    ],
)
def test_a_continuous_step_is_that_of_the_differential_equations(model, most, least_order):
    exact = reference(model)
    coarse, fine = errors(model, 0.01, exact), errors(model, 0.005, exact)
    assert np.all(coarse < most)
    assert np.all(coarse / fine > least_order)
    assert np.all(errors(model._replace(motion=Motion.EULER), 0.01, exact) > 3.0 * coarse)


def test_a_semi_implicit_force_has_the_attitude_after_the_step():
    with jax.enable_x64(True):
        drone, command = unpack(jnp.asarray(START)), Action(0.5, -0.3, 0.2, 0.4)
        at_once, semi = (
            move(drone, (), command, 0.01, PLAIN._replace(motion=motion)).after
            for motion in (Motion.EULER, Motion.SEMI_IMPLICIT)
        )
    thrust = np.linalg.norm(np.array(semi.acc_w) + np.array([0.0, 0.0, PLAIN.g]))
    axis = Rotation.from_quat(semi.quat, scalar_first=True).as_matrix()[:, 2]
    np.testing.assert_allclose(semi.acc_w, axis * thrust - [0.0, 0.0, PLAIN.g], rtol=1e-12)
    np.testing.assert_array_equal(semi.quat, at_once.quat)
    assert np.abs(np.array(semi.acc_w) - np.array(at_once.acc_w)).max() > 0.1


def test_an_accelerometer_off_the_centre_feels_the_turn_of_the_moment():
    """The reading against finite differences of the gyro at steps of 1 ms."""
    offset = PLAIN.with_effects(effects.ImuOffset(*ARM_B))
    _, gyro, felt = flown(offset, 1e-3)
    plain = flown(PLAIN, 1e-3)[2]
    inside = np.arange(len(gyro))[5:15]  # within the first command
    turning = (gyro[inside + 1] - gyro[inside - 1]) / 2e-3
    expected = np.cross(gyro[inside], np.cross(gyro[inside], ARM_B)) + np.cross(turning, ARM_B)
    np.testing.assert_allclose((felt - plain)[inside], expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("late_ms", [3, 14])
def test_late_readings_are_those_of_a_moment_within_a_step(late_ms):
    """Readings at 100 Hz against those at 1 kHz, of which each is at its moment."""
    smooth = PLAIN.with_effects(DRAG)  # nothing jumps where a command does
    _, gyro, felt = flown(smooth.with_effects(effects.ImuLatency(1e-3 * late_ms)), 1e-2)
    _, true_gyro, true_felt = flown(smooth, 1e-3)
    then = np.arange(3, len(gyro)) * 10 + 9 - late_ms
    for reading, true in ((gyro[3:], true_gyro[then]), (felt[3:], true_felt[then])):
        assert np.abs(reading - true).max() < 0.002 * np.abs(np.diff(true, axis=0)).max()
