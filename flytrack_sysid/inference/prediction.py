"""A model's predictions of a log, in float64: steps from every row, and free flights."""

import operator
from typing import Any, NamedTuple

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters, advance
from flytrack_env.effects import acts
from flytrack_env.quaternion import Vec3
from flytrack_env.state import Action, Drone
from flytrack_sysid.inference.record import Filled, Record, build_record, is_applied_certain
from flytrack_sysid.inference.replay import Step, replay, start_replay
from flytrack_sysid.inference.trace_cache import fast_jit
from flytrack_sysid.log import CHANNELS, FlightLog, usual_step
from flytrack_sysid.log_voltage import with_voltage

# For effects with memory, whose memory at the start of a segment is not known.
SETTLING_S = 0.5
# Number of free flights that are computed at once: bounds their memory, and compiles one size.
BATCH = 128
MAX_S = 2.0  # of free flight: shorter ones share the compiled program
FLOWN = ("p", "v", "q", "w")  # channels of a free flight


class Prediction(NamedTuple):
    """A model's step from every row of a log; leaves of the drones are (num_rows,) float64.

    Attributes:
        model: the model that predicts.
        log: the log without gaps.
        before: the measured state. Channels that the log lacks are zero, the attitude is upright,
            and the voltage is ``assumed_voltage``.
        memories: memories of the model's effects before the step.
        after: the state at the next row.
        force_b: specific force of the step (m/s^2), (num_rows, 3).
        record: inputs and measurements of the rows.
        step_s: median time between rows (s).
        is_settled: whether applied action and memories no longer depend on their initial values,
            (num_rows,) bool.
    """

    model: ModelParameters
    log: FlightLog
    before: Drone
    memories: tuple[Any, ...]
    after: Drone
    force_b: np.ndarray
    record: Record
    step_s: float
    is_settled: np.ndarray

    @property
    def is_measured(self) -> np.ndarray:
        """Whether a row was logged, (num_rows,) bool; other rows fill a gap."""
        return self.record.source_row >= 0

    @property
    def lacking(self) -> dict[str, tuple[str, ...]]:
        """The result of ``inputs_that_lack`` for this model and log."""
        return inputs_that_lack(self.model, self.log)


def find_runs(rows: np.ndarray, record: Record) -> list[tuple[int, int]]:
    """Return the runs of scored rows within a flight, as first row and end.

    Args:
        rows: rows that are scored, (num_rows,) bool.
        record: the record of the rows.
    """
    follows = np.append(False, rows[1:] & rows[:-1] & ~record.begins[1:])[: len(rows)]
    starts = np.flatnonzero(rows & ~follows)
    ends = np.flatnonzero(rows & ~np.append(follows[1:], False)[: len(rows)]) + 1
    return list(zip(starts.tolist(), ends.tolist(), strict=True))


def scored_steps(rows: np.ndarray, prediction: Prediction) -> np.ndarray:
    """Return the rows whose step to the next row is scored, ascending.

    Args:
        rows: rows that are scored, (num_rows,) bool.
        prediction: steps from every row.
    """
    exists = rows & prediction.is_measured
    is_followed = np.append(exists[1:] & ~prediction.record.begins[1:], False)[: len(rows)]
    return np.flatnonzero(exists & is_followed & prediction.is_settled)


def inputs_that_lack(model: ModelParameters, log: FlightLog) -> dict[str, tuple[str, ...]]:
    """Return, for each channel that a model predicts, the channels it needs but the log lacks.

    A model without forces beside thrust needs no velocity to predict the specific force.
    """
    force = ["v", "q"] if acts(model.effects, "force") else []
    needs = {
        "p": ["p", "v", "q", *force],
        "v": ["v", "q", *force],
        "q": ["q"],
        "w": [],
        "a": ["q", *force],
        "f": force,
    }
    return {
        name: tuple(dict.fromkeys(channel for channel in channels if channel not in log))
        for name, channels in needs.items()
    }


def columns(vector: Any) -> np.ndarray:
    """Return a vector or quaternion of (num_rows,) leaves as an array, (num_rows, its size)."""
    return np.stack([np.asarray(leaf) for leaf in vector], axis=-1)


