"""Residuals of poses that are late against the gyro.

Position, velocity and attitude are then on another clock than the gyro.

The replay is fed with corrected poses, interpolated at the time of each row. What is judged are the
poses as they were logged: interpolation smooths noise, which would change the likelihood by more
than one motion differs from another. So the modelled changes of a level are delayed as the sensor
delays them, and what interpolation changed is added as a constant:

    residual = change as logged - delay(change as corrected - residual as corrected)

The delay is linear between rows where a simulator moves, as that of the effect ``mocap_latency``
is, and cubic where a drone does.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters
from flytrack_env.motion import Motion
from flytrack_sysid.clocks import read_later
from flytrack_sysid.diagnosis.chunks import NUM_AXES, Chunks
from flytrack_sysid.log import FlightLog
from flytrack_sysid.record import Record, fill_gaps, record_of

POSES = ("p", "v", "q")
TAPS = (1, 0, -1, -2)  # rows of which a delayed value is made, from the row itself
NEAR = 0.25  # of a step: rows so near in time are one
SAME = 1e-6  # of a step


class Late(NamedTuple):
    """How level residuals of corrected chunks become those of what was logged.

    weights: (rows, chunks, taps) of the modelled changes. constant: (rows, chunks, NUM_AXES), rad
    and m/s.
    """

    weights: np.ndarray
    constant: np.ndarray

    def residuals(self, left: np.ndarray) -> np.ndarray:
        """Return the log's residuals from those of corrected chunks.

        left: (models, rows, chunks, NUM_AXES, 2).
        """
        found = left.copy()
        found[..., :-1, 1] = _delayed(left[..., :-1, 1], self.weights, -3) + self.constant[..., :-1]
        return found


def latency_of(model: ModelParameters) -> float:
    """Return how late a model says that poses are, s."""
    return float(model.effect("mocap_latency").latency_s)


def read_poses(log: FlightLog, late_s: float) -> tuple[FlightLog, np.ndarray]:
    """Return a log with late poses moved in time, and where they are known, (num_rows,) bool."""
    if not late_s:
        return log, np.ones(len(log), bool)
    return read_later(log, [name for name in POSES if name in log], late_s)


def _delayed(changes: np.ndarray, weights: np.ndarray, axis: int) -> np.ndarray:
    """Return the sum of changes in nearby rows, (..., axes), with weights (rows, ..., taps)."""
    return sum(
        np.roll(changes, -tap, axis) * weights[..., [place]] for place, tap in enumerate(TAPS)
    )


def _weights(share: np.ndarray, motion: Motion) -> np.ndarray:
    """Return the weights of a delay by shares of a step, (..., taps)."""
    if motion is not Motion.CONTINUOUS:
        zero = np.zeros_like(share)
        return np.stack([zero, 1.0 - share, share, zero], axis=-1)
    ages = [-tap for tap in TAPS]
    shares = ([(share - one) / (age - one) for one in ages if one != age] for age in ages)
    return np.stack([np.prod(one, axis=0) for one in shares], axis=-1)


def _changes(record: Record) -> np.ndarray:
    """Return the turn, rad, and velocity change, m/s, since the row before, (num_rows, 6).

    Both are in the world frame.
    """
    quat = Rotation.from_quat(record.quat, scalar_first=True)
    before = Rotation.from_quat(np.roll(record.quat, 1, axis=0), scalar_first=True)
    faster = record.vel_w - np.roll(record.vel_w, 1, axis=0)
    changes = np.concatenate([(quat * before.inv()).as_rotvec(), faster], axis=1)
    return np.where(record.begins[:, None], 0.0, changes)


def scored_as_logged(
    chunks: Chunks, corrected: FlightLog, logged: FlightLog, late_s: float, motion: Motion
) -> tuple[Chunks, Late]:
    """Return chunks of a corrected log that are judged where poses were logged, and their lateness.

    late_s: of the logged poses; ``corrected`` has them in time and may lack some of the rows.
    """
    seen, moved = fill_gaps(logged), fill_gaps(corrected)
    record, step_s = record_of(moved), float(np.median(np.diff(moved.log.time)))
    far = 2.0 * (np.ptp(logged.time) + late_s + 1.0)  # segments one after the other, well apart
    clock = seen.log.time + far * logged.segment[seen.behind]
    own = moved.log.time + far * corrected.segment[moved.behind]
    place = np.searchsorted(clock, own - NEAR * step_s) + int(np.floor(late_s / step_s + SAME))
    place = np.clip(place, 0, len(clock) - 1)
    run = np.cumsum(seen.log.is_start())
    is_logged = (seen.source_row[place] >= 0) & (np.abs(clock[place] - own - late_s) < 2.0 * step_s)
    is_logged &= run[place] == run[np.searchsorted(clock, own - NEAR * step_s)]
    weights = _weights((own + late_s - clock[place]) / step_s, motion)
    constant = _changes(record_of(seen))[place] - _delayed(_changes(record), weights, 0)
    constant = np.pad(np.where(record.begins[:, None], 0.0, constant), ((0, 0), (0, NUM_AXES - 6)))
    index = np.where(chunks.row < len(own), chunks.row, -1)
    is_inside = index >= 0
    counts = chunks.counts.copy()
    counts[..., :-1, 1] &= (is_logged[index] & is_inside)[..., None]
    late = Late(weights[index], np.where(is_inside[..., None], constant[index], 0.0))
    return chunks._replace(counts=counts), late
