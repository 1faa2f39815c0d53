"""Residuals of models by row of a log, and regressors to plot them against, such as airspeed.

============  =====================================================================  =======
channel       residual of a row, measured minus modelled                             unit
============  =====================================================================  =======
``rates``     gyro, body                                                             rad/s
``attitude``  mean rate of the turn since the row before, body                       rad/s
``force``     accelerometer, or known accelerations as specific force, body          m/s^2
``velocity``  mean acceleration since the row before, body                           m/s^2
``battery``   voltage, summed up since the flight began                              V
============  =====================================================================  =======

``attitude`` and ``velocity`` measure the same as ``rates`` and ``force``, without gyro and
accelerometer. A residual in only one channel of a pair is the error of a sensor.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters, lag
from flytrack_env.state import Action
from flytrack_sysid.diagnosis.result import PLACES
from flytrack_sysid.inference.chunks import Chunks, count_lead_in, cut_chunks
from flytrack_sysid.inference.lateness import get_latency, read_poses
from flytrack_sysid.inference.parameters import STICKS
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.record import Record
from flytrack_sysid.inference.trace_cache import fast_jit
from flytrack_sysid.kinematics import since_first
from flytrack_sysid.log import FlightLog

UNITS = {"rates": "rad/s", "attitude": "rad/s", "force": "m/s²", "velocity": "m/s²", "battery": "V"}
_PER_STEP = ("attitude", "velocity", "battery")  # changes since the row before
_INSTEAD = {"rates": "attitude", "force": "velocity"}
_AXES = "xyz"
BETWEEN_FLIGHTS = 1000  # slots: more than any lag of a correlation, so that flights are separate


class Traces(NamedTuple):
    """Residuals of models and regressors, a value per row of the log.

    Attributes:
        residuals: by model and channel, (num_rows, 3), battery (num_rows, 1), in the units of the
            module's table. Values where ``counts`` is False have no meaning.
        counts: by channel, rows that a fit uses, (num_rows,) bool; all False if the log lacks the
            channel.
        regressors: by name, (num_rows,) each, in the units of ``REGRESSORS``.
        elapsed_s: time (s), flights one after the other, (num_rows,).
        slot: index of each row among evenly spaced ones, (num_rows,) int. A lost row leaves its
            slot empty, and flights are far apart.
        step_s: time between slots (s).
        attitude: body to world in the row before, (num_rows,): the frame of force and velocity.
        row: index of each row in the log that was given, (num_rows,) int. Ends of flights with late
            poses are omitted.
    """

    residuals: Mapping[str, Mapping[str, np.ndarray]]
    counts: Mapping[str, np.ndarray]
    regressors: Mapping[str, np.ndarray]
    elapsed_s: np.ndarray
    slot: np.ndarray
    step_s: float
    attitude: Rotation
    row: np.ndarray

    def used(self, name: str) -> str:
        """Return the column to use: without a sensor, attitude for rates, velocity for force."""
        channel, _, component = name.partition("_")
        if not self.counts[channel].any():
            channel = _INSTEAD.get(channel, channel)
        return f"{channel}_{component}" if component else channel

    def column(self, model: str, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return one component of a residual and where it counts, both (num_rows,).

        Args:
            model: name of the model.
            name: ``rates_x``, ``force_world_z``, ``force_along`` (the direction of flight through
                the air), ``battery``, ...; the result is the column that is ``used`` for it.
        """
        channel, *suffixes = self.used(name).split("_")
        values = self.residuals[model][channel]
        if "along" in suffixes:
            airspeed = np.stack([self.regressors[f"airspeed_{axis}"] for axis in _AXES], axis=-1)
            speed = np.maximum(np.linalg.norm(airspeed, axis=-1, keepdims=True), 1e-6)
            return (values * airspeed / speed).sum(axis=-1), self.counts[channel]
        if "world" in suffixes:
            values = self.attitude.apply(values)
        return values[:, _AXES.index(suffixes[-1]) if suffixes else 0], self.counts[channel]


# Label and unit of each regressor.
REGRESSORS: dict[str, tuple[str, str]] = {
    "time": ("time since the flight began", "s"),
    **{f"airspeed_{axis}": (f"airspeed along body {axis}", "m/s") for axis in _AXES},
    "airspeed": ("airspeed", "m/s"),
    "airspeed_xy": ("airspeed in the rotor plane", "m/s"),
    **{f"applied_{stick}": (f"{stick} action, lagged", "1") for stick in STICKS},
    "thrust_change": ("change of the applied thrust action", "1/s"),
    **{
        f"model_rates_{axis}": (f"{name} rate of the model", "rad/s")
        for axis, name in zip(_AXES, STICKS[:3], strict=True)
    },
    **{f"model_force_{axis}": (f"force of the model, body {axis}", "m/s²") for axis in _AXES},
    **{
        f"turning_{axis}": (f"squared rates about {others}", "rad²/s²")
        for axis, others in zip(_AXES, ("y, z", "x, z", "x, y"), strict=True)
    },
    **{
        f"spin_up_{axis}": (f"demanded change of the {name} rate", "rad/s²")
        for axis, name in zip(_AXES, STICKS[:3], strict=True)
    },
    "height": ("height", "m"),
    "heading": ("heading", "deg"),
    "tilt": ("tilt", "deg"),
    "voltage": ("battery voltage", "V"),
}


