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

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from scipy import special

from flytrack_env.dynamics import ModelParameters, read_sensors
from flytrack_env.effects import BY_NAME, EFFECTS, LEARNED_LAW, Effect, LearnedLaw, effect_of
from flytrack_env.fusion import one_kernel
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_sysid.inference import noise as noises
from flytrack_sysid.inference.chunks import (
    AXES,
    CHUNK_S,
    NUM_AXES,
    Chunks,
    count_lead_in,
    spread_chunks,
)
from flytrack_sysid.inference.lateness import Late
from flytrack_sysid.inference.law_table import tabulated
from flytrack_sysid.inference.parameters import (
    TAUS,
    from_vector,
    in_float64,
    names_of,
    range_of,
    to_vector,
)
from flytrack_sysid.inference.record import Record
from flytrack_sysid.inference.replay import ReplayState, Step, replay_row, start_replay
from flytrack_sysid.inference.trace_cache import keep_trace

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


class Row(NamedTuple):
    """A row of a chunk, and measurements.

    Attributes:
        row: the row.
        gyro_b: rates at the row, body (rad/s).
        later: the measurements at the row after it.
    """

    row: Record
    gyro_b: Any
    later: Measured


def _numbers(*shape: int) -> Any:
    return jax.ShapeDtypeStruct(shape, np.float64)


_FLAG: Any = jax.ShapeDtypeStruct((), np.bool_)
ROW = Row(
    Record(
        source_row=_numbers(),
        step_s=_numbers(),
        command=_numbers(4),
        command_doubt=_numbers(4),
        begins=_FLAG,
        is_applied_known=_FLAG,
        applied=_numbers(4),
        pos_w=_numbers(3),
        vel_w=_numbers(3),
        quat=_numbers(4),
        battery_v=_numbers(),
        piece=_numbers(),
        time_s=_numbers(),
    ),
    gyro_b=_numbers(3),
    later=Measured(_numbers(4), _numbers(3), _numbers(), _numbers(3), _numbers(3)),
)


def _count_numbers(like: Any) -> int:
    """Return how many numbers a tree of shapes has."""
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(like))


def _unpacked(numbers: jax.Array, like: Any) -> Any:
    """Return the tree of numbers (num_numbers,) with the structure and types of another."""
    leaves, structure = jax.tree.flatten(like)
    sizes = [math.prod(leaf.shape) for leaf in leaves]
    starts = np.cumsum(sizes) - sizes
    return jax.tree.unflatten(
        structure,
        [
            numbers[start : start + size].reshape(leaf.shape).astype(leaf.dtype)
            for start, size, leaf in zip(starts, sizes, leaves, strict=True)
        ],
    )


def _packed(leaves: Sequence[jax.Array]) -> jax.Array:
    """Return the numbers of leaves (pairs, ...) as one array, (num_numbers, pairs)."""
    return jnp.concatenate([leaf.reshape(len(leaf), -1).astype(float).T for leaf in leaves])


def _of_step(step: Step, measured: Measured) -> list[Any]:
    """Return the residuals of the row after a step: of each axis, direct and level."""
    row, before, after = step.row, step.before, step.after
    sensors = read_sensors(step.moved, step.model)
    to_world = before.quat.rotate  # whatever attitude the sensors' force had
    rates = to_world(Vec3(*jnp.nan_to_num(measured.gyro_b)) - sensors.rates_b)
    turn = _turn(Quaternion(*measured.quat), after.quat)
    force = to_world(Vec3(*measured.force_b) - sensors.force_b)
    vel_change = Vec3(*measured.vel_w) - before.vel_w - after.acc_w.scale(row.step_s)
    voltage_change = measured.battery_v - after.battery_v
    direct, level = (*rates, *force, jnp.zeros(())), (*turn, *vel_change, voltage_change)
    return [channel for axis in zip(direct, level, strict=True) for channel in axis]


def _state_like(model: ModelParameters) -> ReplayState:
    """Return the shapes and types of the state of a model's replay."""
    return jax.eval_shape(start_replay, model, ROW.row)


@cache
def _no_state(structure: jax.tree_util.PyTreeDef, shapes: tuple[tuple[int, ...], ...]) -> jax.Array:
    """Return a state to begin with, where every chunk begins a flight, so that it is not read.

    It is bound to its device, as states that a program returns are: otherwise JAX would compile the
    program once for the first rows and once for all others.

    Args:
        structure: of a model.
        shapes: of its leaves.
    """
    like = jax.tree.unflatten(structure, [_numbers(*shape) for shape in shapes])
    zeros = jnp.zeros((_count_numbers(_state_like(like)), NUM_PAIRS))
    return jax.device_put(zeros, zeros.sharding)


