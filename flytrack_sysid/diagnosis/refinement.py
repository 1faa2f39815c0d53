"""Refinement: judge effects and their values by how far ahead a model predicts held-out rows.

One-step residuals say what a model lacks; where they leave something unexplained, a law that stands
in for it may fit every step and yet fly off. So free flights of 0.1 to 2 s are started from
measured states (multiple shooting), all parameters are fitted to them on the rows that are learnt
from, and effects are removed that make no held-out flight better, or any horizon worse. A placebo,
which predicts from the state alone and knows no commands, is fitted beside it: where it predicts as
well as the models, the flights say nothing about what answers the commands, and nothing is named
from there.
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
from flytrack_sysid.diagnosis.onset import ended
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.score_test import (
    BASE_CAUSES,
    Candidate,
    prior_information,
    solve,
    step_inside,
)
from flytrack_sysid.diagnosis.search import FittedModel, SearchState
from flytrack_sysid.diagnosis.vetoes import Selection
from flytrack_sysid.log import FlightLog
from flytrack_sysid.parameters import DRAIN, from_vector, in_batches
from flytrack_sysid.prediction_windows import (
    HORIZONS_S,
    QUANTITIES,
    UNITS,
    WINDOWS_PER_BATCH,
    Windows,
    batches_of,
    make_windows,
    prediction_errors,
)
from flytrack_sysid.trace_cache import keep_trace

BATCH = 8  # models at once
SPACING_S, SHORT_SPACING_S = 0.25, 0.05
# To fit and to judge by. Windows overlap: fewer say nearly as much, and a fit flies them often.
MAX_FITTED_WINDOWS, MAX_SCORED_WINDOWS = WINDOWS_PER_BATCH, 3 * WINDOWS_PER_BATCH
MIN_WINDOWS, MIN_BLOCKS = 12, 3  # fewer say nothing of a cell
RIDGE = 0.05  # of the placebo, in units of its regressors' variance
ALWAYS_FITTED_S = 0.25  # horizons up to this are fitted even where the placebo is as good
OUTLIER = 3.0  # errors beyond so many of the base's rms count by their size, not its square
MAX_ROUNDS, REFIT_ROUNDS, MIN_GAIN = (
    10,
    2,
    1e-3,
)  # of a fit, of one without an effect; share of the cost
NEUTRAL = 1e-3  # of a parameter's scale
DAMPINGS = np.array([1e-6, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0])[:BATCH]
# Standard errors over blocks by which an effect has to improve held-out prediction, and by which it
# may where it is worth so large a share of the error: single steps have shown it already.
SURE, LIKELY, WORTHWHILE = 2.0, 1.0, 0.02
SURE_OF_COMMANDS = 1.64  # the same for the better of the models over the placebo, one-sided 95 %
# Errors over the base's that make a horizon worse, and standard errors over blocks by which it then
# has to be worse: where the commands matter, and where they do not and chance alone moves the
# error. What rounds to 1.00 times is as good.
LIKELY_WORSE, WORSE_ANYWHERE = 1.005, 2.0
# Standard errors by which a horizon has to be worse before a model is doubted whose one-step
# residuals are noise: with twenty cells, one standard error is always somewhere.
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
        """Return the rms size of the errors, (models, horizons, quantities); NaN without any."""
        number = self.windows.counts.sum(axis=1)
        mean = self.squares.sum(axis=2) / np.maximum(number, 1)
        return np.where(number > 0, np.sqrt(mean), np.nan)

    def by_block(self, scale: np.ndarray) -> np.ndarray:
        """Return what each block adds to the relative mean squares, (models, blocks, ...).

        scale: the errors they are relative to, (horizons, quantities).
        """
        number = np.maximum(self.windows.counts.sum(axis=1), 1)
        relative = self.squares / (np.square(scale) * number)[:, None]
        return self.windows.sums_by_block(np.moveaxis(relative, 2, 0)).swapaxes(0, 1)

    @property
    def scale(self) -> np.ndarray:
        """The rms errors of the first model to divide by, (horizons, quantities); 1 if none."""
        return np.maximum(np.nan_to_num(self.rms()[0], nan=1.0), 1e-9)

    def against(self, base: "FlightErrors") -> tuple[np.ndarray, np.ndarray]:
        """Return the errors over a base's, and by how many standard errors they are larger.

        Both are (horizons, quantities).
        """
        lost = self.by_block(base.scale)[0] - base.by_block(base.scale)[0]
        return self.rms()[0] / base.scale, sureness(lost)


def sureness(differences: np.ndarray) -> np.ndarray:
    """Return the sum of differences by block, (blocks, ...), in its standard errors."""
    number = max(len(differences), 2)
    centred = differences - differences.mean(axis=0)
    spread = np.sqrt(np.square(centred).sum(axis=0) * number / (number - 1))
    return differences.sum(axis=0) / np.maximum(spread, 1e-300)


@keep_trace
def _errors(vectors: jax.Array, like: ModelParameters, windows: Windows) -> jax.Array:
    return jax.vmap(lambda vector: prediction_errors(from_vector(vector, like), windows))(vectors)


def errors_at(problem: Problem, vectors: np.ndarray, windows: Windows) -> FlightErrors:
    """Return the errors of models on windows; one compiled program serves all.

    vectors: (num_vectors, num_parameters).
    """

    def of_batch(part: np.ndarray) -> np.ndarray:
        found = [np.asarray(_errors(part, problem.like, batch)) for batch in batches_of(windows)]
        return np.concatenate(found, axis=2)[:, :, : len(windows.start)]

    errors = in_batches(of_batch, vectors, BATCH)
    # A model that runs away is as bad as can be, but still a number.
    errors = np.nan_to_num(np.clip(errors, -1e6, 1e6), nan=1e6)
    return FlightErrors(errors.reshape(*errors.shape[:-1], len(QUANTITIES), 3), windows)


def _regressors(windows: Windows) -> np.ndarray:
    """Return what the placebo knows, (windows, regressors): the state at the start."""
    row, record = windows.first_free - 1, windows.record
    turned = Rotation.from_quat(record.quat[row], scalar_first=True).as_matrix().reshape(-1, 9)
    return np.concatenate(
        [record.vel_w[row], record.pos_w[row], turned, windows.gyro_b[row]], axis=1
    )


def _changes(windows: Windows) -> np.ndarray:
    """Return how the state changes up to the horizons, (horizons, windows, quantities, 3)."""
    row, record = windows.first_free - 1, windows.record
    start = Rotation.from_quat(record.quat[row], scalar_first=True)
    found = []
    for end in windows.ends:
        turn = start.inv() * Rotation.from_quat(record.quat[end], scalar_first=True)
        levels = (windows.gyro_b, record.vel_w, record.pos_w)
        found.append(np.stack([turn.as_rotvec(), *(one[end] - one[row] for one in levels)], axis=1))
    return np.stack(found)


def placebo_errors(learnt: Windows, held_out_windows: Windows) -> np.ndarray:
    """Return the errors of ridge regression on the start state, (1, horizons, windows, ...)."""
    known, wanted = _regressors(learnt), _changes(learnt)
    mean, spread = known.mean(axis=0), known.std(axis=0) + 1e-9
    rows, others = (
        np.c_[(one - mean) / spread, np.ones(len(one))]
        for one in (known, _regressors(held_out_windows))
    )
    measured, errors = _changes(held_out_windows), []
    for index in range(len(HORIZONS_S)):
        used = learnt.counts[index].any(axis=-1)
        # Without a window that is so long, it predicts no change, and nothing is judged there.
        damping = RIDGE * max(used.sum(), 1) * np.diag([*np.ones(len(mean)), 1e-9])
        target = wanted[index].reshape(len(rows), -1)[used]
        slopes = np.linalg.solve(rows[used].T @ rows[used] + damping, rows[used].T @ target)
        predicted = (others @ slopes).reshape(len(others), len(QUANTITIES), 3)
        left = measured[index] - predicted
        turns = (Rotation.from_rotvec(one[:, 0]) for one in (predicted, measured[index]))
        left[:, 0] = (next(turns).inv() * next(turns)).as_rotvec()
        errors.append(left)
    return np.where(held_out_windows.counts[..., None], np.stack(errors), 0.0)[None]


class Fit(NamedTuple):
    """A model fitted to windows: vector, free indices, and their covariance, for 95 % intervals.

    covariance: (indices, indices), of which the square roots are halves of intervals.
    """

    vector: np.ndarray
    indices: tuple[int, ...]
    covariance: np.ndarray

    @property
    def half_widths(self) -> np.ndarray:
        """Half of the 95 % interval of each free index."""
        return np.sqrt(np.diag(self.covariance))


class Target(NamedTuple):
    """What a fit minimises: errors on windows, relative to a scale.

    scale: (horizons, quantities). is_fitted: cells that the fit takes into account.
    """

    problem: Problem
    windows: Windows
    scale: np.ndarray
    is_fitted: np.ndarray

    def residuals(self, vectors: np.ndarray) -> np.ndarray:
        """Return relative errors, (num_vectors, windows, numbers)."""
        weight = np.where(self.is_fitted, 1.0 / self.scale, 0.0)
        found = errors_at(self.problem, vectors, self.windows).errors * weight[:, None, :, None]
        return np.moveaxis(found, 2, 1).reshape(len(vectors), len(self.windows.start), -1)

    def cost(self, left: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """Return the robust sum of squares and the weak prior of models, (num_vectors,)."""
        robust = 2.0 * special.huber(OUTLIER, left).sum(axis=(1, 2))
        return robust + np.square(vectors - self.problem.start) @ prior_information(self.problem)

    def fitted(self, vector: np.ndarray, indices: Sequence[int], rounds: int) -> Fit:
        """Fit a model, starting from a vector, by damped Gauss-Newton with one-sided slopes."""
        problem, at = self.problem, np.array(indices, int)
        vector = problem.clipped(vector)
        for number in range(rounds + 1):
            moved, step = problem.nudged(vector, indices)
            left = self.residuals(np.concatenate([vector[None], moved]))
            columns = (left[1:] - left[0]) / step[:, None, None]
            root = np.sqrt(OUTLIER / np.maximum(np.abs(left[0]), OUTLIER))
            prior, pull = prior_information(problem)[at], (vector - problem.start)[at]
            scores = np.einsum("pwn,wn->wp", columns, left[0] * root**2)
            flat = (columns * root).reshape(len(at), -1)
            information = flat @ flat.T + np.diag(prior)
            if number == rounds:
                break
            ways = self._ways(vector, at, information, scores.sum(axis=0) + prior * pull)
            costs = self.cost(self.residuals(ways), ways)
            cost = self.cost(left[:1], vector[None])[0]
            best = int(np.argmin(costs))
            if costs[best] > cost * (1.0 - MIN_GAIN):
                break
            vector = ways[best]
        return Fit(vector, tuple(indices), self._covariance(information, scores))

    def _ways(
        self, vector: np.ndarray, at: np.ndarray, information: np.ndarray, gradient: np.ndarray
    ) -> np.ndarray:
        """Return the vectors that steps of all dampings lead to; parameters at a bound stay."""

        def along(free: np.ndarray, damping: float) -> np.ndarray:
            inner = information[np.ix_(free, free)]
            return -solve(inner + damping * np.diag(np.diag(inner)), gradient[free])

        found = np.repeat(vector[None], len(DAMPINGS), axis=0)
        for number, damping in enumerate(DAMPINGS):
            found[number, at] += step_inside(
                self.problem, vector, at, partial(along, damping=damping)
            )
        return self.problem.clipped(found)

    def _covariance(self, information: np.ndarray, scores: np.ndarray) -> np.ndarray:
        """Return that of 95 % intervals, by the scores of blocks (sandwich); Student's t."""
        by_block = self.windows.sums_by_block(scores)
        inverse = solve(information, np.eye(len(information)))
        number = max(len(by_block), 2)
        covariance = inverse @ (by_block.T @ by_block * number / (number - 1)) @ inverse
        return covariance * stats.t.ppf(0.975, number - 1) ** 2


