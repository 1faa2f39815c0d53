"""Errors of free flights on windows of a log, beside those of a placebo without the commands.

Free flights of 0.1 to 2 s start from measured states (multiple shooting). A placebo predicts from
the state at the start alone. Where it predicts as well as the models, the flights contain no
evidence about the response to the commands.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.inference.free_flight import (
    HORIZONS_S,
    QUANTITIES,
    UNITS,
    WINDOWS_PER_BATCH,
    Windows,
    cut_batches,
    make_windows,
    prediction_errors,
)
from flytrack_sysid.inference.parameters import from_vector, in_batches
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.trace_cache import keep_trace
from flytrack_sysid.log import FlightLog

BATCH = 8  # models that are evaluated at once
SPACING_S, SHORT_SPACING_S = 0.25, 0.05  # between starts of windows, of a usual and a short log
# Limits for the fit and for the held-out score. Windows overlap, so that fewer windows contain
# nearly as much information, and a fit replays them often.
MAX_FITTED_WINDOWS, MAX_SCORED_WINDOWS = WINDOWS_PER_BATCH, 3 * WINDOWS_PER_BATCH
MIN_WINDOWS, MIN_BLOCKS = 12, 3  # a cell with fewer is not scored
RIDGE = 0.05  # penalty of the placebo, in units of its regressors' variance
LIKELY = 1.0  # standard errors over blocks
SURE_OF_COMMANDS = 1.64  # of the better of the models over the placebo, one-sided 95 %
# A horizon is worse if the ratio of its error to the base's is above LIKELY_WORSE, and if it is
# worse by LIKELY standard errors over blocks where the commands matter, or by WORSE_ANYWHERE where
# they do not and only chance changes the error. A ratio that rounds to 1.00 counts as equal.
LIKELY_WORSE, WORSE_ANYWHERE = 1.005, 2.0
# Standard errors by which a horizon has to be worse before a model is doubted whose one-step
# residuals are noise: among twenty cells, one is always worse by one standard error.
SURELY_WORSE = 3.0


class FlightErrors(NamedTuple):
    """Errors on windows, measured minus predicted: (models, horizons, windows, quantities, 3)."""

    errors: np.ndarray
    windows: Windows

    @property
    def squares(self) -> np.ndarray:
        """Squared size of the errors, (models, horizons, windows, quantities)."""
        return np.square(self.errors).sum(axis=-1)

    def rms(self) -> np.ndarray:
        """Return the RMS of the errors, (models, horizons, quantities); NaN without windows."""
        counts = self.windows.counts.sum(axis=1)
        mean = self.squares.sum(axis=2) / np.maximum(counts, 1)
        return np.where(counts > 0, np.sqrt(mean), np.nan)

    def by_block(self, scale: np.ndarray) -> np.ndarray:
        """Return the contribution of each block to the relative mean squares.

        Args:
            scale: errors that they are relative to, (horizons, quantities).

        Returns:
            Contributions, (models, blocks, horizons, quantities).
        """
        counts = np.maximum(self.windows.counts.sum(axis=1), 1)
        relative = self.squares / (np.square(scale) * counts)[:, None]
        return self.windows.sums_by_block(np.moveaxis(relative, 2, 0)).swapaxes(0, 1)

    @property
    def scale(self) -> np.ndarray:
        """RMS errors of the first model as a divisor, (horizons, quantities); 1 without windows."""
        return np.maximum(np.nan_to_num(self.rms()[0], nan=1.0), 1e-9)

    def against(self, base: "FlightErrors") -> tuple[np.ndarray, np.ndarray]:
        """Compare the errors of the first model with those of a base model.

        Returns:
            Ratio of the RMS errors to the base's, and the increase of the mean squares in standard
            errors; both (horizons, quantities).
        """
        increase = self.by_block(base.scale)[0] - base.by_block(base.scale)[0]
        return self.rms()[0] / base.scale, sureness(increase)


def sureness(differences: np.ndarray) -> np.ndarray:
    """Return the sum of differences by block, (blocks, ...), in standard errors of that sum."""
    num_blocks = max(len(differences), 2)
    centred = differences - differences.mean(axis=0)
    spread = np.sqrt(np.square(centred).sum(axis=0) * num_blocks / (num_blocks - 1))
    return differences.sum(axis=0) / np.maximum(spread, 1e-300)


@keep_trace
def _errors(vectors: jax.Array, like: ModelParameters, windows: Windows) -> jax.Array:
    return jax.vmap(lambda vector: prediction_errors(from_vector(vector, like), windows))(vectors)


@dataclass(frozen=True, eq=False)
class Flights:
    """Free flights on windows; a model that is asked for again does not fly again.

    Fits return to vectors: the best of some steps is where the next ones begin, and eliminations
    by two rules begin alike. Of 770 models of a log of Betaflight, 542 were different.
    """

    windows: Windows
    # By what a model has beside its vector: that, and the errors by vector.
    _flown: dict[int, tuple[ModelParameters, dict[bytes, np.ndarray]]] = field(
        default_factory=dict, repr=False
    )

    def errors_at(self, problem: Problem, vectors: np.ndarray) -> FlightErrors:
        """Return the errors of models; all numbers of windows share one compiled program.

        Args:
            vectors: parameters of the models, (num_vectors, num_parameters).
        """
        _, known = self._flown.setdefault(id(problem.like), (problem.like, {}))
        new = {vector.tobytes(): vector for vector in vectors if vector.tobytes() not in known}
        if new:
            errors = self._fly(problem.like, np.stack(list(new.values())))
            known.update(zip(new, errors, strict=True))
        return FlightErrors(np.stack([known[vector.tobytes()] for vector in vectors]), self.windows)

    def _fly(self, like: ModelParameters, vectors: np.ndarray) -> np.ndarray:
        """Return errors, (num_vectors, horizons, windows, quantities, 3)."""

        def errors_of_batch(batch_vectors: np.ndarray) -> np.ndarray:
            by_batch = [
                np.asarray(_errors(batch_vectors, like, batch))
                for batch in cut_batches(self.windows)
            ]
            return np.concatenate(by_batch, axis=2)[:, :, : len(self.windows.start)]

        errors = in_batches(errors_of_batch, vectors, BATCH)
        # A model whose prediction diverges gets a large, finite error.
        errors = np.nan_to_num(np.clip(errors, -1e6, 1e6), nan=1e6)
        return errors.reshape(*errors.shape[:-1], len(QUANTITIES), 3)


def _regressors(windows: Windows) -> np.ndarray:
    """Return the placebo's input, (windows, regressors): the state at the start."""
    row, record = windows.first_free - 1, windows.record
    turned = Rotation.from_quat(record.quat[row], scalar_first=True).as_matrix().reshape(-1, 9)
    return np.concatenate(
        [record.vel_w[row], record.pos_w[row], turned, windows.gyro_b[row]], axis=1
    )


