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
from flytrack_sysid.diagnosis.chunks import NUM_AXES, Chunks

# Variance of a level at its first row, over that of its noise: its first innovation is about 0.
UNKNOWN_START = 1e8
# Least noise, by sensors and float32: direct rad/s, m/s^2; level rad, m/s, V.
FLOORS = np.array([[1e-4] * 3 + [1e-3] * 3 + [1.0], [1e-5] * 3 + [1e-4] * 3 + [1e-4]])
UNIFORM = 12.0**-0.5  # standard deviation of rounding, over the last digit
MIN_DISTURBANCE_RATIO = (
    1e-3  # of a disturbance and of a wander, over the noise: smaller ones are neglected
)
TAU_RANGE_S = (0.02, 5.0)
# Levenberg damping: the first, its factor after a bad step, and its factor after a good step.
FIRST_DAMPING, MORE, LESS = 1e-2, 10.0, 0.2
MAX_ROUNDS = 12
ENOUGH = 1.0  # of minus twice the log likelihood: the error of one parameter
# Sizes of the compiled programs: rows of chunks, and models, at a time.
NUM_ROWS, NUM_CHUNKS, NUM_MODELS = 200, 8, 8
OUTLIER = 4.0  # innovations beyond this count by their size, not by its square


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
    """The filter of a noise at every row, (..., NUM_AXES) each; direct channels before levels.

    Attributes:
        keep: share of the disturbance that is left after a step.
        push: what a step adds to the error of the level, over the disturbance (s).
        direct_d: gain from a direct innovation to the disturbance.
        direct_e: gain from a direct innovation to the error of the level.
        direct_scale: one over the standard deviation of a direct innovation.
        level_d: gain from a level's innovation to the disturbance.
        level_e: gain from a level's innovation to the error of the level.
        level_scale: one over the standard deviation of a level's innovation.
    """

    keep: Any
    push: Any
    direct_d: Any
    direct_e: Any
    direct_scale: Any
    level_d: Any
    level_e: Any
    level_scale: Any