class FlightTest(NamedTuple):
    """Held-out windows, errors of the refitted base and the placebo there, and cells of evidence.

    scale: the base's rms errors, (horizons, quantities). matters: (horizons, quantities) bool, a
    model that is given the commands predicts better than the placebo.
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
        """Return the judge of a base model before anything is known to matter."""
        tested, placebo = (
            errors_at(problem, base[None], held_out_windows),
            placebo_errors(learnt, held_out_windows),
        )
        nothing = np.zeros(tested.scale.shape, bool)
        return cls(
            problem,
            held_out_windows,
            tested,
            FlightErrors(placebo, held_out_windows),
            tested.scale,
            nothing,
        ).seeing(base)

    @property
    def is_known(self) -> np.ndarray:
        """Where held-out windows are enough to judge by, (horizons, quantities)."""
        counts = self.windows.counts
        blocks = self.windows.sums_by_block(counts.swapaxes(0, 1).astype(int))
        return (counts.sum(axis=1) >= MIN_WINDOWS) & ((blocks > 0).sum(axis=0) >= MIN_BLOCKS)

    def tested(self, *vectors: np.ndarray) -> FlightErrors:
        """Return the errors of models on the held-out windows."""
        return errors_at(self.problem, np.stack(vectors), self.windows)

    def seeing(self, vector: np.ndarray) -> "FlightTest":
        """Return the judge that also counts cells as evidence where a model beats the placebo."""
        lost = self.placebo.by_block(self.scale)[0] - self.tested(vector).by_block(self.scale)[0]
        beats = sureness(lost) > SURE_OF_COMMANDS
        return self._replace(matters=self.matters | (beats & self.is_known))

    def is_surely_worse(self, vector: np.ndarray) -> bool:
        """Return whether a model predicts any horizon worse than the base does, beyond chance."""
        ratio, lost = self.tested(vector).against(self.base)
        return bool(np.any(self.is_known & (ratio > LIKELY_WORSE) & (lost > SURELY_WORSE)))

    def worst_ratio(self, vector: np.ndarray) -> float:
        """Return the largest ratio of a model's errors to the base's where it is worse.

        0 where it is nowhere worse.
        """
        ratio, lost = self.tested(vector).against(self.base)
        is_worse = (ratio > LIKELY_WORSE) & (lost > np.where(self.matters, LIKELY, WORSE_ANYWHERE))
        return float(np.max(ratio[self.is_known & is_worse], initial=0.0))

    def losses(self, *vectors: np.ndarray) -> np.ndarray:
        """Return mean squares over the base's in cells that are evidence, (models, blocks)."""
        found = self.tested(*vectors).by_block(self.scale)
        used = self.matters if self.matters.any() else self.is_known
        return found[..., used].mean(axis=-1)


