"""Noise of residuals: white sensor noise and a wandering disturbance, and a whitening filter.

Each axis (three of rotation, three of force, one of the battery) has two channels: a direct one,
``w`` or ``f``, and a level, ``q``, ``v`` or ``v_bat``, whose rate of change the direct one
measures. The model of their residuals is

    d after = exp(-dt / tau) d + white        disturbance: gusts, vibration, what the model lacks
    e after = e + coupling d dt + white       sum of the disturbance, and of the fed-in attitude
    direct  = d + white                       sensor noise
    level   = e + white                       sensor noise; e begins unknown

and a Kalman filter turns residuals into innovations, white and of variance 1. Its gains depend on
the noise alone, so that it is one linear map for residuals and their slopes. It needs no windows:
without wander, a level counts from the first row to the last; with much wander, only its increments
count.
"""

from functools import cached_property, partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.fusion import one_kernel
from flytrack_sysid.inference.chunks import NUM_AXES, Chunks, of_row_before
from flytrack_sysid.inference.trace_cache import fast_jit

# Variance of a level at its first row, over that of its noise: its first innovation is about 0.
UNKNOWN_START = 1e8
# Least noise, by sensors and float32: direct rad/s, m/s^2; level rad, m/s, V.
FLOORS = np.array([[1e-4] * 3 + [1e-3] * 3 + [1.0], [1e-5] * 3 + [1e-4] * 3 + [1e-4]])
UNIFORM = 12.0**-0.5  # standard deviation of rounding, over the last digit
MIN_DISTURBANCE_RATIO = (
    1e-3  # of a disturbance and of a wander, over the noise: smaller ones are neglected
)
TAU_RANGE_S = (0.02, 5.0)  # of a disturbance: from a few rows to a chunk
# Levenberg damping: the first, its factor after a bad step, and its factor after a good step.
FIRST_DAMPING, MORE, LESS = 1e-2, 10.0, 0.2
MAX_ROUNDS = 12  # of Levenberg's method
ENOUGH = 1.0  # of minus twice the log likelihood: the error of one parameter
OUTLIER = 4.0  # innovations beyond this count by their size, not by its square
DIFFERENCE = 1e-4  # of logarithms, for slopes
NUM_COMPARED = 7  # noises: one, and one with each of its six parameters moved
# Sizes of the compiled programs: rows at a time, chunks at a time, and chunks and models at a time.
# A batch takes about as long whatever its size, so the size that needs the fewest is used.
NUM_ROWS, NUM_CHUNKS, BATCHES = 200, 16, ((2, 32), (16, 4))


class Noise(NamedTuple):
    """Noise by axis, each (NUM_AXES,).

    Attributes:
        direct: standard deviation of the direct sensor.
        level: standard deviation of the level's sensor.
        wander: standard deviation of the change of e in a second, as a random walk.
        disturbance: standard deviation of d (unit of the direct channel).
        tau: time constant of d (s).
        coupling: of d: 0 if only the direct sensor has it, 1 if it moves the drone.
    """

    direct: jax.Array
    level: jax.Array
    wander: jax.Array
    disturbance: jax.Array
    tau: jax.Array
    coupling: jax.Array


class Gains(NamedTuple):
    """The filter of a noise at every row, (rows, NUM_AXES, chunks, 1) each.

    Attributes:
        keep: share of the disturbance that is left after a step.
        push: what a step adds to the error of the level, over the disturbance (s).
        direct_d: gain from a direct innovation to the disturbance.
        direct_e: gain from a direct innovation to the error of the level.
        direct_scale: one over the standard deviation of a direct innovation; 0 where none counts.
        level_d: gain from a level's innovation to the disturbance.
        level_e: gain from a level's innovation to the error of the level.
        level_scale: one over the standard deviation of a level's innovation; 0 where none counts.
    """

    keep: Any
    push: Any
    direct_d: Any
    direct_e: Any
    direct_scale: Any
    level_d: Any
    level_e: Any
    level_scale: Any


class Covariance(NamedTuple):
    """Covariance of the filter's state.

    Attributes:
        level: variance of the level's error.
        across: covariance of the level's error and the disturbance.
        disturbance: variance of the disturbance.
    """

    level: Any
    across: Any
    disturbance: Any


