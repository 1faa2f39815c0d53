"""The error of a model's thrust, by applied action and voltage."""

from typing import NamedTuple

import numpy as np
from scipy.stats import binned_statistic_2d

from flytrack_env.dynamics import ModelParameters
from flytrack_env.state import BATTERY_EMPTY_V, BATTERY_FULL_V
from flytrack_sysid.log import FlightLog
from flytrack_sysid.prediction import Prediction, inputs_that_lack, judged_steps
from flytrack_sysid.prediction_errors import predicted_channel
from flytrack_sysid.sensors import specific_force_b

NUM_ACTION_BINS = 10
NUM_VOLTAGE_BINS = 4
# V; a pack that never changes its voltage still gets a bin.
LEAST_VOLTAGE_RANGE = 0.1


class ForceSamples(NamedTuple):
    """Specific force of judged steps, body frame, (num_samples, 3) m/s^2.

    source: the channel it was measured with, f or a. Others (num_samples,): applied thrust action after the
    step, V.
    """

    source: str
    measured_b: np.ndarray
    modelled_b: np.ndarray
    action: np.ndarray
    battery_v: np.ndarray


def force_samples(
    model: ModelParameters, log: FlightLog, prediction: Prediction, rows: np.ndarray
) -> ForceSamples | None:
    """Return the specific force of judged steps, by f, else a; None without both."""
    lacking = inputs_that_lack(model, log)
    source = next((name for name in ("f", "a") if name in log and not lacking[name]), None)
    here = judged_steps(rows, prediction)
    if source is None or not len(here):
        return None
    measured = log["f"] if source == "f" else specific_force_b(log, float(model.g))
    return ForceSamples(
        source=source,
        measured_b=measured[here + 1],
        modelled_b=predicted_channel("f", prediction)[here],
        action=np.asarray(prediction.after.applied.thrust)[here],
        battery_v=np.asarray(prediction.before.battery_v)[here],
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
