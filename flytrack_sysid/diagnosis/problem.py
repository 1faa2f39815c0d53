"""A log against all that a model could be: residuals, slopes and their sums, over blocks of a second.

One program evaluates 16 models at once, each with every effect of the list; a model without an effect has
it at its neutral value. So no set of effects needs a compilation of its own.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import EFFECTS
from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.lanes import LANE_ROWS, LEAD_IN_ROWS, Lanes
from flytrack_sysid.diagnosis.said import unexplained
from flytrack_sysid.parameters import TAUS, bounds_of, names_of, to_vector

BATCH = 16
BLOCK_ROWS = 100  # a second at 100 Hz: what hangs together at most
RELATIVE_STEP = 1e-6  # of a parameter's scale, for slopes


@jax.jit
def _left(vectors: jax.Array, like: ModelParameters, lanes: Lanes) -> jax.Array:
    """Return what models leave, (BATCH, rows, lanes, NUM_AXES, 2)."""
    return jax.vmap(lambda vector: unexplained(vector, like, lanes))(vectors)


@jax.jit
def _whitened(left: jax.Array, gains: noises.Gains, counts: jax.Array) -> jax.Array:
    return jax.vmap(lambda one: noises.innovations(gains, one, counts))(left)


_gains = jax.jit(noises.make_gains)


class Sums(NamedTuple):
    """Products of whitened slopes with each other and with the residual, by block, and its square.

    information: (blocks, count, count). score: (blocks, count). square: minus twice the log likelihood,
    outliers counted by their size. left: whitened residual, (rows, lanes, NUM_AXES, 2).
    """

    information: np.ndarray
    score: np.ndarray
    square: float
    left: np.ndarray


class Problem:
    """Judged rows of a log, and a noise; all parameters in one vector in the order of ``names``."""

    def __init__(self, lanes: Lanes, model: ModelParameters):
        every = model.with_effects(
            *(model.effect(effect.name) for effect in EFFECTS)
        )  # those it has, and neutral ones
        self.like = jax.tree.map(lambda leaf: np.asarray(leaf, float), every)
        self.names = names_of(self.like)
        self.start = to_vector(self.like)
        self.lanes = lanes
        self.counts = lanes.counts
        self.low, self.high = np.array([bounds_of(name) for name in self.names]).T
        self.scale = np.array(
            [_scale(name, value) for name, value in zip(self.names, self.start, strict=True)]
        )
        self.noise: np.ndarray | None = None

    def set_noise(self, sought: np.ndarray) -> None:
        """Weigh from now on with this noise, (6, NUM_AXES)."""
        self.noise = sought
        step_s = noises.step_to(self.lanes)
        self.gains = _gains(noises.noise_of(sought), step_s, self.lanes.is_joined, self.counts)

    def left(self, vectors: np.ndarray) -> jax.Array:
        """Return what models (count, parameters) leave, (count, rows, lanes, NUM_AXES, 2)."""
        parts = []
        for begin in range(0, len(vectors), BATCH):
            part = vectors[begin : begin + BATCH]
            filled = np.concatenate([part, np.repeat(part[-1:], BATCH - len(part), axis=0)])
            parts.append(np.asarray(_left(filled, self.like, self.lanes))[: len(part)])
        return np.concatenate(parts)

    def whitened(self, vectors: np.ndarray) -> np.ndarray:
        """Return innovations of models, (count, rows, lanes, NUM_AXES, 2)."""
        parts = []
        for begin in range(0, len(vectors), BATCH):
            part = vectors[begin : begin + BATCH]
            filled = np.concatenate([part, np.repeat(part[-1:], BATCH - len(part), axis=0)])
            left = _left(filled, self.like, self.lanes)
            parts.append(np.asarray(_whitened(left, self.gains, self.counts))[: len(part)])
        return np.concatenate(parts)

    def whiten(self, left: np.ndarray) -> np.ndarray:
        """Return residuals (BATCH, rows, lanes, NUM_AXES, 2) as innovations."""
        return np.asarray(_whitened(left, self.gains, self.counts))

    def clipped(self, vectors: np.ndarray) -> np.ndarray:
        """Return vectors within bounds."""
        return np.clip(vectors, self.low, self.high)

    def squares(self, vectors: np.ndarray) -> np.ndarray:
        """Return minus twice the log likelihood of models, (count,), without what is constant."""
        return np.array([robust_square(one) for one in self.whitened(vectors)])

    def slopes(
        self, vector: np.ndarray, places: Sequence[int], others: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return innovations at a vector, their slopes along places, and the way to other vectors.

        Slopes are (len(places) + len(others), rows, lanes, NUM_AXES, 2). One-sided differences, into the
        bounds: what an effect does may begin at its neutral value.
        """
        step = RELATIVE_STEP * self.scale[list(places)]
        step = np.where(vector[list(places)] + step > self.high[list(places)], -step, step)
        moved = np.repeat(vector[None], len(places), axis=0)
        moved[np.arange(len(places)), places] += step
        found = self.whitened(np.concatenate([vector[None], moved, others]))
        away = found[1:] - found[0]
        away[: len(places)] /= step[:, None, None, None, None]
        return found[0], away

    def index(self, names: Sequence[str]) -> list[int]:
        """Return the places of parameters in the vector."""
        return [self.names.index(name) for name in names]

    def values(self, vector: np.ndarray) -> Mapping[str, float]:
        """Return a vector's numbers by name."""
        return dict(zip(self.names, vector.tolist(), strict=True))


def _scale(name: str, value: float) -> float:
    """Return the size of a parameter that steps are measured by."""
    if "." in name:
        bounds = bounds_of(name)
        return 0.1 * (bounds.high - bounds.low)
    return abs(value) if name in TAUS else max(abs(value), 1.0)


def robust_weight(left: np.ndarray) -> np.ndarray:
    """Return weights by which outliers count by their size, not its square."""
    size = np.abs(left)
    return np.where(size > noises.OUTLIER, noises.OUTLIER / np.maximum(size, noises.OUTLIER), 1.0)


def robust_square(left: np.ndarray) -> float:
    """Return the sum of squares of innovations, outliers counted by their size."""
    size = np.abs(left)
    beyond = noises.OUTLIER * (2.0 * size - noises.OUTLIER)
    return float(np.where(size < noises.OUTLIER, size**2, beyond).sum())


def blocks_of(values: np.ndarray) -> np.ndarray:
    """Return (..., rows, lanes, axes, 2) as (blocks, ..., numbers), a second each, without the lead-in."""
    kept = values[..., LEAD_IN_ROWS:, :, :, :]
    pieces, lanes = LANE_ROWS // BLOCK_ROWS, kept.shape[-3]
    split = kept.reshape(*kept.shape[:-4], pieces, BLOCK_ROWS, lanes, -1)
    return np.moveaxis(split, (-4, -2), (0, 1)).reshape(pieces * lanes, *kept.shape[:-4], -1)


def sums_of(left: np.ndarray, slopes: np.ndarray) -> Sums:
    """Return the sums that every linear fit needs; ``left`` as a residual falls along ``-slopes``."""
    root = np.sqrt(robust_weight(left))

    of_slopes, of_left = blocks_of(slopes * root), blocks_of(left * root)
    information = of_slopes @ np.swapaxes(of_slopes, 1, 2)
    score = -np.einsum("bpn,bn->bp", of_slopes, of_left)
    return Sums(information, score, robust_square(left), left)
