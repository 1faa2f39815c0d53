"""Black-box models of a drone, trained on the rows that a diagnosis learns from, flown as it is.

All give the body rates after a step and the specific force within it; attitude, velocity and
position follow by integration. None sees where the drone is: a path that all flights share cannot
help them.

==========  =================================================================================
name        what it is
==========  =================================================================================
``fir``     linear in the commands of the last 0.3 s; the force also in the body velocity
``arx``     linear in the commands of 0.1 s, its own last five rates, the body velocity
``network`` the refitted base, and a small network on the same commands for what it leaves
==========  =================================================================================
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.diagnosis.flight_errors import FlightErrors
from flytrack_sysid.inference.free_flight import HORIZONS_S, Windows
from flytrack_sysid.inference.one_step import columns, predict
from flytrack_sysid.inference.record import fill_gaps
from flytrack_sysid.log import FlightLog, median_step
from flytrack_sysid.split import held_out_rows

LONG_S, PAST_RATES_S = 0.3, 0.05  # of commands, of rates
SHORT = 3  # the latest commands are those of LONG_S / SHORT
RIDGE = 1e-3  # in units of the regressors' variance
WIDTH, EPOCHS, PATIENCE, MINIBATCH, RATE = 16, 200, 15, 256, 3e-3
GRAVITY = np.array([0.0, 0.0, 9.80665])


class Rows(NamedTuple):
    """Rows with enough of a past, and what comes of each; all (num_rows, ...).

    Attributes:
        commands: (num_rows, past, 4), the latest last.
        past_rates_b: (num_rows, past, 3).
        base: rates after the step and specific force of the refitted base, body, (num_rows, 6).
        target: the measured ones.
    """

    commands: np.ndarray
    past_rates_b: np.ndarray
    vel_b: np.ndarray
    base: np.ndarray
    target: np.ndarray
    is_held_out: np.ndarray


BlackBox = Callable[[Rows], np.ndarray]


def base_steps(model: ModelParameters, log: FlightLog) -> np.ndarray:
    """Return the base's rates and specific force after a step from every row, body frame."""
    after = predict(model, fill_gaps(log)).after
    to_body = Rotation.from_quat(log["q"], scalar_first=True).inv()
    return np.c_[columns(after.rates_b), to_body.apply(columns(after.acc_w) + GRAVITY)]


def rows_of(log: FlightLog, model: ModelParameters) -> Rows:
    """Return the rows of a log without gaps."""
    step_s, is_start = median_step(log), log.is_start()
    num_commands, num_rates = _past(step_s)
    age = np.arange(len(log)) - np.maximum.accumulate(np.where(is_start, np.arange(len(log)), 0))
    has_next = np.append(~is_start[1:], False)
    now = np.flatnonzero((age >= num_commands - 1) & has_next)
    to_body = Rotation.from_quat(log["q"][now], scalar_first=True).inv()
    acc_w = (log["v"][now + 1] - log["v"][now]) / step_s
    return Rows(
        commands=log["u"][now[:, None] + np.arange(1 - num_commands, 1)],
        past_rates_b=log["w"][now[:, None] + np.arange(1 - num_rates, 1)],
        vel_b=to_body.apply(log["v"][now]),
        base=base_steps(model, log)[now],
        target=np.c_[log["w"][now + 1], to_body.apply(acc_w + GRAVITY)],
        is_held_out=held_out_rows(log)[now],
    )


def _past(step_s: float) -> tuple[int, int]:
    """Return the rows of commands and of rates that are known."""
    return round(LONG_S / step_s), round(PAST_RATES_S / step_s)


def with_pose(log: FlightLog) -> FlightLog:
    """Return the log with attitude and velocity; level and at rest if it has none."""
    level = {"q": np.tile([1.0, 0.0, 0.0, 0.0], (len(log), 1)), "v": np.zeros((len(log), 3))}
    return replace(log, channels=level | dict(log.channels))


def _flat(values: np.ndarray) -> np.ndarray:
    return values.reshape(len(values), -1)


