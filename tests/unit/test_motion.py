"""How a model moves within a step: continuous motion against SciPy's integrator and its own limit."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from flytrack_env.dynamics import ModelParameters, move
from flytrack_env.effects import (
    CommandDelay,
    ImuLatency,
    ImuOffset,
    LinearDrag,
    SecondOrderRates,
    YawReaction,
)
from flytrack_env.motion import Motion
from flytrack_env.state import Action, Drone, unpack
from tests.support.handout_plant import rotation
from tests.support.simulated_flights import fly

MASS, GRAVITY, DRAIN = 1.2, 9.81, 1.3
TAU = np.array([0.03, 0.05, 0.08, 0.04])
COEFFS = np.array([-9.0, -6.0, 3.1, 0.4, 0.9, 1.1])
FULL_RATES = np.array([600.0, 500.0, 130.0])
DRAG = np.array([0.3, 0.2, 0.1])
DELAY_S, REACTION, LOOP_LAG_S, DAMPING = 0.013, 0.05, 0.02, 0.6
ARM_B = np.array([0.02, -0.01, 0.03])
SECONDS = 0.6
COMMAND_S = 0.02  # how long the pilot holds a command
PLAIN = ModelParameters(TAU, COEFFS, FULL_RATES, MASS, GRAVITY, DRAIN, motion=Motion.CONTINUOUS)
DRAGGED = PLAIN.with_effects(LinearDrag(*DRAG), YawReaction(REACTION))
LOOP = DRAGGED.with_effects(SecondOrderRates(*[LOOP_LAG_S] * 3, *[DAMPING] * 3))
FULL = LOOP.with_effects(CommandDelay(DELAY_S))
START = np.array([0, 0, 5, 3, -2, 1, 0, 0, 0, 0.9, 0.1, -0.3, 0.3, 0, 0, 0, 0.1, -0.2, 0.3, 0.2, 23.5])
START[9:13] /= np.linalg.norm(START[9:13])


def held_commands() -> np.ndarray:
    """Return the pilot's commands, (num_holds, 4)."""
    return np.random.default_rng(5).uniform(-0.9, 0.9, (round(SECONDS / COMMAND_S), 4))