@fast_jit
def _lagged(record: Record, tau: np.ndarray) -> Action:
    """Return the applied action at the rows of chunks: commands after lags, (rows, chunks) each."""

    def next_row(applied: Action, row: Record) -> tuple[Action, Action]:
        restarts = row.begins | row.is_applied_known
        measured = Action(*row.applied.T)
        pairs = zip(measured, applied, strict=True)
        applied = Action(*(jax.numpy.where(restarts, new, old) for new, old in pairs))
        return lag(applied, Action(*row.command.T), row.step_s, tau), applied

    first = Action(*record.applied[0].T)
    return jax.lax.scan(next_row, first, record)[1]


class _Rows(NamedTuple):
    """The indices of the log's rows in chunks, and their record.

    Attributes:
        place: indices (row in chunk, chunk) of the record's rows.
        kept: indices of those record rows that are rows of the log.
        record: inputs and measurements, chunk after chunk.
        before: attitude in the row before each row of the log.
    """

    place: tuple[np.ndarray, np.ndarray]
    kept: np.ndarray
    record: Record
    before: Rotation

    def along(self, values: np.ndarray) -> np.ndarray:
        """Return values (rows, chunks, ...) in the order of the record, filled rows included."""
        return np.asarray(values)[self.place]


def _collect_rows(chunks: Chunks) -> _Rows:
    row = np.where(
        (np.arange(len(chunks.row)) >= count_lead_in(len(chunks.row)))[:, None], chunks.row, -1
    )
    chunk, row_in_chunk = np.nonzero(row.T >= 0)  # chunk after chunk is the record's order
    record = Record(*(leaf[row_in_chunk, chunk] for leaf in chunks.record))
    record = record._replace(begins=~chunks.is_joined[row_in_chunk, chunk])
    kept = np.flatnonzero(record.source_row >= 0)
    before = Rotation.from_quat(np.roll(record.quat, 1, axis=0)[kept], scalar_first=True)
    return _Rows((row_in_chunk, chunk), kept, record, before)


def _residuals(residuals: np.ndarray, rows: _Rows) -> dict[str, np.ndarray]:
    """Return the residuals of one model on the log's rows, by channel.

    Args:
        residuals: residuals in the world frame, (rows, chunks, NUM_AXES, 2).
        rows: indices of the log's rows in chunks.
    """
    by_row, record = rows.along(residuals), rows.record
    step_s = np.roll(record.step_s, 1)[:, None]
    result = {}
    for name, (axes, level) in PLACES.items():
        values = by_row[:, axes, level]
        if name == "battery":
            values = since_first(np.cumsum(values, axis=0), record.begins)
        elif name in _PER_STEP:
            values = values / step_s
        result[name] = (
            values[rows.kept] if name == "battery" else rows.before.inv().apply(values[rows.kept])
        )
    return result


def _counts(chunks: Chunks, rows: _Rows) -> dict[str, np.ndarray]:
    """Return the rows that count by channel; changes since a row that was lost do not count."""
    by_row, record = rows.along(chunks.counts), rows.record
    after_measured = np.append(False, record.source_row[:-1] >= 0) & ~record.begins
    by_channel = {
        name: by_row[:, axes, level].all(axis=1) for name, (axes, level) in PLACES.items()
    }
    return {
        name: np.logical_and(counts, after_measured | (name not in _PER_STEP))[rows.kept]
        for name, counts in by_channel.items()
    }


