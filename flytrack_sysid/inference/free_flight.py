"""Free flight from measured states, many windows at once; differentiable in the model.

A window begins with a lead-in. In the lead-in, the state of each row is the measured one, and the
commands settle the applied action and the memories of effects. If there is a gyro, the body rates
are those that it read, later by the model's latency. After the lead-in, the model predicts the
state under the logged commands alone.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters, advance, body_rates, observe_rates, read_gyro
from flytrack_env.effects import MAX_DELAY_STEPS, ImuLatency, at_row, start_memories
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import Action, Drone
from flytrack_sysid.inference.one_step import SETTLING_S
from flytrack_sysid.inference.parameters import in_float64
from flytrack_sysid.inference.record import Filled, Record, build_record, fill_gaps
from flytrack_sysid.inference.replay import measured_drone, where_true
from flytrack_sysid.inference.trace_cache import fast_jit
from flytrack_sysid.log import FlightLog, median_step
from flytrack_sysid.log_voltage import with_voltage

HORIZONS_S = (0.1, 0.25, 0.5, 1.0, 2.0)  # from a rate loop's response to a manoeuvre
# Quantities of an error, three components each, in this order, and the channels that measure them.
CHANNEL_OF = {"attitude": "q", "rates": "w", "velocity": "v", "position": "p"}
QUANTITIES = tuple(CHANNEL_OF)
UNITS = {"attitude": "rad", "rates": "rad/s", "velocity": "m/s", "position": "m"}
# Windows are computed in batches of this size, so that logs of one rate share a compiled program.
WINDOWS_PER_BATCH = 128
BLOCK_S = 2.0  # windows that start in one block count as dependent


class Windows(NamedTuple):
    """Windows of a log.

    Attributes:
        record: inputs and measurements as in ``record``, the lead-in first,
            (rows, windows, ...).
        is_free: whether the state of a row is predicted, (rows,) bool.
        ends: rows at the horizons, (horizons,) int.
        gyro_b: body rates (rad/s), (rows, windows, 3); zeros without a gyro.
        has_gyro: whether the log has a gyro, () bool.
        counts: which errors are scored, (horizons, windows, quantities) bool.
        block: index of the block of 2 s in which a window starts, (windows,) int.
        start: row of the log at which a window starts, (windows,) int.
    """

    record: Record
    is_free: np.ndarray
    ends: np.ndarray
    gyro_b: np.ndarray
    has_gyro: np.ndarray
    counts: np.ndarray
    block: np.ndarray
    start: np.ndarray

    @property
    def first_free(self) -> int:
        """The first row whose state is predicted."""
        return int(np.argmax(self.is_free))

    def sums_by_block(self, values: np.ndarray) -> np.ndarray:
        """Return sums of values, (windows, ...), over the windows of each block, (blocks, ...)."""
        _, block = np.unique(self.block, return_inverse=True)
        sums = np.zeros((block.max() + 1, *values.shape[1:]), values.dtype)
        np.add.at(sums, block, values)
        return sums


def cut_batches(windows: Windows) -> list[Windows]:
    """Split windows into batches of WINDOWS_PER_BATCH; the first window pads the last batch."""
    num_windows = len(windows.start)
    indices_by_batch = np.resize(
        np.arange(num_windows), (-(-num_windows // WINDOWS_PER_BATCH), WINDOWS_PER_BATCH)
    )
    indices_by_batch[-1, num_windows - WINDOWS_PER_BATCH * (len(indices_by_batch) - 1) :] = 0
    return [
        windows._replace(
            record=Record(*(leaf[:, indices] for leaf in windows.record)),
            gyro_b=windows.gyro_b[:, indices],
            counts=windows.counts[:, indices],
            block=windows.block[indices],
            start=windows.start[indices],
        )
        for indices in indices_by_batch
    ]


def make_windows(
    log: FlightLog,
    scored_rows: np.ndarray,
    every_s: float,
    max_windows: int,
    is_settled: np.ndarray | None = None,
) -> Windows:
    """Return windows over the scored rows of a log.

    A window counts at the horizons that it reaches within rows that are scored and measured.

    Args:
        log: the flight log.
        scored_rows: (num_rows,) bool.
        every_s: time between the starts of windows (s).
        max_windows: largest number of windows; more than a batch are thinned evenly to whole
            batches.
        is_settled: rows of the log without gaps at which a flight may start; if None, those after
            a whole lead-in.
    """
    filled = fill_gaps(log)
    step_s = median_step(filled.log)
    lead, ends = _lead_and_ends(filled.log)
    is_scored = scored_rows[filled.behind] & (filled.source_row >= 0)
    begins = filled.log.is_start()
    segment = np.cumsum(begins)
    run = np.cumsum(begins | np.append(True, np.diff(scored_rows[filled.behind].astype(int)) != 0))
    first = np.flatnonzero(begins)[segment - 1]
    rows = np.arange(len(segment))
    can_start = is_scored & (rows - first >= lead if is_settled is None else is_settled)
    starts = rows[can_start & ((rows - first - lead) % max(round(every_s / step_s), 1) == 0)]
    last = np.minimum(starts + ends[:, None], len(rows) - 1)
    is_reached = (starts + ends[:, None] < len(rows)) & (run[last] == run[starts]) & is_scored[last]
    starts, is_reached = starts[is_reached.any(axis=0)], is_reached[:, is_reached.any(axis=0)]
    max_windows = (
        len(starts) // WINDOWS_PER_BATCH * WINDOWS_PER_BATCH
        if WINDOWS_PER_BATCH < len(starts) < max_windows
        else max_windows
    )
    if len(starts) > max_windows:
        kept = np.linspace(0, len(starts) - 1, max_windows).round().astype(int)
        starts, is_reached = starts[kept], is_reached[:, kept]
    windows = _windows_at(filled, starts)
    return windows._replace(
        counts=is_reached[..., None] & np.array([name in log for name in CHANNEL_OF.values()]),
        block=run[starts] * len(rows) + ((starts - first[starts]) * step_s / BLOCK_S).astype(int),
        start=filled.behind[starts],
    )


def _windows_at(filled: Filled, starts: np.ndarray) -> Windows:
    """Return windows that start at some rows of a log without gaps; none of them counts.

    Where a flight begins within a lead-in, its first row comes repeatedly before the others.
    """
    log = filled.log
    lead, ends = _lead_and_ends(log)
    begins = np.flatnonzero(log.is_start())
    first = begins[np.searchsorted(begins, starts, side="right") - 1]
    index = np.clip(starts + np.arange(-lead, ends[-1] + 1)[:, None], first, len(log) - 1)
    gyro_b = log.channels.get("w", np.zeros((len(log), 3)))
    return Windows(
        record=Record(*(leaf[index] for leaf in build_record(filled))),
        is_free=np.arange(len(index)) > lead,
        ends=lead + ends,
        gyro_b=gyro_b[index],
        has_gyro=np.array("w" in log),
        counts=np.zeros((len(ends), len(starts), len(QUANTITIES)), bool),
        block=np.zeros(len(starts), int),
        start=starts,
    )


def _lead_and_ends(log: FlightLog) -> tuple[int, np.ndarray]:
    """Return the number of rows of a lead-in, and those from its end to each horizon."""
    step_s = median_step(log)
    return round(SETTLING_S / step_s), np.round(np.array(HORIZONS_S) / step_s).astype(int)


def _turn(measured: Quaternion, predicted: Quaternion) -> jax.Array:
    """Return the rotation vector (rad) from a predicted to a measured attitude, body frame."""
    inverse = Quaternion(predicted.w, -predicted.x, -predicted.y, -predicted.z)
    turn = inverse.multiply(measured)
    return Rotation.from_quat(jnp.stack([turn.x, turn.y, turn.z, turn.w])).as_rotvec()


def _gyro_in_time(
    gyro_b: jax.Array, step_s: Any, model: ModelParameters
) -> tuple[jax.Array, ModelParameters]:
    """Return gyro readings shifted to the time of each row, and the model without gyro latency.

    If late readings corrected the rates, each error would be corrected again until its reading
    arrives, and the rates would diverge.
    """
    latencies = [effect for effect in model.effects if isinstance(effect, ImuLatency)]
    if not latencies:
        return gyro_b, model
    latency_s = latencies[0].latency_s
    row = jnp.arange(len(gyro_b)) + latency_s / step_s
    before = jnp.clip(jnp.floor(row).astype(int), 0, len(gyro_b) - 2)
    fraction = jnp.clip(row - before, 0.0, 1.0)[:, None]
    reading = gyro_b[before] + fraction * (gyro_b[before + 1] - gyro_b[before])
    return reading, model.with_effects(ImuLatency(jnp.zeros_like(latency_s)))


def _fly(model: ModelParameters, record: Record, gyro_b: jax.Array, windows: Windows) -> Drone:
    """Return the drone of one window after each row; its body rates are those that a gyro reads."""

    def step(carry: tuple[Drone, Any], inputs: tuple[Record, Any, Any]) -> tuple[Any, Drone]:
        (predicted, memories), (row, is_free, gyro) = carry, inputs
        applied = where_true(row.is_applied_known, Action(*row.applied), predicted.applied)
        memories = at_row(memories, row.time_s)
        drone = where_true(is_free, predicted, measured_drone(row, applied, predicted.rates_b))
        gyro_offset = Vec3(*gyro) - read_gyro(drone, memories, row.step_s, in_time)
        observed = observe_rates(drone, memories, drone.rates_b + gyro_offset, row.step_s, model)
        drone, memories = where_true(windows.has_gyro & ~is_free, observed, (drone, memories))
        after, memories_after = advance(drone, memories, Action(*row.command), row.step_s, model)
        read = read_gyro(after, memories_after, row.step_s, model)
        return (after, memories_after), after._replace(rates_b=read)

    read_b, in_time = _gyro_in_time(gyro_b, record.step_s, model)
    first = jax.tree.map(lambda leaf: leaf[0], record)
    applied = Action(*first.applied)
    start = measured_drone(first, applied, body_rates(applied, model.max_rate))
    memories = start_memories(model.effects, start, MAX_DELAY_STEPS)
    return jax.lax.scan(step, (start, memories), (record, windows.is_free, read_b))[1]


def _errors(
    model: ModelParameters, record: Record, gyro_b: jax.Array, windows: Windows
) -> jax.Array:
    """Return the errors of one window at its horizons, (horizons, 12)."""
    flown = _fly(model, record, gyro_b, windows)
    drone = jax.tree.map(lambda leaf: leaf[windows.ends - 1], flown)
    row, gyro_b = jax.tree.map(lambda leaf: leaf[windows.ends], (record, gyro_b))
    turn = jax.vmap(_turn)(Quaternion(*row.quat.T), drone.quat)
    rates, vel, pos = (
        jnp.stack(vector, axis=-1) for vector in (drone.rates_b, drone.vel_w, drone.pos_w)
    )
    return jnp.concatenate([turn, gyro_b - rates, row.vel_w - vel, row.pos_w - pos], axis=-1)


def prediction_errors(model: ModelParameters, windows: Windows) -> jax.Array:
    """Return measured minus predicted state at the horizons.

    Returns:
        Errors, (horizons, windows, 12): turn (rad, body frame), rates (rad/s), velocity (m/s) and
        position (m), three components each; 0 where nothing is scored.
    """
    fly = jax.vmap(
        lambda record, gyro: _errors(model, record, gyro, windows), in_axes=1, out_axes=1
    )
    return jnp.where(
        jnp.repeat(windows.counts, 3, axis=-1), fly(windows.record, windows.gyro_b), 0.0
    )


_batch_errors = fast_jit(prediction_errors)


def evaluate_windows(model: ModelParameters, windows: Windows) -> np.ndarray:
    """Return the errors of one model, (horizons, windows, quantities, 3) float64."""
    with jax.enable_x64(True):
        batches = [
            np.asarray(_batch_errors(in_float64(model), batch)) for batch in cut_batches(windows)
        ]
    errors = np.concatenate(batches, axis=1)[:, : len(windows.start)]
    return errors.reshape(*errors.shape[:-1], len(QUANTITIES), 3)


@fast_jit
def _flights(model: ModelParameters, windows: Windows) -> Drone:
    fly = jax.vmap(lambda record, gyro: _fly(model, record, gyro, windows), in_axes=1, out_axes=1)
    return fly(windows.record, windows.gyro_b)


def fly_freely(
    model: ModelParameters, filled: Filled, starts: np.ndarray, num_steps: int
) -> dict[str, np.ndarray]:
    """Return free flights from measured rows under the logged commands, of at most 2 s.

    Args:
        model: the model that flies.
        filled: the log without gaps.
        starts: rows to start from, at least one, (num_starts,).
        num_steps: steps of every flight; beyond the end of the log the last command is held.

    Returns:
        p, v, q, w after each step, (num_starts, num_steps, size) float64, in the units of the log.
    """
    filled = filled._replace(log=with_voltage(filled.log, model))
    windows = _windows_at(filled, starts)
    free = slice(windows.first_free - 1, windows.first_free - 1 + num_steps)
    with jax.enable_x64(True):
        batches = [_flights(in_float64(model), batch) for batch in cut_batches(windows)]
    result = {}
    for name, leaf in (("p", "pos_w"), ("v", "vel_w"), ("q", "quat"), ("w", "rates_b")):
        flown = [
            np.stack([np.asarray(part)[free] for part in getattr(batch, leaf)], axis=-1)
            for batch in batches
        ]
        result[name] = np.concatenate(flown, axis=1)[:, : len(starts)].swapaxes(0, 1)
    return result