class Conditions(NamedTuple):
    """Inputs of the filter at rows besides their residuals; floats.

    Attributes:
        step_s: time since the row before, (rows, 1, chunks, 1).
        is_known: 1 where the row continues a flight and no lost command acts, (rows, NUM_AXES,
            chunks, 1).
        counts: 1 for scored residuals, (rows, 2, NUM_AXES, chunks, 1).
    """

    step_s: Any
    is_known: Any
    counts: Any


def build_conditions(chunks: Chunks) -> Conditions:
    """Return the conditions of the rows of chunks."""
    return Conditions(
        step_to(chunks)[:, None, :, None],
        np.swapaxes(chunks.is_known, 1, 2)[..., None].astype(float),
        chunks.counts.transpose(0, 3, 2, 1)[..., None].astype(float),
    )


def gains_of_row(noise: Noise, before: Covariance, row: Conditions) -> tuple[Covariance, Gains]:
    """Return the covariance after a row, and the gains at it.

    Args:
        noise: of all axes.
        before: the covariance before the row.
        row: its conditions.
    """
    joined, new = row.is_known, 1.0 - row.is_known
    keep = jnp.exp(-row.step_s / noise.tau)
    stationary = noise.disturbance * noise.disturbance
    push = noise.coupling * row.step_s
    d = joined * (keep * keep * before.disturbance - keep * keep * stationary) + stationary
    across = joined * (keep * before.across + push * d)
    walk = noise.wander * noise.wander * row.step_s
    e = before.level + 2.0 * push * keep * before.across + push * push * d + walk
    e = joined * e + new * UNKNOWN_START * noise.level * noise.level
    direct_size = d + noise.direct * noise.direct
    inverse = row.counts[0] / direct_size
    direct_d, direct_e = d * inverse, across * inverse
    e, across, d = e - direct_e * across, across - direct_e * d, d - direct_d * d
    level_size = e + noise.level * noise.level
    inverse = row.counts[1] / level_size
    level_d, level_e = across * inverse, e * inverse
    gains = Gains(
        keep=joined * keep,
        push=joined * push,
        direct_d=direct_d,
        direct_e=direct_e,
        direct_scale=row.counts[0] * jax.lax.rsqrt(direct_size),
        level_d=level_d,
        level_e=level_e,
        level_scale=row.counts[1] * jax.lax.rsqrt(level_size),
    )
    return Covariance(e - level_e * e, across - level_e * across, d - level_d * across), gains


class Filtered(NamedTuple):
    """State of the filter.

    Attributes:
        level: summed changes of the level.
        error: of the level.
        disturbance: the disturbance.
    """

    level: Any
    error: Any
    disturbance: Any


def innovations_of_row(
    before: Filtered, residuals: jax.Array, gain: Gains
) -> tuple[Filtered, jax.Array]:
    """Return the state after a row, and its innovations, (axes, 2, ...).

    Args:
        before: the state before the row.
        residuals: of the row, (axes, 2, ...).
        gain: of the row.
    """
    level = before.level + residuals[:, 1]
    disturbance = gain.keep * before.disturbance
    error = before.error + gain.push * disturbance
    # Where a residual does not count, its gains and its scale are 0.
    direct = residuals[:, 0] - disturbance
    disturbance = disturbance + gain.direct_d * direct
    error = error + gain.direct_e * direct
    change = level - error
    after = Filtered(level, error + gain.level_e * change, disturbance + gain.level_d * change)
    return after, jnp.stack([direct * gain.direct_scale, change * gain.level_scale], axis=1)


@fast_jit
def _gains_of_rows(
    log_noise: jax.Array, state: Covariance, rows: Conditions
) -> tuple[Covariance, Gains]:
    """Return the covariance after ``NUM_ROWS`` rows of ``NUM_CHUNKS`` chunks, and the gains there.

    Args:
        log_noise: of each chunk, (6, NUM_AXES, NUM_CHUNKS, 1).
        state: the covariance before the rows.
        rows: their conditions.
    """
    return jax.lax.scan(partial(one_kernel(gains_of_row), noise_of(log_noise)), state, rows)


@fast_jit
def _whiten_rows(state: Filtered, gains: Gains, residuals: jax.Array) -> tuple[Filtered, jax.Array]:
    """Return the state after some rows, and their innovations.

    Args:
        state: before the rows.
        gains: of the axes at the rows.
        residuals: (NUM_ROWS, axes, 2, NUM_CHUNKS, models).
    """
    return jax.lax.scan(
        lambda state, row: innovations_of_row(state, *row), state, (residuals, gains)
    )


