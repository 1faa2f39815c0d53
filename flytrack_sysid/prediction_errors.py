"""Errors of a model on a measured flight: one step by channel, free flight, thrust by action."""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import binned_statistic_2d

from flytrack_env.battery import Battery
from flytrack_sysid.inference.free_flight import (
    CHANNEL_OF,
    HORIZONS_S,
    QUANTITIES,
    evaluate_windows,
    make_windows,
)
from flytrack_sysid.inference.free_flight import UNITS as FLIGHT_UNITS
from flytrack_sysid.inference.one_step import Prediction, columns, scored_steps
from flytrack_sysid.log import CHANNELS, FlightLog
from flytrack_sysid.log_voltage import voltages_of, with_voltage
from flytrack_sysid.sensors import specific_force_b

UNITS = {"p": "m", "v": "m/s", "q": "1", "w": "rad/s", "a": "m/s^2", "f": "m/s^2"}
BY_CHANGE, BY_SPREAD = "measured change in one step", "measured channel's spread"
NORMALISED_BY = {**dict.fromkeys("pvq", BY_CHANGE), **dict.fromkeys("waf", BY_SPREAD)}
NRMSE_MEANING = {
    BY_CHANGE: (
        "rmse over the rms of the measured change in one step: 1 is as good as 'nothing changes'"
    ),
    BY_SPREAD: "rmse over the standard deviation of the measured channel: 1 is as good as its mean",
}
# Free flight.
START_EVERY_S = 0.25
MAX_STARTS = 10_000
SHOWN_UNITS = {**FLIGHT_UNITS, "attitude": "deg"}
HIGH_PERCENTILE = 95.0
# Thrust error.
NUM_ACTION_BINS = 10
NUM_VOLTAGE_BINS = 4
# V; a battery whose voltage never changes still gets a bin.
MIN_VOLTAGE_RANGE = 0.1


class ChannelError(NamedTuple):
    """One-step errors of a channel, measured minus modelled.

    Errors of q are those of the quaternion with the sign nearer to the measured one.

    Attributes:
        mse: mean over steps and components.
        mse_by_axis: mean over steps, by component.
        nrmse: normalised RMS error; None if the measured channel never changes.
        angle_rms_deg: RMS angle between measured and modelled attitude (deg); None except for q.
    """

    mse: float
    mse_by_axis: tuple[float, ...]
    nrmse: float | None
    angle_rms_deg: float | None

    def as_json(self, name: str) -> dict[str, Any]:
        """Return the numbers as JSON values."""
        axes = [column.split("_", 1)[1] for column in CHANNELS[name]]
        angle = {} if self.angle_rms_deg is None else {"angle_rms_deg": self.angle_rms_deg}
        return {
            "mse": self.mse,
            "unit_of_mse": "1" if UNITS[name] == "1" else f"({UNITS[name]})^2",
            "mse_by_axis": dict(zip(axes, self.mse_by_axis, strict=True)),
            "nrmse": self.nrmse,
            "nrmse_is": NRMSE_MEANING[NORMALISED_BY[name]],
            **angle,
        }


class OneStep(NamedTuple):
    """One-step errors of all channels that the log has and the model can predict."""

    num_steps: int
    channels: dict[str, ChannelError]

    def as_json(self) -> dict[str, Any]:
        """Return the numbers as JSON values."""
        channels = {name: error.as_json(name) for name, error in self.channels.items()}
        return {"steps": self.num_steps, "channels": channels}


def predicted_channel(name: str, prediction: Prediction) -> np.ndarray:
    """Return the model's prediction of a channel after the step of every row, (num_rows, size)."""
    after = prediction.after
    if name == "f":
        return prediction.force_b
    by_channel = {
        "p": after.pos_w,
        "v": after.vel_w,
        "q": after.quat,
        "w": after.rates_b,
        "a": after.acc_w,
    }
    return columns(by_channel[name])


