"""The specific force that a model does not explain: by speed, and as thrust by applied action and voltage."""

from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.dynamics import ModelParameters, advance
from flytrack_env.effects import start_memories
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import BATTERY_EMPTY_V, BATTERY_FULL_V, Action, Drone
from flytrack_sysid.log import FlightLog
from flytrack_sysid.one_step import predicted_channel
from flytrack_sysid.prediction import (
    Prediction,
    columns,
    in_float64,
    inputs_that_lack,
    judged_steps,
    specific_force_w,
    to_body,
)

# Long enough for the noise of velocity to average out, short beside a manoeuvre.
WINDOW_S = 0.1
SPEED_EDGES = (0.0, 2.0, 5.0, 10.0, 20.0, np.inf)
NUM_ACTION_BINS = 10
NUM_VOLTAGE_BINS = 4
NUM_CURVES = 3
NUM_CURVE_POINTS = 21
# V; a pack that never changes its voltage still gets a bin.
LEAST_VOLTAGE_RANGE = 0.1


class ForceSamples(NamedTuple):
    """Specific force of judged steps or windows, body frame, (num_samples, 3) m/s^2.

    source: the channel it was measured with, f, a or v; v gives body z only. Others (num_samples,): applied
    thrust action after the step, V, rows before the steps.
    """

    source: str
    measured_b: np.ndarray
    modelled_b: np.ndarray
    action: np.ndarray
    battery_v: np.ndarray
    rows: np.ndarray


class SpeedBin(NamedTuple):
    """Unexplained force at speeds from low to high, m/s (inf: no limit); rms of norm and body axes, m/s^2.

    mean_against_velocity: its mean component against the direction of flight: drag that the model lacks.
    """

    low: float
    high: float
    count: int  # type: ignore[assignment]  # hides tuple.count
    rms: float
    rms_b: tuple[float, float, float]
    mean_against_velocity: float