def flown(model: ModelParameters, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states (num_steps, 21), gyro and accelerometer readings (num_steps, 3) at steps of ``dt``."""
    commands = np.repeat(held_commands(), round(COMMAND_S / dt), axis=0)
    with jax.enable_x64(True):
        rows = np.asarray(fly(started(model), commands, model, dt))
    return rows[:, :21], rows[:, 21:24], rows[:, 24:27]


def started(model: ModelParameters) -> Drone:
    """Return the drone at the start, turning as its sticks say."""
    state = START.copy()
    state[13:16] = np.radians(FULL_RATES) * state[16:19]
    return unpack(jnp.asarray(state))


@cache
def reference(case: str) -> tuple[np.ndarray, np.ndarray]:
    """Return position, velocity, attitude, rates at every 20 ms by SciPy, and specific forces, body.

    The same physics as differential equations in NumPy, integrated between the instants at which a command
    arrives.
    """
    delay = DELAY_S if case == "delay" else 0.0
    commands, full = held_commands(), np.radians(FULL_RATES)

    def slopes(t: float, y: np.ndarray, command: np.ndarray) -> np.ndarray:
        vel, q, applied, rates, turning = y[3:6], y[6:10], y[10:14], y[14:17], y[17:20]
        lagging = (command - applied) / TAU
        wanted = full * applied[:3] + np.array([0.0, 0.0, REACTION * lagging[3]])
        natural = 2.0 * DAMPING / LOOP_LAG_S
        spin = wanted if case == "drag" else rates
        accelerating = natural**2 * (wanted - rates) - 2.0 * DAMPING * natural * turning
        w, x, yy, z = q
        a, b, c = spin
        turn = 0.5 * np.array(
            [-x * a - yy * b - z * c, w * a + yy * c - z * b, w * b - x * c + z * a, w * c + x * b - yy * a]
        )
        acc = rotation(q) @ force(t, vel, q, applied) - np.array([0.0, 0.0, GRAVITY])
        return np.concatenate([vel, acc, turn, lagging, turning, accelerating])

    def force(t: float, vel: np.ndarray, q: np.ndarray, applied: np.ndarray) -> np.ndarray:
        u, volt = applied[3], START[20] - DRAIN / 60.0 * t
        thrust = COEFFS @ [1.0, u, u**2, u**3, volt, u * volt]
        return np.array([0.0, 0.0, thrust / MASS]) - DRAG * (rotation(q).T @ vel)

    rates = full * START[16:19]
    y = np.concatenate([START[:6], START[9:13], START[16:20], rates, np.zeros(3)])
    arrivals = np.arange(len(commands)) * COMMAND_S + delay
    ends = (np.arange(len(commands)) + 1) * COMMAND_S
    now, rows, forces = 0.0, [], []
    for end in ends:
        for until in [*arrivals[(arrivals > now) & (arrivals < end)], end]:
            latest = np.flatnonzero(arrivals <= now + 1e-9)
            command = commands[latest[-1]] if len(latest) else START[16:20]
            y = solve_ivp(slopes, (now, until), y, "DOP853", args=(command,), rtol=1e-10, atol=1e-10).y[:, -1]
            now = until
        rows.append(y[:10])
        forces.append(force(now, y[3:6], y[6:10] / np.linalg.norm(y[6:10]), y[10:14]))
    return np.array(rows), np.array(forces)


def errors(model: ModelParameters, dt: float, case: str) -> np.ndarray:
    """Return the largest errors of position, velocity, attitude and specific force against SciPy."""
    states, _, forces_b = flown(model, dt)
    every = round(COMMAND_S / dt)
    states, forces_b = states[every - 1 :: every], forces_b[every - 1 :: every]
    rows, forces = reference(case)
    quats = states[:, 9:13] * np.sign(np.sum(states[:, 9:13] * rows[:, 6:10], axis=1, keepdims=True))
    pairs = (
        (states[:, :3], rows[:, :3]),
        (states[:, 3:6], rows[:, 3:6]),
        (quats, rows[:, 6:10]),
        (forces_b, forces),
    )
    return np.array([np.abs(one - other).max() for one, other in pairs])


# Largest errors of position, m, velocity, m/s, attitude and specific force, m/s^2, at steps of 10 ms; and how
# many times smaller they are at 5 ms. A delay ends anywhere within a step: its error shrinks unevenly.
@pytest.mark.parametrize(
    ("case", "most", "least_order"),
    [
        pytest.param("drag", (1e-5, 5e-5, 5e-6, 2e-4), 3.0, marks=pytest.mark.slow),
        pytest.param("loop", (1e-3, 3e-3, 1e-3, 2e-3), 3.0, marks=pytest.mark.slow),
        ("delay", (3e-4, 1.5e-3, 1e-3, 0.05), 1.0),
    ],
)
def test_a_continuous_step_is_that_of_the_differential_equations(case, most, least_order):
    model = {"drag": DRAGGED, "loop": LOOP, "delay": FULL}[case]
    coarse, fine = errors(model, 0.01, case), errors(model, 0.005, case)
    assert np.all(coarse < most)
    assert np.all(coarse / fine > least_order)
    assert np.all(errors(model._replace(motion=Motion.HANDOUT), 0.01, case) > 3.0 * coarse)


def test_a_semi_implicit_force_has_the_attitude_after_the_step():
    with jax.enable_x64(True):
        drone, command = started(PLAIN), Action(0.5, -0.3, 0.2, 0.4)
        at_once, semi = (
            move(drone, (), command, 0.01, PLAIN._replace(motion=motion)).after
            for motion in (Motion.HANDOUT, Motion.SEMI_IMPLICIT)
        )
    thrust = np.linalg.norm(np.array(semi.acc_w) + np.array([0.0, 0.0, GRAVITY]))
    axis = rotation(np.array(semi.quat))[:, 2]
    np.testing.assert_allclose(semi.acc_w, axis * thrust - [0.0, 0.0, GRAVITY], rtol=1e-12)
    np.testing.assert_array_equal(semi.quat, at_once.quat)
    assert np.abs(np.array(semi.acc_w) - np.array(at_once.acc_w)).max() > 0.1


def test_free_fall_is_exact_and_attitudes_keep_their_norm():
    without_thrust = PLAIN._replace(thrust_coeffs=np.zeros(6))
    states = flown(without_thrust, COMMAND_S)[0]
    time = COMMAND_S * np.arange(1, len(states) + 1)[:, None]
    fall = np.array([0.0, 0.0, -GRAVITY])
    np.testing.assert_allclose(
        states[:, :3], START[:3] + START[3:6] * time + 0.5 * fall * time**2, atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.norm(states[:, 9:13], axis=1), 1.0, atol=1e-12)


def test_an_accelerometer_off_the_centre_feels_the_turn_of_the_moment():
    """The reading against finite differences of the gyro at steps of 1 ms."""
    offset = PLAIN.with_effects(ImuOffset(*ARM_B))
    _, gyro, felt = flown(offset, 1e-3)
    plain = flown(PLAIN, 1e-3)[2]
    inside = np.arange(len(gyro))[5:15]  # within the first command
    turning = (gyro[inside + 1] - gyro[inside - 1]) / 2e-3
    expected = np.cross(gyro[inside], np.cross(gyro[inside], ARM_B)) + np.cross(turning, ARM_B)
    np.testing.assert_allclose((felt - plain)[inside], expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("late_ms", [3, 14])
def test_late_readings_are_those_of_a_moment_within_a_step(late_ms):
    """Readings at 100 Hz against those at 1 kHz, of which each is at its moment."""
    smooth = PLAIN.with_effects(LinearDrag(*DRAG))  # nothing jumps where a command does
    _, gyro, felt = flown(smooth.with_effects(ImuLatency(1e-3 * late_ms)), 1e-2)
    _, true_gyro, true_felt = flown(smooth, 1e-3)
    then = np.arange(3, len(gyro)) * 10 + 9 - late_ms
    for found, true in ((gyro[3:], true_gyro[then]), (felt[3:], true_felt[then])):
        assert np.abs(found - true).max() < 0.002 * np.abs(np.diff(true, axis=0)).max()


@pytest.mark.parametrize("motion", Motion)
def test_a_step_is_differentiable_and_batched(motion):
    def height(tau: jax.Array, stick: jax.Array) -> jax.Array:
        model = PLAIN._replace(tau=tau, motion=motion)
        return move(started(model), (), Action(0.1, 0.2, 0.3, stick), 0.01, model).after.vel_w.z

    with jax.enable_x64(True):
        sticks = jnp.array([-0.5, 0.5])
        slopes = jax.vmap(jax.grad(height), (None, 0))(jnp.asarray(TAU), sticks)
        moved = jax.vmap(height, (None, 0))(jnp.asarray(TAU).at[3].add(1e-6), sticks)
        before = jax.vmap(height, (None, 0))(jnp.asarray(TAU), sticks)
        slopes, expected = np.asarray(slopes[:, 3]), np.asarray((moved - before) / 1e-6)
    np.testing.assert_allclose(slopes, expected, rtol=1e-3)
