"""The specific force that a model does not explain: by speed, and as thrust by applied action and voltage."""

from itertools import pairwise
from typing import NamedTuple

import jax
import numpy as np
from scipy.stats import binned_statistic_2d

from flytrack_env.dynamics import ModelParameters
from flytrack_env.state import BATTERY_EMPTY_V, BATTERY_FULL_V
from flytrack_sysid.log import FlightLog
from flytrack_sysid.prediction import Prediction, inputs_that_lack, judged_steps, specific_force_w, to_body
from flytrack_sysid.prediction_errors import predicted_channel

SPEED_EDGES = (0.0, 2.0, 5.0, 10.0, 20.0, np.inf)
NUM_ACTION_BINS = 10
NUM_VOLTAGE_BINS = 4
# V; a pack that never changes its voltage still gets a bin.
LEAST_VOLTAGE_RANGE = 0.1


class ForceSamples(NamedTuple):
    """Specific force of judged steps, body frame, (num_samples, 3) m/s^2.

    source: the channel it was measured with, f or a. Others (num_samples,): applied thrust action after the
    step, V, rows before the steps.
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


def force_samples(
    model: ModelParameters, log: FlightLog, prediction: Prediction, rows: np.ndarray
) -> ForceSamples | None:
    """Return the specific force of judged steps, by f, else a; None without both."""
    lacking = inputs_that_lack(model, log)
    source = next((name for name in ("f", "a") if name in log and not lacking[name]), None)
    here = judged_steps(rows, prediction)
    if source is None or not len(here):
        return None
    measured = log[source][here + 1]
    if source == "a":
        before = jax.tree.map(lambda leaf: leaf[here], prediction.before)
        measured = to_body(before, specific_force_w(measured, model))
    return ForceSamples(
        source=source,
        measured_b=measured,
        modelled_b=predicted_channel("f", prediction)[here],
        action=np.asarray(prediction.after.applied.thrust)[here],
        battery_v=np.asarray(prediction.before.battery_v)[here],
        rows=here,
    )


def open_force(log: FlightLog, prediction: Prediction, samples: ForceSamples) -> OpenForce:
    """Return the specific force that the model does not explain, in all and by speed over ground, m/s^2.

    The log must have v and q.
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


class ThrustError(NamedTuple):
    """Measured minus modelled thrust; maps are (voltage bins, action bins), NaN where nothing flew, N."""

    source: str
    action_edges: np.ndarray
    voltage_edges: np.ndarray
    count: np.ndarray  # type: ignore[assignment]  # hides tuple.count
    mean_n: np.ndarray
    rms_n: np.ndarray
    total_mean_n: float
    total_rms_n: float


def _voltage_range(battery_v: np.ndarray) -> tuple[float, float]:
    """Return the handout's range of voltage, or the log's where it exceeds that."""
    low, high = float(battery_v.min()), float(battery_v.max())
    if low >= BATTERY_EMPTY_V and high <= BATTERY_FULL_V:
        return BATTERY_EMPTY_V, BATTERY_FULL_V
    return low, max(high, low + LEAST_VOLTAGE_RANGE)


def thrust_error(model: ModelParameters, samples: ForceSamples) -> ThrustError:
    """Return the error of thrust by applied action and voltage; samples beyond an end are in its bin."""
    error_n = float(model.m) * (samples.measured_b[:, 2] - samples.modelled_b[:, 2])
    low, high = _voltage_range(samples.battery_v)
    edges = np.linspace(low, high, NUM_VOLTAGE_BINS + 1), np.linspace(-1.0, 1.0, NUM_ACTION_BINS + 1)
    place = np.clip(samples.battery_v, low, high), np.clip(samples.action, -1.0, 1.0)
    count = binned_statistic_2d(*place, None, "count", edges).statistic
    mean_n, mean_square = binned_statistic_2d(*place, [error_n, error_n**2], "mean", edges).statistic
    return ThrustError(
        source=samples.source,
        action_edges=edges[1],
        voltage_edges=edges[0],
        count=count.astype(int),
        mean_n=mean_n,
        rms_n=np.sqrt(mean_square),
        total_mean_n=float(np.mean(error_n)),
        total_rms_n=float(np.sqrt(np.mean(error_n**2))),
    )