class Refined(NamedTuple):
    """The outcome of a refinement.

    kept: the effects of the extended model. fit: the extended model where it was fitted to windows;
    None where the model from one-step residuals stands. base: the base alone, fitted likewise.
    removed: effects that held-out prediction does not need or is worse with. without: by kept
    effect, the model without it, refitted. problem: with the ranges that were searched.
    """

    kept: tuple[Candidate, ...]
    fit: Fit | None
    base: np.ndarray | None
    removed: tuple[str, ...]
    without: Mapping[str, np.ndarray]
    problem: Problem
    flight_test: FlightTest | None

    def with_law(self, law: LearnedLaw) -> "Refined":
        """Return the same of the problem with a law, its base without it."""
        problem = self.problem.with_law(law)
        own = problem.start[len(self.problem.start) :]
        return self._replace(
            problem=problem, base=None if self.base is None else np.append(self.base, own)
        )

    @property
    def removal_costs(self) -> dict[str, float]:
        """By which share the held-out error grows without an effect, all else refitted."""
        if self.flight_test is None or self.fit is None or not self.without:
            return {}
        losses = self.flight_test.losses(self.fit.vector, *self.without.values()).sum(axis=1)
        costs = np.sqrt(losses[1:] / losses[0]) - 1.0
        return {name: float(cost) for name, cost in zip(self.without, costs, strict=True)}

    def vector_without(self, effect: str) -> np.ndarray:
        """Return the fitted model without an effect, or with nominal base parameters."""
        assert self.fit is not None
        if effect in self.without:
            return self.without[effect]
        own = [name for name in self.problem.names if name.startswith(f"{effect}.")]  # of a sensor
        cause = "thrust_curve" if effect == "thrust_scale" else effect
        fields = BASE_CAUSES.get(cause, own)
        return self.problem.at_start(self.fit.vector, fields)

    def flight_errors(self, vector: np.ndarray) -> dict[str, float]:
        """Return the held-out errors of free flight by seconds; empty where none was judged.

        Of position, or of what the log has instead: attitude, or else rates.
        """
        if self.flight_test is None:
            return {}
        found = table_of(self.flight_test.tested(vector).rms()[0])
        keys = (
            f"{name}_{UNITS[name].replace('/', '_per_')}"
            for name in ("position", "attitude", "rates")
        )
        return next((found[key] for key in keys if key in found), {})


