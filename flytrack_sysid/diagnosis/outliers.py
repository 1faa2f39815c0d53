"""Outliers by channel: isolated rows far beyond the noise, and more than chance brings about.

They count by their size instead of its square (``problem.robust_weight``), so that a few do no
harm; a reader has to know of them all the same. Errors of a model last, so only runs of a few rows
count.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

from flytrack_sysid.diagnosis.chunks import AXES
from flytrack_sysid.diagnosis.noise import OUTLIER
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.result import CHANNELS, Outliers

MAX_RUN_LENGTH = 3  # rows: the filter that whitens takes in part of an outlier and gives it back
FALSE_POSITIVE_RATE = 1e-6  # of so many, were the noise normal
MIN_ROW_FRACTION = 1e-3  # of rows: fewer change nothing


def outliers_of(problems: Sequence[Problem], vector: np.ndarray) -> dict[str, Outliers]:
    """Return the outliers of a model's residuals by channel, of those that have some.

    problems: with a noise; their rows are counted together.
    """
    parts = [(problem.whitened_residuals(vector)[0], problem.counts) for problem in problems]
    found = {}
    for axes, names in zip(AXES, CHANNELS, strict=True):
        for side, name in enumerate(names):
            if name is None:
                continue
            counted = [counts[:, :, axes, side].any(axis=-1) for _, counts in parts]
            number = sum(int(each.sum()) for each in counted)
            far = [np.abs(white[:, :, axes, side]).max(axis=-1) > OUTLIER for white, _ in parts]
            alone = sum(_short_runs(each) for each in far)
            by_chance = number * (axes.stop - axes.start) * 2.0 * stats.norm.sf(OUTLIER)
            if (
                alone > MIN_ROW_FRACTION * number
                and stats.poisson.sf(alone - 1, by_chance) < FALSE_POSITIVE_RATE
            ):
                found[name] = Outliers(alone, number)
    return found


def _short_runs(is_far: np.ndarray) -> int:
    """Return how many rows, (rows, chunks) bool, lie in runs of at most ``MAX_RUN_LENGTH``."""
    edges = np.diff(np.pad(is_far, ((1, 1), (0, 0))).astype(int), axis=0)
    starts, ends = (np.argwhere(sign == edges.T)[:, 1] for sign in (1, -1))
    lengths = ends - starts
    return int(lengths[lengths <= MAX_RUN_LENGTH].sum())


def outlier_notes(outliers: Mapping[str, Outliers]) -> list[str]:
    """Return a sentence on the outliers; none where there are none."""
    if not outliers:
        return []
    listed = ", ".join(f"{one.rows} of {one.of} rows of {name}" for name, one in outliers.items())
    return [f"outliers, beyond {OUTLIER:g} times the noise, count less: {listed}"]
