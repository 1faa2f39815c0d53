"""A model's step from every row of a log, in float64."""

import operator
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import acts, effect_of
from flytrack_env.fusion import one_kernel
from flytrack_env.quaternion import Vec3
from flytrack_env.state import Drone
from flytrack_sysid.inference.parameters import in_float64
from flytrack_sysid.inference.record import Filled, Record, build_record, is_applied_certain
from flytrack_sysid.inference.replay import ReplayState, replay_row, start_replay
from flytrack_sysid.inference.trace_cache import fast_jit
from flytrack_sysid.kinematics import since_first
from flytrack_sysid.log import FlightLog, median_step
from flytrack_sysid.log_voltage import with_voltage

# For effects with memory, whose memory at the start of a segment is not known.
SETTLING_S = 0.5


class Prediction(NamedTuple):
    """A model's step from every row of a log; leaves of the drones are (num_rows,) float64.

    Attributes:
        model: the model that predicts.
        filled: the log without gaps.
        before: the measured state. Channels that the log lacks are zero, the attitude is upright,
            and the voltage is ``assumed_voltage``.
        after: the state at the next row.
        force_b: specific force of the step (m/s^2), (num_rows, 3).
        record: inputs and measurements of the rows.
        step_s: median time between rows (s).
        is_settled: whether applied action and memories no longer depend on their initial values,
            (num_rows,) bool.
    """

    model: ModelParameters
    filled: Filled
    before: Drone
    after: Drone
    force_b: np.ndarray
    record: Record
    step_s: float
    is_settled: np.ndarray

    @property
    def log(self) -> FlightLog:
        """The log without gaps."""
        return self.filled.log

    @property
    def is_measured(self) -> np.ndarray:
        """Whether a row was logged, (num_rows,) bool; other rows fill a gap."""
        return self.record.source_row >= 0

    @property
    def lacking(self) -> dict[str, tuple[str, ...]]:
        """The result of ``inputs_that_lack`` for this model and log."""
        return inputs_that_lack(self.model, self.log)


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


@fast_jit
def _step_from_every_row(
    record: Record, gyro_b: np.ndarray, model: ModelParameters
) -> tuple[Drone, Drone, Vec3]:
    """Return the steps of all rows: drones before, drones after, specific forces."""

    def next_row(model: ModelParameters, state: ReplayState, inputs: tuple[Any, Any]) -> Any:
        after, step = replay_row(model, state, *inputs, is_gyro_fed=True)
        return after, (step.before, step.after, step.moved.context.force_b)

    state = start_replay(model, jax.tree.map(operator.itemgetter(0), record))
    return jax.lax.scan(partial(one_kernel(next_row), model), state, (record, gyro_b))[1]


def predict(model: ModelParameters, filled: Filled) -> Prediction:
    """Return a model's step from every row of a log, from the measured state and logged command.

    The applied action is that of the log. If the log has none, it follows the commands from the
    start of the segment on.
    """
    filled = filled._replace(log=with_voltage(filled.log, model))
    log = filled.log
    record = build_record(filled)._replace(is_applied_known=np.full(len(log), "uprev" in log))
    gyro_b = log.channels.get("w", np.zeros((len(log), 3)))
    with jax.enable_x64(True):
        steps = _step_from_every_row(record, gyro_b, in_float64(model))
        before, after, force_b = jax.tree.map(np.asarray, steps)
    is_settled = np.all(is_applied_certain(record, np.asarray(model.tau, float)), axis=1)
    if any(effect_of(effect).memory for effect in model.effects):
        time_in_segment = since_first(log.time, record.begins)
        is_settled = is_settled & (time_in_segment >= SETTLING_S)
    step_s = median_step(log)
    return Prediction(model, filled, before, after, columns(force_b), record, step_s, is_settled)
