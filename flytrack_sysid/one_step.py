"""Errors of a model's one-step prediction, channel by channel."""

from typing import Any, NamedTuple

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.log import CHANNELS, FlightLog
from flytrack_sysid.prediction import (
    Prediction,
    columns,
    inputs_that_lack,
    judged_steps,
    specific_force_w,
    to_body,
    turn_between,
)

UNITS = {"p": "m", "v": "m/s", "q": "1", "w": "rad/s", "a": "m/s^2", "f": "m/s^2"}
BY_CHANGE, BY_SPREAD = "measured change in one step", "measured channel's spread"
NORMALISED_BY = {
    "p": BY_CHANGE,
    "v": BY_CHANGE,
    "q": BY_CHANGE,
    "w": BY_SPREAD,
    "a": BY_SPREAD,
    "f": BY_SPREAD,
}
NRMSE_MEANING = {
    BY_CHANGE: "rmse over the rms of the measured change in one step: 1 is as good as 'nothing changes'",
    BY_SPREAD: "rmse over the standard deviation of the measured channel: 1 is as good as its mean",
}


class ChannelError(NamedTuple):
    """One-step errors of a channel, measured minus modelled.

    errors: (num_steps, size), unit of the channel; of q with the sign that is nearer to the measured one.
    mse: mean over steps and components. nrmse: None where the measured channel never changes.
    turn_deg: of q, (num_steps, 3) deg, the turn from modelled to measured attitude, body axes; else None.
    """

    errors: np.ndarray
    mse: float
    mse_by_axis: tuple[float, ...]
    nrmse: float | None
    turn_deg: np.ndarray | None = None

    @property
    def angle_rms_deg(self) -> float | None:
        """Rms of the angle between measured and modelled attitude, deg; None but for q."""
        if self.turn_deg is None:
            return None
        return float(np.sqrt(np.mean(np.sum(self.turn_deg**2, axis=1))))

    def as_json(self, name: str) -> dict[str, Any]:
        """Return the numbers, not the single errors, as JSON values."""
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
    """One-step errors of all channels that the log has and the model can be judged on."""

    num_steps: int
    channels: dict[str, ChannelError]

    def as_json(self) -> dict[str, Any]:
        """Return the numbers as JSON values."""
        channels = {name: error.as_json(name) for name, error in self.channels.items()}
        return {"steps": self.num_steps, "channels": channels}


def predicted_channel(name: str, prediction: Prediction, model: ModelParameters) -> np.ndarray:
    """Return what the model predicts of a channel after every row's step, (num_rows, size)."""
    after = prediction.after
    if name == "f":
        return to_body(prediction.before, specific_force_w(columns(after.acc_w), model))
    of = {"p": after.pos_w, "v": after.vel_w, "q": after.quat, "w": after.rates_b, "a": after.acc_w}
    return columns(of[name])


def error_of(name: str, before: np.ndarray, measured: np.ndarray, predicted: np.ndarray) -> ChannelError:
    """Return a channel's errors; all (num_steps, size)."""
    turn_deg = None
    if name == "q":

        def nearer(quats: np.ndarray) -> np.ndarray:
            return np.where(np.sum(quats * measured, axis=1, keepdims=True) < 0.0, -quats, quats)

        before, predicted = nearer(before), nearer(predicted)
        turn_deg = np.rad2deg(turn_between(predicted, measured))
    errors = measured - predicted
    by_change = NORMALISED_BY[name] == BY_CHANGE
    scale = np.mean((measured - before) ** 2) if by_change else np.mean(np.var(measured, axis=0))
    mse = float(np.mean(errors**2))
    return ChannelError(
        errors=errors,
        mse=mse,
        mse_by_axis=tuple(np.mean(errors**2, axis=0).tolist()),
        nrmse=float(np.sqrt(mse / scale)) if scale > 0.0 else None,
        turn_deg=turn_deg,
    )


def one_step_errors(
    model: ModelParameters, log: FlightLog, prediction: Prediction, rows: np.ndarray
) -> OneStep:
    """Return the errors from each judged row to the next; rows: (num_rows,) bool, those judged.

    Of acceleration and specific force, the first that the log has.
    """
    lacking = inputs_that_lack(model, log)
    force = next((name for name in ("a", "f") if name in log and not lacking[name]), None)
    names = [name for name in ("p", "v", "q", "w") if name in log and not lacking[name]]
    names += [force] if force else []
    here = judged_steps(rows, prediction)
    if not len(here):
        return OneStep(0, {})
    channels = {
        name: error_of(
            name, log[name][here], log[name][here + 1], predicted_channel(name, prediction, model)[here]
        )
        for name in names
    }
    return OneStep(len(here), channels)