@keep_trace
def _replay_rows(
    vectors: jax.Array, like: ModelParameters, state: jax.Array, rows: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the state of pairs of a model and a chunk after some rows, and their residuals.

    A state and a row are one array each, of all their numbers: a loop that carries hundreds of
    small arrays takes longer for these than for the physics.

    Args:
        vectors: the model of each pair, (parameters, NUM_PAIRS), in the order of
            ``parameters.names_of(like)``.
        like: the model whose parameters the vectors have.
        state: before the rows, (num_numbers, NUM_PAIRS).
        rows: the rows of each pair's chunk, (NUM_ROWS, num_numbers, NUM_PAIRS), each a ``Row``.

    Returns:
        The state, and the residuals, (NUM_ROWS, 2 * NUM_AXES, NUM_PAIRS).
    """

    def of_pair(vector: jax.Array, numbers: jax.Array, row_numbers: jax.Array) -> Any:
        model, row = from_vector(vector, like), _unpacked(row_numbers, ROW)
        state = _unpacked(numbers, _state_like(model))
        state, step = replay_row(model, state, row.row, row.gyro_b)
        return jax.tree.leaves(state), _of_step(step, row.later)

    def of_row(vectors: jax.Array, state: jax.Array, row: jax.Array) -> Any:
        leaves, residuals = jax.vmap(of_pair, in_axes=1)(vectors, state, row)
        return _packed(leaves), jnp.stack(residuals)

    return jax.lax.scan(partial(one_kernel(of_row), vectors), state, rows)


class Batches:
    """The rows with which ``NUM_PAIRS`` pairs of a model and a chunk are replayed.

    The pairs are those of all chunks and the first model, then of the second, and so on. One size
    serves logs of any length, rate and channels.
    """

    def __init__(self, chunks: Chunks):
        nowhere = np.zeros((*chunks.row.shape, 3))
        record, gyro_b = chunks.record, chunks.measured.get("w", nowhere + np.nan)
        force_b = chunks.measured.get("f", nowhere)
        measured = Measured(record.quat, record.vel_w, record.battery_v, gyro_b, force_b)
        record, gyro_b = jax.tree.map(lambda leaf: leaf[:-1], (record, gyro_b))
        row = Row(record, gyro_b, jax.tree.map(lambda leaf: leaf[1:], measured))
        num_rows, self._num_chunks = len(chunks.row) - 1, chunks.row.shape[1]
        self._rows = np.zeros(
            (num_rows + -num_rows % NUM_ROWS, _count_numbers(ROW), self._num_chunks)
        )
        leaves = [
            leaf.reshape(num_rows, self._num_chunks, -1).astype(float)
            for leaf in jax.tree.leaves(row)
        ]
        self._rows[:num_rows] = np.swapaxes(np.concatenate(leaves, axis=-1), 1, 2)
        self._known: dict[int, tuple[jax.Array, ...]] = {}

    def at(self, first_pair: int) -> tuple[jax.Array, ...]:
        """Return the rows of the batch that begins with a pair, ``NUM_ROWS`` at a time.

        They are made once for each first chunk.
        """
        first_chunk = first_pair % self._num_chunks
        if first_chunk not in self._known:
            pair = (first_chunk + np.arange(NUM_PAIRS)) % self._num_chunks
            self._known[first_chunk] = tuple(
                jnp.asarray(self._rows[row : row + NUM_ROWS, :, pair])
                for row in range(0, len(self._rows), NUM_ROWS)
            )
        return self._known[first_chunk]


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
        like = in_float64(with_all_effects)
        names, start = names_of(like), to_vector(like)
        low, high = np.array([range_of(name)[:2] for name in names]).T
        noise, _ = noises.noise_bounds(chunks)
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

    def thinned(self, max_chunks: int) -> "Problem":
        """Return the problem with at most ``max_chunks`` chunks, evenly spread over the log."""
        indices = spread_chunks(self.chunks, max_chunks)
        if len(indices) == self.chunks.row.shape[1]:
            return self
        thinned = self.with_chunks(self.chunks.selected(indices))
        if self.late is None:
            return thinned
        return replace(thinned, late=Late(*(leaf[:, indices] for leaf in self.late)))

    def with_law(self, law: LearnedLaw) -> "Problem":
        """Return the problem whose vectors end with the parameters of a law.

        At the start, the scale of the law is 0. All laws share the compiled programs.
        """
        like = in_float64(self.like.with_effects(tabulated(law._replace(scale=0.0))))
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

    @cached_property
    def _like(self) -> ModelParameters:
        """``like`` as JAX's arrays: a program takes longer to convert NumPy's than to run."""
        return jax.tree.map(jnp.asarray, self.like)

    def _replayed(self, vectors: np.ndarray) -> np.ndarray:
        num_rows, num_chunks = self.chunks.row.shape
        # In memory models are last, as blocks of innovations need them.
        by_chunk = np.empty((num_chunks, num_rows, 2 * NUM_AXES, len(vectors)))
        for first in range(0, len(vectors), NUM_PAIRS):
            models = slice(first, first + NUM_PAIRS)
            residuals = self._replayed_pairs(vectors[models])
            for row in range(num_rows):  # one by one, so that they stay in the processor's cache
                by_chunk[:, row, :, models] = residuals[row].transpose(2, 0, 1)
        result = by_chunk.reshape(num_chunks, num_rows, NUM_AXES, 2, len(vectors))
        result = result.transpose(4, 1, 0, 2, 3)
        result[:, ~self.chunks.is_joined] = 0.0
        for name, axes in zip(("w", "f"), AXES, strict=False):
            if name not in self.chunks.measured:
                result[..., axes, 0] = 0.0
        return result

    def _replayed_pairs(self, vectors: np.ndarray) -> np.ndarray:
        """Return residuals as they are replayed, (rows, 2 * NUM_AXES, models, chunks)."""
        num_rows, num_chunks = self.chunks.row.shape
        num_pairs = len(vectors) * num_chunks
        leaves, structure = jax.tree.flatten(self._like)
        no_state = _no_state(structure, tuple(map(np.shape, leaves)))
        pairs = np.zeros((num_rows, 2 * NUM_AXES, num_pairs))
        for first in range(0, num_pairs, NUM_PAIRS):
            pair, state = np.minimum(first + np.arange(NUM_PAIRS), num_pairs - 1), no_state
            of_pairs = jnp.asarray(vectors[pair // num_chunks].T)
            for number, rows in enumerate(self.batches.at(first)):
                state, residuals = _replay_rows(of_pairs, self._like, state, rows)
                # The residuals of a step are those of the row after it.
                part = pairs[1 + number * NUM_ROWS :, :, first:][:NUM_ROWS, :, :NUM_PAIRS]
                part[...] = np.asarray(residuals)[: len(part), :, : part.shape[2]]
        return pairs.reshape(num_rows, 2 * NUM_AXES, len(vectors), num_chunks)

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
        self,
        vector: np.ndarray,
        indices: Sequence[int],
        share: float = RELATIVE_STEP,
        least_lag_s: float = 0.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return copies of a vector, each with one parameter moved, and the steps, for slopes.

        Differences are one-sided and within the bounds: an effect may be defined on one side of
        neutral only.

        Args:
            vector: to copy.
            indices: of the parameters to move.
            share: the step as a share of a parameter's scale.
            least_lag_s: the smallest step of a lag, s. One far below the time between rows changes
                nothing, so that its slope says nothing of a longer one.
        """
        indices = list(indices)
        is_lag = np.isin(indices, self.parameter_indices(TAUS))
        step = np.maximum(share * self.scale[indices], least_lag_s * is_lag)
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
        columns = residuals[1:]
        columns -= residuals[0]
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
    step_s = chunks.record.median_step_s
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


def split_seconds(values: np.ndarray) -> np.ndarray:
    """Reshape (..., rows, chunks, axes, 2) to seconds, (CHUNK_S, chunks, ..., numbers).

    The lead-in is left out. Innovations are not copied.
    """
    kept = values[..., count_lead_in(values.shape[-4]) :, :, :, :]
    rows_per_s = kept.shape[-4] // CHUNK_S
    split = kept.reshape(*kept.shape[:-4], CHUNK_S, rows_per_s, *kept.shape[-3:])
    split = np.moveaxis(split, (-5, -3), (0, 1))
    return split.reshape(*split.shape[:-3], math.prod(split.shape[-3:]))


def split_blocks(values: np.ndarray) -> np.ndarray:
    """Reshape (..., rows, chunks, axes, 2) to blocks of a second, (blocks, ..., numbers)."""
    return merge_seconds(split_seconds(values))


def merge_seconds(values: np.ndarray) -> np.ndarray:
    """Reshape (CHUNK_S, chunks, ...) to (blocks, ...)."""
    return values.reshape(math.prod(values.shape[:2]), *values.shape[2:])
