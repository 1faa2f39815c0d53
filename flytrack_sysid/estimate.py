"""Least squares over all channels of a log, each weighted by the noise estimated from the log.

A fit replays a log and searches as the diagnosis does. Unlike the diagnosis, it weights each
component by one noise, so that the errors of a model do not enter the weights, and it sums steps up
in short windows, so that positions count without velocities.

========  ==============================================================================  =======
channel   residual                                                                        unit
========  ==============================================================================  =======
``w``     body rates, against the lag driven by the commands                              rad/s
``f``     specific force, body (from ``a`` where the log has no accelerometer)            m/s^2
``v``     velocity, against the integrated acceleration, centred in windows               m/s
``p``     position, likewise without offset and slope; only where the log lacks ``v``     m
``q``     attitude, against the integrated rates, as a world-frame rotation, centred      rad
``v_bat`` battery voltage, against its drain, centred                                     V
========  ==============================================================================  =======

Centring removes the value at the start of a window, which is measured with noise like all others.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.inference import parameters
from flytrack_sysid.inference.chunks import AXES, DIRECT, Chunks, count_lead_in, make_chunks
from flytrack_sysid.inference.problem import Problem, robust_weight
from flytrack_sysid.inference.record import is_applied_certain, make_record
from flytrack_sysid.inference.score_test import Linearization, solve
from flytrack_sysid.inference.search import refine
from flytrack_sysid.log import FlightLog

TURNS, FORCES, BATTERY = AXES
# Noise that the first round assumes, (NUM_AXES, 2), in the channels' units: that of common sensors.
FIRST_NOISE = np.array([[0.1, 0.01]] * 3 + [[1.5, 0.05]] * 3 + [[1.0, 0.02]])
MIN_NOISE = 1e-12
LAST_STEPS = (
    0,
    0,
    3,
)  # full Gauss-Newton steps at the end of each round: only the last round has to be exact
Report = Callable[[int, int], None]
LAST_RISE = 1e-10  # relative rise of the cost in such a step that may be rounding


class FitError(ValueError):
    """Data that do not determine the model, or that no model of this structure fits."""


class Estimate(NamedTuple):
    """The result of a fit, in float64.

    Attributes:
        model: the model with the estimated parameters.
        free: names of the estimated parameters.
        covariance: covariance of the estimated parameters.
        noise: RMS residuals by channel, per component.
        count: number of residuals.
    """

    model: ModelParameters
    free: tuple[str, ...]
    covariance: np.ndarray
    noise: dict[str, np.ndarray]
    count: int  # type: ignore[assignment]  # hides tuple.count


def _in_line(values: np.ndarray) -> np.ndarray:
    """Reshape (rows, chunks, ...) without lead-ins to (all rows, ...), in the order of time."""
    without_lead_in = np.swapaxes(values[count_lead_in(len(values)) :], 0, 1)
    return without_lead_in.reshape(-1, *without_lead_in.shape[2:])


class Windows(NamedTuple):
    """The windows of a level.

    Attributes:
        starts: indices into all rows where windows begin.
        counts: which values count, (all rows, axes).
    """

    starts: np.ndarray
    counts: np.ndarray

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Return, for every row, the sum of values, (all rows, axes), over its window."""
        lengths = np.diff(np.append(self.starts, len(values)))
        return np.repeat(np.add.reduceat(values, self.starts, axis=0), lengths, axis=0)

    def centred(self, values: np.ndarray) -> np.ndarray:
        """Return values less their mean over the rows of the window that count."""
        return values - self.sums(values * self.counts) / np.maximum(self.sums(self.counts), 1.0)

    def without_slope(self, values: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Return values less their regression on time, (all rows, 1), over the rows that count."""
        values, time = self.centred(values), self.centred(time)
        spread = self.sums(time * time * self.counts)
        return (
            values
            - self.sums(time * values * self.counts) / np.where(spread > 0.0, spread, 1.0) * time
        )

    def num_used(self) -> int:
        """Return the number of windows in which anything counts."""
        return int(np.add.reduceat(self.counts, self.starts).any(axis=1).sum())


@dataclass(frozen=True, eq=False)
class Channels(Problem):
    """A log and the residuals of its channels, in the axes and windows of this module's table.

    The noise of this problem is a standard deviation for each component, (NUM_AXES, 2).

    Attributes:
        levels: the windows of turns, forces and battery.
        has_position: whether the level of forces is the position instead of the velocity.
    """

    levels: tuple[Windows, ...] = ()
    has_position: bool = False

    @classmethod
    def of_log(cls, log: FlightLog, scored_rows: np.ndarray, model: ModelParameters) -> "Channels":
        """Build the problem of the scored rows of a log, (num_rows,) bool, for a model."""
        tau, has_position = (
            np.asarray(model.tau, float),
            "p" in log and "q" in log and "v" not in log,
        )
        chunks = make_chunks(log, np.ones(len(log), bool), tau, float(model.g))
        certain = is_applied_certain(make_record(log), tau)[chunks.row]
        chunks = chunks._replace(counts=_counts(chunks, scored_rows, certain, has_position))
        return replace(cls.of(chunks, model, ()), levels=_levels(chunks), has_position=has_position)

    def residuals(self, vectors: np.ndarray) -> np.ndarray:
        """Return residuals, (num_models, rows, chunks, NUM_AXES, 2); 0 where nothing counts."""
        all_residuals = super().residuals(vectors)
        for model_residuals in all_residuals:
            in_line = self._of_channels(_in_line(model_residuals))
            model_residuals[count_lead_in(len(model_residuals)) :] = in_line.reshape(
                model_residuals.shape[1], -1, *model_residuals.shape[2:]
            ).swapaxes(0, 1)
        return all_residuals * self.counts

    def _of_channels(self, residuals: np.ndarray) -> np.ndarray:
        """Return the channels' residuals from those of single steps, (all rows, NUM_AXES, 2)."""
        before = Rotation.from_quat(
            _in_line(np.roll(self.chunks.record.quat, 1, axis=0)), scalar_first=True
        )
        result, turn = residuals.copy(), residuals[:, TURNS, 1]
        for axes in (TURNS, FORCES):
            result[:, axes, 0] = before.apply(residuals[:, axes, 0], inverse=True)
        # Turns are composed to second order: to first order, attitude noise would not cancel.
        turned = self.levels[0].centred(np.cumsum(turn, axis=0)) - turn
        result[:, TURNS, 1] += 0.5 * np.cross(turn, turned)
        level = np.cumsum(result[..., 1], axis=0)
        for axes, windows in zip(AXES, self.levels, strict=True):
            result[:, axes, 1] = windows.centred(level[:, axes])
        if self.has_position:
            result[:, FORCES, 1] = self._of_positions(residuals[:, FORCES, 1])
        return result

    def _of_positions(self, residuals: np.ndarray) -> np.ndarray:
        """Return residuals of positions from those of changes of velocity, (all rows, 3) m/s."""
        record = self.chunks.record
        step_s = _in_line(np.roll(record.step_s, 1, axis=0))[:, None]  # of the step to the row
        change = _in_line(np.diff(record.vel_w, axis=0, prepend=record.vel_w[:1])) - residuals
        displacement = (np.cumsum(change, axis=0) - 0.5 * change) * step_s
        offsets = _in_line(record.pos_w) - np.cumsum(displacement, axis=0)
        return self.levels[1].without_slope(offsets, np.cumsum(step_s, axis=0))

    def whiten(self, residuals: np.ndarray, axes: slice = slice(None)) -> np.ndarray:
        """Return residuals over their noise."""
        return residuals / self.noise[axes]

    def spread(self, vector: np.ndarray) -> np.ndarray:
        """Return the RMS residuals of a model, (NUM_AXES, 2).

        The means and slopes that are removed from windows count as fitted parameters.
        """
        counts = self.counts.sum(axis=(0, 1))
        for axes, windows in zip(AXES, self.levels, strict=True):
            counts[axes, 1] -= windows.num_used() * (
                2 if self.has_position and axes is FORCES else 1
            )
        squares = np.square(self.residuals(vector[None])[0]).sum(axis=(0, 1))
        return np.maximum(np.sqrt(squares / np.maximum(counts, 1)), MIN_NOISE)

    def by_channel(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Return values, (NUM_AXES, 2), by the names of the channels that count."""
        level = ("q", "p" if self.has_position else "v", "v_bat")
        sides = (
            (name, values[axes], self.counts[..., axes, :], side)
            for side, names in enumerate((DIRECT, level))
            for name, axes in zip(names, AXES, strict=True)
        )
        return {
            name: channel_values[:, side]
            for name, channel_values, counts, side in sides
            if name and counts[..., side].any()
        }


def _counts(
    chunks: Chunks, scored_rows: np.ndarray, certain: np.ndarray, has_position: bool
) -> np.ndarray:
    """Return which residuals of scored rows count, (rows, chunks, NUM_AXES, 2) bool.

    Args:
        chunks: the log in chunks.
        scored_rows: (num_rows,) bool.
        certain: where applied actions are known, (rows, chunks, 4) bool.
        has_position: whether the level of forces is the position.
    """
    source = chunks.record.source_row
    is_scored = scored_rows[source] & (source >= 0) & (chunks.row >= 0)
    is_scored[: count_lead_in(len(is_scored))] = False
    behind = scored_rows[
        np.maximum.accumulate(source, axis=0)
    ]  # for a filled row, that of the row before the gap
    counts = chunks.counts & is_scored[..., None, None]
    counts[1:, :, FORCES, 0] &= behind[
        :-1, :, None
    ]  # a force belongs to a step that starts from measured values
    if "w" in chunks.measured:
        counts[..., TURNS, 0] = certain[..., :3] & (is_scored & chunks.is_joined)[..., None]
    if has_position:
        counts[..., FORCES, 1] = certain[..., 3:] & is_scored[..., None]
    return counts


def _levels(chunks: Chunks) -> tuple[Windows, ...]:
    """Return the windows of levels.

    Windows of the voltage are flights. Other windows are pieces of a flight, cut where unknown
    commands become known again.
    """
    joined, counts = _in_line(chunks.is_joined), _in_line(chunks.counts[..., 1]).astype(float)
    is_cut = np.diff(_in_line(chunks.record.piece), prepend=-1) != 0
    result = []
    for axes in AXES:
        known = _in_line(chunks.is_known[..., axes.start]) | ~joined
        is_back = known & ~np.append(True, known[:-1])
        is_new = ~joined if axes is BATTERY else ~joined | is_cut | is_back
        result.append(Windows(np.flatnonzero(is_new), counts[:, axes]))
    return tuple(result)


def _covariance(linearization: Linearization) -> np.ndarray:
    """Return the parameters' covariance, widened where residuals within a flight are correlated.

    The covariance is that of independent residuals with the assumed noise. Each standard deviation
    is raised to that of the cluster-robust (sandwich) estimate over pieces of a flight, if that is
    larger, since errors of the model make residuals correlated within a piece.
    """
    problem, white = linearization.problem, linearization.white * robust_weight(linearization.white)
    bread = solve(linearization.total, np.eye(len(linearization.total)))
    is_used = problem.counts.any(axis=(2, 3))
    columns = problem.whiten(linearization.slopes.columns)
    scores = np.einsum("prlak,rlak->rlp", columns, white, optimize=True)[is_used]
    pieces, piece = np.unique(problem.chunks.record.piece[is_used], return_inverse=True)
    by_piece = np.zeros((len(pieces), len(bread)))
    np.add.at(by_piece, piece, scores)
    robust = bread @ (by_piece.T @ by_piece) @ bread * (len(pieces) / max(len(pieces) - 1, 1))
    inflation = np.sqrt(np.maximum(np.diag(robust) / np.diag(bread), 1.0))
    return bread * np.outer(inflation, inflation)


def _acting(linearization: Linearization, free: tuple[str, ...], may_be_idle: bool) -> list[int]:
    """Return the indices of parameters that residuals depend on; others mislead a search.

    Wind, for example, acts only if there is some drag.

    Args:
        linearization: residuals and slopes at the current vector.
        free: names of the parameters to estimate.
        may_be_idle: whether residuals may be independent of a parameter, as in the first round.

    Raises:
        FitError: residuals are not finite, or are independent of a parameter.
    """
    if not np.isfinite(linearization.columns).all() or not np.isfinite(linearization.cost):
        raise FitError("the fit diverged: residuals are not finite")
    acts = np.flatnonzero(np.abs(linearization.columns).max(axis=(0, 1, 3), initial=0.0))
    names = [linearization.problem.names[linearization.indices[column]] for column in acts]
    idle = [name for name in free if name not in names]
    if idle and not may_be_idle:
        raise FitError(
            f"{', '.join(idle)}: nothing that the log measured depends on it; expected it fixed"
        )
    return linearization.problem.parameter_indices(names)


def _polished(
    problem: Problem, vector: np.ndarray, indices: list[int], steps: int
) -> Linearization:
    """Take up to ``steps`` full Gauss-Newton steps, so that the slope of the cost is rounding.

    The cost is flat at its minimum. A search that compares costs therefore ends where the order of
    summation decides, so that another number of threads gives another model.
    """
    current = Linearization(problem, problem.slopes(vector, indices))
    for _ in range(steps):
        trial_vector = current.vector.copy()
        trial_vector[indices] += current.step_inside()
        trial_vector = problem.clipped(trial_vector)
        trial = Linearization(problem, problem.slopes(trial_vector, indices))
        if not trial.cost <= current.cost * (1.0 + LAST_RISE):
            break
        current = trial
    return current


def estimate(
    log: FlightLog,
    scored_rows: np.ndarray,
    start: ModelParameters,
    free: tuple[str, ...],
    report: Report = lambda done, rounds: None,
) -> Estimate:
    """Return the least squares estimate of a model's free parameters from the scored rows of a log.

    The weights, and the rows that lost commands spoil, follow from the estimate of the previous
    round.

    Raises:
        FitError: the search diverged, or no residual depends on a parameter.
    """
    with threadpool_limits(1, "blas"), jax.enable_x64(True):
        model = parameters.in_float64(start)
        noise = FIRST_NOISE
        for round_index, steps in enumerate(LAST_STEPS):
            problem = replace(Channels.of_log(log, scored_rows, model), noise=noise)
            vector = problem.clipped(problem.start)
            free_indices = problem.parameter_indices(
                [name for name in free if name in problem.names]
            )
            initial = Linearization(problem, problem.slopes(vector, free_indices))
            indices = _acting(initial, free, may_be_idle=round_index == 0)
            vector, _ = refine(problem, vector, indices, initial)
            polished = _polished(problem, vector, indices, steps)
            noise = problem.spread(polished.vector)
            names = tuple(problem.names[index] for index in indices)
            model = parameters.with_values(
                model, dict(zip(names, polished.vector[indices], strict=True))
            )
            report(round_index + 1, len(LAST_STEPS))
    count = int(problem.counts.sum())
    return Estimate(model, names, _covariance(polished), problem.by_channel(noise), count)
