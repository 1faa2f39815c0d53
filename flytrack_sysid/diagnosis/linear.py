"""A log seen from one model: what each parameter would change, to first order, and how sure that is."""

import copy
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from flytrack_sysid.diagnosis.candidates import CANDIDATES, Candidate
from flytrack_sysid.diagnosis.problem import Problem, Slopes, blocks_of, robust_square, robust_weight

# A direction of which the others leave less than this share is not told apart from them.
LEAST_OWN_SHARE = 1e-7
AT_BOUND = 1e-9
PROBES = [candidate for candidate in CANDIDATES if candidate.probe is not None]
ALIKE = 0.1  # relative change of a parameter that is looked for at probes, in which its slope stays
PROBE_PRIOR = 1e-2  # a step to a probe is known to be less than ten times that


class Gain(NamedTuple):
    """What freeing some parameters besides others would gain.

    chi2: in minus twice the log likelihood. inflation: of its variance, where residuals of a second hang
    together. step: of the parameters. aside: of the others, along with it. information: about those that
    others do not do, what others explain taken out.
    """

    chi2: float
    inflation: float
    step: np.ndarray
    aside: np.ndarray
    information: np.ndarray

    @property
    def count(self) -> int:
        """How many parameters the log says something of."""
        return len(self.information)

    @property
    def robust(self) -> float:
        """The gain over the inflation."""
        return self.chi2 / self.inflation


class Outlook:
    """A model and, to first order, what every column would change: parameters, and ways to probes.

    vector: the model. places: parameters of the first columns. probes: candidates of further ones, whose
    step is the share of the way to the probe. columns: whitened, by blocks of a second. Slopes may be
    those at a model nearby (``at``).
    """

    def __init__(self, problem: Problem, slopes: Slopes, probes: Sequence[Candidate] = ()):
        self.problem, self.slopes, self.noise = problem, slopes, problem.noise
        self.places, self.probes = list(slopes.places), list(probes)
        self.prior = np.concatenate(
            [prior_information(problem)[self.places], np.full(len(self.probes), PROBE_PRIOR)]
        )
        self.columns = problem.whiten(slopes.columns)
        self.vector, self.white = slopes.vector, problem.whiten(slopes.left[None])[0]
        self._weigh()

    def _weigh(self) -> None:
        root = np.sqrt(robust_weight(self.white))
        weighed = blocks_of(self.columns * root)
        rest = blocks_of(self.white * root)
        self.by_block = weighed @ np.swapaxes(weighed, 1, 2)
        self.score_by_block = -np.einsum("bpn,bn->bp", weighed, rest, optimize=True)
        self.total = self.by_block.sum(axis=0) + np.diag(self.prior)
        self._rescore()

    def _rescore(self) -> None:
        pull = np.zeros(len(self.prior))
        pull[: len(self.places)] = (
            (self.prior[: len(self.places)]) * (self.vector - self.problem.start)[self.places]
        )
        self.score = self.score_by_block.sum(axis=0) - pull
        self.cost = cost_of(self.problem, self.vector[None], self.white[None])[0]

    def moved(self, vector: np.ndarray, white: np.ndarray) -> "Outlook":
        """Return the outlook from a model nearby, with the slopes of this one."""
        later = copy.copy(self)
        later.vector, later.white = vector, white
        root = np.sqrt(robust_weight(white))
        rest = blocks_of(white * root * root)
        later.score_by_block = -np.einsum("bpn,bn->bp", blocks_of(self.columns), rest, optimize=True)
        later._rescore()
        return later

    def distance(self, vector: np.ndarray) -> float:
        """Return by how much, to first order, a model differs from where slopes were taken, as a chi2."""
        change = vector - self.slopes.vector
        places = np.array(self.places)
        elsewhere = np.delete(change, places)
        sloping = self.problem.index(sorted({one.probe[0] for one in PROBES}))
        size = np.maximum(np.abs(vector), np.abs(self.slopes.vector))
        # Where there was no slope, none says how far away the model is.
        if np.any(elsewhere != 0.0) or np.any((np.abs(change) > ALIKE * size)[sloping]):
            return np.inf
        count = len(places)
        return float(change[places] @ self.total[:count, :count] @ change[places])

    def narrowed(self, places: Sequence[int]) -> "Outlook":
        """Return the outlook along some of the places only."""
        kept = [self.places.index(place) for place in places]
        later = copy.copy(self)
        later.places, later.probes = list(places), []
        later.prior, later.columns = self.prior[kept], self.columns[kept]
        later.by_block = self.by_block[:, kept][:, :, kept]
        later.score_by_block = self.score_by_block[:, kept]
        later.total, later.score = self.total[np.ix_(kept, kept)], self.score[kept]
        return later

    def column(self, name: str) -> int:
        """Return the column of a parameter."""
        return self.places.index(self.problem.names.index(name))

    def columns_of(self, candidate: Candidate) -> list[int]:
        """Return a candidate's columns: its probe's and those of its other parameters."""
        fields = [
            field for field in candidate.fields if candidate.probe is None or field != candidate.probe[0]
        ]
        columns = [self.column(field) for field in fields]
        if candidate.probe is not None:
            columns.insert(0, len(self.places) + self.probes.index(candidate))
        return columns

    def acting(self, columns: Sequence[int]) -> list[int]:
        """Return the columns that change anything."""
        return [column for column in columns if self.total[column, column] > 2.0 * self.prior[column]]

    def step(self, columns: Sequence[int]) -> np.ndarray:
        """Return the step along columns that explains most, nothing else moving."""
        columns = list(columns)
        return solve(self.total[np.ix_(columns, columns)], self.score[columns])

    def step_inside(self) -> np.ndarray:
        """Return the step along all places that explains most within bounds: what is stuck there stays."""
        problem, places = self.problem, np.array(self.places)
        low, high, now = problem.low[places], problem.high[places], self.vector[places]
        room = AT_BOUND * np.maximum(np.abs(now), 1.0)
        free, step = np.ones(len(places), bool), np.zeros(len(places))
        while free.any():
            step[:] = 0.0
            step[free] = self.step(np.flatnonzero(free))
            stuck = free & (((now <= low + room) & (step < 0.0)) | ((now >= high - room) & (step > 0.0)))
            if not stuck.any():
                break
            free &= ~stuck
            step[stuck] = 0.0
        return step

    def gain(self, added: Sequence[int], given: Sequence[int]) -> Gain | None:
        """Return what freeing ``added`` columns besides ``given`` ones gains; None where those do the same.

        Columns that those nearly do are left out, and their step is 0.
        """
        given, every = list(given), list(added)
        added = self._own(every, given)
        if not added:
            return None
        across = self.total[np.ix_(given, added)]
        inner = self.total[np.ix_(given, given)]
        share = solve(inner, across)
        own = self.total[np.ix_(added, added)] - across.T @ share
        score = self.score[added] - share.T @ self.score[given]
        step = solve(own, score)
        both = np.concatenate([solve(inner, self.score[given]) - share @ step, step])
        columns = given + added
        blocks = self.score_by_block[:, columns] - self.by_block[:, columns][:, :, columns] @ both
        blocks = blocks[:, len(given) :] - blocks[:, : len(given)] @ share
        whole = np.zeros(len(every))
        whole[[every.index(column) for column in added]] = step
        return Gain(float(score @ step), inflation_of(own, blocks), whole, both[: len(given)], own)

    def _own(self, columns: list[int], given: list[int]) -> list[int]:
        """Return the columns that are not what given ones, or those before them, nearly do."""
        kept: list[int] = []
        for column in columns:
            others = given + kept
            across = self.total[others, column]
            own = self.total[column, column] - across @ solve(self.total[np.ix_(others, others)], across)
            least = max(LEAST_OWN_SHARE * self.total[column, column], 2.0 * self.prior[column])
            if own > least:
                kept.append(column)
        return kept


