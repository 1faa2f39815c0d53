"""What rivals that know no package share: the nominal model in NumPy, along a log and in flight."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from flytrack_bench.misspec import Flights
from flytrack_env.dynamics import ModelParameters
from flytrack_env.motion import Motion
from flytrack_env.thrust import collective_thrust
from flytrack_sysid import FlightLog

SECONDS_PER_MINUTE = 60.0
SKIPPED_S = 0.5  # of the log's beginning: lags depend on commands from before it
CERTAIN = 1e-3  # of a stick
WINDOW = 10  # rows over which attitude and velocity are differenced
UP = np.array([0.0, 0.0, 1.0])


class State(NamedTuple):
    """What features and residuals are functions of, a row each.

    Attributes:
        applied: lagged sticks, (n, 4).
        slope: of them (1/s), (n, 4).
        attitude: body to world, n.
        vel_w: m/s, (n, 3).
        pos_w: m, (n, 3).
        thrust: over mass, of the model (m/s^2), (n,).
        jerk: its slope (m/s^3), (n,).
        sag: its slope with a voltage that falls by thrust over full thrust (m/s^2 per V), (n,).
        rates_b: of the model (rad/s), (n, 3).
        turning_b: their slope (rad/s^2), (n, 3).
    """

    applied: np.ndarray
    slope: np.ndarray
    attitude: Rotation
    vel_w: np.ndarray
    pos_w: np.ndarray
    thrust: np.ndarray
    jerk: np.ndarray
    sag: np.ndarray
    rates_b: np.ndarray
    turning_b: np.ndarray

    @property
    def vel_b(self) -> np.ndarray:
        """Velocity in the body (m/s), (n, 3)."""
        return np.asarray(self.attitude.inv().apply(self.vel_w))


def state_of(
    model: ModelParameters,
    applied: np.ndarray,
    slope: np.ndarray,
    volt: np.ndarray,
    attitude: Rotation,
    vel_w: np.ndarray,
    pos_w: np.ndarray,
) -> State:
    """Return the state with what the nominal model makes of it."""
    _, linear, square, cube, by_volt, both = np.asarray(model.thrust_coeffs, float)
    stick, mass = applied[:, 3], float(model.m)
    per_stick = linear + both * volt + stick * (2.0 * square + 3.0 * cube * stick)
    thrust = thrust_over_mass(model, stick, volt)
    full = thrust_over_mass(model, np.ones_like(volt), volt)
    full_rates = np.radians(np.asarray(model.max_rate, float))
    return State(
        applied,
        slope,
        attitude,
        vel_w,
        pos_w,
        thrust,
        jerk=per_stick * slope[:, 3] / mass,
        sag=-(by_volt + both * stick) / mass * thrust / full,
        rates_b=full_rates * applied[:, :3],
        turning_b=full_rates * slope[:, :3],
    )


class Replay(NamedTuple):
    """The nominal model along a log.

    Attributes:
        state: at each row, where the log says it.
        motion: how the plant moves within a step.
        gyro: measured minus modelled rates (rad/s), (n, 3).
        force: measured minus modelled specific force (m/s^2), (n, 3).
        first: rows at which windows begin, and ``last`` where they end.
        turning: rate of turn over each window minus the model's, in its first body frame.
        pushing: the same of the change of velocity (m/s^2).
    """

    state: State
    motion: Motion
    gyro: np.ndarray
    force: np.ndarray
    first: np.ndarray
    last: np.ndarray
    turning: np.ndarray
    pushing: np.ndarray

    def turning_at(self, rows: np.ndarray) -> np.ndarray:
        """Return the model's rates in the steps that end in rows (rad/s), (rows, 3)."""
        rates_b = self.state.rates_b
        if self.motion is Motion.CONTINUOUS:
            return np.asarray(0.5 * (rates_b[rows - 1] + rates_b[rows]))
        return np.asarray(rates_b[rows])

    def turned(self, rates_b: np.ndarray) -> np.ndarray:
        """Return the mean of rates over each window, in its first body frame, (windows, 3)."""
        attitude = self.state.attitude
        mean_w = self.over_windows(attitude.apply(rates_b))
        return np.asarray(attitude[self.first].inv().apply(mean_w))

    def over_windows(self, rates_b: np.ndarray) -> np.ndarray:
        """Return the mean of rates over each window, (windows, 3).

        A simulator's rates are those of the steps that end in a row.
        """
        total = np.vstack([np.zeros(3), np.cumsum(rates_b, axis=0)])
        mean = (total[self.last + 1] - total[self.first + 1]) / WINDOW
        if self.motion is Motion.CONTINUOUS:  # the trapezoidal rule
            mean += (rates_b[self.first] - rates_b[self.last]) / (2.0 * WINDOW)
        return np.asarray(mean)

    def pushed(self, force_b: np.ndarray) -> np.ndarray:
        """Return the mean of forces over each window, in its first body frame, (windows, 3)."""
        attitude = self.state.attitude
        acting = attitude
        if self.motion is Motion.EULER:  # the force acts in the attitude before its step
            acting = attitude[np.maximum(np.arange(len(force_b)) - 1, 0)]
        mean_w = self.over_windows(acting.apply(force_b))
        return np.asarray(attitude[self.first].inv().apply(mean_w))