def windows_of(log: FlightLog, rows: np.ndarray, most: int = MAX_SCORED_WINDOWS) -> Windows | None:
    """Return windows over some rows of a log; None where there are none."""
    found = make_windows(log, rows, SPACING_S, most)
    if len(found.start) < WINDOWS_PER_BATCH:  # a chunk costs the same, full or not
        found = make_windows(log, rows, SHORT_SPACING_S, WINDOWS_PER_BATCH)
    return found if len(found.start) else None


def at_bounds(problem: Problem, vector: np.ndarray, fields: Sequence[str]) -> list[str]:
    """Return those parameters that are at the end of the range that is searched; shapes may be."""
    found = []
    for place in problem.indices_of(fields):
        effect, _, field = problem.names[place].partition(".")
        low, high, value = problem.low[place], problem.high[place], vector[place]
        room = 1e-6 * max(abs(value), 1.0)
        is_shape = bool(field) and field in BY_NAME[effect].search.shapes
        is_neutral = bool(field) and abs(value - problem.start[place]) <= room
        if not (is_shape or is_neutral) and not low + room < value < high - room:
            found.append(problem.names[place])
    return found


def widened(problem: Problem, fields: Sequence[str]) -> Problem:
    """Return the problem with twice the range for some parameters, but not for remembered delays.

    What is not negative stays so; what is one-sided stays one-sided.
    """
    low, high = problem.low.copy(), problem.high.copy()
    for name, place in zip(fields, problem.indices_of(fields), strict=True):
        effect, _, field = name.partition(".")
        if not field or field in BY_NAME[effect].max_steps:
            continue
        width = high[place] - low[place]
        if low[place] < problem.start[place]:
            low[place] = low[place] - width if low[place] < 0.0 else 0.2 * low[place]
        high[place] += width if high[place] > problem.start[place] else 0.0
    return replace(problem, low=low, high=high)