def _regressors(
    model: ModelParameters, record: Record, applied: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the regressors in the order of the record.

    Args:
        applied: action after the lags, (num_rows, 4).
    """
    attitude = Rotation.from_quat(record.quat, scalar_first=True)
    wind = model.effect("wind")
    airspeed = attitude.inv().apply(record.vel_w - np.array([wind.v_x, wind.v_y, wind.v_z], float))
    change = np.diff(applied, axis=0, append=applied[-1:]) / record.step_s[:, None]
    change = np.where(np.append(record.begins[1:], True)[:, None], 0.0, change)
    body_x = attitude.apply((1.0, 0.0, 0.0))
    max_rates = np.deg2rad(np.asarray(model.max_rate, float))
    result = {
        "airspeed": np.linalg.norm(airspeed, axis=1),
        "airspeed_xy": np.hypot(airspeed[:, 0], airspeed[:, 1]),
        "thrust_change": change[:, 3],
        "height": record.pos_w[:, 2],
        "heading": np.rad2deg(np.arctan2(body_x[:, 1], body_x[:, 0])),
        "tilt": np.rad2deg(np.arccos(np.clip(attitude.apply((0.0, 0.0, 1.0))[:, 2], -1.0, 1.0))),
        "voltage": record.battery_v,
    }
    for index, axis in enumerate(_AXES):
        result[f"airspeed_{axis}"] = airspeed[:, index]
        result[f"spin_up_{axis}"] = change[:, index] * max_rates[index]
    # Values of a row are those of the step to it, from the row before. The lag acts first in a
    # step, so that the applied action is that of the row itself.
    result = {name: np.roll(values, 1) for name, values in result.items()}
    return result | {f"applied_{stick}": applied[:, index] for index, stick in enumerate(STICKS)}


def _predicted(
    residuals: dict[str, np.ndarray], chunks: Chunks, rows: _Rows, gravity: float
) -> dict[str, np.ndarray]:
    """Return the rates and specific force that a model predicts: measured minus residual."""
    record, before = rows.record, rows.before
    step_s = np.roll(record.step_s, 1)[rows.kept, None]
    if "w" in chunks.measured:
        rates = rows.along(chunks.measured["w"])[rows.kept] - residuals["rates"]
    else:
        after = Rotation.from_quat(record.quat[rows.kept], scalar_first=True)
        rates = (before.inv() * after).as_rotvec() / step_s - residuals["attitude"]
    acceleration = (record.vel_w - np.roll(record.vel_w, 1, axis=0))[rows.kept] / step_s
    force = before.inv().apply(acceleration + np.array([0.0, 0.0, gravity])) - residuals["velocity"]
    squares = rates**2
    turning = squares.sum(axis=1, keepdims=True) - squares
    parts = {"model_rates": rates, "model_force": force, "turning": turning}
    return {
        f"{name}_{axis}": part[:, index]
        for name, part in parts.items()
        for index, axis in enumerate(_AXES)
    }


def traces(log: FlightLog, models: Mapping[str, ModelParameters], like: str) -> Traces:
    """Return the residuals of models on the rows of a log at which all of them know the pose.

    Each model reads poses with its own latency. Regressors of a row are those of the step to it:
    state and commands of the row before, and the action after its lag.

    Args:
        like: name of the model whose lags, rates and wind determine the regressors. A delay of
            commands is ignored.

    Raises:
        KeyError: ``like`` is not one of the models.
    """
    base = models[like]
    logs = {late_s: read_poses(log, late_s) for late_s in map(get_latency, models.values())}
    is_known = np.logical_and.reduce([is_row_known for _, is_row_known in logs.values()])
    in_time = {late_s: shifted.select(is_known) for late_s, (shifted, _) in logs.items()}
    log = in_time[get_latency(base)]
    with jax.enable_x64(True):
        by_lateness = {
            late_s: cut_chunks(late_log, np.ones(len(late_log), bool), base)
            for late_s, late_log in in_time.items()
        }
        chunk_residuals = []
        for model in models.values():
            problem = Problem.of(
                by_lateness[get_latency(model)], model._replace(motion=base.motion)
            )
            chunk_residuals.append(problem.residuals(problem.start[None])[0])
        chunks = by_lateness[get_latency(base)]
        lagged = _lagged(chunks.record, np.asarray(base.tau, float))
        applied = np.stack([np.asarray(stick) for stick in lagged], axis=-1)
    rows = _collect_rows(chunks)
    residuals = {
        name: _residuals(model_residuals, rows)
        for name, model_residuals in zip(models, chunk_residuals, strict=True)
    }
    in_record_order = _regressors(base, rows.record, rows.along(applied))
    step_s = rows.record.median_step_s
    regressors = {
        "time": since_first(log.time, log.is_start()),
        **{name: values[rows.kept] for name, values in in_record_order.items()},
    }
    regressors |= _predicted(residuals[like], chunks, rows, float(base.g))
    slot = np.arange(len(rows.record.begins)) + BETWEEN_FLIGHTS * np.cumsum(rows.record.begins)
    elapsed_s, counts = step_s * rows.kept, _counts(chunks, rows)
    row = np.flatnonzero(is_known)
    return Traces(
        residuals, counts, regressors, elapsed_s, slot[rows.kept], step_s, rows.before, row
    )
