"""The score test: the first-order gain of freeing parameters, from one linearization of a log.

A ``Linearization`` has a model's whitened residuals and their slopes along every parameter, summed
over blocks of a second. Gains are divided by ``inflation``: the variance of the scores of blocks
over that of independent rows.
"""

import copy
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg, optimize, stats

from flytrack_env.effects import BY_NAME, EFFECTS, Effect, takes_motors
from flytrack_sysid.inference.parameters import (
    DRAIN,
    TAUS,
    THRUST_COEFFS,
    fields_of_sticks,
    neutral_value,
    range_of,
)
from flytrack_sysid.inference.problem import (
    SEARCHED,
    Problem,
    Slopes,
    merge_seconds,
    robust_square,
    robust_weight,
    split_seconds,
)

FALSE_POSITIVE_RATE = 1e-4  # that an absent effect is named, for each effect
FALSE_CHANGE_RATE = 1e-5  # that an effect changes within a log although none does, for each effect
MIN_SIDE_FRACTION = 0.04  # of a log on each side of a change
# A direction cannot be told from others that explain all but this share of it.
MIN_INDEPENDENT_FRACTION = 1e-7
AT_BOUND = 1e-9  # of a parameter, or absolutely: this near to a bound it is there
# Relative change of a parameter with probes within which its slope holds.
SAME_SLOPE = 0.1
PROBE_PRIOR = 1e-2  # prior: a step is shorter than ten times the way to the probe
# Names of causes in the base, and the parameters of each.
BASE_CAUSES = {
    **{name: (name,) for name in TAUS},
    "thrust_curve": THRUST_COEFFS,
    "battery_drain": (DRAIN,),
}

# The same with those of the effects of a craft, which a model has or has not.
ALL_BASE_CAUSES = {
    **BASE_CAUSES,
    **{
        name: tuple(f"{effect.name}.{field}" for field in fields)
        for effect in EFFECTS
        for name, fields in effect.search.base_causes.items()
    },
}


def base_fields(cause: str) -> tuple[str, ...]:
    """Return the base parameters of a cause; none if it is an effect of its own.

    Those of a scale of thrust, which is one factor between two curves, are the curve's.
    """
    return ALL_BASE_CAUSES.get("thrust_curve" if cause == "thrust_scale" else cause, ())


class Probe(NamedTuple):
    """A value of a parameter at which the search looks for an effect.

    Attributes:
        field: the parameter, ``effect.parameter``.
        value: of the parameter.
    """

    field: str
    value: float

    @property
    def is_one_way(self) -> bool:
        """Whether the parameter's range begins at its neutral value."""
        return range_of(self.field).low == neutral_value(self.field)

    def placed_in(self, problem: Problem, vector: np.ndarray) -> np.ndarray:
        """Return the vector with the probe in place."""
        vector = vector.copy()
        vector[problem.names.index(self.field)] = self.value
        return vector


class Candidate(NamedTuple):
    """An effect and one parameterization of it.

    Attributes:
        effect: its name.
        fields: ``effect.parameter`` names that are freed.
        probes: of the fields that have no slope at neutral; each may lie at another share of its
            way.
    """

    effect: str
    fields: tuple[str, ...]
    probes: tuple[Probe, ...] = ()

    @property
    def num_priced(self) -> int:
        """The number of parameters that count; not those that only shape what others do."""
        shapes = [f"{self.effect}.{field}" for field in BY_NAME[self.effect].search.shapes]
        return sum(field not in shapes for field in self.fields)

    @property
    def groups(self) -> list[tuple[str, ...]]:
        """Its fields, grouped by what changes together; several groups of independent settings."""
        fields = set(self.fields)
        contained = [
            group.fields
            for group in list_candidates(BY_NAME[self.effect])
            if fields.issuperset(group.fields)
        ]
        largest = [
            group
            for group in contained
            if not any(set(group) < set(larger) for larger in contained)
        ]
        return largest if BY_NAME[self.effect].search.is_setting else [self.fields]

    def excludes(self, other: "Candidate") -> bool:
        """Return whether a model can have only one of two candidates.

        Candidates of one effect exclude each other, except settings that no group connects.
        """
        if self.effect != other.effect or not BY_NAME[self.effect].search.is_setting:
            return self.effect == other.effect
        fields, other_fields = {*self.fields}, {*other.fields}
        return any(
            fields & family and other_fields & family
            for family in find_families(BY_NAME[self.effect])
        )

    @property
    def other_fields(self) -> tuple[str, ...]:
        """Its fields without those of the probes."""
        return tuple(field for field in self.fields if field not in dict(self.probes))