def refine(
    state: SearchState,
    base: FittedModel,
    model: FittedModel,
    log: FlightLog,
    held_out: np.ndarray,
    is_explained: bool,
) -> Refined:
    """Return which effects of a model predict held-out flights better, and their values.

    base, model: those from one-step residuals. held_out: (num_rows,) bool. is_explained: one-step
    residuals leave noise only; the model is then the most likely one already, and stands as long as
    it predicts no horizon worse than the base.
    """
    learnt, held_out_windows = (
        windows_of(log, ~held_out, MAX_FITTED_WINDOWS),
        windows_of(log, held_out),
    )
    problem, candidates, extended = state.problem, model.candidates, model.vector
    as_found = Refined(candidates, None, None, (), {}, problem, None)
    if learnt is None or held_out_windows is None:
        return as_found
    flight_test = FlightTest.of(problem, learnt, held_out_windows, base.vector).seeing(extended)
    as_found = as_found._replace(flight_test=flight_test)
    if not candidates or not flight_test.is_known.any():
        return as_found
    acting = _acting(problem, _probed(problem, extended, candidates), candidates, learnt)
    found = _Refinement(
        flight_test, learnt, base.vector, tuple(state.base_indices), acting, is_explained
    )
    is_at_bound = bool(at_bounds(problem, extended, found.fields_of(candidates)))
    if is_explained and not is_at_bound and not flight_test.is_surely_worse(extended):
        return as_found
    return found.run(extended, as_found)