def inflation_of(information: np.ndarray, scores: np.ndarray) -> float:
    """Return how much more scores of blocks, (blocks, count), vary than information says; at least 1."""
    used = np.abs(scores).sum(axis=1) > 0.0
    spread = scores[used].T @ scores[used]
    number = max(int(used.sum()), 2)
    ratio = np.trace(solve(information, spread)) / len(information) * number / (number - 1)
    return max(float(ratio), 1.0)


def solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solution of a positive semidefinite system, in the scale of its diagonal."""
    if len(matrix) == 0:
        return np.zeros((0, *right.shape[1:]))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * np.outer(scale, scale) + 1e-12 * np.eye(len(matrix))
    scaled_right = right * (scale if right.ndim == 1 else scale[:, None])
    found = linalg.solve(scaled, scaled_right, assume_a="sym", check_finite=False)
    return found * (scale if right.ndim == 1 else scale[:, None])


def prior_information(problem: Problem) -> np.ndarray:
    """Return what is known of each parameter beforehand: next to nothing, and enough to keep it finite."""
    finite = np.isfinite(problem.high - problem.low)
    width = np.where(finite, problem.high - problem.low, 0.0)
    return 1.0 / np.where(finite, width, 10.0 * problem.scale) ** 2


def cost_of(problem: Problem, vectors: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Return minus twice the log likelihood of models, and what is known beforehand, (count,)."""
    known = prior_information(problem) * (vectors - problem.start) ** 2
    return np.array([robust_square(one) for one in white]) + known.sum(axis=1)
