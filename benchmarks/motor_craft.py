"""Quadcopters as rigid bodies with motors in NumPy, many at once; no code is the package's.

Newton's and Euler's equations with a whole inertia matrix, in vectors and rotation matrices,
integrated by Runge-Kutta's fourth order at 1 ms. Axes and order of motors are the package's: x
forward, y left, z up; rear right, front right, rear left, front left. A pilot with a rate loop at
the rate of the log keeps a craft in the air.
"""

from typing import NamedTuple

import numpy as np

GRAVITY = 9.80665
PLACES = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])  # ahead, left
YAW = np.array([1.0, -1.0, -1.0, 1.0])  # reaction of each propeller on the craft
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

    pos: np.ndarray
    vel: np.ndarray
    turn: np.ndarray
    rates: np.ndarray
    speeds: np.ndarray


def hovering(crafts: Crafts, height_m: float = 2.0) -> State:
    """Return level crafts at rest whose motors turn as for a hover."""
    count = len(crafts.mass)
    pos = np.tile([0.0, 0.0, height_m], (count, 1))
    speed = speed_for(crafts, crafts.mass * GRAVITY / crafts.thrust.sum(axis=1))
    identity, zeros = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    return State(pos, zeros, identity, zeros, np.repeat(speed[:, None], 4, axis=1))


def speed_for(crafts: Crafts, share: np.ndarray) -> np.ndarray:
    """Return the speed at which a motor gives a share of its full thrust, the root of a square."""
    a, b = 1.0 - crafts.linear, crafts.linear
    b, a = (value.reshape(-1, *[1] * (np.ndim(share) - 1)) for value in (b, a))
    return (np.sqrt(b * b + 4.0 * a * np.maximum(share, 0.0)) - b) / (2.0 * a)


def compute_thrusts(crafts: Crafts, speeds: np.ndarray) -> np.ndarray:
    """Return the thrust of each motor, N, (n, 4)."""
    linear = crafts.linear[:, None]
    return crafts.thrust * (linear * speeds + (1.0 - linear) * speeds**2)


def specific_force(crafts: Crafts, state: State) -> np.ndarray:
    """Return what an accelerometer at the centre of mass reads, body, m/s^2, (n, 3)."""
    total = compute_thrusts(crafts, state.speeds).sum(axis=1)
    air = np.einsum("nij,ni->nj", state.turn, state.vel)
    force = -crafts.drag * air - crafts.quadratic * np.abs(air) * air
    force[:, :2] -= (crafts.rotor_drag * total)[:, None] * air[:, :2]
    force[:, 2] += total
    return force / crafts.mass[:, None]


def _change(crafts: Crafts, state: State, commands: np.ndarray) -> State:
    lag = np.where(commands > state.speeds, crafts.up_s[:, None], crafts.down_s[:, None])
    spin_up = (commands - state.speeds) / lag
    thrusts = compute_thrusts(crafts, state.speeds)
    force = np.zeros((*thrusts.shape, 3))
    force[..., 2] = thrusts
    torque = np.cross(crafts.places, force).sum(axis=1)
    torque[:, 2] += crafts.yaw_arm * (thrusts @ YAW) + crafts.momentum * (spin_up @ YAW)
    torque -= crafts.damping * state.rates
    momentum = np.einsum("nij,nj->ni", crafts.inertia, state.rates)
    momentum[:, 2] -= crafts.momentum * (state.speeds @ YAW)
    torque -= np.cross(state.rates, momentum)
    turning = np.cross(state.turn, state.rates[:, None])
    acc = np.einsum("nij,nj->ni", state.turn, specific_force(crafts, state))
    acc[:, 2] -= GRAVITY
    spun = np.linalg.solve(crafts.inertia, torque[..., None])[..., 0]
    return State(state.vel, acc, turning, spun, spin_up)


def advance(crafts: Crafts, state: State, commands: np.ndarray, step_s: float = STEP_S) -> State:
    """Return the state a step later under held commands (0 to 1), (n, 4), by Runge and Kutta."""

    def moved(change: State, share: float) -> State:
        return State(*(a + share * step_s * b for a, b in zip(state, change, strict=True)))

    k1 = _change(crafts, state, commands)
    k2 = _change(crafts, moved(k1, 0.5), commands)
    k3 = _change(crafts, moved(k2, 0.5), commands)
    k4 = _change(crafts, moved(k3, 1.0), commands)
    changes = zip(k1, k2, k3, k4, strict=True)
    return moved(State(*((a + 2.0 * b + 2.0 * c + d) / 6.0 for a, b, c, d in changes)), 1.0)