class Variances(NamedTuple):
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
        step_s: time since the row before, (..., 1).
        is_known: 1 where the row continues a flight and no lost command acts, (..., NUM_AXES).
        counts: 1 for scored residuals, (..., NUM_AXES, 2).
    """

    step_s: Any
    is_known: Any
    counts: Any


def gains_of_row(
    noise: "Noise", variances: Variances, row: Conditions, keep: Any
) -> tuple[Variances, Gains]:
    """Return the covariance after a row, and the gains at it.

    Args:
        noise: of all axes.
        variances: the covariance before the row.
        row: its conditions.
        keep: exp(-step / tau).
    """
    joined, new = row.is_known, 1.0 - row.is_known
    stationary = noise.disturbance * noise.disturbance
    push = noise.coupling * row.step_s
    d = joined * (keep * keep * variances.disturbance - keep * keep * stationary) + stationary
    across = joined * (keep * variances.across + push * d)
    walk = noise.wander * noise.wander * row.step_s
    e = variances.level + 2.0 * push * keep * variances.across + push * push * d + walk
    e = joined * e + new * UNKNOWN_START * noise.level * noise.level
    direct_size = d + noise.direct * noise.direct
    inverse = row.counts[..., 0] / direct_size
    direct_d, direct_e = d * inverse, across * inverse
    e, across, d = e - direct_e * across, across - direct_e * d, d - direct_d * d
    level_size = e + noise.level * noise.level
    inverse = row.counts[..., 1] / level_size
    level_d, level_e = across * inverse, e * inverse
    updated = Variances(e - level_e * e, across - level_e * across, d - level_d * across)
    gains = Gains(
        keep=joined * keep,
        push=joined * push,
        direct_d=direct_d,
        direct_e=direct_e,
        direct_scale=jax.lax.rsqrt(direct_size),
        level_d=level_d,
        level_e=level_e,
        level_scale=jax.lax.rsqrt(level_size),
    )
    return updated, gains


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
    state: Filtered, residuals: Any, gain: Gains, counts: Any
) -> tuple[Filtered, Any, Any]:
    """Return the state after a row, and its innovations, direct and level.

    Args:
        state: before the row.
        residuals: of the row, (..., NUM_AXES, 2).
        gain: of the row.
        counts: 1 for scored residuals, (..., NUM_AXES, 2).
    """
    level = state.level + residuals[..., 1]
    disturbance = gain.keep * state.disturbance
    error = state.error + gain.push * disturbance
    direct_innovation = (residuals[..., 0] - disturbance) * counts[..., 0]
    disturbance = disturbance + gain.direct_d * direct_innovation
    error = error + gain.direct_e * direct_innovation
    level_innovation = (level - error) * counts[..., 1]
    updated = Filtered(
        level,
        error + gain.level_e * level_innovation,
        disturbance + gain.level_d * level_innovation,
    )
    return updated, direct_innovation * gain.direct_scale, level_innovation * gain.level_scale


def build_conditions(chunks: Chunks) -> Conditions:
    """Return the conditions of the rows of chunks, leaves (rows, chunks, ...)."""
    return Conditions(
        step_to(chunks)[..., None], chunks.is_known.astype(float), chunks.counts.astype(float)
    )


@jax.jit
def _gains_of_rows(
    log_noise: jax.Array, state: Variances, rows: Conditions
) -> tuple[Variances, Gains]:
    """Return the covariance after some rows, and the gains at them, (NUM_ROWS, NUM_CHUNKS, ...)."""
    noise = noise_of(log_noise)

    def next_row(state: Variances, row: Conditions) -> tuple[Variances, Gains]:
        return gains_of_row(noise, state, row, jnp.exp(-row.step_s / noise.tau))

    return jax.lax.scan(next_row, state, rows)


@jax.jit
def _whiten_rows(
    state: Filtered, gains: Gains, counts: jax.Array, residuals: jax.Array
) -> tuple[Filtered, jax.Array]:
    """Return the state after some rows, and innovations (NUM_ROWS, NUM_MODELS, NUM_CHUNKS, ...)."""

    def next_row(state: Filtered, inputs: tuple[Any, ...]) -> tuple[Filtered, jax.Array]:
        gain, counting, values = inputs
        state, direct, level = innovations_of_row(state, values, gain, counting)
        return state, jnp.stack([direct, level], axis=-1)

    return jax.lax.scan(next_row, state, (gains, counts, residuals))


class Whitener:
    """The filter of a noise for rows of chunks: a linear map for residuals and their slopes."""

    def __init__(self, chunks: Chunks, log_noise: np.ndarray):
        self._chunks, self._log_noise = chunks, log_noise

    @cached_property
    def _parts(self) -> dict[int, dict[int, tuple[Gains, jax.Array]]]:
        """The gains and counts, by first chunk and first row."""
        zeros = jnp.zeros((NUM_CHUNKS, NUM_AXES))
        gains_by_part: dict[int, dict[int, tuple[Gains, jax.Array]]] = {}
        for chunk, parts in cut_to_size(build_conditions(self._chunks)).items():
            state, gains_by_part[chunk] = Variances(zeros, zeros, zeros), {}
            for begin, rows in parts.items():
                state, gains = _gains_of_rows(self._log_noise, state, rows)
                gains_by_part[chunk][begin] = gains, rows.counts
        return gains_by_part

    def __call__(self, residuals: np.ndarray, axes: slice = slice(None)) -> np.ndarray:
        """Return residuals as innovations of variance 1; they are 0 where nothing counts.

        Args:
            residuals: (models, rows, chunks, axes, 2).
            axes: the axes of the residuals, of ``NUM_AXES``.
        """
        num_models, (num_rows, num_chunks) = len(residuals), self._chunks.row.shape
        padding = -num_models % NUM_MODELS, -num_rows % NUM_ROWS, -num_chunks % NUM_CHUNKS
        size = np.add((num_models, num_rows, num_chunks), padding)
        values = np.zeros((size[1], size[0], size[2], NUM_AXES, 2))
        chosen = values[:num_rows, :num_models, :num_chunks, axes]
        chosen[...] = np.moveaxis(residuals, 0, 1)
        zeros = jnp.zeros((NUM_MODELS, NUM_CHUNKS, NUM_AXES))
        for (chunk, parts), model in product(self._parts.items(), range(0, size[0], NUM_MODELS)):
            state = Filtered(zeros, zeros, zeros)
            for begin, (gains, counts) in parts.items():
                part = (
                    slice(begin, begin + NUM_ROWS),
                    slice(model, model + NUM_MODELS),
                    slice(chunk, chunk + NUM_CHUNKS),
                )
                state, values[part] = _whiten_rows(state, gains, counts, values[part])
        return np.moveaxis(chosen, 0, 1)


def cut_to_size(tree: Any) -> dict[int, dict[int, Any]]:
    """Return leaves (rows, chunks, ...) in parts of one size, by first chunk and first row.

    Parts are padded with 0, so that one program serves logs of any length and rate.
    """
    num_rows, num_chunks = jax.tree.leaves(tree)[0].shape[:2]
    padding = [(0, -num_rows % NUM_ROWS), (0, -num_chunks % NUM_CHUNKS)]
    padded = jax.tree.map(lambda leaf: np.pad(leaf, padding + [(0, 0)] * (leaf.ndim - 2)), tree)

    def part(row: int, chunk: int) -> Any:
        part_slices = slice(row, row + NUM_ROWS), slice(chunk, chunk + NUM_CHUNKS)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[part_slices]), padded)

    return {
        chunk: {row: part(row, chunk) for row in range(0, num_rows, NUM_ROWS)}
        for chunk in range(0, num_chunks, NUM_CHUNKS)
    }


def step_to(chunks: Chunks) -> np.ndarray:
    """Return the time since the row before (s), (rows, chunks)."""
    step_s = chunks.record.step_s
    return np.concatenate([step_s[:1], step_s[:-1]])


def noise_of(log_noise: jax.Array | np.ndarray) -> Noise:
    """Return the noise from its logarithms and a logit, (6, NUM_AXES)."""
    direct, level = jnp.exp(log_noise[0]), jnp.exp(log_noise[1])
    disturbance, wander = direct * jnp.exp(log_noise[3]), level * jnp.exp(log_noise[2])
    return Noise(
        direct, level, wander, disturbance, jnp.exp(log_noise[4]), jax.nn.sigmoid(log_noise[5])
    )


DIFFERENCE = 1e-4  # of logarithms, for slopes


@jax.jit
def _misfit_rows(
    log_noise: jax.Array, state: Any, rows: Conditions, residuals: jax.Array
) -> tuple[Any, tuple[jax.Array, jax.Array, jax.Array]]:
    """Return the state after some rows, and the contributions of these to the misfit of a noise.

    The contributions are each axis's misfit (NUM_AXES,), its slopes (6, NUM_AXES) and its expected
    curvature (NUM_AXES, 6, 6). The misfit is minus twice the log likelihood; outliers count by
    their size. Axes do not depend on each other, so that one difference serves all.
    """
    shifts = DIFFERENCE * jnp.eye(len(log_noise))[:, :, None]
    noise = jax.vmap(noise_of)(jnp.concatenate([log_noise[None], log_noise + shifts]))
    noise = jax.tree.map(lambda leaf: leaf[:, None, :], noise)  # (noises, chunks, axes)

    def next_row(noise: Noise, state: Any, inputs: Any) -> Any:
        row, values = inputs
        (variances, filtered), keep = state, jnp.exp(-row.step_s / noise.tau)
        variances, gain = gains_of_row(noise, variances, row, keep)
        filtered, direct, level = innovations_of_row(filtered, values, gain, row.counts)
        white = jnp.stack([direct, level], axis=-1)
        scale = jnp.stack([gain.direct_scale, gain.level_scale], axis=-1)
        return (variances, filtered), (white, scale)

    kernel = partial(one_kernel(next_row), noise)
    state, (white, scale) = jax.lax.scan(kernel, state, (rows, residuals))
    size = jnp.abs(white)
    squares = jnp.where(size < OUTLIER, size**2, OUTLIER * (2.0 * size - OUTLIER))
    logs = -2.0 * jnp.log(scale) * rows.counts[:, None]
    errors = white / scale
    misfit = (squares + logs).sum(axis=(0, 2, 4))

    def slopes(values: jax.Array, axis: int = 0) -> jax.Array:
        shifted = jax.lax.slice_in_dim(values, 1, None, axis=axis)
        return (shifted - jax.lax.slice_in_dim(values, 0, 1, axis=axis)) / DIFFERENCE

    log_slopes = slopes(logs, axis=1)
    error_slopes = slopes(errors, axis=1) * scale[:, :1]
    curvature = jnp.einsum("rjlac,rklac->ajk", log_slopes, log_slopes)
    curvature += 2.0 * jnp.einsum("rjlac,rklac->ajk", error_slopes, error_slopes)
    return state, (misfit[0], slopes(misfit), curvature)


class Likelihood:
    """The likelihood of noises, given residuals of chunks (rows, chunks, NUM_AXES, 2)."""

    def __init__(self, chunks: Chunks, residuals: np.ndarray):
        self._parts = cut_to_size((build_conditions(chunks), residuals))

    def misfit(self, log_noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the sums of ``_misfit_rows`` over all rows."""
        zeros = jnp.zeros((1 + len(log_noise), NUM_CHUNKS, NUM_AXES))
        begin = Variances(*[zeros] * 3), Filtered(*[zeros] * 3)
        sums = []
        for parts in self._parts.values():
            state = begin
            for rows, residuals in parts.values():
                state, added = _misfit_rows(log_noise, state, rows, residuals)
                sums.append(added)
        total, slopes, curvature = (
            np.sum([np.asarray(leaf) for leaf in leaves], axis=0)
            for leaves in zip(*sums, strict=True)
        )
        return total, slopes, curvature


def noise_floors(chunks: Chunks) -> np.ndarray:
    """Return the least noise of each channel, (2, NUM_AXES): of its last digit or of float32."""
    return np.maximum(FLOORS, chunks.quanta * UNIFORM)


def least_noise(chunks: Chunks) -> np.ndarray:
    """Return the logarithms of the least noise, (6, NUM_AXES), with which a problem begins."""
    return _bounds(chunks)[0]


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

    The method is Fisher scoring with Levenberg damping, for each axis by itself.
    """
    likelihood, (low, high) = Likelihood(chunks, residuals), _bounds(chunks)
    best = np.clip(first_guess(chunks, residuals) if start is None else start, low, high)
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
    return best


def _bounds(chunks: Chunks) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of the search, (6, NUM_AXES) and (6, 1), as logarithms and a logit."""
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
