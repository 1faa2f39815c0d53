"""Least squares over all channels of a log, each weighted by the noise that it turns out to have.

A fit replays a log and searches as the diagnosis does, but weights each component by one noise, and
sums steps up in short windows: so positions count without velocities, and what a model lacks has no
part in the weights.

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

Centring takes out what a window began with, which is measured with noise like the rest.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid import parameters
from flytrack_sysid.diagnosis.chunks import AXES, DIRECT, Chunks, lead_in_of, make_chunks
from flytrack_sysid.diagnosis.problem import Problem, robust_weight
from flytrack_sysid.diagnosis.score_test import Linearization, solve
from flytrack_sysid.diagnosis.search import refine
from flytrack_sysid.log import FlightLog
from flytrack_sysid.record import is_applied_certain, make_record

TURNS, FORCES, BATTERY = AXES
# Noise that the first round assumes, (NUM_AXES, 2), in the channels' units: that of common sensors.
FIRST_NOISE = np.array([[0.1, 0.01]] * 3 + [[1.5, 0.05]] * 3 + [[1.0, 0.02]])
MIN_NOISE = 1e-12
LAST_STEPS = (
    0,
    0,
    3,
)  # full Gauss-Newton steps at the end of each round: only the last is to be exact
LAST_RISE = 1e-10  # of the cost, which rounding may add to such a step


class FitError(ValueError):
    """Data that do not determine the model, or that no model of this structure fits."""


class Estimate(NamedTuple):
    """What a fit found, in float64.

    model: with the estimate in it. free: names of what was estimated. covariance: of the free
    parameters. noise: rms left of each channel, per component. count: numbers that were explained.
    """

    model: ModelParameters
    free: tuple[str, ...]
    covariance: np.ndarray
    noise: dict[str, np.ndarray]
    count: int  # type: ignore[assignment]  # hides tuple.count


def _in_line(values: np.ndarray) -> np.ndarray:
    """Return (rows, chunks, ...) without lead-ins as (all rows, ...), in the order of time."""
    own = np.swapaxes(values[lead_in_of(len(values)) :], 0, 1)
    return own.reshape(-1, *own.shape[2:])


class Windows(NamedTuple):
    """The windows of a level.

    starts: the rows in line where windows begin. counts: what counts, (all rows, axes).
    """

    starts: np.ndarray
    counts: np.ndarray

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Return, at every row, the sum of (all rows, axes) over its window."""
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

    noise: (NUM_AXES, 2), a standard deviation each. levels: the windows of turns, forces and
    battery. has_position: of forces, the level is position and not velocity.
    """

    levels: tuple[Windows, ...] = ()
    has_position: bool = False

    @classmethod
    def of_log(cls, log: FlightLog, scored_rows: np.ndarray, model: ModelParameters) -> "Channels":
        """Return the judged rows of a log, (num_rows,) bool, for a model and its effects."""
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
        found = super().residuals(vectors)
        for left in found:
            in_line = self._of_channels(_in_line(left))
            left[lead_in_of(len(left)) :] = in_line.reshape(
                left.shape[1], -1, *left.shape[2:]
            ).swapaxes(0, 1)
        return found * self.counts

    def _of_channels(self, left: np.ndarray) -> np.ndarray:
        """Return the channels' residuals from those of single steps, (all rows, NUM_AXES, 2)."""
        before = Rotation.from_quat(
            _in_line(np.roll(self.chunks.record.quat, 1, axis=0)), scalar_first=True
        )
        found, turn = left.copy(), left[:, TURNS, 1]
        for axes in (TURNS, FORCES):
            found[:, axes, 0] = before.apply(left[:, axes, 0], inverse=True)
        # One turn after the other, to second order: to first, attitude noise would not cancel.
        turned = self.levels[0].centred(np.cumsum(turn, axis=0)) - turn
        found[:, TURNS, 1] += 0.5 * np.cross(turn, turned)
        level = np.cumsum(found[..., 1], axis=0)
        for axes, windows in zip(AXES, self.levels, strict=True):
            found[:, axes, 1] = windows.centred(level[:, axes])
        if self.has_position:
            found[:, FORCES, 1] = self._of_positions(left[:, FORCES, 1])
        return found

    def _of_positions(self, left: np.ndarray) -> np.ndarray:
        """Return residuals of positions from those of changes of velocity, (all rows, 3) m/s."""
        record = self.chunks.record
        step_s = _in_line(np.roll(record.step_s, 1, axis=0))[:, None]  # of the step to the row
        change = _in_line(np.diff(record.vel_w, axis=0, prepend=record.vel_w[:1])) - left
        moved = (np.cumsum(change, axis=0) - 0.5 * change) * step_s
        off = _in_line(record.pos_w) - np.cumsum(moved, axis=0)
        return self.levels[1].without_slope(off, np.cumsum(step_s, axis=0))

    def whiten(self, left: np.ndarray, axes: slice = slice(None)) -> np.ndarray:
        """Return residuals over their noise."""
        return left / self.noise[axes]

    def spread(self, vector: np.ndarray) -> np.ndarray:
        """Return the rms residuals of a model, (NUM_AXES, 2).

        The means and slopes taken out of windows count as fitted.
        """
        number = self.counts.sum(axis=(0, 1))
        for axes, windows in zip(AXES, self.levels, strict=True):
            number[axes, 1] -= windows.num_used() * (
                2 if self.has_position and axes is FORCES else 1
            )
        squares = np.square(self.residuals(vector[None])[0]).sum(axis=(0, 1))
        return np.maximum(np.sqrt(squares / np.maximum(number, 1)), MIN_NOISE)

    def by_channel(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Return (NUM_AXES, 2) by the names of the channels that count."""
        level = ("q", "p" if self.has_position else "v", "v_bat")
        sides = (
            (name, values[axes], self.counts[..., axes, :], side)
            for side, names in enumerate((DIRECT, level))
            for name, axes in zip(names, AXES, strict=True)
        )
        return {
            name: own[:, side]
            for name, own, counts, side in sides
            if name and counts[..., side].any()
        }


def _counts(
    chunks: Chunks, scored_rows: np.ndarray, certain: np.ndarray, has_position: bool
) -> np.ndarray:
    """Return what counts of judged rows.

    certain: where applied actions are known, (rows, chunks, 4).
    """
    source = chunks.record.source_row
    is_scored = scored_rows[source] & (source >= 0) & (chunks.row >= 0)
    is_scored[: lead_in_of(len(is_scored))] = False
    behind = scored_rows[
        np.maximum.accumulate(source, axis=0)
    ]  # of a filled row, the one before the gap
    counts = chunks.counts & is_scored[..., None, None]
    counts[1:, :, FORCES, 0] &= behind[
        :-1, :, None
    ]  # a force is that of a step from measured values
    if "w" in chunks.measured:
        counts[..., TURNS, 0] = certain[..., :3] & (is_scored & chunks.is_joined)[..., None]
    if has_position:
        counts[..., FORCES, 1] = certain[..., 3:] & is_scored[..., None]
    return counts


def _levels(chunks: Chunks) -> tuple[Windows, ...]:
    """Return the windows of levels.

    Those of voltage are flights; others are pieces, cut where doubt of commands ends.
    """
    joined, counts = _in_line(chunks.is_joined), _in_line(chunks.counts[..., 1]).astype(float)
    is_cut = np.diff(_in_line(chunks.record.piece), prepend=-1) != 0
    found = []
    for axes in AXES:
        known = _in_line(chunks.is_known[..., axes.start]) | ~joined
        is_back = known & ~np.append(True, known[:-1])
        is_new = ~joined if axes is BATTERY else ~joined | is_cut | is_back
        found.append(Windows(np.flatnonzero(is_new), counts[:, axes]))
    return tuple(found)


def _covariance(found: Linearization) -> np.ndarray:
    """Return the parameters' covariance, widened where residuals within a flight are correlated.

    That of independent residuals of the noise assumed, in which each standard deviation is raised
    to that of the cluster-robust (sandwich) estimate over pieces of a flight, if that is larger:
    what the model lacks shows as residuals that agree within a piece.
    """
    problem, white = found.problem, found.white * robust_weight(found.white)
    bread = solve(found.total, np.eye(len(found.total)))
    used = problem.counts.any(axis=(2, 3))
    columns = problem.whiten(found.slopes.columns)
    pulls = np.einsum("prlak,rlak->rlp", columns, white, optimize=True)[used]
    pieces, piece = np.unique(problem.chunks.record.piece[used], return_inverse=True)
    by_piece = np.zeros((len(pieces), len(bread)))
    np.add.at(by_piece, piece, pulls)
    robust = bread @ (by_piece.T @ by_piece) @ bread * (len(pieces) / max(len(pieces) - 1, 1))
    widen = np.sqrt(np.maximum(np.diag(robust) / np.diag(bread), 1.0))
    return bread * np.outer(widen, widen)


def _acting(found: Linearization, free: tuple[str, ...], may_be_idle: bool) -> list[int]:
    """Return the indices of parameters that residuals depend on; others mislead a search.

    Wind, say, acts only once there is some drag; what is idle after the first round too is refused.
    """
    if not np.isfinite(found.columns).all() or not np.isfinite(found.cost):
        raise FitError("the fit diverged: residuals are not finite")
    acts = np.flatnonzero(np.abs(found.columns).max(axis=(0, 2), initial=0.0))
    names = [found.problem.names[found.indices[column]] for column in acts]
    idle = [name for name in free if name not in names]
    if idle and not may_be_idle:
        raise FitError(
            f"{', '.join(idle)}: nothing that the log measured depends on it; expected it fixed"
        )
    return found.problem.indices_of(names)


def _polished(
    problem: Problem, vector: np.ndarray, indices: list[int], steps: int
) -> Linearization:
    """Take up to ``steps`` full steps, so that the cost's slope, not only its change, is rounding.

    The cost is flat at its least, so that a search which compares costs ends where the order of
    summation decides: another number of threads, another model.
    """
    found = Linearization(problem, problem.slopes(vector, indices))
    for _ in range(steps):
        moved = found.vector.copy()
        moved[indices] += found.step_inside()
        moved = problem.clipped(moved)
        later = Linearization(problem, problem.slopes(moved, indices))
        if not later.cost <= found.cost * (1.0 + LAST_RISE):
            break
        found = later
    return found


def estimate(
    log: FlightLog,
    scored_rows: np.ndarray,
    start: ModelParameters,
    free: tuple[str, ...],
    report: Callable[[int, int], None] = lambda done, rounds: None,
) -> Estimate:
    """Return the least squares estimate of a model's free parameters from the judged rows of a log.

    Weights and the rows that lost commands spoil follow from the estimate of the round before.

    Raises:
        FitError: a search that diverged, or a parameter on which nothing depends.
    """
    with threadpool_limits(1, "blas"), jax.enable_x64(True):
        model: Any = jax.tree.map(lambda leaf: np.asarray(leaf, float), start)
        noise = FIRST_NOISE
        for number, steps in enumerate(LAST_STEPS):
            problem = replace(Channels.of_log(log, scored_rows, model), noise=noise)
            vector = problem.clipped(problem.start)
            seen = problem.indices_of([name for name in free if name in problem.names])
            near = Linearization(problem, problem.slopes(vector, seen))
            indices = _acting(near, free, may_be_idle=number == 0)
            vector, _ = refine(problem, vector, indices, near)
            found = _polished(problem, vector, indices, steps)
            noise = problem.spread(found.vector)
            names = tuple(problem.names[index] for index in indices)
            model = parameters.with_values(
                model, dict(zip(names, found.vector[indices], strict=True))
            )
            report(number + 1, len(LAST_STEPS))
    count = int(problem.counts.sum())
    return Estimate(model, names, _covariance(found), problem.by_channel(noise), count)
