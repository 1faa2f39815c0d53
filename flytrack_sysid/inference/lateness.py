"""Residuals of poses that are late against the gyro.

Position, velocity and attitude are then on another clock than the gyro.

The replay is fed with corrected poses, interpolated at the time of each row. The scored residuals
are those of the poses as logged: interpolation smooths noise, which would change the likelihood by
more than one motion differs from another. So the modelled changes of a level are delayed as the
sensor delays them, and the change due to interpolation is added as a constant:

    residual = change as logged - delay(change as corrected - residual as corrected)

The delay interpolates linearly between rows for a simulator's motion, as the effect
``mocap_latency`` does, and cubically for a drone's.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters
from flytrack_env.motion import Motion
from flytrack_sysid.clocks import read_later
from flytrack_sysid.inference.chunks import NUM_AXES, Chunks
from flytrack_sysid.inference.record import Record, build_record, fill_gaps
from flytrack_sysid.log import FlightLog

POSES = ("p", "v", "q")
TAPS = (1, 0, -1, -2)  # rows that make up a delayed value, relative to its own row
NEAR = 0.25  # of a step: rows this close in time are the same row
SAME = 1e-6  # of a step


class Late(NamedTuple):
    """Map from level residuals of corrected chunks to those of the poses as logged.

    Attributes:
        weights: of the modelled changes, (rows, chunks, taps).
        constant: added to the residuals (rad and m/s), (rows, chunks, NUM_AXES).
    """

    weights: np.ndarray
    constant: np.ndarray

    def residuals(self, corrected: np.ndarray) -> np.ndarray:
        """Return the residuals of poses as logged.

        Args:
            corrected: the residuals of corrected chunks, (models, rows, chunks, NUM_AXES, 2).
        """
        result = corrected.copy()
        with np.errstate(invalid="ignore"):  # of a diverged trial: infinite ones become NaN
            result[..., :-1, 1] = (
                _delayed(corrected[..., :-1, 1], self.weights, -3) + self.constant[..., :-1]
            )
        return result


def get_latency(model: ModelParameters) -> float:
    """Return the lateness of poses in a model (s)."""
    return float(model.effect("mocap_latency").latency_s)


def read_poses(log: FlightLog, late_s: float) -> tuple[FlightLog, np.ndarray]:
    """Return a log with late poses corrected, and where they are known, (num_rows,) bool."""
    if not late_s:
        return log, np.ones(len(log), bool)
    return read_later(log, [name for name in POSES if name in log], late_s)


def _delayed(changes: np.ndarray, weights: np.ndarray, axis: int) -> np.ndarray:
    """Return the sum of changes (..., axes) in nearby rows, with weights (rows, ..., taps)."""
    return sum(
        np.roll(changes, -tap, axis) * weights[..., [index]] for index, tap in enumerate(TAPS)
    )


def _weights(share: np.ndarray, motion: Motion) -> np.ndarray:
    """Return the weights (..., taps) of a delay by shares of a step."""
    if motion is not Motion.CONTINUOUS:
        zero = np.zeros_like(share)
        return np.stack([zero, 1.0 - share, share, zero], axis=-1)
    ages = [-tap for tap in TAPS]
    shares = ([(share - one) / (age - one) for one in ages if one != age] for age in ages)
    return np.stack([np.prod(one, axis=0) for one in shares], axis=-1)


def _changes(record: Record) -> np.ndarray:
    """Return the turn (rad) and velocity change (m/s) since the row before, (num_rows, 6).

    Both are in the world frame.
    """
    quat = Rotation.from_quat(record.quat, scalar_first=True)
    before = Rotation.from_quat(np.roll(record.quat, 1, axis=0), scalar_first=True)
    velocity_change = record.vel_w - np.roll(record.vel_w, 1, axis=0)
    changes = np.concatenate([(quat * before.inv()).as_rotvec(), velocity_change], axis=1)
    return np.where(record.begins[:, None], 0.0, changes)


def scored_as_logged(
    chunks: Chunks, corrected: FlightLog, logged: FlightLog, late_s: float, motion: Motion
) -> tuple[Chunks, Late]:
    """Return chunks of a corrected log that are scored where poses were logged, and their lateness.

    Args:
        chunks: of the corrected log.
        corrected: the log with poses in time; it may lack some of the rows.
        logged: the log with late poses.
        late_s: lateness of the logged poses.
        motion: of the log.
    """
    filled, moved = fill_gaps(logged), fill_gaps(corrected)
    record, step_s = build_record(moved), float(np.median(np.diff(moved.log.time)))
    gap_s = 2.0 * (np.ptp(logged.time) + late_s + 1.0)  # segments one after the other, well apart
    logged_s = filled.log.time + gap_s * logged.segment[filled.behind]
    corrected_s = moved.log.time + gap_s * corrected.segment[moved.behind]
    last = len(logged_s) - 1
    same = np.minimum(np.searchsorted(logged_s, corrected_s - NEAR * step_s), last)
    nearest = np.clip(same + int(np.floor(late_s / step_s + SAME)), 0, last)
    run = np.cumsum(filled.log.is_start())
    is_logged = (filled.source_row[nearest] >= 0) & (
        np.abs(logged_s[nearest] - corrected_s - late_s) < 2.0 * step_s
    )
    is_logged &= run[nearest] == run[same]
    weights = _weights((corrected_s + late_s - logged_s[nearest]) / step_s, motion)
    constant = _changes(build_record(filled))[nearest] - _delayed(_changes(record), weights, 0)
    constant = np.pad(np.where(record.begins[:, None], 0.0, constant), ((0, 0), (0, NUM_AXES - 6)))
    index = np.where(chunks.row < len(corrected_s), chunks.row, -1)
    is_inside = index >= 0
    counts = chunks.counts.copy()
    counts[..., :-1, 1] &= (is_logged[index] & is_inside)[..., None]
    late = Late(weights[index], np.where(is_inside[..., None], constant[index], 0.0))
    return chunks._replace(counts=counts), late
