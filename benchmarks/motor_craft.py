"""Quadcopters as rigid bodies with motors, many at once, in float64; no code is the package's.

Newton's and Euler's equations with a whole inertia matrix, in vectors and rotation matrices,
integrated by Runge-Kutta's fourth order at 1 ms. Axes and order of motors are the package's: x
forward, y left, z up; rear right, front right, rear left, front left. A pilot with a rate loop at
the rate of the log keeps a craft in the air.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

GRAVITY = 9.80665
PLACES = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])  # ahead, left
YAW = np.array([1.0, -1.0, -1.0, 1.0])  # reaction of each propeller on the craft
UP = np.array([0.0, 0.0, 1.0])
STEP_S = 1e-3
TO_TORQUE = np.stack([PLACES[:, 1], -PLACES[:, 0], YAW])  # (3, 4)


class Crafts(NamedTuple):
    """Crafts; (n, ...) each.

    Attributes:
        mass: kg, (n,).
        inertia: kg m^2, (n, 3, 3).
        places: of the motors from the centre of mass, m, (n, 4, 3).
        thrust: of each motor at full speed, N, (n, 4).
        linear: share of the thrust that goes with the speed, not with its square, (n,).
        yaw_arm: torque over thrust, m, (n,).
        up_s: lag of a motor that speeds up, (n,).
        down_s: of one that slows down, (n,).
        momentum: of a rotor at full speed, kg m^2/s, (n,).
        drag: force against the airspeed, by body axis, N s/m, (n, 3).
        quadratic: the same with the square of each axis's airspeed, N s^2/m^2, (n, 3).
        rotor_drag: force against the airspeed in the rotors' plane over the thrust, s/m, (n,).
        damping: torque against the rates, N m s, (n, 3).
    """

    mass: np.ndarray
    inertia: np.ndarray
    places: np.ndarray
    thrust: np.ndarray
    linear: np.ndarray
    yaw_arm: np.ndarray
    up_s: np.ndarray
    down_s: np.ndarray
    momentum: np.ndarray = np.zeros(1)
    drag: np.ndarray = np.zeros((1, 3))
    quadratic: np.ndarray = np.zeros((1, 3))
    rotor_drag: np.ndarray = np.zeros(1)
    damping: np.ndarray = np.zeros((1, 3))


class State(NamedTuple):
    """Position, velocity, attitude as a matrix, rates, speeds of the motors (0 to 1); (n, ...)."""

    pos: Any
    vel: Any
    turn: Any
    rates: Any
    speeds: Any


def hovering(crafts: Crafts) -> State:
    """Return level crafts at rest at 2 m whose motors turn as for a hover."""
    count = len(crafts.mass)
    pos = np.tile(2.0 * UP, (count, 1))
    speed = speed_for(crafts, crafts.mass * GRAVITY / crafts.thrust.sum(axis=1))
    identity, zeros = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    return State(pos, zeros, identity, zeros, np.repeat(speed[:, None], 4, axis=1))


def speed_for(crafts: Crafts, share: Any) -> Any:
    """Return the speed at which a motor gives a share of its full thrust, the root of a square."""
    a, b = 1.0 - crafts.linear, crafts.linear
    return ((b * b + 4.0 * a * share.clip(0.0)) ** 0.5 - b) / (2.0 * a)


# Of one craft.


def _thrusts(craft: Crafts, speeds: Any) -> Any:
    """Return the thrust of each motor, N, (4,)."""
    return craft.thrust * (craft.linear * speeds + (1.0 - craft.linear) * speeds**2)


def _specific_force(craft: Crafts, state: State) -> Any:
    """Return what an accelerometer at the centre of mass reads, body, m/s^2, (3,)."""
    total = _thrusts(craft, state.speeds).sum()
    air = state.turn.T @ state.vel
    drag = craft.drag * air + craft.quadratic * abs(air) * air
    drag += craft.rotor_drag * total * (air - air * UP)
    return (total * UP - drag) / craft.mass


def _change(craft: Crafts, state: State, commands: Any) -> State:
    lag = jnp.where(commands > state.speeds, craft.up_s, craft.down_s)
    spin_up = (commands - state.speeds) / lag
    thrusts = _thrusts(craft, state.speeds)
    torque = jnp.cross(craft.places, thrusts[:, None] * UP).sum(axis=0)
    torque += (craft.yaw_arm * (thrusts @ YAW) + craft.momentum * (spin_up @ YAW)) * UP
    momentum = craft.inertia @ state.rates - craft.momentum * (state.speeds @ YAW) * UP
    torque -= craft.damping * state.rates + jnp.cross(state.rates, momentum)
    acc = state.turn @ _specific_force(craft, state) - GRAVITY * UP
    turning = jnp.cross(state.turn, state.rates)
    return State(state.vel, acc, turning, jnp.linalg.solve(craft.inertia, torque), spin_up)


def _advance(craft: Crafts, state: State, commands: Any, step_s: Any) -> State:
    """Return the state a step later under held commands (0 to 1), (4,), by Runge and Kutta."""

    def moved(change: State, share: float) -> State:
        return jax.tree.map(lambda a, b: a + share * step_s * b, state, change)

    k1 = _change(craft, state, commands)
    k2 = _change(craft, moved(k1, 0.5), commands)
    k3 = _change(craft, moved(k2, 0.5), commands)
    k4 = _change(craft, moved(k3, 1.0), commands)
    changes = jax.tree.map(lambda a, b, c, d: (a + 2.0 * b + 2.0 * c + d) / 6.0, k1, k2, k3, k4)
    return moved(changes, 1.0)


KNOT_S, ATTITUDE_GAIN, YAW_REACH = 0.35, 7.0, 2.0
RATE_GAIN = np.array([18.0, 18.0, 8.0])  # 1/s
YAW_TORQUE = 0.1  # N m a kg


def _steer(craft: Crafts, knots: Any, reach: Any, state: State, time_s: Any) -> Any:
    """Return a pilot's commands of the motors, (4,) in 0.02 to 1; knots: (4, num_knots)."""
    knot, share = jnp.divmod(time_s / KNOT_S, 1.0)
    share = share * share * (3.0 - 2.0 * share)
    first, second = knots[:, knot.astype(int)], knots[:, knot.astype(int) + 1]
    *push, yaw = first + share * (second - first)
    acc = jnp.stack(push) * reach - 0.6 * state.vel - 0.15 * (state.pos - 2.0 * UP) + GRAVITY * UP
    acc = acc.at[2].set(jnp.maximum(acc[2], 0.3 * GRAVITY))
    tilt = jnp.cross(state.turn[:, 2], acc / jnp.linalg.norm(acc))
    rates = ATTITUDE_GAIN * (state.turn.T @ tilt)
    rates = rates.at[2].set(yaw * YAW_REACH)
    torque = jnp.diag(craft.inertia) * RATE_GAIN * (rates - state.rates)
    most = YAW_TORQUE * craft.mass
    torque = torque.at[2].set(jnp.clip(torque[2], -most, most))
    # The mixer knows the frame as it was meant to be: the mean arms of all four motors.
    ahead, left = jnp.abs(craft.places[:, :2]).mean(axis=0)
    shares = torque / (4.0 * jnp.stack([left, ahead, abs(craft.yaw_arm)])) @ TO_TORQUE
    along = acc @ state.turn[:, 2] * craft.mass / 4.0
    return jnp.clip(speed_for(craft, (along + shares) / craft.thrust.mean()), 0.02, 1.0)


