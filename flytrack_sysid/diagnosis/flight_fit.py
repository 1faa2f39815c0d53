"""Fits of models to free flights: damped Gauss-Newton with a Huber loss, and robust intervals."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from flytrack_env.effects import BY_NAME
from flytrack_sysid.diagnosis.flight_errors import BATCH, Flights
from flytrack_sysid.inference.free_flight import Windows
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.score_test import prior_information, solve, step_inside

OUTLIER = 3.0  # Huber loss: linear beyond this multiple of the base model's RMS error
MIN_GAIN = 1e-3  # smallest relative decrease of the cost in an iteration
LAG_STEP = 0.5  # of the time between rows: the least step of a lag for intervals
# Levenberg's, of the diagonal of the information; all are tried at once.
DAMPINGS = np.array([1e-6, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0])[:BATCH]


class Fit(NamedTuple):
    """A model fitted to windows.

    Attributes:
        vector: all parameters, (num_parameters,).
        indices: the free parameters.
        covariance: covariance of the free parameters, (indices, indices), times the square of
            ``quantile``: roots of its diagonal are half-widths of 95 % intervals. Parameters at the
            end of their range are held there, and have none.
        half_widths: half of the 95 % interval of each free index; of those at the end of their
            range as if it went on.
        losses: cost of each block of windows without a fit to this block, (blocks,), to first
            order (Takeuchi, "Distribution of informational statistics and a criterion of model
            fitting", Suri-Kagaku 153, 1976).
        columns: slopes of the relative errors along the free parameters, (indices, windows, ...).
    """

    vector: np.ndarray
    indices: tuple[int, ...]
    covariance: np.ndarray
    half_widths: np.ndarray
    losses: np.ndarray
    columns: np.ndarray

    @property
    def half_widths_by_index(self) -> dict[int, float]:
        """``half_widths`` by index."""
        return dict(zip(self.indices, self.half_widths.tolist(), strict=True))

    @property
    def quantile(self) -> float:
        """Standard deviations in half of a 95 % interval, Student's t for the number of blocks."""
        return float(stats.t.ppf(0.975, max(len(self.losses), 2) - 1))


class Linearized(NamedTuple):
    """A model's errors on windows to first order.

    Attributes:
        residuals: relative errors, (windows, numbers).
        columns: their slopes along the free parameters, (indices, windows, numbers).
        information: of the free parameters with the prior, (indices, indices).
        scores: of windows, (windows, indices).
        cost: as of ``Target.cost``.
    """

    residuals: np.ndarray
    columns: np.ndarray
    information: np.ndarray
    scores: np.ndarray
    cost: float


def huber_loss(residuals: np.ndarray) -> np.ndarray:
    """Return the Huber loss of relative errors, summed over the last axis; small ones' squares."""
    return 2.0 * special.huber(OUTLIER, residuals).sum(axis=-1)


class Target(NamedTuple):
    """The cost that a fit minimises: errors on windows, relative to a scale.

    Attributes:
        problem: the parameters, their ranges and priors.
        flights: that are compared with the log.
        scale: errors that count as 1, (horizons, quantities).
        is_fitted: cells that the fit takes into account, (horizons, quantities).
    """

    problem: Problem
    flights: Flights
    scale: np.ndarray
    is_fitted: np.ndarray

    def residuals(self, vectors: np.ndarray) -> np.ndarray:
        """Return relative errors, (num_vectors, windows, horizons * quantities * 3)."""
        weight = np.where(self.is_fitted, 1.0 / self.scale, 0.0)
        errors = self.flights.errors_at(self.problem, vectors).errors * weight[:, None, :, None]
        return np.moveaxis(errors, 2, 1).reshape(len(vectors), len(self.windows.start), -1)

    def cost(self, residuals: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """Return the Huber loss plus the weak prior of each model, (num_vectors,)."""
        robust = huber_loss(residuals).sum(axis=1)
        return robust + np.square(vectors - self.problem.start) @ prior_information(self.problem)

    def fitted(
        self, vector: np.ndarray, indices: Sequence[int], rounds: int, nearby: Fit | None = None
    ) -> Fit:
        """Fit a model from a start vector by damped Gauss-Newton with one-sided differences.

        Args:
            vector: where the fit starts.
            indices: of the free parameters.
            rounds: the most iterations.
            nearby: a fit along these indices and others whose slopes serve for this one, too.
        """
        problem, free_indices = self.problem, np.array(indices, int)
        columns = nearby and nearby.columns[[nearby.indices.index(index) for index in indices]]
        vector = problem.clipped(vector)
        for _ in range(rounds):
            at_vector = self.linearized(vector, indices, columns)
            prior, pull = (
                prior_information(problem)[free_indices],
                (vector - problem.start)[free_indices],
            )
            gradient = at_vector.scores.sum(axis=0) + prior * pull
            candidates = self._ways(vector, free_indices, at_vector.information, gradient)
            costs = self.cost(self.residuals(candidates), candidates)
            best = int(np.argmin(costs))
            if costs[best] > at_vector.cost * (1.0 - MIN_GAIN):
                break
            vector = candidates[best]
        final = self.linearized(vector, indices, columns, LAG_STEP * self.step_s)
        information, scores = final.information, final.scores
        whole = self._covariance(information, scores)
        room = 1e-6 * problem.scale[free_indices]
        is_inside = (vector - problem.low)[free_indices] > room
        is_inside &= (problem.high - vector)[free_indices] > room
        inside = np.ix_(is_inside, is_inside)
        covariance = np.zeros_like(whole)
        covariance[inside] = self._covariance(information[inside], scores[:, is_inside])
        variances = np.where(is_inside, np.diag(covariance), np.diag(whole))
        by_block = self.windows.sums_by_block(scores[:, is_inside])
        moved = solve(information[inside], by_block.T).T
        losses = self.windows.sums_by_block(huber_loss(final.residuals))
        losses += 2.0 * (by_block * moved).sum(axis=1)
        return Fit(vector, tuple(indices), covariance, np.sqrt(variances), losses, final.columns)

    def nearer_nominal(self, fit: Fit, field: str) -> Fit:
        """Return a fit with a parameter as near to nominal as changes no flight.

        At a bound, a parameter may have gone on without effect: a delay of yaw that is shorter than
        the others' by more than these are long, say.
        """
        vectors = np.repeat(fit.vector[None], BATCH, axis=0)
        index = self.problem.names.index(field)
        vectors[:, index] = np.linspace(self.problem.start[index], fit.vector[index], BATCH)
        residuals = self.residuals(vectors)
        changes = np.abs(residuals - residuals[-1]).max(axis=(1, 2)) > 0.0
        return fit._replace(vector=vectors[np.flatnonzero(changes).max(initial=-1) + 1])

    def losses(self, *vectors: np.ndarray) -> np.ndarray:
        """Return the cost of each block of windows, (num_vectors, blocks)."""
        by_window = huber_loss(self.residuals(np.stack(vectors)))
        return np.stack([self.windows.sums_by_block(one) for one in by_window])

    @property
    def windows(self) -> Windows:
        """Those of the flights."""
        return self.flights.windows

    @property
    def step_s(self) -> float:
        """Usual time between rows, s."""
        return self.windows.record.median_step_s

    def linearized(
        self,
        vector: np.ndarray,
        indices: Sequence[int],
        columns: np.ndarray | None = None,
        least_lag_s: float = 0.0,
    ) -> Linearized:
        """Return a model's errors to first order.

        Args:
            vector: all parameters.
            indices: of the free ones.
            columns: slopes of a nearby model; if None, those of this one.
            least_lag_s: as of ``Problem.nudged``.
        """
        problem = self.problem
        if columns is None:
            moved, step = problem.nudged(vector, indices, least_lag_s=least_lag_s)
            residuals, *others = self.residuals(np.concatenate([vector[None], moved]))
            columns = (np.array(others) - residuals) / step[:, None, None]
        else:
            residuals = self.residuals(vector[None])[0]
        root = np.sqrt(OUTLIER / np.maximum(np.abs(residuals), OUTLIER))
        scores = np.einsum("pwn,wn->wp", columns, residuals * root**2)
        flat = (columns * root).reshape(len(indices), -1)
        information = flat @ flat.T + np.diag(prior_information(problem)[list(indices)])
        cost = float(self.cost(residuals[None], vector[None])[0])
        return Linearized(residuals, columns, information, scores, cost)

    def _ways(
        self,
        vector: np.ndarray,
        free_indices: np.ndarray,
        information: np.ndarray,
        gradient: np.ndarray,
    ) -> np.ndarray:
        """Return the vector after the step of each damping; parameters at a bound stay there."""

        def newton_step(free: np.ndarray, damping: float) -> np.ndarray:
            inner = information[np.ix_(free, free)]
            return -solve(inner + damping * np.diag(np.diag(inner)), gradient[free])

        candidates = np.repeat(vector[None], len(DAMPINGS), axis=0)
        for index, damping in enumerate(DAMPINGS):
            candidates[index, free_indices] += step_inside(
                self.problem, vector, free_indices, partial(newton_step, damping=damping)
            )
        return self.problem.clipped(candidates)

    def _covariance(self, information: np.ndarray, scores: np.ndarray) -> np.ndarray:
        """Return the sandwich covariance from the scores of blocks, scaled to 95 % intervals.

        The scale is the quantile of Student's t distribution.
        """
        by_block = self.windows.sums_by_block(scores)
        inverse = solve(information, np.eye(len(information)))
        num_blocks = max(len(by_block), 2)
        covariance = inverse @ (by_block.T @ by_block * num_blocks / (num_blocks - 1)) @ inverse
        return covariance * stats.t.ppf(0.975, num_blocks - 1) ** 2


def at_bounds(problem: Problem, vector: np.ndarray, fields: Sequence[str]) -> list[str]:
    """Return those parameters that are at the end of their searched range, except for shapes."""
    result = []
    for index in problem.parameter_indices(fields):
        effect, _, field = problem.names[index].partition(".")
        low, high, value = problem.low[index], problem.high[index], vector[index]
        room = 1e-6 * max(abs(value), 1.0)
        is_shape = bool(field) and field in BY_NAME[effect].search.shapes
        is_neutral = bool(field) and abs(value - problem.start[index]) <= room
        if not (is_shape or is_neutral) and not low + room < value < high - room:
            result.append(problem.names[index])
    return result