class OpenForce(NamedTuple):
    """Specific force, measured minus modelled, body axes, m/s^2."""

    source: str
    mean_b: tuple[float, float, float]
    rms_b: tuple[float, float, float]
    by_speed: tuple[SpeedBin, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the numbers as JSON values, but for a speed that is inf."""
        bins = [
            {
                "speed_from_m_per_s": part.low,
                "speed_to_m_per_s": part.high,
                "count": part.count,
                "rms_m_per_s2": part.rms,
                "rms_body_xyz_m_per_s2": list(part.rms_b),
                "mean_against_velocity_m_per_s2": part.mean_against_velocity,
            }
            for part in self.by_speed
        ]
        return {
            "what": "specific force that the model does not explain",
            "measured_with": self.source,
            "mean_body_xyz_m_per_s2": list(self.mean_b),
            "rms_body_xyz_m_per_s2": list(self.rms_b),
            "by_speed": bins,
        }


def _from_velocity(
    model: ModelParameters, log: FlightLog, prediction: Prediction, here: np.ndarray
) -> ForceSamples:
    """Return samples along body z of the change of velocity over windows that do not overlap."""
    length = max(1, round(WINDOW_S / prediction.steps.median))
    run = np.cumsum(np.append(True, np.diff(here) > 1)) if len(here) else here
    place = np.arange(len(here)) - np.searchsorted(run, run)
    is_first = place % length == 0
    whole = is_first & (np.append(run, np.full(length, -1))[length - 1 :][: len(here)] == run)
    windows = here[whole][:, None] + np.arange(length)
    rows = windows[:, length // 2]
    duration = prediction.steps.duration[windows]
    weights = duration / duration.sum(axis=1, keepdims=True)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.einsum("wk,wk...->w...", weights, values[windows])

    acc_w = (log["v"][windows[:, -1] + 1] - log["v"][windows[:, 0]]) / duration.sum(axis=1)[:, None]
    error_w = acc_w - mean(columns(prediction.after.acc_w))
    axis_w = mean(columns(prediction.before.quat.axes()[2]))
    axis_w /= np.linalg.norm(axis_w, axis=1, keepdims=True)
    modelled = np.zeros((len(rows), 3))
    modelled[:, 2] = mean(predicted_channel("f", prediction, model)[:, 2])
    measured = modelled.copy()
    measured[:, 2] += np.sum(axis_w * error_w, axis=1)
    action, battery_v = map(np.asarray, (prediction.after.applied.thrust, prediction.before.battery_v))
    return ForceSamples("v", measured, modelled, mean(action), mean(battery_v), rows)


def force_samples(
    model: ModelParameters, log: FlightLog, prediction: Prediction, rows: np.ndarray
) -> ForceSamples | None:
    """Return the specific force of judged steps, by f, else a, else v; None without any of them."""
    lacking = inputs_that_lack(model, log)
    source = next((name for name in ("f", "a", "v") if name in log and not lacking[name]), None)
    here = judged_steps(rows, prediction)
    if source is None or not len(here):
        return None
    if source == "v":
        samples = _from_velocity(model, log, prediction, here)
        return samples if len(samples.rows) else None
    measured = log[source][here + 1]
    if source == "a":
        before = jax.tree.map(lambda leaf: leaf[here], prediction.before)
        measured = to_body(before, specific_force_w(measured, model))
    return ForceSamples(
        source=source,
        measured_b=measured,
        modelled_b=predicted_channel("f", prediction, model)[here],
        action=np.asarray(prediction.after.applied.thrust)[here],
        battery_v=np.asarray(prediction.before.battery_v)[here],
        rows=here,
    )


def open_force(log: FlightLog, prediction: Prediction, samples: ForceSamples) -> OpenForce:
    """Return the specific force that the model does not explain, in all and by speed over ground, m/s^2.

    The log must have v and q, and the samples be of f or a.
    """
    error_b = samples.measured_b - samples.modelled_b
    before = jax.tree.map(lambda leaf: leaf[samples.rows], prediction.before)
    vel_b = to_body(before, log["v"][samples.rows])
    speed = np.linalg.norm(vel_b, axis=1)
    against = -np.sum(error_b * vel_b, axis=1) / np.maximum(speed, np.finfo(float).tiny)
    bins = []
    for low, high in pairwise(SPEED_EDGES):
        is_in = (speed >= low) & (speed < high)
        if is_in.any():
            squared = np.mean(error_b[is_in] ** 2, axis=0)
            bins.append(
                SpeedBin(
                    low=low,
                    high=high,
                    count=int(is_in.sum()),
                    rms=float(np.sqrt(squared.sum())),
                    rms_b=tuple(np.sqrt(squared).tolist()),
                    mean_against_velocity=float(np.mean(against[is_in])),
                )
            )
    return OpenForce(
        source=samples.source,
        mean_b=tuple(np.mean(error_b, axis=0).tolist()),
        rms_b=tuple(np.sqrt(np.mean(error_b**2, axis=0)).tolist()),
        by_speed=tuple(bins),
    )


class ThrustCurve(NamedTuple):
    """Thrust against the applied action, N, at one voltage; measured in a range around it.

    modelled_action, modelled_n: the model at rest. measured_action, measured_n: means of the bins flown.
    """

    voltage_v: float
    modelled_action: np.ndarray
    modelled_n: np.ndarray
    measured_action: np.ndarray
    measured_n: np.ndarray


class ThrustError(NamedTuple):
    """Measured minus modelled thrust; maps are (voltage bins, action bins), NaN where nothing flew, N."""

    source: str
    action_edges: np.ndarray
    voltage_edges: np.ndarray
    count: np.ndarray  # type: ignore[assignment]  # hides tuple.count
    mean_n: np.ndarray
    rms_n: np.ndarray
    curves: tuple[ThrustCurve, ...]
    total_mean_n: float
    total_rms_n: float

    def as_json(self) -> dict[str, Any]:
        """Return the numbers as JSON values, NaN where nothing flew."""
        return {
            "what": "mass times specific force along body z, measured minus modelled, N; "
            "rows by voltage, columns by applied thrust action",
            "measured_with": self.source,
            "total_mean_n": self.total_mean_n,
            "total_rms_n": self.total_rms_n,
            "action_edges": self.action_edges.tolist(),
            "voltage_edges_v": self.voltage_edges.tolist(),
            "count": self.count.tolist(),
            "mean_n": self.mean_n.tolist(),
            "rms_n": self.rms_n.tolist(),
            "curves": [
                {name: np.asarray(values).tolist() for name, values in curve._asdict().items()}
                for curve in self.curves
            ],
        }


@jax.jit
def _force_at_rest(action: jax.Array, battery_v: jax.Array, dt: Any, model: ModelParameters) -> jax.Array:
    """Return the specific force along body z of a drone at rest, all (num_points,), m/s^2."""

    def one(action: jax.Array, battery_v: jax.Array) -> Any:
        zero = jnp.zeros_like(action)
        still, upright = Vec3(zero, zero, zero), Quaternion(zero + 1.0, zero, zero, zero)
        command = Action(zero, zero, zero, action)
        drone = Drone(still, still, still, upright, still, command, battery_v)
        after, _ = advance(drone, start_memories(model.effects, drone), command, dt, model)
        return after.acc_w.z + model.g

    return jax.vmap(one)(action, battery_v)


def _thrust_at_rest(
    model: ModelParameters, action: np.ndarray, battery_v: np.ndarray, dt: float
) -> np.ndarray:
    """Return the force along body z of a hovering drone by the simulator's own step, N, shape of action.

    action: applied and commanded, 1. battery_v: V, the same shape. dt: s.
    """
    with jax.enable_x64(True):
        force = _force_at_rest(np.asarray(action, float), np.asarray(battery_v, float), dt, in_float64(model))
        return float(model.m) * np.asarray(force)


def _voltage_range(battery_v: np.ndarray) -> tuple[float, float]:
    """Return the handout's range of voltage, or the log's where it exceeds that."""
    low, high = float(battery_v.min()), float(battery_v.max())
    if low >= BATTERY_EMPTY_V and high <= BATTERY_FULL_V:
        return BATTERY_EMPTY_V, BATTERY_FULL_V
    return low, max(high, low + LEAST_VOLTAGE_RANGE)


def _bin_of(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the bins that values are in; values beyond an end belong to its bin."""
    return np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)


