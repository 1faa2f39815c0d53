"""Outliers by channel: isolated rows far beyond the noise, and more than chance explains.

They count by their size instead of its square (``problem.robust_weight``), so that a few do no
harm. They are still reported. Errors of a model last, so only runs of a few rows are outliers.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

from flytrack_sysid.diagnosis.result import CHANNELS, Outliers
from flytrack_sysid.inference.chunks import AXES
from flytrack_sysid.inference.noise import OUTLIER
from flytrack_sysid.inference.problem import Problem

MAX_RUN_LENGTH = 3  # rows: the whitening filter absorbs a part of an outlier and returns it later
FALSE_POSITIVE_RATE = 1e-6  # of this many outliers, if the noise is normal
MIN_ROW_FRACTION = 1e-3  # of rows: fewer have no effect


def find_outliers(problems: Sequence[Problem], vector: np.ndarray) -> dict[str, Outliers]:
    """Return the outliers of a model's residuals, by channel that has some.

    Args:
        problems: with a noise; their rows are counted together.
        vector: the model.
    """
    parts = [(problem.whitened_residuals(vector)[0], problem.counts) for problem in problems]
    result = {}
    for axes, names in zip(AXES, CHANNELS, strict=True):
        for side, name in enumerate(names):
            if name is None:
                continue
            counted = [counts[:, :, axes, side].any(axis=-1) for _, counts in parts]
            num_rows = sum(int(rows.sum()) for rows in counted)
            far = [np.abs(white[:, :, axes, side]).max(axis=-1) > OUTLIER for white, _ in parts]
            num_isolated = sum(_short_runs(rows) for rows in far)
            by_chance = num_rows * (axes.stop - axes.start) * 2.0 * stats.norm.sf(OUTLIER)
            if (
                num_isolated > MIN_ROW_FRACTION * num_rows
                and stats.poisson.sf(num_isolated - 1, by_chance) < FALSE_POSITIVE_RATE
            ):
                result[name] = Outliers(num_isolated, num_rows)
    return result


def _short_runs(is_far: np.ndarray) -> int:
    """Return the number of rows in runs of at most ``MAX_RUN_LENGTH``.

    Args:
        is_far: rows beyond the noise, (rows, chunks) bool.
    """
    edges = np.diff(np.pad(is_far, ((1, 1), (0, 0))).astype(int), axis=0)
    starts, ends = (np.argwhere(sign == edges.T)[:, 1] for sign in (1, -1))
    lengths = ends - starts
    return int(lengths[lengths <= MAX_RUN_LENGTH].sum())


def outlier_notes(outliers: Mapping[str, Outliers]) -> list[str]:
    """Return a sentence on the outliers, if there are any."""
    if not outliers:
        return []
    listed = ", ".join(
        f"{counts.rows} of {counts.of} rows of {name}" for name, counts in outliers.items()
    )
    return [f"outliers, beyond {OUTLIER:g} times the noise, count less: {listed}"]
