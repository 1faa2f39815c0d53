"""What a log measured minus what the model predicts, channel by channel.

========  ==============================================================================  =======
channel   residual                                                                        unit
========  ==============================================================================  =======
``w``     body rates, against the lag driven by the commands                              rad/s
``f``     specific force, body (from ``a`` where the log has no accelerometer)            m/s^2
``v``     velocity, against the integrated acceleration, centred in windows               m/s
``p``     position, likewise without offset and slope; only where the log lacks ``v``     m
``q``     attitude, against the integrated rates, as a world-frame rotation, centred      rad
``v_bat`` battery voltage, against its drain, centred                                     V
========  ==============================================================================  =======

Centring takes out what a window began with, which is measured with noise like the rest.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.quaternion import Quaternion
from flytrack_sysid.log import FlightLog
from flytrack_sysid.record import Record, is_applied_certain, measured_channels
from flytrack_sysid.replay import Step, replay, where_true

CENTRED = ("v", "p", "q", "v_bat")
ROWS_PADDED_TO, SIDES_PADDED_TO, MOST_PADDING = 64, 8, 3


class Channel(NamedTuple):
    """What one channel measured; (num_rows, components) and masks of the same shape.

    window: (num_rows,) int, what is centred together.
    """

    measured: np.ndarray
    counts: np.ndarray
    window: np.ndarray


class Sides(NamedTuple):
    """Flights side by side: (longest, num_flights) rows of the record, and each row's place in that, flat."""

    rows: np.ndarray
    place: np.ndarray


class Problem(NamedTuple):
    """A record with what was measured in it; counts are 0 where a row is not to be judged."""

    record: Record
    turns_afresh: np.ndarray
    channels: dict[str, Channel]
    flights: Sides


def make_problem(log: FlightLog, record: Record, judged: np.ndarray, model: ModelParameters) -> Problem:
    """Return the problem of explaining the judged rows of a log.

    judged: (rows of the log,) bool. The lags of ``model`` say how long lost commands are remembered.
    """
    is_certain = is_applied_certain(record, np.asarray(model.tau, float))
    exists = (record.source_row >= 0) & judged[record.source_row]
    is_after = exists & ~record.begins
    behind = np.maximum.accumulate(record.source_row)  # of a filled row, the one before the gap
    starts_judged = np.append(True, judged[behind][:-1])  # a force is that of a step from measured values
    turns, lifts = is_certain[:, :3], is_certain[:, 3]
    turn_window, turns_afresh = _windows(record, turns.all(axis=1))
    lift_window, _ = _windows(record, lifts)
    allowed = {
        "w": turns & is_after[:, None],
        "q": (turns.all(axis=1) & exists)[:, None],
        "f": (lifts & is_after & starts_judged)[:, None],
        "v": (lifts & exists)[:, None],
        "p": (lifts & exists)[:, None],
        "v_bat": exists[:, None],
    }
    flight = np.cumsum(record.begins) - 1
    windows = {"q": turn_window, "v": lift_window, "p": lift_window, "v_bat": flight}
    channels = {}
    for name, values in measured_channels(log, record, float(model.g)).items():
        width = 3 if name == "q" else values.shape[1]
        counts = np.broadcast_to(allowed[name], (len(values), width)).astype(float)
        channels[name] = Channel(values, counts, windows.get(name, flight))
    return Problem(record, turns_afresh, channels, _side_by_side(record))


