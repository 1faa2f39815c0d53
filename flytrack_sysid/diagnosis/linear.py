"""A log seen from one model: what each parameter would change, to first order, and how sure that is."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from flytrack_sysid.diagnosis.candidates import CANDIDATES, Candidate, opened
from flytrack_sysid.diagnosis.problem import Problem, Sums, sums_of

# A direction of which the others leave less than this share is not told apart from them.
LEAST_OWN_SHARE = 1e-7


class Gain(NamedTuple):
    """What freeing some parameters besides others would gain.

    chi2: in minus twice the log likelihood. inflation: of its variance, where residuals of a second hang
    together. step: of the parameters. information: about those that others do not do, what others explain
    taken out.
    """

    chi2: float
    inflation: float
    step: np.ndarray
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
    """Sums over blocks of all columns at one vector: every parameter that may be free, and every probe.

    vector: the model. places: parameters of the columns. probes: candidates of further columns, whose step
    is the share of the way to the probe.
    """

    def __init__(
        self, problem: Problem, vector: np.ndarray, places: Sequence[int], probes: Sequence[Candidate]
    ):
        self.problem, self.vector = problem, vector
        self.places, self.probes = list(places), list(probes)
        others = np.array([opened(problem, vector, probe) for probe in self.probes]).reshape(-1, len(vector))
        left, slopes = problem.slopes(vector, self.places, others)
        self.sums: Sums = sums_of(left, slopes)
        prior = np.concatenate([prior_information(problem)[self.places], np.full(len(self.probes), 1e-2)])
        self.prior = prior
        self.total = self.sums.information.sum(axis=0) + np.diag(prior)
        pull = prior_information(problem)[self.places] * (vector - problem.start)[self.places]
        pull = np.concatenate([pull, np.zeros(len(self.probes))])
        self.score = self.sums.score.sum(axis=0) - pull
        known = prior_information(problem) * (vector - problem.start) ** 2
        self.cost = self.sums.square + float(known.sum())

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

    def step(self, columns: Sequence[int]) -> np.ndarray:
        """Return the step along columns that explains most, nothing else moving."""
        columns = list(columns)
        return solve(self.total[np.ix_(columns, columns)], self.score[columns])

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
        blocks = self.sums.score[:, columns] - self.sums.information[:, columns][:, :, columns] @ both
        blocks = blocks[:, len(given) :] - blocks[:, : len(given)] @ share
        whole = np.zeros(len(every))
        whole[[every.index(column) for column in added]] = step
        return Gain(float(score @ step), inflation_of(own, blocks), whole, own)

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
    """Return how much more scores of blocks, (blocks, count), vary than their information says; at least 1."""
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


PROBES = [candidate for candidate in CANDIDATES if candidate.probe is not None]