def _latest(rows: Rows) -> np.ndarray:
    return _flat(rows.commands[:, -(rows.commands.shape[1] // SHORT) :])


def _fir(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    commands = _flat(rows.commands)
    return commands, np.c_[commands, rows.vel_b]


def _arx(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    regressors = np.c_[_latest(rows), _flat(rows.past_rates_b)]
    return regressors, np.c_[regressors, rows.vel_b]


def fit_ridge(inputs: np.ndarray, outputs: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return a ridge regression with an offset, as a function of inputs."""
    mean, spread = inputs.mean(axis=0), inputs.std(axis=0) + 1e-9

    def scale(inputs: np.ndarray) -> np.ndarray:
        return np.c_[(inputs - mean) / spread, np.ones(len(inputs))]

    scaled = scale(inputs)
    damping = RIDGE * len(inputs) * np.diag([*np.ones(len(mean)), 1e-9])
    slopes = np.linalg.solve(scaled.T @ scaled + damping, scaled.T @ outputs)
    return lambda inputs: scale(inputs) @ slopes


def fit_linear(rows: Rows, regressors: Callable[[Rows], tuple[np.ndarray, np.ndarray]]) -> BlackBox:
    """Return a ridge regression of rates and of force, each on its own regressors."""
    of_rates, of_force = regressors(rows)
    rates = fit_ridge(of_rates, rows.target[:, :3])
    force = fit_ridge(of_force, rows.target[:, 3:])

    def black_box(rows: Rows) -> np.ndarray:
        of_rates, of_force = regressors(rows)
        return np.c_[rates(of_rates), force(of_force)]

    return black_box


class _Network(nn.Module):
    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        hidden = nn.tanh(nn.Dense(WIDTH)(nn.tanh(nn.Dense(WIDTH)(inputs))))
        return nn.Dense(6, kernel_init=nn.initializers.zeros)(hidden)


def fit_network(rows: Rows) -> BlackBox:
    """Return the base with a network for its residual, stopped early by every fourth block."""

    def stack_inputs(rows: Rows) -> np.ndarray:
        return np.c_[_latest(rows), rows.base, rows.vel_b]

    inputs, residual = stack_inputs(rows), rows.target - rows.base
    mean, spread, size = inputs.mean(axis=0), inputs.std(axis=0) + 1e-9, residual.std(axis=0)
    inputs = ((inputs - mean) / spread).astype(np.float32)
    residual = (residual / size).astype(np.float32)
    module, optimizer = _Network(), optax.adam(RATE)
    weights = module.init(jax.random.key(0), inputs[:1])

    @jax.jit
    def loss(weights: Any, inputs: jax.Array, residual: jax.Array) -> jax.Array:
        return jnp.mean(optax.huber_loss(module.apply(weights, inputs), residual))

    @jax.jit
    def update(weights: Any, memory: Any, inputs: jax.Array, residual: jax.Array) -> Any:
        gradient = jax.grad(loss)(weights, inputs, residual)
        change, memory = optimizer.update(gradient, memory)
        return optax.apply_updates(weights, change), memory

    rng, memory = np.random.default_rng(0), optimizer.init(weights)
    is_held_out = rows.is_held_out
    trained, best, lowest, waited = np.flatnonzero(~is_held_out), weights, np.inf, 0
    for _ in range(EPOCHS):
        edges = np.arange(MINIBATCH, len(trained), MINIBATCH)
        for batch in np.split(rng.permutation(trained), edges)[:-1]:
            weights, memory = update(weights, memory, inputs[batch], residual[batch])
        error = float(loss(weights, inputs[is_held_out], residual[is_held_out]))
        best, lowest, waited = (weights, error, 0) if error < lowest else (best, lowest, waited + 1)
        if waited > PATIENCE:
            break
    apply = jax.jit(module.apply)

    def black_box(rows: Rows) -> np.ndarray:
        scaled = ((stack_inputs(rows) - mean) / spread).astype(np.float32)
        return rows.base + size * np.asarray(apply(best, scaled), float)

    return black_box


def fit_linear_boxes(rows: Rows) -> Mapping[str, BlackBox]:
    """Return the linear black boxes by name; of logs with rates alone, too."""
    return {"fir": fit_linear(rows, _fir), "arx": fit_linear(rows, _arx)}


def fly_windows(black_box: BlackBox, windows: Windows, base: np.ndarray) -> FlightErrors:
    """Return a black box's errors on windows of a log.

    Args:
        base: ``base_steps`` of all rows of the log.
    """
    record, first = windows.record, windows.first_free - 1
    step_s = float(np.median(record.step_s))
    num_commands, num_rates = _past(step_s)
    rates_b = [windows.gyro_b[row] for row in range(first - num_rates + 1, first + 1)]
    attitude = Rotation.from_quat(record.quat[first], scalar_first=True)
    vel_w, pos_w = record.vel_w[first], record.pos_w[first]
    errors = []
    for row in range(first, windows.ends[-1]):
        in_log = np.minimum(windows.start + row - first, len(base) - 1)
        rows = Rows(
            commands=record.command[row + 1 - num_commands : row + 1].swapaxes(0, 1),
            past_rates_b=np.stack(rates_b[-num_rates:], axis=1),
            vel_b=attitude.inv().apply(vel_w),
            base=base[in_log],
            target=np.zeros((len(in_log), 6)),
            is_held_out=np.zeros(len(in_log), bool),
        )
        after = black_box(rows)
        acc_w = attitude.apply(after[:, 3:]) - GRAVITY
        pos_w, vel_w = pos_w + (vel_w + 0.5 * acc_w * step_s) * step_s, vel_w + acc_w * step_s
        turn_b = 0.5 * (rates_b[-1] + after[:, :3]) * step_s
        attitude = attitude * Rotation.from_rotvec(turn_b)
        rates_b.append(after[:, :3])
        if row + 1 in windows.ends:
            measured = Rotation.from_quat(record.quat[row + 1], scalar_first=True)
            errors.append(
                [
                    (attitude.inv() * measured).as_rotvec(),
                    windows.gyro_b[row + 1] - rates_b[-1],
                    record.vel_w[row + 1] - vel_w,
                    record.pos_w[row + 1] - pos_w,
                ]
            )
    assert len(errors) == len(HORIZONS_S)
    by_window = np.stack(errors).swapaxes(1, 2)
    return FlightErrors(np.where(windows.counts[..., None], by_window, 0.0)[None], windows)
