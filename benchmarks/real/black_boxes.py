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
from flytrack_sysid.diagnosis.refinement import Tested
from flytrack_sysid.log import FlightLog, usual_step
from flytrack_sysid.prediction import columns, predict
from flytrack_sysid.prediction_windows import HORIZONS_S, Windows
from flytrack_sysid.record import fill_gaps
from flytrack_sysid.split import held_out_rows

LONG_S, PAST_RATES_S, SHORT = (
    0.3,
    0.05,
    3,
)  # of commands, of rates; SHORT: which part of the commands
RIDGE = 1e-3  # in units of the regressors' variance
WIDTH, EPOCHS, PATIENCE, MINIBATCH, RATE = 16, 200, 15, 256, 3e-3
GRAVITY = np.array([0.0, 0.0, 9.80665])


class Rows(NamedTuple):
    """Rows with enough of a past, and what comes of each; all (num_rows, ...).

    commands: (num_rows, past, 4), the latest last. past_rates_b: (num_rows, past, 3). base: rates
    after the step and specific force of the refitted base, body, (num_rows, 6). target: the
    measured ones.
    """

    commands: np.ndarray
    past_rates_b: np.ndarray
    vel_b: np.ndarray
    base: np.ndarray
    target: np.ndarray
    is_held_out: np.ndarray


Answer = Callable[[Rows], np.ndarray]


def base_steps(model: ModelParameters, log: FlightLog) -> np.ndarray:
    """Return the base's rates and specific force after a step from every row, body frame."""
    after = predict(model, fill_gaps(log)).after
    turned = Rotation.from_quat(log["q"], scalar_first=True)
    return np.c_[columns(after.rates_b), turned.inv().apply(columns(after.acc_w) + GRAVITY)]


def rows_of(log: FlightLog, model: ModelParameters) -> Rows:
    """Return the rows of a log without gaps."""
    step_s, base = float(np.median(usual_step(log))), base_steps(model, log)
    long, past_rates = _past(step_s)
    starts = np.flatnonzero(log.is_start())
    first = np.repeat(starts, np.diff(np.append(starts, len(log))))
    now = np.flatnonzero(
        (np.arange(len(log)) - first >= long - 1) & np.append(~log.is_start()[1:], False)
    )
    turned = Rotation.from_quat(log["q"][now], scalar_first=True).inv()
    acc_w = (log["v"][now + 1] - log["v"][now]) / step_s
    return Rows(
        commands=log["u"][now[:, None] + np.arange(1 - long, 1)],
        past_rates_b=log["w"][now[:, None] + np.arange(1 - past_rates, 1)],
        vel_b=turned.apply(log["v"][now]),
        base=base[now],
        target=np.c_[log["w"][now + 1], turned.apply(acc_w + GRAVITY)],
        is_held_out=held_out_rows(log)[now],
    )


def _past(step_s: float) -> tuple[int, int]:
    """Return the rows of commands and of rates that are known."""
    return round(LONG_S / step_s), round(PAST_RATES_S / step_s)


def posed(log: FlightLog) -> FlightLog:
    """Return the log with attitude and velocity; level and at rest if it has none."""
    level = {"q": np.tile([1.0, 0.0, 0.0, 0.0], (len(log), 1)), "v": np.zeros((len(log), 3))}
    return replace(log, channels=level | dict(log.channels))


