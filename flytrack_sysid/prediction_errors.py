"""Errors of a model on a measured flight: one step by channel, free flight, thrust by action."""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import binned_statistic_2d

from flytrack_env.battery import Battery
from flytrack_sysid.inference.prediction import (
    MAX_S,
    Prediction,
    columns,
    find_runs,
    free_flights,
    scored_steps,
)
from flytrack_sysid.log import CHANNELS
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
HORIZONS_S = (0.1, 0.5, 1.0, MAX_S)
START_EVERY_S = 0.25
# Channel of each error, and its unit.
QUANTITIES = {
    "position": ("p", "m"),
    "velocity": ("v", "m/s"),
    "attitude": ("q", "deg"),
    "rates": ("w", "rad/s"),
}
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
            f"{name}_{QUANTITIES[name][1].replace('/', '_per_')}": spread._asdict()
            for name, spread in self.errors.items()
        }
        return {"horizon_s": self.horizon_s, "starts": self.num_starts, **errors}


def _starts_and_ends(prediction: Prediction, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows to start from, and the rows at the horizons.

    Returns:
        Starts, (num_starts,), and ends, (num_starts, num_horizons). An end is the row nearest to
        its horizon; -1 if the run of scored rows ends before it.
    """
    starts, ends = [], []
    half_step = 0.5 * prediction.step_s
    for first, end in find_runs(rows, prediction.record):
        time, is_settled = prediction.log.time[first:end], prediction.is_settled[first:end]
        if not is_settled.any():
            continue
        start_times = np.arange(time[np.argmax(is_settled)], time[-1], START_EVERY_S)
        begin = np.searchsorted(time, start_times - half_step)
        begin = begin[prediction.is_measured[first + begin]]
        reached = np.searchsorted(time, time[begin, None] + np.array(HORIZONS_S) - half_step)
        last = np.minimum(first + reached, len(rows) - 1)
        starts.append(first + begin)
        ends.append(np.where((reached < len(time)) & prediction.is_measured[last], last, -1))
    if not starts:
        return np.zeros(0, int), np.zeros((0, len(HORIZONS_S)), int)
    return np.concatenate(starts), np.concatenate(ends)


def _spread(distances: np.ndarray) -> Spread:
    median, high = np.percentile(distances, [50.0, HIGH_PERCENTILE]).tolist()
    return Spread(median, float(np.sqrt(np.mean(distances**2))), high)


def rollout_errors(prediction: Prediction, rows: np.ndarray) -> tuple[Rollout, ...]:
    """Return the errors of free flights from measured states, a start every 0.25 s of scored runs.

    Args:
        prediction: steps from every row.
        rows: rows that are scored, (num_rows,) bool. A flight stays within them, and begins and
            ends in measured rows.
    """
    log, lacking = prediction.log, prediction.lacking
    names = [
        name for name, (channel, _) in QUANTITIES.items() if channel in log and not lacking[channel]
    ]
    starts, ends = _starts_and_ends(prediction, rows)
    starts, ends = starts[(ends >= 0).any(axis=1)], ends[(ends >= 0).any(axis=1)]
    is_reached = ends >= 0
    flights = free_flights(prediction, starts, np.where(is_reached, ends, starts[:, None] + 1))
    rollouts = []
    for index, horizon_s in enumerate(HORIZONS_S):
        reaches = is_reached[:, index]
        errors = {}
        for name in names if reaches.any() else ():
            channel = QUANTITIES[name][0]
            with np.errstate(over="ignore", invalid="ignore"):  # a model may diverge
                measured, at_end = (
                    log[channel][ends[reaches, index]],
                    flights[channel][reaches, index],
                )
                difference = turn_between(measured, at_end) if channel == "q" else measured - at_end
                distances = np.linalg.norm(difference, axis=1)
                errors[name] = _spread(np.rad2deg(distances) if channel == "q" else distances)
        rollouts.append(Rollout(horizon_s, int(reaches.sum()), errors))
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
    empty_v, full_v = float(battery.empty_v), float(battery.full_v)
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