class _Refinement(NamedTuple):
    """What the steps of a refinement share.

    acting: the effects that change how a model predicts: not those of sensors that windows do not
    see, whose values stay as they are. is_explained: as in ``refine``.
    """

    flight_test: FlightTest
    learnt: Windows
    base: np.ndarray
    base_indices: tuple[int, ...]
    acting: tuple[str, ...]
    is_explained: bool

    def fields_of(self, candidates: Sequence[Candidate]) -> list[str]:
        """Return the parameters of effects that act on the windows."""
        return [name for one in candidates if one.effect in self.acting for name in one.fields]

    def target(self, problem: Problem) -> Target:
        """Return what is fitted: cells that are evidence, and short horizons."""
        scale = errors_at(problem, self.base[None], self.learnt).scale
        is_short = (np.array(HORIZONS_S) <= ALWAYS_FITTED_S)[:, None]
        return Target(problem, self.learnt, scale, self.flight_test.matters | is_short)

    def indices(self, problem: Problem, candidates: Sequence[Candidate]) -> list[int]:
        """Return the free indices that act on the windows."""
        own = [place for place in self.base_indices if problem.names[place] != DRAIN]
        return own + problem.indices_of(self.fields_of(candidates))

    def run(self, extended: np.ndarray, as_found: Refined) -> Refined:
        """Return the refined model with the effects that held-out prediction needs."""
        problem, candidates = as_found.problem, as_found.kept
        target = self.target(problem)
        indices = self.indices(problem, candidates)
        fit = target.fitted(extended, indices, MAX_ROUNDS)
        probed = _probed(problem, fit.vector, candidates)
        if np.any(probed != fit.vector):  # single steps left a parameter where it has no slope
            other = target.fitted(probed, indices, MAX_ROUNDS)
            both = np.stack([fit.vector, other.vector])
            fit = (fit, other)[int(np.argmin(target.cost(target.residuals(both), both)))]
        stuck = at_bounds(problem, fit.vector, self.fields_of(candidates))
        if stuck:
            problem = widened(problem, stuck)
            target = target._replace(problem=problem)
            fit = target.fitted(fit.vector, fit.indices, MAX_ROUNDS)
        flight_test = self.flight_test.seeing(fit.vector)
        base = target.fitted(self.base, self.indices(problem, ()), MAX_ROUNDS).vector
        found = as_found._replace(fit=fit, base=base, problem=problem, flight_test=flight_test)
        return self._eliminate(found, target)

    def _eliminate(self, found: Refined, target: Target) -> Refined:
        """Return the model without effects that are not needed, or that make any horizon worse."""
        assert found.fit is not None and found.flight_test is not None
        flight_test, fit, without = found.flight_test, found.fit, {}
        kept = [one for one in found.kept if not _is_neutral(found.problem, fit.vector, one.fields)]
        removed = [one.effect for one in found.kept if one not in kept]
        while any(one.effect in self.acting for one in kept):
            tried = [one for one in kept if one.effect in self.acting]
            fits = [self._without(target, fit, kept, one) for one in tried]
            losses = flight_test.losses(fit.vector, *(one.vector for one in fits))
            sure = np.array([sureness(one - losses[0]) for one in losses[1:]])
            worth = np.sqrt(losses[1:].sum(axis=1) / losses[0].sum()) - 1.0
            needed = np.where(
                (worth >= WORTHWHILE) & (sure >= LIKELY), np.maximum(sure, SURE), sure
            )
            needed[:] = needed if flight_test.matters.any() else np.inf  # nothing that could tell
            without = {one.effect: less.vector for one, less in zip(tried, fits, strict=True)}
            if self.is_explained and not flight_test.is_surely_worse(fit.vector):
                break
            weakest = int(np.argmin(needed))
            if needed[weakest] >= SURE:
                if flight_test.worst_ratio(fit.vector) < 1.0:
                    break
                weakest = int(np.argmin([flight_test.worst_ratio(one.vector) for one in fits]))
            kept.remove(tried[weakest])
            removed.append(tried[weakest].effect)
            indices = self.indices(target.problem, kept)
            fit = target.fitted(fits[weakest].vector, indices, MAX_ROUNDS)
        if not any(
            one.effect in self.acting for one in kept
        ):  # the base as single steps have it stands
            return found._replace(kept=tuple(kept), fit=None, removed=tuple(removed), without={})
        return found._replace(kept=tuple(kept), fit=fit, removed=tuple(removed), without=without)

    def _without(self, target: Target, fit: Fit, kept: Sequence[Candidate], one: Candidate) -> Fit:
        vector = target.problem.at_start(fit.vector, one.fields)
        rest = [other for other in kept if other is not one]
        return target.fitted(vector, self.indices(target.problem, rest), REFIT_ROUNDS)