def thrust_over_mass(model: ModelParameters, stick: np.ndarray, volt: np.ndarray) -> np.ndarray:
    """Return the model's thrust over mass (m/s^2)."""
    coeffs = np.asarray(model.thrust_coeffs, float)
    return np.asarray(collective_thrust(stick, volt, coeffs)) / float(model.m)


def lagged(tau: Any, commands: np.ndarray, step_s: float) -> np.ndarray:
    """Return the lagged sticks at each row, (rows, ..., 4), from held commands (rows, ..., 4)."""
    before = np.concatenate([commands[:1], commands[:-1]])
    keep = np.exp(-step_s / np.asarray(tau, float))
    columns = [
        lfilter([1.0 - k], [1.0, -k], before[..., i], axis=0, zi=k * before[:1, ..., i])[0]
        for i, k in enumerate(keep)
    ]
    return np.stack(columns, axis=-1)


def replay(log: FlightLog, model: ModelParameters) -> Replay:
    """Return the nominal model along a log, where it is certain what was commanded."""
    step_s = float(np.median(np.diff(log.time)))
    index = np.round((log.time - log.time[0]) / step_s).astype(int)
    grid = np.arange(index[-1] + 1)
    before = np.searchsorted(index, grid, side="right") - 1
    applied, otherwise = (
        lagged(model.tau, log["u"][row], step_s) for row in (before, np.searchsorted(index, grid))
    )
    # A lost row's command is unknown: rows count where the one before or after it do the same.
    is_certain = np.abs(applied - otherwise).max(axis=1) < CERTAIN
    slope = np.gradient(applied, step_s, axis=0)
    is_used = (log.time >= log.time[0] + SKIPPED_S) & is_certain[index]
    rows, on_grid = log.select(is_used), index[is_used]
    attitude = Rotation.from_quat(rows["q"], scalar_first=True)
    volt = rows["v_bat"][:, 0]
    state = state_of(model, applied[on_grid], slope[on_grid], volt, attitude, rows["v"], rows["p"])
    thrust_b = state.thrust[:, None] * UP
    is_whole = np.convolve(np.diff(rows.time) > 1.5 * step_s, np.ones(WINDOW), "valid") == 0
    starts = np.arange(0, len(rows) - WINDOW, WINDOW)
    first = starts[is_whole[starts]]
    last = first + WINDOW
    found = Replay(
        state, model.motion, rows["w"] - state.rates_b, rows["f"] - thrust_b, first, last, UP, UP
    )
    duration = WINDOW * step_s
    # What is left of the turn after the model's, in the first body frame.
    turned = attitude[first].inv() * attitude[last]
    for row in range(1, WINDOW + 1)[::-1]:
        turned = turned * Rotation.from_rotvec(-step_s * found.turning_at(first + row))
    gained_w = (rows["v"][last] - rows["v"][first]) / duration + float(model.g) * UP
    return found._replace(
        turning=turned.as_rotvec() / duration,
        pushing=attitude[first].inv().apply(gained_w) - found.pushed(thrust_b),
    )


def fly(
    model: ModelParameters,
    flights: Flights,
    residual: Callable[[State], tuple[np.ndarray, np.ndarray]],
) -> np.ndarray:
    """Return positions at the ends of flights (m), (num_flights, 3), by the model's motion.

    Args:
        residual: returns what force (m/s^2) and rates (rad/s) of the body have beyond the model.
    """
    step_s, past = flights.step_s, flights.past
    applied = lagged(model.tau, flights.commands.swapaxes(0, 1), step_s)
    # One row more: the last command acts until the end of the flight.
    final = applied[-1] + (flights.commands[:, -1] - applied[-1]) * -np.expm1(
        -step_s / np.asarray(model.tau, float)
    )
    applied = np.concatenate([applied, final[None]])
    slope = np.gradient(applied, step_s, axis=0)
    pos_w, vel_w, volt = past["p"][:, -1], past["v"][:, -1], past["v_bat"][:, -1, 0]
    attitude = Rotation.from_quat(past["q"][:, -1], scalar_first=True)
    drop = float(model.battery_drain_v_per_min) / SECONDS_PER_MINUTE * step_s
    for row in range(len(applied) - flights.num_steps, len(applied)):
        stick, sloped = applied[row], slope[row]
        if model.motion is Motion.CONTINUOUS:
            stick, sloped = (0.5 * (values[row - 1] + values[row]) for values in (applied, slope))
        state = state_of(model, stick, sloped, volt, attitude, vel_w, pos_w)
        force_b, extra_b = residual(state)
        turn = (state.rates_b + extra_b) * step_s
        after = attitude * Rotation.from_rotvec(turn)
        acting = {
            Motion.EULER: attitude,
            Motion.SEMI_IMPLICIT: after,
            Motion.CONTINUOUS: attitude * Rotation.from_rotvec(0.5 * turn),
        }[model.motion]
        acc_w = acting.apply(state.thrust[:, None] * UP + force_b) - float(model.g) * UP
        pos_w = pos_w + vel_w * step_s + 0.5 * acc_w * step_s**2
        vel_w, attitude, volt = vel_w + acc_w * step_s, after, volt - drop
    return pos_w