class Flight(NamedTuple):
    """What was flown, a row each ``dt``; (rows, n, ...). Commands act from their row on."""

    states: State
    commands: np.ndarray
    force: np.ndarray


class Pilot:
    """A pilot: random smooth accelerations and yaw rates, flown by loops of attitude and rates.

    Args:
        rng: of the setpoints.
        duration_s: of the flight.
        reach: of the accelerations, m/s^2.
    """

    def __init__(self, rng: np.random.Generator, count: int, duration_s: float, reach: float):
        self.knots = rng.uniform(-1.0, 1.0, (count, 4, int(duration_s / KNOT_S) + 3))
        self.reach = np.array([reach, reach, 0.6 * reach])

    def setpoints(self, time_s: float) -> np.ndarray:
        """Return the wished accelerations and yaw rate, (n, 4) shares."""
        knot, share = divmod(time_s / KNOT_S, 1.0)
        share = share * share * (3.0 - 2.0 * share)
        first, second = self.knots[..., int(knot)], self.knots[..., int(knot) + 1]
        return first + share * (second - first)

    def commands(self, crafts: Crafts, state: State, time_s: float) -> np.ndarray:
        """Return the motors' commands, (n, 4) in 0.02 to 1."""
        wished = self.setpoints(time_s)
        home = np.array([0.0, 0.0, 2.0])
        acc = wished[:, :3] * self.reach - 0.6 * state.vel - 0.15 * (state.pos - home)
        acc[:, 2] += GRAVITY
        acc[:, 2] = np.maximum(acc[:, 2], 0.3 * GRAVITY)
        up = acc / np.linalg.norm(acc, axis=1, keepdims=True)
        tilt = np.cross(state.turn[:, :, 2], up)
        error = np.einsum("nij,ni->nj", state.turn, tilt)
        rates = ATTITUDE_GAIN * error
        rates[:, 2] = wished[:, 3] * YAW_REACH
        turning = RATE_GAIN * (rates - state.rates)
        torque = np.einsum("nii->ni", crafts.inertia) * turning
        # The mixer knows the frame as it was meant to be: the mean arms of all four motors.
        arms = np.abs(crafts.places[:, :, :2]).mean(axis=1)
        arms = np.stack([arms[:, 1], arms[:, 0], np.abs(crafts.yaw_arm)], axis=1)
        torque[:, 2] = np.clip(torque[:, 2], -YAW_TORQUE * crafts.mass, YAW_TORQUE * crafts.mass)
        shares = torque / (4.0 * arms) @ TO_TORQUE
        along = np.einsum("ni,ni->n", acc, state.turn[:, :, 2]) * crafts.mass / 4.0
        full = crafts.thrust.mean(axis=1, keepdims=True)
        return np.clip(speed_for(crafts, (along[:, None] + shares) / full), 0.02, 1.0)


KNOT_S, ATTITUDE_GAIN, YAW_REACH = 0.35, 7.0, 2.0
RATE_GAIN = np.array([18.0, 18.0, 8.0])  # 1/s
YAW_TORQUE = 0.1  # N m a kg


def fly(
    crafts: Crafts, pilot: Pilot, duration_s: float, dt: float = 0.01, step_s: float = STEP_S
) -> Flight:
    """Return a flight from the hover."""
    state, rows = hovering(crafts), []
    for row in range(round(duration_s / dt)):
        commands = pilot.commands(crafts, state, row * dt)
        rows.append((state, commands, specific_force(crafts, state)))
        for _ in range(round(dt / step_s)):
            state = advance(crafts, state, commands, step_s)
        left, _, right = np.linalg.svd(state.turn)
        state = state._replace(turn=left @ right)
    states = State(*(np.stack(leaf) for leaf in zip(*(row[0] for row in rows), strict=True)))
    return Flight(states, np.stack([row[1] for row in rows]), np.stack([row[2] for row in rows]))