def _changes(windows: Windows) -> np.ndarray:
    """Return the change of the state up to each horizon, (horizons, windows, quantities, 3)."""
    row, record = windows.first_free - 1, windows.record
    start = Rotation.from_quat(record.quat[row], scalar_first=True)
    changes = []
    for end in windows.ends:
        turn = start.inv() * Rotation.from_quat(record.quat[end], scalar_first=True)
        levels = (windows.gyro_b, record.vel_w, record.pos_w)
        changes.append(
            np.stack([turn.as_rotvec(), *(level[end] - level[row] for level in levels)], axis=1)
        )
    return np.stack(changes)


def placebo_errors(learnt: Windows, held_out_windows: Windows) -> np.ndarray:
    """Return the errors of ridge regression on the start state, (1, horizons, windows, ...)."""
    regressors, changes = _regressors(learnt), _changes(learnt)
    mean, spread = regressors.mean(axis=0), regressors.std(axis=0) + 1e-9
    rows, held_out_rows = (
        np.c_[(values - mean) / spread, np.ones(len(values))]
        for values in (regressors, _regressors(held_out_windows))
    )
    measured, errors = _changes(held_out_windows), []
    for index in range(len(HORIZONS_S)):
        is_used = learnt.counts[index].any(axis=-1)
        # Without a window of this length, the placebo predicts no change, and nothing is scored.
        damping = RIDGE * max(is_used.sum(), 1) * np.diag([*np.ones(len(mean)), 1e-9])
        target = changes[index].reshape(len(rows), -1)[is_used]
        slopes = np.linalg.solve(
            rows[is_used].T @ rows[is_used] + damping, rows[is_used].T @ target
        )
        predicted = (held_out_rows @ slopes).reshape(len(held_out_rows), len(QUANTITIES), 3)
        residuals = measured[index] - predicted
        turns = (Rotation.from_rotvec(values[:, 0]) for values in (predicted, measured[index]))
        residuals[:, 0] = (next(turns).inv() * next(turns)).as_rotvec()
        errors.append(residuals)
    return np.where(held_out_windows.counts[..., None], np.stack(errors), 0.0)[None]