def list_candidates(effect: Effect) -> list[Candidate]:
    """Return the candidates of an effect."""
    candidates = []
    for group in effect.search.groups or (tuple(effect.ranges),):
        fields = tuple(f"{effect.name}.{field}" for field in group)
        probes_by_field = [
            [Probe(f"{effect.name}.{field}", value) for value in effect.search.probes[field]]
            for field in group
            if field in effect.search.probes
        ]
        combinations = zip(*probes_by_field, strict=True) if probes_by_field else [()]
        candidates += [Candidate(effect.name, fields, probes) for probes in combinations]
    return candidates


def find_families(effect: Effect) -> list[set[str]]:
    """Return sets of parameters that groups connect: one weak motor, say, or another, or two."""
    families: list[set[str]] = []
    for candidate in list_candidates(effect):
        family = {*candidate.fields}
        family |= set().union(*(known for known in families if known & family))
        families = [*(known for known in families if not known & family), family]
    return families


CANDIDATES = [candidate for effect in SEARCHED for candidate in list_candidates(effect)]


def searched_in(problem: Problem) -> list[str]:
    """Return the names of the effects that are looked for, in the order of the list.

    What acts on sticks and on the rates that follow them is not part of a craft whose motors are
    commanded. A scale of its force alone is an exact twin of ``motors.load``.
    """
    if not takes_motors(problem.like.effects):
        return [effect.name for effect in SEARCHED]
    unknown = fields_of_sticks(problem.like)
    return [
        effect.name
        for effect in SEARCHED
        if not unknown.issuperset(f"{effect.name}.{field}" for field in effect.ranges)
        and effect.name != "thrust_scale"
    ]


def candidates_for(problem: Problem) -> list[Candidate]:
    """Return the candidates: effects of the list, and settings of the craft that may change."""
    searched = searched_in(problem)
    unknown = fields_of_sticks(problem.like)
    given = [BY_NAME[name] for name in problem.given_effects if BY_NAME[name].search.is_setting]
    return [
        *(
            candidate
            for candidate in CANDIDATES
            if candidate.effect in searched and unknown.isdisjoint(candidate.fields)
        ),
        *(
            candidate
            for effect in given
            if effect.search.groups
            for candidate in list_candidates(effect)
        ),
    ]


def threshold(num_parameters: int) -> float:
    """Return the gain of chi2 above which an effect with this number of parameters is named."""
    return float(stats.chi2.isf(FALSE_POSITIVE_RATE, num_parameters))


def change_threshold(
    num_parameters: int, trimmed: float = MIN_SIDE_FRACTION, chance: float = FALSE_CHANGE_RATE
) -> float:
    """Return the gain of chi2 above which an effect changes at some time within a log.

    Without a change, the largest gain of all times (sup-LM) exceeds it with probability ``chance``.

    Source: Andrews 1993, section 5. The tail is that of D. DeLong (Communications in Statistics 10,
    1981).

    Args:
        num_parameters: that change.
        trimmed: share of the log on each side in which no change is searched for.
        chance: the probability.
    """
    span = 2.0 * np.log((1.0 - trimmed) / trimmed)

    def excess(size: float) -> float:
        crossings = (size - num_parameters) * span + 2.0
        return float(stats.chi2.logpdf(size, num_parameters) + np.log(crossings) - np.log(chance))

    lowest = float(stats.chi2.isf(chance, num_parameters))
    return float(optimize.brentq(excess, lowest, 10.0 * lowest + 100.0))


class Gain(NamedTuple):
    """The gain of freeing some parameters besides given ones.

    Attributes:
        chi2: the gain in minus twice the log likelihood.
        inflation: of its variance, where residuals within a second are correlated.
        step: of the freed parameters.
        given_step: of the given ones, along with it.
        information: about the parameters that given ones cannot replace, with the given ones
            projected out.
    """

    chi2: float
    inflation: float
    step: np.ndarray
    given_step: np.ndarray
    information: np.ndarray

    @property
    def num_parameters(self) -> int:
        """The number of parameters that the log determines."""
        return len(self.information)

    @property
    def robust(self) -> float:
        """The gain over its inflation."""
        return self.chi2 / self.inflation


