"""Validation: how well a model predicts a flight log."""

from typing import Any, NamedTuple

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid import prediction_errors
from flytrack_sysid.inference.one_step import Prediction, predict
from flytrack_sysid.inference.record import fill_gaps
from flytrack_sysid.log import FlightLog
from flytrack_sysid.log_motion import check_commands, motion_notes, required_motion
from flytrack_sysid.log_voltage import voltage_notes
from flytrack_sysid.steps import (
    HELD_AFTER_S,
    HELD_BEFORE_S,
    MIN_JUMP,
    StepResponse,
    step_responses,
)

NAMES = {
    "p": "position",
    "v": "velocity",
    "q": "attitude",
    "w": "body rates",
    "a": "acceleration",
    "f": "specific force",
}


class Validation(NamedTuple):
    """Errors of a model on the scored rows of a log.

    Attributes:
        num_rows: number of rows of the log.
        num_judged: number of scored rows.
        one_step: errors of single steps.
        rollouts: errors of free flight, by its length.
        thrust: errors of the thrust; None if the log does not measure it.
        steps: responses to commanded steps.
        notes: sentences on what is not scored and why, and on what is assumed.
    """

    num_rows: int
    num_judged: int
    one_step: prediction_errors.OneStep
    rollouts: tuple[prediction_errors.Rollout, ...]
    thrust: prediction_errors.ThrustError | None
    steps: tuple[StepResponse, ...]
    notes: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the numbers as JSON values in SI units, V and, where the names say so, degrees.

        Channels that are not scored are absent, and the notes name them. Numbers that are not
        finite are null.
        """
        return _json_of(
            {
                "rows": self.num_rows,
                "judged_rows": self.num_judged,
                "one_step": self.one_step.as_json(),
                "rollouts": [rollout.as_json() for rollout in self.rollouts],
                **({} if self.thrust is None else {"thrust": self.thrust}),
                "steps": self.steps,
                "notes": self.notes,
            }
        )


def _json_of(value: Any) -> Any:
    """Return JSON values, with null for non-finite numbers: empty bins, a model that diverged."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, dict):
        return {name: _json_of(item) for name, item in value.items()}
    if isinstance(value, (tuple, list, np.ndarray)):
        return [
            _json_of(item) for item in (value.tolist() if isinstance(value, np.ndarray) else value)
        ]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _notes_of(prediction: Prediction) -> list[str]:
    """Return sentences on what the log lacks, and on what is assumed instead."""
    log, notes = prediction.log, []
    for name, lacking in prediction.lacking.items():
        if name in log and lacking:
            verb = "is" if len(lacking) == 1 else "are"
            notes.append(
                f"{NAMES[name]} ({name}): not judged; {', '.join(lacking)} {verb} not in the log"
            )
        elif name not in log and name not in ("a", "f"):
            notes.append(f"{NAMES[name]} ({name}): not in the log")
    if "a" not in log and "f" not in log:
        notes.append("acceleration (a) and specific force (f): not in the log")
    if "uprev" not in log:
        notes.append(
            "applied action (uprev): not in the log; computed from the commands by the model's own "
            "lags, as if the first command of a segment had been held before"
        )
    if not prediction.is_settled.all():
        count = int(np.sum(~prediction.is_settled))
        notes.append(
            f"{count} rows after a segment's start or lost commands start no judged step or "
            "flight: the applied action, or the memory of the model's effects, is not known there"
        )
    return notes


def validate(model: ModelParameters, log: FlightLog, rows: np.ndarray | None = None) -> Validation:
    """Return the errors of a model on a log, from the measured states under the logged commands.

    A measured log is replayed continuously, whatever the motion of the model, and a note says so.

    Args:
        model: the model to validate.
        log: the flight log.
        rows: rows that are scored (``split.held_out_rows``), (num_rows,) bool; all if None. Other
            rows are used only for the applied action and the memories of effects.

    Raises:
        LogError: the model takes other commands than the log has.
        ValueError: ``rows`` has another shape or type.
    """
    rows = np.ones(len(log), bool) if rows is None else np.asarray(rows)
    if rows.shape != (len(log),) or rows.dtype != bool:
        raise ValueError(
            f"rows: found {rows.dtype} of shape {rows.shape}, expected bool of ({len(log)},)"
        )
    check_commands(log, model)
    num_rows, num_judged = len(log), int(rows.sum())
    contradictions = motion_notes(
        log, model, None, f"replayed as the model says ({model.motion.value})"
    )
    model = model._replace(motion=required_motion(log) or model.motion)
    contradictions += voltage_notes(log, model.battery)
    filled = fill_gaps(log)
    prediction = predict(model, filled)
    rollouts = prediction_errors.rollout_errors(prediction, log, rows)
    rows = rows[filled.behind]
    notes = [*contradictions, *_notes_of(prediction)]
    one_step = prediction_errors.one_step_errors(prediction, rows)
    if not one_step.num_steps:
        notes.append("one step: no judged row is followed by a judged row")
    too_long = [f"{rollout.horizon_s:g} s" for rollout in rollouts if not rollout.num_starts]
    if too_long:
        notes.append(f"free flight of {', '.join(too_long)}: no judged stretch is that long")
    thrust = prediction_errors.thrust_error(prediction, rows)
    if thrust is None:
        notes.append("thrust: no judged step has f or a to compare the model with")
    elif "v_bat" not in log:
        notes.append("thrust by voltage: v_bat is not in the log")
        thrust = None
    steps = () if log.has_motors else step_responses(prediction, rows)
    if not steps and not log.has_motors:
        notes.append(
            f"step responses: no judged command of roll, pitch or yaw jumps by {MIN_JUMP:g} "
            f"between {HELD_BEFORE_S:g} s and {HELD_AFTER_S:g} s of constant command, with body "
            "rates measured"
        )
    return Validation(num_rows, num_judged, one_step, rollouts, thrust, steps, tuple(notes))
