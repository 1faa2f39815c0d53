"""A log and its possible models: residuals, slopes and whitening for parameter vectors.

One program replays pairs of a model and a chunk, some rows at a time, whatever the length, rate and
channels of a log. Each model has every effect of the list; a model without an effect has it at its
neutral value. So all sets of effects share one compilation.

========  ==============================================================================  =======
channel   residual of a row                                                               unit
========  ==============================================================================  =======
``w``     gyro minus the modelled rates, world frame                                      rad/s
``q``     turn since the row before minus the modelled turn, world frame                  rad
``f``     accelerometer minus the modelled specific force, world frame                    m/s^2
``v``     change of velocity since the row before minus the modelled change, world frame  m/s
``v_bat`` change of voltage since the row before minus the modelled change                V
========  ==============================================================================  =======
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from scipy import special

from flytrack_env.dynamics import ModelParameters, read_sensors
from flytrack_env.effects import BY_NAME, EFFECTS, LEARNED_LAW, Effect, LearnedLaw, effect_of
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.chunks import AXES, CHUNK_S, NUM_AXES, Chunks, count_lead_in
from flytrack_sysid.diagnosis.lateness import Late
from flytrack_sysid.parameters import TAUS, from_vector, names_of, range_of, to_vector
from flytrack_sysid.record import Record
from flytrack_sysid.replay import Step, replay, start_replay
from flytrack_sysid.trace_cache import keep_trace

# The effects that a replay can show of any craft. It is fed with poses, so their lateness has to be
# known before.
SEARCHED = tuple(
    effect for effect in EFFECTS if "pose" not in effect.hooks and not effect.search.is_setting
)
# Size of the compiled replay: pairs of a model and a chunk, and rows at a time.
NUM_PAIRS, NUM_ROWS = 32, 200
RELATIVE_STEP = 1e-6  # of a parameter's scale, for slopes


def _turn(measured: Quaternion, predicted: Quaternion) -> Vec3:
    """Return the small world-frame rotation from a predicted to a measured attitude, rad."""
    conjugate = Quaternion(predicted.w, -predicted.x, -predicted.y, -predicted.z)
    error = measured.multiply(conjugate)
    double = jnp.where(error.w < 0.0, -2.0, 2.0)
    return Vec3(double * error.x, double * error.y, double * error.z)


class Measured(NamedTuple):
    """Measurements at a row, (..., size).

    Attributes:
        quat: attitude.
        vel_w: velocity, world (m/s).
        battery_v: voltage (V).
        gyro_b: rates, body (rad/s); NaN where the log has none.
        force_b: specific force, body (m/s^2); 0 where there is no accelerometer.
    """

    quat: Any
    vel_w: Any
    battery_v: Any
    gyro_b: Any
    force_b: Any


class Rows(NamedTuple):
    """Rows of chunks, and measurements.

    Attributes:
        row: the rows.
        gyro_b: rates at the rows, body (rad/s).
        later: the measurements at the rows after them.
    """

    row: Record
    gyro_b: Any
    later: Measured


def _of_step(step: Step, measured: Measured) -> jax.Array:
    """Return the residuals of the row after a step, (NUM_AXES, 2)."""
    row, before, after = step.row, step.before, step.after
    sensors = read_sensors(step.moved, step.model)
    to_world = before.quat.rotate  # whatever attitude the sensors' force had
    rates = to_world(Vec3(*jnp.nan_to_num(measured.gyro_b)) - sensors.rates_b)
    turn = _turn(Quaternion(*measured.quat), after.quat)
    force = to_world(Vec3(*measured.force_b) - sensors.force_b)
    vel_change = Vec3(*measured.vel_w) - before.vel_w - after.acc_w.scale(row.step_s)
    voltage_change = measured.battery_v - after.battery_v
    direct, level = (*rates, *force, 0.0), (*turn, *vel_change, voltage_change)
    return jnp.stack([jnp.stack(direct), jnp.stack(level)], axis=-1)


States = tuple[jax.Array, ...]  # leaves of the states of pairs, (NUM_PAIRS, ...)


@jax.jit
def _start_states(vectors: jax.Array, like: ModelParameters, row: Record) -> States:
    """Return the states before the first rows of pairs.

    Args:
        vectors: the model of each pair, (NUM_PAIRS, parameters).
        like: the model whose parameters the vectors have.
        row: leaves (NUM_PAIRS, ...).
    """
    start = jax.vmap(lambda vector, row: start_replay(from_vector(vector, like), row))
    return tuple(jax.tree.leaves(start(vectors, row)))


@keep_trace
def _replay_rows(
    vectors: jax.Array, like: ModelParameters, states: States, rows: Rows
) -> tuple[States, jax.Array]:
    """Return the states of pairs after some rows, and (rows, NUM_PAIRS, NUM_AXES, 2) residuals.

    Args:
        vectors: the model of each pair, (NUM_PAIRS, parameters), in the order of
            ``parameters.names_of(like)``.
        like: the model whose parameters the vectors have.
        states: before the rows.
        rows: the chunk of each pair, leaves (rows, NUM_PAIRS, ...).
    """

    def of_pair(vector: jax.Array, leaves: States, rows: Rows) -> Any:
        model = from_vector(vector, like)
        first = jax.tree.map(lambda leaf: leaf[0], rows.row)
        structure = jax.tree.structure(jax.eval_shape(start_replay, model, first))
        state = jax.tree.unflatten(structure, leaves)
        state, residuals = replay(model, state, rows.row, rows.gyro_b, _of_step, rows.later)
        return tuple(jax.tree.leaves(state)), residuals

    return jax.vmap(of_pair, in_axes=(0, 0, 1), out_axes=(0, 1))(vectors, states, rows)


class Batch(NamedTuple):
    """Rows with which ``NUM_PAIRS`` pairs of a model and a chunk are replayed.

    Attributes:
        first: the first row of each pair's chunk.
        parts: all rows, ``NUM_ROWS`` at a time.
    """

    first: Record
    parts: tuple[Rows, ...]


class Batches:
    """Batches of chunks: pairs of all chunks and the first model, then of the second, and so on.

    One size serves logs of any length, rate and channels.
    """

    def __init__(self, chunks: Chunks):
        nowhere = np.zeros((*chunks.row.shape, 3))
        record, gyro_b = chunks.record, chunks.measured.get("w", nowhere + np.nan)
        force_b = chunks.measured.get("f", nowhere)
        self._record, self._gyro_b = record, gyro_b
        self._measured = Measured(record.quat, record.vel_w, record.battery_v, gyro_b, force_b)
        self._num_rows, self._num_chunks = chunks.row.shape
        self._known: dict[int, Batch] = {}

    def at(self, first_pair: int) -> Batch:
        """Return the batch that begins with a pair; it is made once for each first chunk."""
        first_chunk = first_pair % self._num_chunks
        if first_chunk not in self._known:
            self._known[first_chunk] = self._beginning_with(first_chunk)
        return self._known[first_chunk]

    def _beginning_with(self, first_chunk: int) -> Batch:
        pair = (first_chunk + np.arange(NUM_PAIRS)) % self._num_chunks

        def at(first: int, values: Any) -> Any:
            row = np.minimum(first + np.arange(NUM_ROWS), self._num_rows - 1)
            return jax.tree.map(lambda leaf: jnp.asarray(leaf[row[:, None], pair]), values)

        parts = tuple(
            Rows(at(row, self._record), at(row, self._gyro_b), at(row + 1, self._measured))
            for row in range(0, self._num_rows - 1, NUM_ROWS)
        )
        return Batch(jax.tree.map(lambda leaf: jnp.asarray(leaf[0, pair]), self._record), parts)


class Window(NamedTuple):
    """The window of a log in which an effect acts.

    Outside, the effect is as in the given model.

    Attributes:
        effect: its name.
        start: the effect acts from the step to this row of the record on.
        end: the effect no longer acts in the step to this row.
    """

    effect: str
    start: int = -1
    end: int = sys.maxsize


class Slopes(NamedTuple):
    """A model's residuals, and how they change along columns, not whitened.

    Attributes:
        vector: the model.
        residuals: (rows, chunks, NUM_AXES, 2).
        indices: the parameters of the first columns; ways to other vectors follow.
        columns: (num_columns, rows, chunks, NUM_AXES, 2).
    """

    vector: np.ndarray
    residuals: np.ndarray
    indices: tuple[int, ...]
    columns: np.ndarray


@dataclass(frozen=True, eq=False)
class Problem:
    """Scored rows of a log and a noise, for models as vectors in the order of ``names``.

    Attributes:
        chunks: the rows.
        like: the nominal model with every effect, float64.
        given_effects: those that the nominal model has.
        names: of the parameters.
        start: the nominal model's parameters.
        low: the lower bound of each parameter.
        high: the upper bound of each parameter.
        scale: the size of each parameter's steps.
        batches: the rows, as they are replayed.
        noise: as of ``noise.fit_noise``, (6, NUM_AXES); the least one before ``with_noise``.
        whitener: the filter of the noise.
        late: of chunks whose poses were corrected.
        windows: of the effects that act for a part of the log only.
    """

    chunks: Chunks
    like: ModelParameters
    given_effects: tuple[str, ...]
    names: tuple[str, ...]
    start: np.ndarray
    low: np.ndarray
    high: np.ndarray
    scale: np.ndarray
    batches: Batches
    noise: np.ndarray
    whitener: noises.Whitener
    late: Late | None = None
    windows: tuple[Window, ...] = ()

    @classmethod
    def of(
        cls,
        chunks: Chunks,
        model: ModelParameters,
        effects: Sequence[Effect] = SEARCHED,
        late: Late | None = None,
    ) -> Self:
        """Return the problem of chunks and a nominal model, with the least noise.

        Args:
            chunks: the rows.
            model: the nominal one.
            effects: those that the model may have.
            late: of chunks whose poses were corrected.
        """
        model = as_replayed(model)
        with_all_effects = model.with_effects(*(model.effect(effect.name) for effect in effects))
        like = jax.tree.map(lambda leaf: np.asarray(leaf, float), with_all_effects)
        names, start = names_of(like), to_vector(like)
        low, high = np.array([range_of(name)[:2] for name in names]).T
        noise = noises.least_noise(chunks)
        return cls(
            chunks=chunks,
            like=like,
            given_effects=tuple(effect_of(given_effect).name for given_effect in model.effects),
            names=names,
            start=start,
            low=low,
            high=np.minimum(high, _longest(names, chunks)),
            scale=np.array([_scale(name, value) for name, value in zip(names, start, strict=True)]),
            batches=Batches(chunks),
            noise=noise,
            whitener=noises.Whitener(chunks, noise),
            late=late,
        )

    def with_noise(self, noise: np.ndarray) -> "Problem":
        """Return the same problem, weighted by a noise.

        Args:
            noise: as of ``noise.fit_noise``, (6, NUM_AXES).
        """
        return replace(self, noise=noise, whitener=noises.Whitener(self.chunks, noise))

    def with_chunks(self, chunks: Chunks) -> "Problem":
        """Return the same problem of other chunks."""
        whitener = noises.Whitener(chunks, self.noise)
        return replace(self, chunks=chunks, batches=Batches(chunks), whitener=whitener)

    def with_law(self, law: LearnedLaw) -> "Problem":
        """Return the problem whose vectors end with the parameters of a law.

        At the start, the scale of the law is 0.
        """
        like = self.like.with_effects(law._replace(scale=0.0))
        like = jax.tree.map(lambda leaf: np.asarray(leaf, float), like)
        names, start = names_of(like), to_vector(like)
        low, high = (
            np.array([range_of(name)[:2] for name in names[len(self.names) :]]).reshape(-1, 2).T
        )
        return replace(
            self,
            like=like,
            names=names,
            start=start,
            low=np.append(self.low, low),
            high=np.append(self.high, high),
            scale=np.append(self.scale, np.ones(len(low))),
        )

    @property
    def fitted_noise(self) -> noises.Noise:
        """The noise in the sensors' units."""
        return noises.noise_of(self.noise)

    @property
    def has_given_law(self) -> bool:
        """Whether the nominal model has a law that was learnt from another log."""
        return LEARNED_LAW.name in self.given_effects

    @property
    def counts(self) -> np.ndarray:
        """The residuals to explain, (rows, chunks, NUM_AXES, 2) bool."""
        return self.chunks.counts

    def residuals(self, vectors: np.ndarray) -> np.ndarray:
        """Return residuals (num_models, rows, chunks, NUM_AXES, 2) of models.

        Rows outside an effect's window come from another replay, which has no memory of the effect.

        Args:
            vectors: the models, (num_models, parameters).
        """
        result = self._composed(vectors) if self.windows else self._replayed(vectors)
        return result if self.late is None else self.late.residuals(result)

    def _replayed(self, vectors: np.ndarray) -> np.ndarray:
        rows, chunks = self.chunks.row.shape
        num_pairs = len(vectors) * chunks
        pairs = np.zeros((rows, num_pairs, NUM_AXES, 2))
        for first in range(0, num_pairs, NUM_PAIRS):
            pair_numbers = np.minimum(first + np.arange(NUM_PAIRS), num_pairs - 1)
            residuals = self._replay_pairs(vectors[pair_numbers // chunks], self.batches.at(first))
            pairs[1:, first : first + NUM_PAIRS] = residuals[:, : num_pairs - first]
        result = np.swapaxes(pairs.reshape(rows, len(vectors), chunks, NUM_AXES, 2), 0, 1)
        result *= self.chunks.is_joined[..., None, None]
        for name, axes in zip(("w", "f"), AXES, strict=False):
            if name not in self.chunks.measured:
                result[..., axes, 0] = 0.0
        return result

    def _replay_pairs(self, vectors: np.ndarray, batch: Batch) -> np.ndarray:
        """Return the residuals of all rows but the first, (rows - 1, NUM_PAIRS, NUM_AXES, 2)."""
        states, parts = _start_states(vectors, self.like, batch.first), []
        for rows in batch.parts:
            states, residuals = _replay_rows(vectors, self.like, states, rows)
            parts.append(residuals)
        return np.concatenate(parts)[: len(self.chunks.row) - 1]

    def _composed(self, vectors: np.ndarray) -> np.ndarray:
        """Return residuals of models with windows of effects; each row is of one replay."""
        result = self._replayed(vectors)
        row = self.chunks.row
        acts = np.stack([(row >= window.start) & (row < window.end) for window in self.windows])
        for acting in np.unique(acts.reshape(len(acts), -1), axis=1).T:
            if not acting.all():
                inactive = [
                    window.effect
                    for window, is_on in zip(self.windows, acting, strict=True)
                    if not is_on
                ]
                is_here = (acts == acting[:, None, None]).all(axis=0)
                result = np.where(
                    is_here[..., None, None],
                    self._replayed(self.without(vectors, inactive)),
                    result,
                )
        return result

    def without(self, vectors: np.ndarray, effects: Sequence[str]) -> np.ndarray:
        """Return vectors (..., parameters) with some effects as in the given model."""
        return self.at_start(
            vectors, [name for name in self.names if name.split(".")[0] in effects]
        )

    def at_start(self, vectors: np.ndarray, fields: Sequence[str]) -> np.ndarray:
        """Return vectors (..., parameters) with some parameters as in the given model."""
        vectors, indices = vectors.copy(), self.parameter_indices(fields)
        vectors[..., indices] = self.start[indices]
        return vectors

    def whiten(self, residuals: np.ndarray, axes: slice = slice(None)) -> np.ndarray:
        """Return residuals (num_models, rows, chunks, axes, 2) of some axes as innovations."""
        return self.whitener(residuals, axes)

    def whitened_residuals(self, *vectors: np.ndarray) -> np.ndarray:
        """Return the innovations of models, (num_models, rows, chunks, NUM_AXES, 2)."""
        return self.whiten(self.residuals(np.stack(vectors)))

    def clipped(self, vectors: np.ndarray) -> np.ndarray:
        """Return vectors within bounds."""
        return np.clip(vectors, self.low, self.high)

    def nudged(
        self, vector: np.ndarray, indices: Sequence[int], share: float = RELATIVE_STEP
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return copies of a vector, each with one parameter moved, and the steps, for slopes.

        Differences are one-sided and within the bounds: an effect may be defined on one side of
        neutral only.

        Args:
            vector: to copy.
            indices: of the parameters to move.
            share: the step as a share of a parameter's scale.
        """
        indices = list(indices)
        step = share * self.scale[indices]
        step = np.where(vector[indices] + step > self.high[indices], -step, step)
        moved = np.repeat(vector[None], len(indices), axis=0)
        moved[np.arange(len(indices)), indices] += step
        return moved, step

    def slopes(
        self, vector: np.ndarray, indices: Sequence[int], others: np.ndarray | None = None
    ) -> Slopes:
        """Return a model's residuals, their slopes along indices, and the ways to other vectors."""
        moved, step = self.nudged(vector, indices)
        others = np.zeros((0, len(vector))) if others is None else others
        residuals = self.residuals(np.concatenate([vector[None], moved, others]))
        columns = residuals[1:] - residuals[0]
        columns[: len(step)] /= step[:, None, None, None, None]
        return Slopes(vector, residuals[0], tuple(indices), columns)

    def parameter_indices(self, names: Sequence[str]) -> list[int]:
        """Return the indices of parameters in the vector."""
        return [self.names.index(name) for name in names]


def as_replayed(model: ModelParameters) -> ModelParameters:
    """Return a model without the effects on poses."""
    return model._replace(
        effects=tuple(effect for effect in model.effects if "pose" not in effect_of(effect).hooks)
    )


def vector_of(model: ModelParameters) -> np.ndarray:
    """Return a model as a vector of a ``Problem``."""
    return to_vector(
        as_replayed(model).with_effects(*(model.effect(effect.name) for effect in SEARCHED))
    )


def _longest(names: Sequence[str], chunks: Chunks) -> np.ndarray:
    """Return the longest delay (s) that each effect remembers; infinity for other parameters."""
    step_s = float(np.median(chunks.record.step_s))
    fields = [name.partition(".") for name in names]
    steps = [
        BY_NAME[effect].max_steps.get(field, np.inf) if field else np.inf
        for effect, _, field in fields
    ]
    return np.array(steps) * step_s


def _scale(name: str, value: float) -> float:
    """Return the size of a parameter, in which steps are measured."""
    if "." in name:
        bounds = range_of(name)
        return 0.1 * (bounds.high - bounds.low)
    return abs(value) if name in TAUS else max(abs(value), 1.0)


def robust_weight(white: np.ndarray) -> np.ndarray:
    """Return Huber weights of innovations: outliers count by their size, not by its square."""
    return noises.OUTLIER / np.maximum(np.abs(white), noises.OUTLIER)


def robust_square(white: np.ndarray) -> float:
    """Return the sum of squares of innovations, outliers counted by their size."""
    return float(2.0 * special.huber(noises.OUTLIER, white).sum())


def blocks_of(values: np.ndarray) -> np.ndarray:
    """Reshape (..., rows, chunks, axes, 2) to blocks of a second, (blocks, ..., numbers).

    The lead-in is left out.
    """
    rows, chunks = values.shape[-4:-2]
    kept = values[..., count_lead_in(rows) :, :, :, :]
    rows_per_s = kept.shape[-4] // CHUNK_S
    split = kept.reshape(*kept.shape[:-4], CHUNK_S, rows_per_s, chunks, kept.shape[-2] * 2)
    return np.moveaxis(split, (-4, -2), (0, 1)).reshape(
        CHUNK_S * chunks, *kept.shape[:-4], rows_per_s * kept.shape[-2] * 2
    )