def _acting(
    problem: Problem, vector: np.ndarray, candidates: Sequence[Candidate], windows: Windows
) -> tuple[str, ...]:
    """Return the effects that change how a model predicts."""
    without = [problem.at_start(vector, one.fields) for one in candidates]
    found = errors_at(problem, np.stack([vector, *without]), windows).errors
    changes = np.abs(found[1:] - found[0]).max(axis=(1, 2, 3, 4))
    return tuple(
        one.effect for one, change in zip(candidates, changes, strict=True) if change > 0.0
    )


def _is_neutral(problem: Problem, vector: np.ndarray, fields: Sequence[str]) -> bool:
    """Return whether parameters are nominal, apart from those that only shape what others do."""
    own = [
        name
        for name in fields
        if name.split(".")[1] not in BY_NAME[name.split(".")[0]].search.shapes
    ]
    indices = problem.indices_of(own)
    return bool(np.all(np.abs(vector - problem.start)[indices] < NEUTRAL * problem.scale[indices]))


def _probed(problem: Problem, vector: np.ndarray, candidates: Sequence[Candidate]) -> np.ndarray:
    """Return the vector with those probed parameters that are still neutral at their probes."""
    result = vector.copy()
    for probe in (probe for one in candidates for probe in one.probes):
        if _is_neutral(problem, vector, [probe.field]):
            result[problem.names.index(probe.field)] = probe.value
    return result


def table_of(tested: np.ndarray) -> dict[str, dict[str, float]]:
    """Return rms errors, (horizons, quantities), by quantity with its unit and by seconds."""
    return {
        f"{quantity}_{UNITS[quantity].replace('/', '_per_')}": {
            f"{horizon:g}": float(value)
            for horizon, value in zip(HORIZONS_S, tested[:, index], strict=True)
            if np.isfinite(value)
        }
        for index, quantity in enumerate(QUANTITIES)
        if np.isfinite(tested[:, index]).any()
    }


def reduced(selection: Selection, refined: Refined) -> Selection:
    """Return the selection with only the effects that a refinement kept; the base if it kept none.

    Where none was fitted to flights, as sensors that flights do not see, single steps decide; the
    base alone stands where it flies better.
    """
    model = selection.model
    if refined.fit is not None:
        if refined.kept == model.candidates:
            return selection
        return selection._replace(
            model=model._replace(candidates=refined.kept, indices=refined.fit.indices)
        )
    if refined.kept:
        kept = selection if refined.kept == model.candidates else _narrowed(selection, refined.kept)
        if not _flies_worse(kept, refined.flight_test):
            return kept
    state, base = selection.state, selection.base
    # What an effect that is gone held at nominal is free again, as it was when the base was fitted.
    held = tuple(
        one for one in state.held if state.problem.names.index(one.field) not in base.indices
    )
    return selection._replace(state=replace(state, held=held), model=base)


def _narrowed(selection: Selection, kept: Sequence[Candidate]) -> Selection:
    """Return the selection with some of its effects, fitted to single steps again."""
    state, model = selection.state, selection.model
    removed = [one.effect for one in model.candidates if one not in kept]
    state = replace(state, held=tuple(one for one in state.held if one.effect not in removed))
    model = state.fitted(kept, state.problem.without(model.vector, removed))
    state, linearization = state.linearized(model.vector)
    ablations = ablate_all(state, model, linearization)
    return selection._replace(state=state, model=model, ablations=ablations)


def _flies_worse(selection: Selection, flight_test: FlightTest | None) -> bool:
    """Return whether a model predicts held-out flights worse than its base does.

    The model is the one after its last change within the log.
    """
    if flight_test is None:
        return False
    vector = selection.state.problem.without(selection.model.vector, ended(selection))
    if selection.unexplained.flagged:
        return flight_test.worst_ratio(vector) >= 1.0
    return flight_test.is_surely_worse(vector)