def in_float64(model: ModelParameters) -> ModelParameters:
    """Return the same model with leaves of float64."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, float), model)


@fast_jit
def _step_from_every_row(
    record: Record, gyro_b: np.ndarray, model: ModelParameters
) -> tuple[Drone, tuple[Any, ...], Drone, Vec3]:
    """Return the steps of all rows: drones and memories before, drones after, specific forces."""

    def observe(step: Step, _: None) -> tuple[Any, ...]:
        return step.before, step.memories, step.after, step.moved.context.force_b

    state = start_replay(model, jax.tree.map(operator.itemgetter(0), record))
    return replay(model, state, record, gyro_b, observe, is_gyro_fed=True)[1]


def predict(model: ModelParameters, filled: Filled) -> Prediction:
    """Return a model's step from every row of a log, from the measured state and logged command.

    The applied action is that of the log. If the log has none, it follows the commands from the
    start of the segment on.
    """
    filled = filled._replace(log=with_voltage(filled.log, model))
    log = filled.log
    record = build_record(filled)._replace(is_applied_known=np.full(len(log), "uprev" in log))
    gyro_b = log["w"] if "w" in log else np.zeros((len(log), 3))
    with jax.enable_x64(True):
        steps = _step_from_every_row(record, gyro_b, in_float64(model))
        before, memories, after, force_b = jax.tree.map(np.asarray, steps)
    is_settled = np.all(is_applied_certain(record, np.asarray(model.tau, float)), axis=1)
    if jax.tree.leaves(memories):
        time_in_segment = log.time - log.time[record.begins][np.cumsum(record.begins) - 1]
        is_settled = is_settled & (time_in_segment >= SETTLING_S)
    step_s = float(np.median(usual_step(log)))
    return Prediction(
        model, log, before, memories, after, columns(force_b), record, step_s, is_settled
    )


@fast_jit
def _fly(
    starts: tuple[Drone, tuple[Any, ...]],
    commands: Action,
    durations: jax.Array,
    model: ModelParameters,
) -> dict[str, Any]:
    """Return free flights: p, v, q, w after every step; leaves are (num_steps, BATCH)."""

    def step(carry: Any, row: tuple[Any, ...]) -> Any:
        (drone, memories), (command, duration) = carry, row
        step_all = jax.vmap(advance, in_axes=(0, 0, 0, 0, None))
        drone, memories = step_all(drone, memories, command, duration, model)
        state = {"p": drone.pos_w, "v": drone.vel_w, "q": drone.quat, "w": drone.rates_b}
        return (drone, memories), state

    return jax.lax.scan(step, starts, (commands, durations))[1]


def free_flights(
    prediction: Prediction, starts: np.ndarray, end_rows: np.ndarray
) -> dict[str, np.ndarray]:
    """Return free flights from measured rows under the logged commands: p, v, q, w.

    Beyond the end of the log the last command is held.

    Args:
        prediction: steps from every row.
        starts: rows to start from, (num_starts,).
        end_rows: later rows at which states are returned, (num_starts, num_ends).

    Returns:
        States by channel, (num_starts, num_ends, size), in the units of the log.
    """
    after = end_rows - starts[:, None] - 1
    num_steps = max(int(np.ceil(MAX_S / prediction.step_s)), 1 + after.max(initial=0))
    result = {name: np.empty((*end_rows.shape, len(CHANNELS[name]))) for name in FLOWN}
    for begin in range(0, len(starts), BATCH):
        padded = np.resize(starts[begin : begin + BATCH], BATCH)
        rows = np.minimum(padded + np.arange(num_steps)[:, None], len(prediction.log) - 1)
        with jax.enable_x64(True):
            states = (prediction.before, prediction.memories)
            first = jax.tree.map(operator.itemgetter(padded), states)
            commands = Action(*(column[rows] for column in prediction.log["u"].T))
            flights = _fly(
                first, commands, prediction.record.step_s[rows], in_float64(prediction.model)
            )
        steps = after[begin : begin + BATCH]
        for name, leaves in flights.items():
            result[name][begin : begin + BATCH] = columns(leaves)[
                steps, np.arange(len(steps))[:, None]
            ]
    return result
