"""A log against all that a model could be: residuals, slopes and their sums, over blocks of a second.

One program evaluates 20 models at once, another four, each with every effect of the list; a model without
an effect has it at its neutral value. So no set of effects needs a compilation of its own.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME, EFFECTS, effect_of
from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.lanes import LANE_S, Lanes, lead_in_of
from flytrack_sysid.diagnosis.said import unexplained
from flytrack_sysid.parameters import TAUS, bounds_of, names_of, to_vector

BATCH, FEW = 20, 4
RELATIVE_STEP = 1e-6  # of a parameter's scale, for slopes


@jax.jit
def _left(vectors: jax.Array, like: ModelParameters, lanes: Lanes) -> jax.Array:
    """Return what models leave, (BATCH, rows, lanes, NUM_AXES, 2)."""
    return jax.vmap(lambda vector: unexplained(vector, like, lanes))(vectors)


@jax.jit
def _whitened(left: jax.Array, gains: noises.Gains, counts: jax.Array) -> jax.Array:
    return jax.vmap(lambda one: noises.innovations(gains, one, counts))(left)


_gains = jax.jit(noises.make_gains)


class Slopes(NamedTuple):
    """What a model leaves, (rows, lanes, NUM_AXES, 2), and how that changes, (count, ...), before whitening.

    places: of the first columns; ways to other vectors follow.
    """

    vector: np.ndarray
    left: np.ndarray
    places: tuple[int, ...]
    columns: np.ndarray


class Problem:
    """Judged rows of a log, and a noise; all parameters in one vector in the order of ``names``."""

    def __init__(self, lanes: Lanes, model: ModelParameters):
        # Those it has, and neutral ones.
        every = model.with_effects(*(model.effect(effect.name) for effect in EFFECTS))
        self.given_effects = tuple(effect_of(one).name for one in model.effects)
        self.like = jax.tree.map(lambda leaf: np.asarray(leaf, float), every)
        self.names = names_of(self.like)
        self.start = to_vector(self.like)
        self.lanes = lanes
        self.counts = lanes.counts
        self.low, self.high = np.array([bounds_of(name) for name in self.names]).T
        self.high = np.minimum(self.high, _longest(self.names, lanes))
        self.scale = np.array(
            [_scale(name, value) for name, value in zip(self.names, self.start, strict=True)]
        )
        self.noise: np.ndarray | None = None
        self.barred: tuple[str, ...] = ()  # effects that the log cannot be asked about
        self.refused: tuple[str, ...] = ()  # effects that were taken back, and are not to come again
        self.held: tuple[str, ...] = ()  # base parameters that stay nominal
        self.held_for: dict[str, tuple[str, ...]] = {}  # those, by the effect that made them needless
        self.last_outlook: Any = None  # ``linear.Outlook`` along everything: slopes are dear

    def set_noise(self, sought: np.ndarray) -> None:
        """Weigh from now on with this noise, (6, NUM_AXES)."""
        self.noise = sought
        step_s = noises.step_to(self.lanes)
        self.gains = _gains(noises.noise_of(sought), step_s, self.lanes.is_known, self.counts)

    def left(self, vectors: np.ndarray) -> np.ndarray:
        """Return what models (count, parameters) leave, (count, rows, lanes, NUM_AXES, 2)."""
        return self._in_batches(lambda part: _left(part, self.like, self.lanes), vectors)

    def whiten(self, left: np.ndarray, axes: slice = slice(None)) -> np.ndarray:
        """Return residuals (count, rows, lanes, NUM_AXES, 2), or of some axes, as innovations."""
        gains = noises.Gains(*(np.asarray(leaf)[..., axes] for leaf in self.gains))
        return self._in_batches(lambda part: _whitened(part, gains, self.counts[..., axes, :]), left)

    @staticmethod
    def _in_batches(tell: Callable[[np.ndarray], jax.Array], values: np.ndarray) -> np.ndarray:
        """Return what a program of fixed batch says of values, (count, ...)."""
        size = FEW if len(values) <= FEW else BATCH
        parts = []
        for begin in range(0, len(values), size):
            part = values[begin : begin + size]
            filled = np.concatenate([part, np.repeat(part[-1:], size - len(part), axis=0)])
            parts.append(np.asarray(tell(filled))[: len(part)])
        return np.concatenate(parts)

    def clipped(self, vectors: np.ndarray) -> np.ndarray:
        """Return vectors within bounds."""
        return np.clip(vectors, self.low, self.high)

    def slopes(self, vector: np.ndarray, places: Sequence[int], others: np.ndarray | None = None) -> "Slopes":
        """Return what a model leaves, its slopes along places, and the way to other vectors.

        One-sided differences, into the bounds: what an effect does may begin at its neutral value.
        """
        places = list(places)
        step = RELATIVE_STEP * self.scale[places]
        step = np.where(vector[places] + step > self.high[places], -step, step)
        moved = np.repeat(vector[None], len(places), axis=0)
        moved[np.arange(len(places)), places] += step
        others = np.zeros((0, len(vector))) if others is None else others
        found = self.left(np.concatenate([vector[None], moved, others]))
        away = found[1:] - found[0]
        away[: len(places)] /= step[:, None, None, None, None]
        return Slopes(vector, found[0], tuple(places), away)

    def index(self, names: Sequence[str]) -> list[int]:
        """Return the places of parameters in the vector."""
        return [self.names.index(name) for name in names]


def _longest(names: Sequence[str], lanes: Lanes) -> np.ndarray:
    """Return the longest value of parameters that are times: so many steps of the log as are remembered."""
    step_s = float(np.median(lanes.record.step_s))
    fields = [name.partition(".") for name in names]
    return np.array(
        [
            BY_NAME[effect].most_steps.get(field, np.inf) * step_s if field else np.inf
            for effect, _, field in fields
        ]
    )


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
    rows, lanes = values.shape[-4:-2]
    kept = values[..., lead_in_of(rows) :, :, :, :]
    second = kept.shape[-4] // LANE_S
    split = kept.reshape(*kept.shape[:-4], LANE_S, second, lanes, kept.shape[-2] * 2)
    return np.moveaxis(split, (-4, -2), (0, 1)).reshape(
        LANE_S * lanes, *kept.shape[:-4], second * kept.shape[-2] * 2
    )