class FlightTest(NamedTuple):
    """Held-out windows, and the errors of the refitted base and of the placebo on them.

    Attributes:
        problem: the parameters of the models.
        flights: held-out free flights.
        base: errors of the refitted base.
        placebo: errors of the placebo.
        scale: RMS errors of the base, (horizons, quantities).
        matters: cells that are evidence, (horizons, quantities): a model that gets the commands
            predicts better than the placebo.
    """

    problem: Problem
    flights: Flights
    base: FlightErrors
    placebo: FlightErrors
    scale: np.ndarray
    matters: np.ndarray

    @classmethod
    def of(
        cls, problem: Problem, learnt: Windows, held_out: Flights, base: np.ndarray
    ) -> "FlightTest":
        """Build the test of a base model; only that model decides which cells are evidence."""
        errors = held_out.errors_at(problem, base[None])
        placebo = FlightErrors(placebo_errors(learnt, held_out.windows), held_out.windows)
        matters = np.zeros(errors.scale.shape, bool)
        flight_test = cls(problem, held_out, errors, placebo, errors.scale, matters)
        return flight_test._with_evidence(errors)

    @property
    def windows(self) -> Windows:
        """Those of the flights."""
        return self.flights.windows

    @property
    def is_known(self) -> np.ndarray:
        """Whether a cell has enough held-out windows for a score, (horizons, quantities)."""
        counts = self.windows.counts
        blocks = self.windows.sums_by_block(counts.swapaxes(0, 1).astype(int))
        return (counts.sum(axis=1) >= MIN_WINDOWS) & ((blocks > 0).sum(axis=0) >= MIN_BLOCKS)

    def tested(self, *vectors: np.ndarray) -> FlightErrors:
        """Return the errors of models on the held-out windows."""
        return self.flights.errors_at(self.problem, np.stack(vectors))

    def seeing(self, vector: np.ndarray) -> "FlightTest":
        """Return the test with those cells added as evidence where a model beats the placebo."""
        return self._with_evidence(self.tested(vector))

    def with_base(self, vector: np.ndarray) -> "FlightTest":
        """Return the test that compares models with another base; ``scale`` stays."""
        return self._replace(base=self.tested(vector))

    def prefers(self, vector: np.ndarray, other: np.ndarray) -> bool:
        """Return whether the other model predicts a horizon worse than the base, this one none."""
        return self.worst_ratio(vector) == 0.0 < self.worst_ratio(other)

    def _with_evidence(self, errors: FlightErrors) -> "FlightTest":
        gain = self.placebo.by_block(self.scale)[0] - errors.by_block(self.scale)[0]
        beats = sureness(gain) > SURE_OF_COMMANDS
        return self._replace(matters=self.matters | (beats & self.is_known))

    def is_surely_worse(self, vector: np.ndarray) -> bool:
        """Return whether a model predicts any horizon significantly worse than the base does."""
        ratio, z_scores = self.tested(vector).against(self.base)
        return bool(np.any(self.is_known & (ratio > LIKELY_WORSE) & (z_scores > SURELY_WORSE)))

    def worst_ratio(self, vector: np.ndarray) -> float:
        """Return the largest ratio of a model's errors to the base's among cells that are worse.

        Returns:
            The ratio; 0 if no cell is worse.
        """
        ratio, z_scores = self.tested(vector).against(self.base)
        is_worse = (ratio > LIKELY_WORSE) & (
            z_scores > np.where(self.matters, LIKELY, WORSE_ANYWHERE)
        )
        return float(np.max(ratio[self.is_known & is_worse], initial=0.0))

    def losses(self, *vectors: np.ndarray) -> np.ndarray:
        """Return mean squares relative to the base's in cells of evidence, (models, blocks)."""
        squares = self.tested(*vectors).by_block(self.scale)
        is_used = self.matters if self.matters.any() else self.is_known
        return squares[..., is_used].mean(axis=-1)


def sample_windows(
    log: FlightLog, rows: np.ndarray, max_windows: int = MAX_SCORED_WINDOWS
) -> Windows | None:
    """Return windows over some rows of a log; None if there are none."""
    windows = make_windows(log, rows, SPACING_S, max_windows)
    if len(windows.start) < WINDOWS_PER_BATCH:  # a chunk costs the same, full or not
        windows = make_windows(log, rows, SHORT_SPACING_S, WINDOWS_PER_BATCH)
    return windows if len(windows.start) else None


def tabulate_errors(rms: np.ndarray) -> dict[str, dict[str, float]]:
    """Arrange RMS errors, (horizons, quantities), by quantity with unit and by horizon in s."""
    return {
        f"{quantity}_{UNITS[quantity].replace('/', '_per_')}": {
            f"{horizon:g}": float(value)
            for horizon, value in zip(HORIZONS_S, rms[:, index], strict=True)
            if np.isfinite(value)
        }
        for index, quantity in enumerate(QUANTITIES)
        if np.isfinite(rms[:, index]).any()
    }
