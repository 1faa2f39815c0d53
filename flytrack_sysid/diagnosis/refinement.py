"""Refinement: keep the effects that make the free-flight prediction of held-out rows better.

One-step residuals show what a model lacks. Where they leave something unexplained, a law that
stands in for it may fit every step although its prediction diverges over many steps. Refinement
therefore

1. starts free flights of 0.1 to 2 s from measured states (multiple shooting),
2. fits all parameters to the flights on the training rows,
3. removes effects that make no flight better that was not fitted, or any horizon worse: flights of
   held-out rows, and to first order those of each block of training rows without this block,
4. holds parameters at nominal that an effect does not need.

It also fits a placebo, which predicts from the state at the start alone, without the commands.
Where the placebo predicts as well as the models, the flights contain no evidence about the response
to the commands, and the diagnosis names nothing from there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from scipy import special, stats
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME, LearnedLaw
from flytrack_sysid.diagnosis.model_selection import ablate_all
from flytrack_sysid.diagnosis.vetoes import Selection
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
from flytrack_sysid.inference.parameters import DRAIN, from_vector, in_batches
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.score_test import (
    Candidate,
    base_fields,
    candidates_for,
    prior_information,
    solve,
    step_inside,
)
from flytrack_sysid.inference.search import FittedModel, SearchState
from flytrack_sysid.inference.trace_cache import keep_trace
from flytrack_sysid.log import FlightLog

BATCH = 8  # models that are evaluated at once
SPACING_S, SHORT_SPACING_S = 0.25, 0.05
# Limits for the fit and for the held-out score. Windows overlap, so that fewer windows contain
# nearly as much information, and a fit replays them often.
MAX_FITTED_WINDOWS, MAX_SCORED_WINDOWS = WINDOWS_PER_BATCH, 3 * WINDOWS_PER_BATCH
MIN_WINDOWS, MIN_BLOCKS = 12, 3  # a cell with fewer is not scored
RIDGE = 0.05  # penalty of the placebo, in units of its regressors' variance
ALWAYS_FITTED_S = 0.25  # horizons up to this are fitted even where the placebo is as good
OUTLIER = 3.0  # Huber loss: linear beyond this multiple of the base model's RMS error
MAX_ROUNDS, REFIT_ROUNDS, MIN_GAIN = (
    10,
    2,
    1e-3,
)  # iterations of a fit, and of a fit without an effect; smallest relative decrease of the cost
LAG_STEP = 0.5  # of the time between rows: the least step of a lag for intervals
NEUTRAL = 1e-3  # largest distance from nominal, relative to a parameter's scale
DAMPINGS = np.array([1e-6, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0])[:BATCH]
# An effect has to improve the prediction of blocks by SURE standard errors over them. LIKELY
# standard errors are enough where it is worth the share WORTHWHILE of the error: single steps have
# shown it already.
SURE, LIKELY, WORTHWHILE = 2.0, 1.0, 0.02
SURE_OF_COMMANDS = 1.64  # the same for the better of the models over the placebo, one-sided 95 %
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


def errors_at(problem: Problem, vectors: np.ndarray, windows: Windows) -> FlightErrors:
    """Return the errors of models on windows; all numbers of windows share one compiled program.

    Args:
        vectors: parameters of the models, (num_vectors, num_parameters).
    """

    def errors_of_batch(batch_vectors: np.ndarray) -> np.ndarray:
        by_batch = [
            np.asarray(_errors(batch_vectors, problem.like, batch))
            for batch in cut_batches(windows)
        ]
        return np.concatenate(by_batch, axis=2)[:, :, : len(windows.start)]

    errors = in_batches(errors_of_batch, vectors, BATCH)
    # A model whose prediction diverges gets a large, finite error.
    errors = np.nan_to_num(np.clip(errors, -1e6, 1e6), nan=1e6)
    return FlightErrors(errors.reshape(*errors.shape[:-1], len(QUANTITIES), 3), windows)


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
    """

    vector: np.ndarray
    indices: tuple[int, ...]
    covariance: np.ndarray
    half_widths: np.ndarray
    losses: np.ndarray

    @property
    def quantile(self) -> float:
        """Standard deviations in half of a 95 % interval, Student's t for the number of blocks."""
        return float(stats.t.ppf(0.975, max(len(self.losses), 2) - 1))


def huber_loss(residuals: np.ndarray) -> np.ndarray:
    """Return the Huber loss of relative errors, summed over the last axis; small ones' squares."""
    return 2.0 * special.huber(OUTLIER, residuals).sum(axis=-1)