def build_gains(conditions: Conditions, log_noise: np.ndarray) -> Gains:
    """Return the filters of chunks, each of a noise; rows and chunks are padded to whole parts.

    Args:
        conditions: of the rows of chunks.
        log_noise: the noise of each chunk, (6, NUM_AXES, chunks).
    """
    num_rows, _, num_chunks, _ = conditions.step_s.shape
    size = num_rows + -num_rows % NUM_ROWS, NUM_AXES, num_chunks + -num_chunks % NUM_CHUNKS, 1
    gains = Gains(*(np.empty(size) for _ in Gains._fields))
    for chunk in range(0, num_chunks, NUM_CHUNKS):
        noise = _cut(log_noise[..., None], (6, NUM_AXES, NUM_CHUNKS, 1), chunk=chunk)
        state = Covariance(*[np.zeros((NUM_AXES, NUM_CHUNKS, 1))] * 3)
        for row in range(0, num_rows, NUM_ROWS):
            rows = Conditions(
                *(
                    _cut(leaf, (NUM_ROWS, *leaf.shape[1:-2], NUM_CHUNKS, 1), row, chunk)
                    for leaf in conditions
                )
            )
            state, of_rows = _gains_of_rows(noise, state, rows)
            for gain, part in zip(gains, of_rows, strict=True):
                gain[row : row + NUM_ROWS, :, chunk : chunk + NUM_CHUNKS] = part
    return gains