def _side_by_side(record: Record) -> Sides:
    """Return the flights of a record side by side, or all rows in one column if that is shorter.

    Columns are padded to round numbers, so that logs of about the same flights share a program.
    """
    num_rows = len(record.begins)
    end = 1 + int(np.flatnonzero(record.source_row >= 0)[-1])
    first = np.union1d(0, np.flatnonzero(record.begins[:end]))
    lengths = np.diff(np.append(first, end))
    longest = -(-int(lengths.max()) // ROWS_PADDED_TO) * ROWS_PADDED_TO
    num = -(-len(first) // SIDES_PADDED_TO) * SIDES_PADDED_TO
    if longest * num > MOST_PADDING * num_rows:
        return Sides(np.arange(num_rows)[:, None], np.arange(num_rows))
    starts = np.append(first, np.repeat(num_rows - 1, num - len(first)))
    rows = np.minimum(starts + np.arange(longest)[:, None], num_rows - 1)
    within = np.arange(end) - np.repeat(first, lengths)
    place = np.zeros(num_rows, int)
    place[:end] = within * num + np.repeat(np.arange(len(first)), lengths)
    return Sides(rows, place)


def _windows(record: Record, is_certain: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return windows, new ones also where doubt ends, and where they begin."""
    is_back = is_certain & ~np.append(True, is_certain[:-1])
    is_new = np.append(True, np.diff(record.piece) != 0) | record.begins | is_back
    return np.cumsum(is_new) - 1, is_new


def _sums(values: jax.Array, window: jax.Array) -> jax.Array:
    """Return, at every row, the sum over its window."""
    return jax.ops.segment_sum(values, window, num_segments=len(window))[window]


def _centred(values: jax.Array, counts: jax.Array, window: jax.Array) -> jax.Array:
    """Return values less their mean over the rows of the window that count."""
    mean = _sums(values * counts, window) / jnp.maximum(_sums(counts, window), 1.0)
    return values - mean


def _without_slope(values: jax.Array, time: jax.Array, counts: jax.Array, window: jax.Array) -> jax.Array:
    """Return values less their regression on time, over the rows of the window that count."""
    values = _centred(values, counts, window)
    time = _centred(time[:, None], counts, window)
    spread = _sums(time * time * counts, window)
    slope = _sums(time * values * counts, window) / jnp.where(spread > 0.0, spread, 1.0)
    return values - slope * time


def _rotation_between(measured: jax.Array, predicted: jax.Array) -> jax.Array:
    """Return the world-frame rotation vector from predicted to measured attitudes, rad."""
    conjugate = Quaternion(*predicted.T)._replace(x=-predicted[:, 1], y=-predicted[:, 2], z=-predicted[:, 3])
    error = jnp.stack(tuple(Quaternion(*measured.T).multiply(conjugate)), axis=-1)
    error = error * jnp.where(error[:, :1] < 0.0, -1.0, 1.0)
    vector = error[:, 1:]
    squared = jnp.sum(vector**2, axis=1, keepdims=True)
    is_turned = squared > 0.0
    sine = jnp.sqrt(jnp.where(is_turned, squared, 1.0))
    # Angle over sine of the half angle; 2 where there is no turn to divide by.
    factor = jnp.where(is_turned, 2.0 * jnp.arctan2(sine, error[:, :1]) / sine, 2.0)
    return vector * factor


class Predicted(NamedTuple):
    """What the model predicts of the rows, (num_rows, ...), each from the row before; nothing of the first.

    rates_b: (3,) rad/s. force_b: (3,) m/s^2, specific force of the step to the row.
    acc_w: (3,) m/s^2, the same with gravity, world. battery_change_v: of the step to the row. quat: (4,),
    integrated from the measured attitude where ``turns_afresh`` was last true.
    """

    rates_b: jax.Array
    force_b: jax.Array
    acc_w: jax.Array
    battery_change_v: jax.Array
    quat: jax.Array


def predict_rows(
    model: ModelParameters, record: Record, turns_afresh: jax.Array | np.ndarray, flights: Sides | None = None
) -> Predicted:
    """Return what a model predicts of every row; differentiable in the model.

    turns_afresh: (num_rows,) bool, where the attitude is taken from the log again. flights: of the record,
    replayed side by side; one after the other if None.
    """
    if flights is None:
        return _predict_column(model, record, turns_afresh)
    given = record, jnp.asarray(turns_afresh)
    columns = jax.tree.map(lambda leaf: leaf[flights.rows], given)
    found = jax.vmap(partial(_predict_column, model), in_axes=1, out_axes=1)(*columns)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[flights.place], found)


def _predict_column(
    model: ModelParameters, record: Record, turns_afresh: jax.Array | np.ndarray
) -> Predicted:
    def observe(step: Step, _: None) -> tuple[Any, ...]:
        before = step.before.quat
        inverse = before._replace(x=-before.x, y=-before.y, z=-before.z)
        turn = inverse.multiply(step.after.quat)
        seen = (turn, step.after.rates_b, step.moved.context.force_b, step.after.acc_w)
        stacked = (jnp.stack(tuple(leaves)) for leaves in seen)
        return *stacked, step.after.battery_v - step.before.battery_v

    of_next = replay(model, record, "commanded", None, observe)
    quat = _integrated(record, Quaternion(*of_next[0].T), record.begins | turns_afresh)
    rates_b, force_b, acc_w, change_v = (
        jnp.concatenate([jnp.zeros_like(values[:1]), values[:-1]]) for values in of_next[1:]
    )
    return Predicted(rates_b, force_b, acc_w, change_v, quat)


def _integrated(record: Record, turns_b: Quaternion, is_fresh: jax.Array | np.ndarray) -> jax.Array:
    """Return the attitude that turns lead to at every row, (num_rows, 4), as measured where it is fresh."""

    def next_row(quat: Quaternion, inputs: tuple[Any, ...]) -> tuple[Quaternion, Quaternion]:
        measured, turn_b, is_fresh = inputs
        quat = where_true(is_fresh, measured, quat)
        return quat.multiply(turn_b).normalize(), quat

    measured = Quaternion(*record.quat.T)
    start = jax.tree.map(lambda column: column[0], measured)
    found = jax.lax.scan(next_row, start, (measured, turns_b, is_fresh))[1]
    return jnp.stack(tuple(found), axis=-1)


def _raw(name: str, channel: Channel, predicted: Predicted, record: Record) -> jax.Array:
    """Return measured minus predicted of one channel, before centring."""
    step_s = jnp.concatenate([jnp.zeros(1), record.step_s[:-1]])[:, None]  # of the step to the row
    measured = jnp.asarray(channel.measured)
    if name == "w":
        return measured - predicted.rates_b
    if name == "f":
        return measured - predicted.force_b
    if name == "q":
        return _rotation_between(measured, predicted.quat)
    if name == "v_bat":
        return measured - jnp.cumsum(predicted.battery_change_v)[:, None]
    vel_change = jnp.cumsum(predicted.acc_w * step_s, axis=0)
    if name == "v":
        return measured - vel_change
    moved = (vel_change - predicted.acc_w * step_s) * step_s + 0.5 * predicted.acc_w * step_s**2
    return measured - jnp.cumsum(moved, axis=0)


def residuals(model: ModelParameters, problem: Problem) -> dict[str, jax.Array]:
    """Return the residuals of each channel, (num_rows, components); 0 where a row does not count."""
    record = jax.tree.map(jnp.asarray, problem.record)
    predicted = predict_rows(model, record, problem.turns_afresh, problem.flights)
    time = jnp.cumsum(record.step_s)
    found = {}
    for name, channel in problem.channels.items():
        values, counts = _raw(name, channel, predicted, record), jnp.asarray(channel.counts)
        if name == "p":
            values = _without_slope(values, time, counts, jnp.asarray(channel.window))
        elif name in CENTRED:
            values = _centred(values, counts, jnp.asarray(channel.window))
        found[name] = values * counts
    return found