def turn_between(quats: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return the rotation vectors that turn attitudes into other attitudes.

    Args:
        quats: attitudes, (num, 4).
        targets: the other attitudes, (num, 4).

    Returns:
        Rotation vectors in the body frame (rad), (num, 3).
    """
    first, second = (Rotation.from_quat(values, scalar_first=True) for values in (quats, targets))
    return (first.inv() * second).as_rotvec()


def error_of(
    name: str, before: np.ndarray, measured: np.ndarray, predicted: np.ndarray
) -> ChannelError:
    """Return the one-step errors of a channel.

    Args:
        name: name of the channel.
        before: measured values before the step, (num_steps, size).
        measured: measured values after the step, (num_steps, size).
        predicted: predicted values after the step, (num_steps, size).
    """
    angle_rms_deg = None
    if name == "q":

        def nearer(quats: np.ndarray) -> np.ndarray:
            return np.where(np.sum(quats * measured, axis=1, keepdims=True) < 0.0, -quats, quats)

        before, predicted = nearer(before), nearer(predicted)
        turn_deg = np.rad2deg(turn_between(predicted, measured))
        angle_rms_deg = float(np.sqrt(np.mean(np.sum(turn_deg**2, axis=1))))
    squares = (measured - predicted) ** 2
    by_change = NORMALISED_BY[name] == BY_CHANGE
    scale = np.mean((measured - before) ** 2) if by_change else np.mean(np.var(measured, axis=0))
    mse = float(np.mean(squares))
    nrmse = float(np.sqrt(mse / scale)) if scale > 0.0 else None
    return ChannelError(mse, tuple(np.mean(squares, axis=0).tolist()), nrmse, angle_rms_deg)


def one_step_errors(prediction: Prediction, rows: np.ndarray) -> OneStep:
    """Return the errors of the steps from each scored row to the next.

    Channels include only one of acceleration and specific force, the first that the log has.

    Args:
        prediction: steps from every row.
        rows: rows that are scored, (num_rows,) bool.
    """
    log, lacking = prediction.log, prediction.lacking
    force = next((name for name in ("a", "f") if name in log and not lacking[name]), None)
    names = [name for name in ("p", "v", "q", "w") if name in log and not lacking[name]]
    names += [force] if force else []
    starts = scored_steps(rows, prediction)
    if not len(starts):
        return OneStep(0, {})
    channels = {
        name: error_of(
            name,
            log[name][starts],
            log[name][starts + 1],
            predicted_channel(name, prediction)[starts],
        )
        for name in names
    }
    return OneStep(len(starts), channels)


class Spread(NamedTuple):
    """Size of an error over all starts."""

    median: float
    rms: float
    p95: float


class Rollout(NamedTuple):
    """Errors at one horizon; ``errors`` is empty if there is no start."""

    horizon_s: float
    num_starts: int
    errors: dict[str, Spread]

    def as_json(self) -> dict[str, Any]:
        """Return the numbers as JSON values."""
        errors = {
            f"{name}_{SHOWN_UNITS[name].replace('/', '_per_')}": spread._asdict()
            for name, spread in self.errors.items()
        }
        return {"horizon_s": self.horizon_s, "starts": self.num_starts, **errors}


def _spread(distances: np.ndarray) -> Spread:
    median, high = np.percentile(distances, [50.0, HIGH_PERCENTILE]).tolist()
    return Spread(median, float(np.sqrt(np.mean(distances**2))), high)


def rollout_errors(prediction: Prediction, log: FlightLog, rows: np.ndarray) -> tuple[Rollout, ...]:
    """Return the errors of free flights from measured states, a start every 0.25 s of scored rows.

    Args:
        prediction: steps from every row.
        log: the log, which may have gaps.
        rows: its rows that are scored, (num_rows,) bool. A flight stays within them, and begins and
            ends in measured rows.
    """
    windows = make_windows(
        with_voltage(log, prediction.model),
        rows,
        START_EVERY_S,
        MAX_STARTS,
        prediction.is_settled,
    )
    if not len(windows.start):
        return tuple(Rollout(horizon_s, 0, {}) for horizon_s in HORIZONS_S)
    names = [name for name, channel in CHANNEL_OF.items() if not prediction.lacking[channel]]
    with np.errstate(over="ignore", invalid="ignore"):  # a model may diverge
        distances = np.linalg.norm(evaluate_windows(prediction.model, windows), axis=-1)
    distances[..., QUANTITIES.index("attitude")] *= 180.0 / np.pi
    rollouts = []
    for horizon_s, by_window, counts in zip(HORIZONS_S, distances, windows.counts, strict=True):
        errors = {}
        for name in names:
            index = QUANTITIES.index(name)
            if counts[:, index].any():
                errors[name] = _spread(by_window[counts[:, index], index])
        rollouts.append(Rollout(horizon_s, int(counts.any(axis=1).sum()), errors))
    return tuple(rollouts)


class ThrustError(NamedTuple):
    """Measured minus modelled thrust (N).

    Maps are (voltage bins, action bins), NaN in bins without a step.

    Attributes:
        source: channel that measures the thrust.
        action_edges: edges of the action bins.
        voltage_edges: edges of the voltage bins (V).
        count: map of the number of steps.
        mean_n: map of the mean error.
        rms_n: map of the RMS error.
        total_mean_n: mean error of all steps.
        total_rms_n: RMS error of all steps.
    """

    source: str
    action_edges: np.ndarray
    voltage_edges: np.ndarray
    count: np.ndarray  # type: ignore[assignment]  # hides tuple.count
    mean_n: np.ndarray
    rms_n: np.ndarray
    total_mean_n: float
    total_rms_n: float


def _voltage_range(battery_v: np.ndarray, battery: Battery) -> tuple[float, float]:
    """Return the voltage range of the battery, or that of the log if it exceeds the battery's."""
    low, high = float(battery_v.min()), float(battery_v.max())
    empty_v, full_v = voltages_of(battery)
    if low >= empty_v and high <= full_v:
        return empty_v, full_v
    return low, max(high, low + MIN_VOLTAGE_RANGE)


def thrust_error(prediction: Prediction, rows: np.ndarray) -> ThrustError | None:
    """Return the thrust error of scored steps by applied action and voltage; None without steps.

    Thrust is measured by f, else by a. Samples beyond the last edge are in the last bin, and
    samples below the first edge in the first bin.

    Args:
        prediction: steps from every row.
        rows: rows that are scored, (num_rows,) bool.
    """
    log, model, step_rows = prediction.log, prediction.model, scored_steps(rows, prediction)
    source = next(
        (name for name in ("f", "a") if name in log and not prediction.lacking[name]), None
    )
    if source is None or not len(step_rows):
        return None
    measured_b = log["f"] if source == "f" else specific_force_b(log, float(model.g))
    error_n = float(model.m) * (measured_b[step_rows + 1, 2] - prediction.force_b[step_rows, 2])
    battery_v = np.asarray(prediction.before.battery_v)[step_rows]
    low, high = _voltage_range(battery_v, model.battery)
    edges = (
        np.linspace(low, high, NUM_VOLTAGE_BINS + 1),
        np.linspace(-1.0, 1.0, NUM_ACTION_BINS + 1),
    )
    action = np.asarray(prediction.after.applied.thrust)[step_rows]
    coordinates = np.clip(battery_v, low, high), np.clip(action, -1.0, 1.0)
    count = binned_statistic_2d(*coordinates, None, "count", edges).statistic
    mean_n, mean_square = binned_statistic_2d(
        *coordinates, [error_n, error_n**2], "mean", edges
    ).statistic
    return ThrustError(
        source=source,
        action_edges=edges[1],
        voltage_edges=edges[0],
        count=count.astype(int),
        mean_n=mean_n,
        rms_n=np.sqrt(mean_square),
        total_mean_n=float(np.mean(error_n)),
        total_rms_n=float(np.sqrt(np.mean(error_n**2))),
    )