def thrust_error(model: ModelParameters, samples: ForceSamples, dt: float) -> ThrustError:
    """Return the error of thrust by applied action and voltage; dt: s, of the model's step at rest."""
    measured_n = float(model.m) * samples.measured_b[:, 2]
    error_n = measured_n - float(model.m) * samples.modelled_b[:, 2]
    action_edges = np.linspace(-1.0, 1.0, NUM_ACTION_BINS + 1)
    low, high = _voltage_range(samples.battery_v)
    voltage_edges = np.linspace(low, high, NUM_VOLTAGE_BINS + 1)
    by_action = _bin_of(samples.action, action_edges)

    def means(by_voltage: np.ndarray, num_voltages: int, values: np.ndarray) -> np.ndarray:
        place, shape = by_voltage * NUM_ACTION_BINS + by_action, (num_voltages, NUM_ACTION_BINS)
        count = np.bincount(place, minlength=num_voltages * NUM_ACTION_BINS)
        total = np.bincount(place, weights=values, minlength=len(count))
        return np.divide(total, count, out=np.full(len(count), np.nan), where=count > 0).reshape(shape)

    by_voltage = _bin_of(samples.battery_v, voltage_edges)
    mean = partial(means, by_voltage, NUM_VOLTAGE_BINS)
    count = np.zeros((NUM_VOLTAGE_BINS, NUM_ACTION_BINS), int)
    np.add.at(count, (by_voltage, by_action), 1)

    thirds = np.linspace(low, high, NUM_CURVES + 1)
    by_third = _bin_of(samples.battery_v, thirds)
    measured, at = (means(by_third, NUM_CURVES, values) for values in (measured_n, samples.action))
    grid = np.linspace(-1.0, 1.0, NUM_CURVE_POINTS)
    curves = []
    for index, (start, end) in enumerate(pairwise(thirds.tolist())):
        middle, is_flown = 0.5 * (start + end), np.isfinite(measured[index])
        modelled = _thrust_at_rest(model, grid, np.full_like(grid, middle), dt)
        curves.append(ThrustCurve(middle, grid, modelled, at[index][is_flown], measured[index][is_flown]))
    return ThrustError(
        source=samples.source,
        action_edges=action_edges,
        voltage_edges=voltage_edges,
        count=count,
        mean_n=mean(error_n),
        rms_n=np.sqrt(mean(error_n**2)),
        curves=tuple(curves),
        total_mean_n=float(np.mean(error_n)),
        total_rms_n=float(np.sqrt(np.mean(error_n**2))),
    )
