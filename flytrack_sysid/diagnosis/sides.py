"""What smooth features of a flight would explain of one side of a residual: rotation, or force."""

import numpy as np

from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.linear import inflation_of, solve
from flytrack_sysid.diagnosis.problem import Problem, blocks_of, robust_weight
from flytrack_sysid.diagnosis.regressors import SIDES, Flown, flown
from flytrack_sysid.diagnosis.search import Found
from flytrack_sysid.parameters import TAUS

RIDGE = 1e-6  # of each column's own: features are nearly dependent where little was flown


def whitened(problem: Problem, features_w: np.ndarray, side: str) -> np.ndarray:
    """Return what features (count, rows, lanes, 3) would leave, whitened, of a side's axes."""
    step_s = noises.step_to(problem.lanes)[..., None]
    joined = features_w * problem.lanes.is_joined[..., None]
    return problem.whiten(np.stack([joined, joined * step_s], axis=-1), SIDES[side])


def flight_of(problem: Problem, found: Found) -> Flown:
    """Return what was flown, with the lags that were found."""
    return flown(problem.lanes, found.vector[problem.index(TAUS)])


def seen(problem: Problem, found: Found) -> tuple[np.ndarray, np.ndarray]:
    """Return what a model leaves, and its slopes along what is free, whitened."""
    slopes = problem.slopes(found.vector, found.places)
    return problem.whiten(slopes.left[None])[0], problem.whiten(slopes.columns)


class Side:
    """Sums of one side's axes: what is given (columns of the model), residual, and features as they come."""

    def __init__(self, problem: Problem, side: str, left: np.ndarray, slopes: np.ndarray):
        axes = SIDES[side]
        self.left = left[..., axes, :]
        self.root = np.sqrt(robust_weight(self.left))
        self.rest = blocks_of(self.left * self.root)
        given = slopes[..., axes, :]
        acting = np.abs(given).reshape(len(given), -1).max(axis=1) > 0.0
        self.given = blocks_of(given[acting] * self.root)

    def _beside(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return shares of what is given in columns, information and score with those taken out."""
        across = np.einsum("bgn,bfn->gf", self.given, columns, optimize=True)
        inner = np.einsum("bgn,bhn->gh", self.given, self.given, optimize=True)
        inner += RIDGE * np.diag(np.maximum(np.diag(inner), 1.0))
        share = solve(inner, across)
        total = np.einsum("bfn,bhn->fh", columns, columns, optimize=True)
        own = total - across.T @ share + RIDGE * np.diag(np.diag(total))
        given = np.einsum("bgn,bn->g", self.given, self.rest, optimize=True)
        self.from_given = solve(inner, given)
        return share, own, np.einsum("bfn,bn->f", columns, self.rest, optimize=True) - share.T @ given

    def gain(self, columns: np.ndarray) -> tuple[float, float, np.ndarray]:
        """Return chi2 of features besides what is given, its inflation, and their coefficients."""
        share, own, score = self._beside(columns)
        own += np.eye(len(own))  # features of size 1 that nothing asks for
        step = solve(own, score)
        given = self.from_given - share @ step
        after = self.rest - np.einsum("bfn,f->bn", columns, step) - np.einsum("bgn,g->bn", self.given, given)
        blocks = np.einsum("bfn,bn->bf", columns, after) - np.einsum("bgn,bn->bg", self.given, after) @ share
        return float(score @ step), inflation_of(own, blocks), step

    def best_group(self, columns: np.ndarray, size: int) -> int:
        """Return which group of so many features in a row explains most, each for itself."""
        _, own, score = self._beside(columns)
        groups = range(len(score) // size)
        inner = [slice(group * size, (group + 1) * size) for group in groups]
        chi2 = [score[part] @ solve(own[part, part] + np.eye(size), score[part]) for part in inner]
        return int(np.argmax(chi2))

    def lambda_of(self, columns: np.ndarray, size: np.ndarray) -> float:
        """Return the squared signature of slopes at a size, fitted again beside what is given."""
        _, own, score = self._beside(columns)
        again = size - solve(own, score)
        return float(again @ own @ again)