def whiten(gains: Gains, residuals: np.ndarray, white: np.ndarray) -> None:
    """Fill an array with the innovations of residuals, of variance 1; 0 where nothing counts.

    Args:
        gains: of the axes of the residuals.
        residuals: (rows, axes, 2, chunks, models).
        white: of the same shape.
    """
    num_rows, num_axes, _, num_chunks, num_models = residuals.shape
    chunks_at_once, models_at_once = min(
        BATCHES, key=lambda size: -(-num_chunks // size[0]) * -(-num_models // size[1])
    )
    shape = NUM_ROWS, num_axes, 2, chunks_at_once, models_at_once
    starts = range(0, num_chunks, chunks_at_once), range(0, num_models, models_at_once)
    for chunk, model in product(*starts):
        state = Filtered(*[np.zeros((num_axes, *shape[3:]))] * 3)
        for row in range(0, num_rows, NUM_ROWS):
            part = slice(row, row + NUM_ROWS), slice(None), slice(chunk, chunk + shape[3])
            of_rows = Gains(*(gain[part] for gain in gains))
            state, result = _whiten_rows(state, of_rows, _cut(residuals, shape, row, chunk, model))
            target = white[row:, :, :, chunk:, model:][tuple(map(slice, shape))]
            target[...] = np.asarray(result)[tuple(map(slice, target.shape))]


def _cut(
    values: np.ndarray, shape: tuple[int, ...], row: int = 0, chunk: int = 0, model: int = 0
) -> np.ndarray:
    """Return a part of values (..., chunks, models) from an index on, padded with 0 to a shape."""
    part = values[row:, ..., chunk:, model:][tuple(map(slice, shape))]
    padded = np.zeros(shape)
    padded[tuple(map(slice, part.shape))] = part
    return padded


class Whitener:
    """The filter of a noise for rows of chunks."""

    def __init__(self, chunks: Chunks, log_noise: np.ndarray):
        self._chunks, self._log_noise = chunks, log_noise

    @cached_property
    def _gains(self) -> Gains:
        num_chunks = self._chunks.row.shape[1]
        by_chunk = np.repeat(self._log_noise[..., None], num_chunks, axis=2)
        return build_gains(build_conditions(self._chunks), by_chunk)

    def __call__(self, residuals: np.ndarray, axes: slice = slice(None)) -> np.ndarray:
        """Return residuals as innovations of variance 1; they are 0 where nothing counts.

        In memory the innovations of a row of a chunk are together, and models are last.

        Args:
            residuals: (models, rows, chunks, axes, 2).
            axes: the axes of the residuals, of ``NUM_AXES``.
        """
        num_models, num_rows, num_chunks = residuals.shape[:3]
        white = np.empty((num_chunks, num_rows, *residuals.shape[3:], num_models))
        gains = Gains(*(gain[:, axes] for gain in self._gains))
        whiten(gains, residuals.transpose(1, 3, 4, 2, 0), white.transpose(1, 2, 3, 0, 4))
        return white.transpose(4, 1, 0, 2, 3)


def step_to(chunks: Chunks) -> np.ndarray:
    """Return the time since the row before (s), (rows, chunks)."""
    return of_row_before(chunks.record.step_s)


def noise_of(log_noise: jax.Array | np.ndarray) -> Noise:
    """Return the noise from its logarithms and a logit, (6, NUM_AXES, ...)."""
    direct, level = jnp.exp(log_noise[0]), jnp.exp(log_noise[1])
    disturbance, wander = direct * jnp.exp(log_noise[3]), level * jnp.exp(log_noise[2])
    return Noise(
        direct, level, wander, disturbance, jnp.exp(log_noise[4]), jax.nn.sigmoid(log_noise[5])
    )


class Likelihood:
    """The likelihood of noises, given residuals of chunks (rows, chunks, NUM_AXES, 2)."""

    def __init__(self, chunks: Chunks, residuals: np.ndarray):
        # The compared noises act on copies of the chunks.
        conditions = build_conditions(chunks)
        self._conditions = Conditions(
            *(np.concatenate([leaf] * NUM_COMPARED, axis=-2) for leaf in conditions)
        )
        of_chunks = residuals.transpose(0, 2, 3, 1)[..., None]
        self._residuals = np.concatenate([of_chunks] * NUM_COMPARED, axis=3)

    def misfit(self, log_noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return each axis's misfit of a noise, (NUM_AXES,), its slopes and expected curvature.

        The misfit is minus twice the log likelihood; outliers count by their size. Axes do not
        depend on each other, so that one difference serves all. The slopes are (6, NUM_AXES), the
        curvature is (NUM_AXES, 6, 6).
        """
        shifts = DIFFERENCE * np.concatenate([np.zeros((1, 6)), np.eye(6)]).T
        num_chunks = self._residuals.shape[3] // NUM_COMPARED
        by_chunk = np.repeat(log_noise[:, :, None] + shifts[:, None], num_chunks, axis=2)
        gains, white = build_gains(self._conditions, by_chunk), np.empty_like(self._residuals)
        whiten(gains, self._residuals, white)
        scale = np.stack([gains.direct_scale, gains.level_scale], axis=2)
        scale = scale[: len(white), ..., : white.shape[3], 0]
        white, scale = (
            np.moveaxis(values.reshape(*values.shape[:3], NUM_COMPARED, num_chunks), 3, 0)
            for values in (white[..., 0], np.where(scale > 0.0, scale, 1.0))
        )
        size, logs = np.abs(white), -2.0 * np.log(scale)
        squares = np.where(size < OUTLIER, size**2, OUTLIER * (2.0 * size - OUTLIER))
        misfit = (squares + logs).sum(axis=(1, 3, 4))

        def slopes(values: np.ndarray) -> np.ndarray:
            return (values[1:] - values[0]) / DIFFERENCE

        curvature = np.zeros((NUM_AXES, 6, 6))
        for weight, changes in ((1.0, slopes(logs)), (2.0, slopes(white / scale) * scale[0])):
            by_axis = np.moveaxis(changes, 2, 0).reshape(NUM_AXES, 6, -1)
            curvature += weight * by_axis @ np.swapaxes(by_axis, 1, 2)
        return misfit[0], slopes(misfit), curvature


def noise_floors(chunks: Chunks) -> np.ndarray:
    """Return the least noise of each channel, (2, NUM_AXES): of its last digit or of float32."""
    return np.maximum(FLOORS, chunks.quanta * UNIFORM)


def first_guess(chunks: Chunks, residuals: np.ndarray) -> np.ndarray:
    """Return a first estimate of log noise, (6, NUM_AXES), robust against slow residuals."""
    counts, floors = chunks.counts, noise_floors(chunks)
    is_pair = counts[1:] & counts[:-1]
    guess = np.zeros((6, NUM_AXES))
    for axis in range(NUM_AXES):
        direct = (residuals[1:, :, axis, 0] - residuals[:-1, :, axis, 0])[is_pair[..., axis, 0]]
        level = residuals[1:, :, axis, 1][is_pair[..., axis, 1]]
        for channel, change in enumerate((direct, level)):
            spread = np.sqrt(0.5 * np.mean(np.square(change))) if len(change) else 1.0
            guess[channel, axis] = np.log(max(spread, floors[channel, axis]))
    guess[2], guess[3], guess[4], guess[5] = np.log(0.1), np.log(0.1), np.log(0.3), 0.0
    return guess


def disturbance_gain(chunks: Chunks, residuals: np.ndarray, log_noise: np.ndarray) -> np.ndarray:
    """Return the decrease of minus twice the log likelihood due to a disturbance, by axis."""
    without = log_noise.copy()
    without[3] = np.log(MIN_DISTURBANCE_RATIO)
    likelihood = Likelihood(chunks, residuals)
    return likelihood.misfit(without)[0] - likelihood.misfit(log_noise)[0]


def total_misfit(chunks: Chunks, residuals: np.ndarray, log_noise: np.ndarray) -> float:
    """Return minus twice the log likelihood of residuals under a noise."""
    return float(np.sum(Likelihood(chunks, residuals).misfit(log_noise)[0]))


def fit_noise(chunks: Chunks, residuals: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """Return the likeliest log noise, (6, NUM_AXES), of residuals (rows, chunks, NUM_AXES, 2).

    A fit may end where the shortest disturbance passes for the sensor's noise, which is then next
    to nothing. Such an axis is fitted from the first guess, too.
    """
    likelihood, bounds = Likelihood(chunks, residuals), noise_bounds(chunks)
    guess = first_guess(chunks, residuals)
    best, misfit = _descended(likelihood, bounds, guess if start is None else start)
    is_shortest = best[4] <= np.log(TAU_RANGE_S[0])
    if start is None or not is_shortest.any():
        return best
    other, other_misfit = _descended(likelihood, bounds, np.where(is_shortest, guess, best))
    return np.where(other_misfit < misfit, other, best)


def _descended(
    likelihood: Likelihood, bounds: tuple[np.ndarray, np.ndarray], start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the likeliest log noise near another one, and its misfit by axis.

    The method is Fisher scoring with Levenberg damping, for each axis by itself.
    """
    low, high = bounds
    best = np.clip(start, low, high)
    misfit, slopes, curvature = likelihood.misfit(best)
    damping = np.full(NUM_AXES, FIRST_DAMPING)
    for _ in range(MAX_ROUNDS):
        damped = curvature + 1e-9 * np.eye(6)
        damped = damped + damping[:, None, None] * np.eye(6) * np.maximum(
            np.diagonal(curvature, axis1=1, axis2=2)[:, :, None], 1.0
        )
        is_stuck = ((best <= low) & (slopes > 0.0)) | ((best >= high) & (slopes < 0.0))
        free_slopes = np.where(is_stuck, 0.0, slopes)
        damped = np.where(
            is_stuck.T[:, :, None] | is_stuck.T[:, None, :], np.eye(6) * damped, damped
        )
        step = np.linalg.solve(damped, free_slopes.T[..., None])[..., 0].T
        trial = np.clip(best - np.clip(step, -1.0, 1.0), low, high)
        trial_misfit, trial_slopes, trial_curvature = likelihood.misfit(trial)
        is_better = trial_misfit < misfit
        best = np.where(is_better, trial, best)
        slopes = np.where(is_better, trial_slopes, slopes)
        curvature = np.where(is_better[:, None, None], trial_curvature, curvature)
        damping = np.where(is_better, damping * LESS, damping * MORE)
        misfit = np.where(is_better, trial_misfit, misfit)
        expected = 0.5 * np.sum(free_slopes * step, axis=0)
        if np.all(expected < ENOUGH):
            break
    return best, misfit


def noise_bounds(chunks: Chunks) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of the search, (6, NUM_AXES) and (6, 1), as logarithms and a logit.

    A problem begins with the lower ones.
    """
    low = [
        np.log(MIN_DISTURBANCE_RATIO),
        np.log(MIN_DISTURBANCE_RATIO),
        np.log(TAU_RANGE_S[0]),
        -5.0,
    ]
    high = [np.log(1e3)] * 4 + [np.log(TAU_RANGE_S[1]), 5.0]
    lowest = np.concatenate(
        [np.log(noise_floors(chunks)), np.repeat(low, NUM_AXES).reshape(-1, NUM_AXES)]
    )
    return lowest, np.array(high)[:, None]