class Target(NamedTuple):
    """The cost that a fit minimises: errors on windows, relative to a scale.

    Attributes:
        problem: the parameters, their ranges and priors.
        windows: free flights that are compared with the log.
        scale: errors that count as 1, (horizons, quantities).
        is_fitted: cells that the fit takes into account, (horizons, quantities).
    """

    problem: Problem
    windows: Windows
    scale: np.ndarray
    is_fitted: np.ndarray

    def residuals(self, vectors: np.ndarray) -> np.ndarray:
        """Return relative errors, (num_vectors, windows, horizons * quantities * 3)."""
        weight = np.where(self.is_fitted, 1.0 / self.scale, 0.0)
        errors = errors_at(self.problem, vectors, self.windows).errors * weight[:, None, :, None]
        return np.moveaxis(errors, 2, 1).reshape(len(vectors), len(self.windows.start), -1)

    def cost(self, residuals: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """Return the Huber loss plus the weak prior of each model, (num_vectors,)."""
        robust = huber_loss(residuals).sum(axis=1)
        return robust + np.square(vectors - self.problem.start) @ prior_information(self.problem)

    def fitted(self, vector: np.ndarray, indices: Sequence[int], rounds: int) -> Fit:
        """Fit a model from a start vector by damped Gauss-Newton with one-sided differences."""
        problem, free_indices = self.problem, np.array(indices, int)
        vector = problem.clipped(vector)
        for _ in range(rounds):
            information, scores, cost = self.linearized(vector, indices)
            prior, pull = (
                prior_information(problem)[free_indices],
                (vector - problem.start)[free_indices],
            )
            candidates = self._ways(
                vector, free_indices, information, scores.sum(axis=0) + prior * pull
            )
            costs = self.cost(self.residuals(candidates), candidates)
            best = int(np.argmin(costs))
            if costs[best] > cost * (1.0 - MIN_GAIN):
                break
            vector = candidates[best]
        information, scores, _ = self.linearized(vector, indices, LAG_STEP * self.step_s)
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
        losses = self.losses(vector) + 2.0 * (by_block * moved).sum(axis=1)
        return Fit(vector, tuple(indices), covariance, np.sqrt(variances), losses)

    def losses(self, vector: np.ndarray) -> np.ndarray:
        """Return the cost of each block of windows, (blocks,)."""
        return self.windows.sums_by_block(huber_loss(self.residuals(vector[None])[0]))

    @property
    def step_s(self) -> float:
        """Usual time between rows, s."""
        return float(np.median(self.windows.record.step_s))

    def linearized(
        self, vector: np.ndarray, indices: Sequence[int], least_lag_s: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Return information, scores of windows, (windows, indices), and cost of a vector.

        Args:
            vector: all parameters.
            indices: of the free ones.
            least_lag_s: as of ``Problem.nudged``.
        """
        problem = self.problem
        moved, step = problem.nudged(vector, indices, least_lag_s=least_lag_s)
        residuals = self.residuals(np.concatenate([vector[None], moved]))
        columns = (residuals[1:] - residuals[0]) / step[:, None, None]
        root = np.sqrt(OUTLIER / np.maximum(np.abs(residuals[0]), OUTLIER))
        scores = np.einsum("pwn,wn->wp", columns, residuals[0] * root**2)
        flat = (columns * root).reshape(len(step), -1)
        information = flat @ flat.T + np.diag(prior_information(problem)[list(indices)])
        return information, scores, float(self.cost(residuals[:1], vector[None])[0])

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


class FlightTest(NamedTuple):
    """Held-out windows, and the errors of the refitted base and of the placebo on them.

    Attributes:
        problem: the parameters of the models.
        windows: held-out free flights.
        base: errors of the refitted base.
        placebo: errors of the placebo.
        scale: RMS errors of the base, (horizons, quantities).
        matters: cells that are evidence, (horizons, quantities): a model that gets the commands
            predicts better than the placebo.
    """

    problem: Problem
    windows: Windows
    base: FlightErrors
    placebo: FlightErrors
    scale: np.ndarray
    matters: np.ndarray

    @classmethod
    def of(
        cls, problem: Problem, learnt: Windows, held_out_windows: Windows, base: np.ndarray
    ) -> "FlightTest":
        """Build the test of a base model; only that model decides which cells are evidence."""
        errors = errors_at(problem, base[None], held_out_windows)
        placebo = FlightErrors(placebo_errors(learnt, held_out_windows), held_out_windows)
        matters = np.zeros(errors.scale.shape, bool)
        flight_test = cls(problem, held_out_windows, errors, placebo, errors.scale, matters)
        return flight_test._with_evidence(errors)

    @property
    def is_known(self) -> np.ndarray:
        """Whether a cell has enough held-out windows for a score, (horizons, quantities)."""
        counts = self.windows.counts
        blocks = self.windows.sums_by_block(counts.swapaxes(0, 1).astype(int))
        return (counts.sum(axis=1) >= MIN_WINDOWS) & ((blocks > 0).sum(axis=0) >= MIN_BLOCKS)

    def tested(self, *vectors: np.ndarray) -> FlightErrors:
        """Return the errors of models on the held-out windows."""
        return errors_at(self.problem, np.stack(vectors), self.windows)

    def seeing(self, vector: np.ndarray) -> "FlightTest":
        """Return the test with those cells added as evidence where a model beats the placebo."""
        return self._with_evidence(self.tested(vector))

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


class Refined(NamedTuple):
    """The result of a refinement.

    Attributes:
        kept: the effects of the extended model.
        fit: the extended model, if it was fitted to windows; None if the model from one-step
            residuals stands.
        base: the base alone, fitted to the same windows.
        removed: effects that held-out prediction does not need, or that make it worse.
        without: by kept effect, the model without it, refitted.
        problem: the problem with the ranges that were searched.
        flight_test: held-out windows and errors; None if there are no windows.
    """

    kept: tuple[Candidate, ...]
    fit: Fit | None
    base: np.ndarray | None
    removed: tuple[str, ...]
    without: Mapping[str, np.ndarray]
    problem: Problem
    flight_test: FlightTest | None

    def with_law(self, law: LearnedLaw) -> "Refined":
        """Return the result for the problem with a law added, which is neutral in the base."""
        problem = self.problem.with_law(law)
        law_start = problem.start[len(self.problem.start) :]
        return self._replace(
            problem=problem, base=None if self.base is None else np.append(self.base, law_start)
        )

    @property
    def removal_costs(self) -> dict[str, float]:
        """Relative increase of the held-out error without an effect, all else refitted."""
        if self.flight_test is None or self.fit is None or not self.without:
            return {}
        losses = self.flight_test.losses(self.fit.vector, *self.without.values()).sum(axis=1)
        costs = np.sqrt(losses[1:] / losses[0]) - 1.0
        return {name: float(cost) for name, cost in zip(self.without, costs, strict=True)}

    def vector_without(self, effect: str, fit: Fit) -> np.ndarray:
        """Return the fitted model without an effect, or with nominal base parameters."""
        if effect in self.without:
            return self.without[effect]
        of_sensor = [name for name in self.problem.names if name.startswith(f"{effect}.")]
        return self.problem.at_start(fit.vector, base_fields(effect) or of_sensor)

    def flight_errors(self, vector: np.ndarray) -> dict[str, float]:
        """Return the held-out errors of free flight by horizon in seconds; empty without a test.

        The errors are those of position; without position in the log, those of attitude, or else of
        the rates.
        """
        if self.flight_test is None:
            return {}
        errors = tabulate_errors(self.flight_test.tested(vector).rms()[0])
        keys = (
            f"{name}_{UNITS[name].replace('/', '_per_')}"
            for name in ("position", "attitude", "rates")
        )
        return next((errors[key] for key in keys if key in errors), {})


def sample_windows(
    log: FlightLog, rows: np.ndarray, max_windows: int = MAX_SCORED_WINDOWS
) -> Windows | None:
    """Return windows over some rows of a log; None if there are none."""
    windows = make_windows(log, rows, SPACING_S, max_windows)
    if len(windows.start) < WINDOWS_PER_BATCH:  # a chunk costs the same, full or not
        windows = make_windows(log, rows, SHORT_SPACING_S, WINDOWS_PER_BATCH)
    return windows if len(windows.start) else None


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


def widened(problem: Problem, fields: Sequence[str]) -> Problem:
    """Return the problem with twice the range for some parameters, except for remembered delays.

    A non-negative range stays non-negative, and a one-sided range stays one-sided.
    """
    low, high = problem.low.copy(), problem.high.copy()
    for name, index in zip(fields, problem.parameter_indices(fields), strict=True):
        effect, _, field = name.partition(".")
        if not field or field in BY_NAME[effect].max_steps:
            continue
        width = high[index] - low[index]
        if low[index] < problem.start[index]:
            low[index] = low[index] - width if low[index] < 0.0 else 0.2 * low[index]
        high[index] += width if high[index] > problem.start[index] else 0.0
    return replace(problem, low=low, high=high)


def refine(
    state: SearchState,
    base: FittedModel,
    model: FittedModel,
    log: FlightLog,
    held_out: np.ndarray,
    is_explained: bool,
    doubted: Sequence[str] = (),
) -> Refined:
    """Select the effects of a model that predict held-out flights better, and fit their values.

    Args:
        base: the base from one-step residuals.
        model: the extended model from one-step residuals.
        held_out: rows of the log that no fit uses, (num_rows,) bool.
        is_explained: whether one-step residuals are noise only. The model is then the most likely
            one already, and stands unless it predicts a horizon worse than the base.
        doubted: effects that held-out single steps contradict: flights of these rows decide.
    """
    learnt, held_out_windows = (
        sample_windows(log, ~held_out, MAX_FITTED_WINDOWS),
        sample_windows(log, held_out),
    )
    problem, candidates, extended = state.problem, model.candidates, model.vector
    unrefined = Refined(candidates, None, None, (), {}, problem, None)
    if learnt is None or held_out_windows is None:
        return unrefined
    flight_test = FlightTest.of(problem, learnt, held_out_windows, base.vector).seeing(extended)
    unrefined = unrefined._replace(flight_test=flight_test)
    if not candidates or not flight_test.is_known.any():
        return unrefined
    acting = _acting(problem, _probed(problem, extended, candidates), candidates, learnt)
    refinement = _Refinement(
        flight_test,
        learnt,
        base.vector,
        tuple(state.base_indices),
        acting,
        is_explained,
        tuple(doubted),
    )
    is_at_bound = bool(at_bounds(problem, extended, refinement.fields_of(candidates)))
    if is_explained and not is_at_bound and not flight_test.is_surely_worse(extended):
        return unrefined
    return refinement.run(extended, unrefined)


class _Refinement(NamedTuple):
    """The data that the steps of a refinement share.

    Attributes:
        flight_test: held-out windows and the errors on them.
        learnt: windows that the fits use.
        base: the base from one-step residuals, (num_parameters,).
        base_indices: the free parameters of the base.
        acting: the effects that change the predictions. Effects of sensors that windows do not
            contain are not among them; their values stay as they are.
        is_explained: as in ``refine``.
        doubted: as in ``refine``.
    """

    flight_test: FlightTest
    learnt: Windows
    base: np.ndarray
    base_indices: tuple[int, ...]
    acting: tuple[str, ...]
    is_explained: bool
    doubted: tuple[str, ...]

    def fields_of(self, candidates: Sequence[Candidate]) -> list[str]:
        """Return the parameters of effects that act on the windows."""
        return [
            name
            for candidate in candidates
            if candidate.effect in self.acting
            for name in candidate.fields
        ]

    def target(self, problem: Problem) -> Target:
        """Return the cost of a fit, over cells that are evidence and over short horizons."""
        scale = errors_at(problem, self.base[None], self.learnt).scale
        is_short = (np.array(HORIZONS_S) <= ALWAYS_FITTED_S)[:, None]
        return Target(problem, self.learnt, scale, self.flight_test.matters | is_short)

    def indices(self, problem: Problem, candidates: Sequence[Candidate]) -> list[int]:
        """Return the indices of the free parameters that act on the windows."""
        base_indices = [index for index in self.base_indices if problem.names[index] != DRAIN]
        return base_indices + problem.parameter_indices(self.fields_of(candidates))

    def run(self, extended: np.ndarray, unrefined: Refined) -> Refined:
        """Return the refined model with the effects that held-out prediction needs."""
        problem, candidates = unrefined.problem, unrefined.kept
        target = self.target(problem)
        indices = self.indices(problem, candidates)
        fit = target.fitted(extended, indices, MAX_ROUNDS)
        probed = _probed(problem, fit.vector, candidates)
        if np.any(probed != fit.vector):  # single steps left a parameter where its slope is zero
            from_probes = target.fitted(probed, indices, MAX_ROUNDS)
            vectors = np.stack([fit.vector, from_probes.vector])
            fit = (fit, from_probes)[
                int(np.argmin(target.cost(target.residuals(vectors), vectors)))
            ]
        stuck = at_bounds(problem, fit.vector, self.fields_of(candidates))
        if stuck:
            problem = widened(problem, stuck)
            target = target._replace(problem=problem)
            fit = target.fitted(fit.vector, fit.indices, MAX_ROUNDS)
        flight_test = self.flight_test.seeing(fit.vector)
        base = target.fitted(self.base, self.indices(problem, ()), MAX_ROUNDS).vector
        refined = unrefined._replace(fit=fit, base=base, problem=problem, flight_test=flight_test)
        return self._eliminate(refined, fit, flight_test, target)

    def _eliminate(
        self, refined: Refined, fit: Fit, flight_test: FlightTest, target: Target
    ) -> Refined:
        """Remove effects that are not needed, or that make any horizon worse."""
        without: dict[str, np.ndarray] = {}
        kept = [
            candidate
            for candidate in refined.kept
            if not _is_neutral(refined.problem, fit.vector, candidate.fields)
        ]
        removed = [candidate.effect for candidate in refined.kept if candidate not in kept]
        while any(candidate.effect in self.acting for candidate in kept):
            tried = [candidate for candidate in kept if candidate.effect in self.acting]
            fits = [self._without(target, fit, kept, candidate) for candidate in tried]
            losses = np.stack([self._losses(target, one) for one in (fit, *fits)])
            losses_more = (losses[1:] - losses[0]).T
            sure = sureness(losses_more)
            worth = np.sqrt(losses[1:].sum(axis=1) / losses[0].sum()) - 1.0
            needed = np.where(
                (worth >= WORTHWHILE) & (sure >= LIKELY), np.maximum(sure, SURE), sure
            )
            needed[:] = needed if flight_test.matters.any() else np.inf  # no cell is evidence
            held_out_sure = sureness(losses_more[len(fit.losses) :])
            is_doubted = np.array([candidate.effect in self.doubted for candidate in tried])
            needed[is_doubted & (held_out_sure < LIKELY)] = -np.inf
            without = {
                candidate.effect: reduced_fit.vector
                for candidate, reduced_fit in zip(tried, fits, strict=True)
            }
            if self.is_explained and not flight_test.is_surely_worse(fit.vector):
                break
            weakest = int(np.argmin(needed))
            if needed[weakest] >= SURE:
                if flight_test.worst_ratio(fit.vector) < 1.0:
                    break
                weakest = int(
                    np.argmin([flight_test.worst_ratio(reduced_fit.vector) for reduced_fit in fits])
                )
            kept.remove(tried[weakest])
            removed.append(tried[weakest].effect)
            indices = self.indices(target.problem, kept)
            fit = target.fitted(fits[weakest].vector, indices, MAX_ROUNDS)
        if not any(
            candidate.effect in self.acting for candidate in kept
        ):  # the base from single steps stands
            return refined._replace(kept=tuple(kept), fit=None, removed=tuple(removed), without={})
        if not self.is_explained:
            fit, kept = self._narrowed(target, fit, kept)
        return refined._replace(kept=tuple(kept), fit=fit, removed=tuple(removed), without=without)

    def _narrowed(
        self, target: Target, fit: Fit, kept: Sequence[Candidate]
    ) -> tuple[Fit, list[Candidate]]:
        """Return a fit and its effects without parameters that effects do not need.

        Some parameters of an effect trade off: each may be nominal, and not all of them. Others
        end at a bound, since nothing in the flights depends on them. They are held at nominal.
        """
        kept = list(kept)
        for number in range(len(kept)):
            while (field := superfluous(target.problem, fit, kept[number])) is not None:
                candidate, others = kept[number], [*kept]
                others[number] = candidate._replace(
                    fields=tuple(name for name in candidate.fields if name != field),
                    probes=tuple(probe for probe in candidate.probes if probe.field != field),
                )
                vector = target.problem.at_start(fit.vector, [field])
                held = target.fitted(vector, self.indices(target.problem, others), MAX_ROUNDS)
                if sureness(self._losses(target, held) - self._losses(target, fit)) >= SURE:
                    break
                fit, kept = held, others
        return fit, kept

    def _losses(self, target: Target, fit: Fit) -> np.ndarray:
        """Return the cross-validated cost of each block, learnt ones first, (blocks,)."""
        held_out = target._replace(windows=self.flight_test.windows)
        return np.concatenate([fit.losses, held_out.losses(fit.vector)])

    def _without(
        self, target: Target, fit: Fit, kept: Sequence[Candidate], removed: Candidate
    ) -> Fit:
        vector = target.problem.at_start(fit.vector, removed.fields)
        remaining = [candidate for candidate in kept if candidate is not removed]
        return target.fitted(vector, self.indices(target.problem, remaining), REFIT_ROUNDS)


def _acting(
    problem: Problem, vector: np.ndarray, candidates: Sequence[Candidate], windows: Windows
) -> tuple[str, ...]:
    """Return the effects that change the predictions of a model."""
    without = [problem.at_start(vector, candidate.fields) for candidate in candidates]
    errors = errors_at(problem, np.stack([vector, *without]), windows).errors
    changes = np.abs(errors[1:] - errors[0]).max(axis=(1, 2, 3, 4))
    return tuple(
        candidate.effect
        for candidate, change in zip(candidates, changes, strict=True)
        if change > 0.0
    )


def _is_neutral(problem: Problem, vector: np.ndarray, fields: Sequence[str]) -> bool:
    """Return whether parameters are nominal, apart from those that only shape a law."""
    scaled_fields = [
        name
        for name in fields
        if name.split(".")[1] not in BY_NAME[name.split(".")[0]].search.shapes
    ]
    indices = problem.parameter_indices(scaled_fields)
    return bool(np.all(np.abs(vector - problem.start)[indices] < NEUTRAL * problem.scale[indices]))


def superfluous(problem: Problem, fit: Fit, candidate: Candidate) -> str | None:
    """Return a parameter that an effect may not need, if there is one beside others.

    It is at a bound, or the nearest to its nominal value where all may be nominal.
    """
    half = dict(zip(fit.indices, fit.half_widths, strict=True))
    change = np.abs(fit.vector - problem.start)
    indices = problem.parameter_indices(candidate.fields)
    shown = [index for index in indices if half.get(index, 0.0) > 0.0]
    if len(shown) < 2:
        return None
    stuck = at_bounds(problem, fit.vector, [problem.names[index] for index in shown])
    if stuck:
        return stuck[0]
    if any(change[index] > half[index] for index in shown):
        return None
    return problem.names[min(shown, key=lambda index: change[index] / half[index])]


def _probed(problem: Problem, vector: np.ndarray, candidates: Sequence[Candidate]) -> np.ndarray:
    """Return the vector with the neutral ones of the probed parameters set to their probes."""
    result = vector.copy()
    for probe in (probe for candidate in candidates for probe in candidate.probes):
        if _is_neutral(problem, vector, [probe.field]):
            result[problem.names.index(probe.field)] = probe.value
    return result


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


def reduced(selection: Selection, refined: Refined) -> Selection:
    """Return the selection with only the effects that a refinement kept; the base if it kept none.

    If no kept effect was fitted to flights, as with effects of sensors that flights do not contain,
    single steps decide. The base alone stands where it predicts flights better.
    """
    model = selection.model
    if refined.fit is not None:
        if refined.kept == model.candidates:
            return selection
        nominal = [
            name
            for candidate in refined.kept
            for name in model.candidate(candidate.effect).fields
            if name not in candidate.fields
        ]
        vector = refined.problem.at_start(model.vector, nominal)
        return selection._replace(
            model=model._replace(
                candidates=refined.kept, vector=vector, indices=refined.fit.indices
            )
        )
    if refined.kept:
        return selection if refined.kept == model.candidates else _narrowed(selection, refined.kept)
    return selection._replace(model=selection.base)


def with_effects(selection: Selection, effects: Sequence[str]) -> Selection:
    """Return the selection with some effects added, fitted to single steps again."""
    problem, model = selection.state.problem, selection.model
    added: dict[str, Candidate] = {}
    for candidate in candidates_for(problem):
        known = added.get(candidate.effect, candidate)
        if candidate.effect in effects and len(candidate.fields) >= len(known.fields):
            added[candidate.effect] = candidate
    candidates = (*model.candidates, *added.values())
    return _fitted_again(selection, candidates, _probed(problem, model.vector, candidates))


def _narrowed(selection: Selection, kept: Sequence[Candidate]) -> Selection:
    """Return the selection with some of its effects only, fitted to single steps again."""
    model = selection.model
    removed = [candidate.effect for candidate in model.candidates if candidate not in kept]
    return _fitted_again(selection, kept, selection.state.problem.without(model.vector, removed))


def _fitted_again(
    selection: Selection, candidates: Sequence[Candidate], vector: np.ndarray
) -> Selection:
    """Return the selection with these effects, fitted to single steps from a vector."""
    model = selection.state.fitted(candidates, vector)
    state, linearization = selection.state.linearized(model.vector)
    ablations = ablate_all(state, model, linearization)
    return selection._replace(state=state, model=model, ablations=ablations)