class Linearization:
    """A model's residuals and their slopes along columns: parameters, and ways to probes.

    The slopes may be those of a nearby model.

    Attributes:
        vector: the model.
        indices: parameters of the first columns.
        probes: of the further columns, whose step is the share of the way to the probe.
        columns: whitened slopes, (CHUNK_S, chunks, columns, numbers).
    """

    def __init__(self, problem: Problem, slopes: Slopes, probes: Sequence[Probe] = ()):
        self.problem, self.slopes, self.noise = problem, slopes, problem.noise
        self.indices, self.probes = list(slopes.indices), list(probes)
        self.prior = np.concatenate(
            [prior_information(problem)[self.indices], np.full(len(self.probes), PROBE_PRIOR)]
        )
        self.columns = split_seconds(problem.whiten(slopes.columns))
        white = problem.whiten(slopes.residuals[None])[0]
        root = np.sqrt(robust_weight(split_seconds(white)))[:, :, None]
        # Second by second: a copy of all columns is the most memory that a diagnosis takes.
        weighted = (columns * by_row for columns, by_row in zip(self.columns, root, strict=True))
        self.by_block = np.concatenate([part @ np.swapaxes(part, 1, 2) for part in weighted])
        self.total = self.by_block.sum(axis=0) + np.diag(self.prior)
        self._move(slopes.vector, white)

    def _move(self, vector: np.ndarray, white: np.ndarray) -> None:
        self.vector, self.white = vector, white
        weighted = split_seconds(white * robust_weight(white))[..., None]
        self.score_by_block = -merge_seconds(self.columns @ weighted)[..., 0]
        change = (vector - self.problem.start)[self.indices]
        prior_score = self.prior * np.append(change, np.zeros(len(self.probes)))
        self.score = self.score_by_block.sum(axis=0) - prior_score
        self.cost = compute_costs(self.problem, vector[None], white[None])[0]

    def moved(self, vector: np.ndarray, white: np.ndarray | None = None) -> "Linearization":
        """Return the linearization at a nearby model, with the slopes of this one.

        Args:
            vector: the nearby model.
            white: its whitened residuals, if they are known.
        """
        shifted = copy.copy(self)
        shifted._move(
            vector, self.problem.whitened_residuals(vector)[0] if white is None else white
        )
        return shifted

    def refreshed(self, indices: Sequence[int]) -> "Linearization":
        """Return the linearization with the slopes of this very model along some indices."""
        if np.array_equal(self.vector, self.slopes.vector):
            return self
        fresh = self.problem.slopes(self.vector, indices)
        columns = np.copy(self.slopes.columns)
        columns[self.columns_at(indices)] = fresh.columns
        slopes = Slopes(self.vector, fresh.residuals, self.slopes.indices, columns)
        return Linearization(self.problem, slopes, self.probes)

    def distance(self, vector: np.ndarray) -> float:
        """Return the distance of a model from that of the slopes, as a first-order chi2."""
        change = vector - self.slopes.vector
        indices = np.array(self.indices)
        fixed_change = np.delete(change, indices)
        probed = self.problem.parameter_indices(sorted({probe.field for probe in self.probes}))
        size = np.maximum(np.abs(vector), np.abs(self.slopes.vector))
        # First order cannot measure the distance along parameters without a slope.
        if np.any(fixed_change != 0.0) or np.any((np.abs(change) > SAME_SLOPE * size)[probed]):
            return np.inf
        end = len(indices)
        return float(change[indices] @ self.total[:end, :end] @ change[indices])

    def narrowed(self, indices: Sequence[int]) -> "Linearization":
        """Return the linearization along some of the indices only."""
        columns = self.columns_at(indices)
        narrow = copy.copy(self)
        narrow.indices, narrow.probes = list(indices), []
        narrow.prior, narrow.columns = self.prior[columns], self.columns[:, :, columns]
        narrow.by_block = self.by_block[:, columns][:, :, columns]
        narrow.score_by_block = self.score_by_block[:, columns]
        narrow.total, narrow.score = self.total[np.ix_(columns, columns)], self.score[columns]
        return narrow

    def of_blocks(self, is_chosen: np.ndarray) -> "Linearization":
        """Return what some blocks alone tell: their sums, with the residuals of all."""
        part = copy.copy(self)
        part.by_block, part.score_by_block = (
            self.by_block[is_chosen],
            self.score_by_block[is_chosen],
        )
        part.total = part.by_block.sum(axis=0) + np.diag(self.prior)
        part.score = part.score_by_block.sum(axis=0)
        return part

    def stepped(self, indices: Sequence[int]) -> tuple[np.ndarray, "Linearization"]:
        """Return the best step along indices, and what is left after it, to first order."""
        columns, after = self.columns_at(indices), copy.copy(self)
        step = self.step(columns)
        after.score_by_block = self.score_by_block - self.by_block[:, :, columns] @ step
        after.score = self.score - self.total[:, columns] @ step
        return step, after

    def column(self, name: str) -> int:
        """Return the column of a parameter."""
        return self.indices.index(self.problem.names.index(name))

    def columns_at(self, indices: Sequence[int], without: Sequence[int] = ()) -> list[int]:
        """Return the columns of indices in the vector, except some columns."""
        columns = [self.indices.index(index) for index in indices]
        return [column for column in columns if column not in without]

    def columns_of(self, candidate: Candidate) -> list[int]:
        """Return a candidate's columns: those of its probes, then those of its other parameters."""
        probe_columns = [self.probe_column(probe) for probe in candidate.probes]
        return probe_columns + [self.column(field) for field in candidate.other_fields]

    def probe_column(self, probe: Probe) -> int:
        """Return the column of the way to a probe."""
        return len(self.indices) + self.probes.index(probe)

    def acting(self, columns: Sequence[int]) -> list[int]:
        """Return the columns that change the residuals."""
        return [
            column for column in columns if self.total[column, column] > 2.0 * self.prior[column]
        ]

    def step(self, columns: Sequence[int]) -> np.ndarray:
        """Return the step along columns that explains most, with all others fixed."""
        return solve(self.total[np.ix_(columns, columns)], self.score[columns])

    def step_inside(self) -> np.ndarray:
        """Return the best step along all indices within bounds; parameters stuck at one stay."""
        return step_inside(
            self.problem,
            self.vector,
            self.indices,
            lambda free: self.step(np.flatnonzero(free).tolist()),
        )

    def projected(
        self, columns: Sequence[int], given: Sequence[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return information about columns with given ones projected out, and the projection.

        Returns:
            The information (columns, columns), and the shares of the given columns in the others
            (given, columns).
        """
        across = self.total[np.ix_(given, columns)]
        share = solve(self.total[np.ix_(given, given)], across)
        return self.total[np.ix_(columns, columns)] - across.T @ share, share

    def gain(self, added: Sequence[int], given: Sequence[int]) -> Gain | None:
        """Return the gain of freeing ``added`` besides ``given`` columns; None if these suffice.

        Columns that the given ones nearly replace are left out, and their step is 0.
        """
        given, columns = list(given), list(added)
        added = self._own(columns, given)
        if not added:
            return None
        freed_gain = self.freed(added, given)
        step = np.zeros(len(columns))
        step[[columns.index(column) for column in added]] = freed_gain.step
        return freed_gain._replace(step=step)

    def freed(self, added: list[int], given: list[int]) -> Gain:
        """Return the gain of freeing ``added`` columns besides ``given`` ones.

        None of them may nearly replace another.
        """
        information, share = self.projected(added, given)
        score = self.score[added] - share.T @ self.score[given]
        step = solve(information, score)
        alone = solve(self.total[np.ix_(given, given)], self.score[given])
        joint, columns = np.concatenate([alone - share @ step, step]), given + added
        scores = self.score_by_block[:, columns] - self.by_block[:, columns][:, :, columns] @ joint
        scores = scores[:, len(given) :] - scores[:, : len(given)] @ share
        return Gain(
            float(score @ step),
            estimate_inflation(information, scores),
            step,
            joint[: len(given)],
            information,
        )

    def gain_of(self, candidate: Candidate, given: Sequence[int]) -> Gain | None:
        """Return the gain of a candidate; None if others replace it or no probe lies ahead.

        Parameters whose range begins at neutral do not move away from their probes: their step
        is 0.
        """
        columns = self.columns_of(candidate)
        probe_columns = columns[: len(candidate.probes)]
        one_way_columns = {
            self.probe_column(probe) for probe in candidate.probes if probe.is_one_way
        }
        kept = list(columns)
        while not probe_columns or set(kept) & set(probe_columns):
            gain = self.gain(kept, given)
            if gain is None:
                break
            steps = dict(zip(kept, gain.step, strict=True))
            forwards = [
                column for column in kept if column not in one_way_columns or steps[column] > 0.0
            ]
            if forwards == kept:
                return gain._replace(step=np.array([steps.get(column, 0.0) for column in columns]))
            kept = forwards
        return None

    def _own(self, columns: list[int], given: list[int]) -> list[int]:
        """Return the columns that given ones and earlier ones do not nearly replace."""
        kept: list[int] = []
        for column in columns:
            others = given + kept
            across = self.total[others, column]
            information = self.total[column, column] - across @ solve(
                self.total[np.ix_(others, others)], across
            )
            min_information = max(
                MIN_INDEPENDENT_FRACTION * self.total[column, column], 2.0 * self.prior[column]
            )
            if information > min_information:
                kept.append(column)
        return kept


def step_inside(
    problem: Problem,
    vector: np.ndarray,
    indices: Sequence[int] | np.ndarray,
    step_along: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    """Return the step along indices that stays within bounds; parameters stuck at one do not move.

    Args:
        problem: with the bounds.
        vector: where the step begins.
        indices: of the parameters that may move.
        step_along: returns the best step along the free ones, from a mask of the indices
            (num_indices,) bool.
    """
    indices = np.array(indices)
    low, high, current = problem.low[indices], problem.high[indices], vector[indices]
    tolerance = AT_BOUND * np.maximum(np.abs(current), 1.0)
    free, step = np.ones(len(indices), bool), np.zeros(len(indices))
    while free.any():
        step[:] = 0.0
        step[free] = step_along(free)
        stuck = free & (
            ((current <= low + tolerance) & (step < 0.0))
            | ((current >= high - tolerance) & (step > 0.0))
        )
        if not stuck.any():
            break
        free &= ~stuck
        step[stuck] = 0.0
    return step


def estimate_inflation(information: np.ndarray, scores: np.ndarray) -> float:
    """Return how much more scores vary than information says, at least 1.

    Args:
        information: (parameters, parameters).
        scores: (blocks, parameters).
    """
    used = np.abs(scores).sum(axis=1) > 0.0
    spread = scores[used].T @ scores[used]
    count = max(int(used.sum()), 2)
    ratio = np.trace(solve(information, spread)) / len(information) * count / (count - 1)
    return max(float(ratio), 1.0)


def solve(matrix: np.ndarray, right_side: np.ndarray) -> np.ndarray:
    """Return the solution of a positive semidefinite system, in the scale of its diagonal."""
    if len(matrix) == 0:
        return np.zeros((0, *right_side.shape[1:]))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * np.outer(scale, scale) + 1e-12 * np.eye(len(matrix))
    scaled_right = right_side * (scale if right_side.ndim == 1 else scale[:, None])
    solution = linalg.solve(scaled, scaled_right, assume_a="sym", check_finite=False)
    return solution * (scale if right_side.ndim == 1 else scale[:, None])


def prior_information(problem: Problem) -> np.ndarray:
    """Return the weak prior information about each parameter; it only keeps estimates finite."""
    finite = np.isfinite(problem.high - problem.low)
    width = np.where(finite, problem.high - problem.low, 0.0)
    return 1.0 / np.where(finite, width, 10.0 * problem.scale) ** 2


def compute_costs(problem: Problem, vectors: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Return minus twice the log likelihood of models plus their prior, (num_models,).

    Args:
        problem: the rows, with the noise.
        vectors: the models, (num_models, parameters).
        white: their whitened residuals.
    """
    prior = prior_information(problem) * (vectors - problem.start) ** 2
    return np.array([robust_square(innovations) for innovations in white]) + prior.sum(axis=1)