# Of all crafts.


@jax.jit
def _advance_all(crafts: Crafts, state: State, commands: Any, step_s: Any) -> State:
    return jax.vmap(_advance, (0, 0, 0, None))(crafts, state, commands, step_s)


def advance(crafts: Crafts, state: State, commands: np.ndarray, step_s: float = STEP_S) -> State:
    """Return the state a step later under held commands (0 to 1), (n, 4), by Runge and Kutta."""
    with jax.enable_x64(True):
        return jax.tree.map(np.array, _advance_all(crafts, state, commands, step_s))


class Flight(NamedTuple):
    """What was flown, a row each ``dt``; (rows, n, ...). Commands act from their row on."""

    states: State
    commands: np.ndarray
    force: np.ndarray


class Pilot:
    """A pilot: random smooth accelerations and yaw rates, flown by loops of attitude and rates.

    Args:
        rng: of the setpoints.
        count: crafts that it flies.
        duration_s: of the flight.
        reach: of the accelerations, m/s^2.
    """

    def __init__(self, rng: np.random.Generator, count: int, duration_s: float, reach: float):
        self.knots = rng.uniform(-1.0, 1.0, (count, 4, int(duration_s / KNOT_S) + 3))
        self.reach = np.array([reach, reach, 0.6 * reach])


def fly(
    crafts: Crafts, pilot: Pilot, duration_s: float, dt: float = 0.01, step_s: float = STEP_S
) -> Flight:
    """Return a flight from the hover."""
    times_s = np.arange(round(duration_s / dt)) * dt
    with jax.enable_x64(True):
        steering = pilot.knots, pilot.reach, times_s
        flown = _fly(crafts, hovering(crafts), *steering, round(dt / step_s), step_s)
        return jax.tree.map(np.array, flown)


@jax.jit
def _fly(
    crafts: Crafts, start: State, knots: Any, reach: Any, times_s: Any, steps: Any, step_s: Any
) -> Flight:
    def fly_row(state: State, time_s: Any) -> tuple[State, Flight]:
        steer = jax.vmap(_steer, (0, 0, None, 0, None))
        commands = steer(crafts, knots, reach, state, time_s)
        row = Flight(state, commands, jax.vmap(_specific_force)(crafts, state))
        state = jax.lax.fori_loop(
            0, steps, lambda _, state: _advance_all(crafts, state, commands, step_s), state
        )
        left, _, right = jnp.linalg.svd(state.turn)
        return state._replace(turn=left @ right), row

    rows: Flight = jax.lax.scan(fly_row, jax.tree.map(jnp.asarray, start), times_s)[1]
    return rows