def _latest(rows: Rows) -> np.ndarray:
    return rows.commands[:, -(rows.commands.shape[1] // SHORT) :]


def _flat(values: np.ndarray) -> np.ndarray:
    return values.reshape(len(values), -1)


def _fir(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    commands = _flat(rows.commands)
    return commands, np.c_[commands, rows.vel_b]


def _arx(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    own = np.c_[_flat(_latest(rows)), _flat(rows.past_rates_b)]
    return own, np.c_[own, rows.vel_b]


def linear(rows: Rows, regressors: Callable[[Rows], tuple[np.ndarray, np.ndarray]]) -> Answer:
    """Return a ridge regression of rates and of force, each on its own regressors."""
    fits = []
    for known, wanted in zip(
        regressors(rows), (rows.target[:, :3], rows.target[:, 3:]), strict=True
    ):
        mean, spread = known.mean(axis=0), known.std(axis=0) + 1e-9
        scaled = np.c_[(known - mean) / spread, np.ones(len(known))]
        damping = RIDGE * len(known) * np.diag([*np.ones(len(mean)), 1e-9])
        slopes = np.linalg.solve(scaled.T @ scaled + damping, scaled.T @ wanted)
        fits.append((mean, spread, slopes))

    def answer(other: Rows) -> np.ndarray:
        parts = [
            np.c_[(known - mean) / spread, np.ones(len(known))] @ slopes
            for known, (mean, spread, slopes) in zip(regressors(other), fits, strict=True)
        ]
        return np.concatenate(parts, axis=1)

    return answer


class _Network(nn.Module):
    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        hidden = nn.tanh(nn.Dense(WIDTH)(nn.tanh(nn.Dense(WIDTH)(inputs))))
        return nn.Dense(6, kernel_init=nn.initializers.zeros)(hidden)


def network(rows: Rows) -> Answer:
    """Return the base with a network for what it leaves, stopped early by every fourth block."""

    def inputs_of(some: Rows) -> np.ndarray:
        return np.c_[_flat(_latest(some)), some.base, some.vel_b]

    known, left = inputs_of(rows), rows.target - rows.base
    mean, spread, size = known.mean(axis=0), known.std(axis=0) + 1e-9, left.std(axis=0)
    known, left = ((known - mean) / spread).astype(np.float32), (left / size).astype(np.float32)
    module, chain = _Network(), optax.adam(RATE)
    weights = module.init(jax.random.key(0), known[:1])

    @jax.jit
    def loss(weights: Any, inputs: jax.Array, wanted: jax.Array) -> jax.Array:
        return jnp.mean(optax.huber_loss(module.apply(weights, inputs), wanted))

    @jax.jit
    def update(weights: Any, memory: Any, inputs: jax.Array, wanted: jax.Array) -> tuple[Any, Any]:
        change, memory = chain.update(jax.grad(loss)(weights, inputs, wanted), memory)
        return optax.apply_updates(weights, change), memory

    rng, memory = np.random.default_rng(0), chain.init(weights)
    learnt, best, lowest, waited = np.flatnonzero(~rows.is_held_out), weights, np.inf, 0
    for _ in range(EPOCHS):
        for part in np.split(rng.permutation(learnt), np.arange(MINIBATCH, len(learnt), MINIBATCH))[
            :-1
        ]:
            weights, memory = update(weights, memory, known[part], left[part])
        now = float(loss(weights, known[rows.is_held_out], left[rows.is_held_out]))
        best, lowest, waited = (weights, now, 0) if now < lowest else (best, lowest, waited + 1)
        if waited > PATIENCE:
            break
    apply = jax.jit(module.apply)

    def answer(other: Rows) -> np.ndarray:
        scaled = ((inputs_of(other) - mean) / spread).astype(np.float32)
        return other.base + size * np.asarray(apply(best, scaled), float)

    return answer


def linear_ones(rows: Rows) -> Mapping[str, Answer]:
    """Return the linear black boxes by name; of logs with rates alone, too."""
    return {"fir": linear(rows, _fir), "arx": linear(rows, _arx)}


def flown(answer: Answer, windows: Windows, base: np.ndarray) -> Tested:
    """Return a black box's errors on windows of a log.

    base: ``base_steps`` of all rows of the log.
    """
    record, first = windows.record, windows.first_free - 1
    step_s = float(np.median(record.step_s))
    long, past_rates = _past(step_s)
    past = [windows.gyro_b[first - age] for age in range(past_rates)][::-1]
    turned = Rotation.from_quat(record.quat[first], scalar_first=True)
    vel_w, pos_w = record.vel_w[first], record.pos_w[first]
    seen = []
    for row in range(first, windows.ends[-1]):
        own = np.minimum(windows.start + row - first, len(base) - 1)
        rows = Rows(
            commands=record.command[row + 1 - long : row + 1].swapaxes(0, 1),
            past_rates_b=np.stack(past[-past_rates:], axis=1),
            vel_b=turned.inv().apply(vel_w),
            base=base[own],
            target=np.zeros((len(own), 6)),
            is_held_out=np.zeros(len(own), bool),
        )
        found = answer(rows)
        acc_w = turned.apply(found[:, 3:]) - GRAVITY
        pos_w, vel_w = pos_w + (vel_w + 0.5 * acc_w * step_s) * step_s, vel_w + acc_w * step_s
        turned = turned * Rotation.from_rotvec(0.5 * (past[-1] + found[:, :3]) * step_s)
        past.append(found[:, :3])
        if row + 1 in windows.ends:
            measured = Rotation.from_quat(record.quat[row + 1], scalar_first=True)
            levels = ((windows.gyro_b, past[-1]), (record.vel_w, vel_w), (record.pos_w, pos_w))
            turn = (turned.inv() * measured).as_rotvec()
            seen.append(np.stack([turn, *(one[row + 1] - now for one, now in levels)], axis=1))
    assert len(seen) == len(HORIZONS_S)
    return Tested(np.where(windows.counts[..., None], np.stack(seen), 0.0)[None], windows)
