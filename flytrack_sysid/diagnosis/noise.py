"""Noise of residuals: white sensor noise and a wandering disturbance, and a whitening filter.

Each axis (three of rotation, three of force, one of the battery) has two channels: a direct one,
``w`` or ``f``, and a level, ``q``, ``v`` or ``v_bat``, whose rate of change the direct one
measures. The model of their residuals is

    d after = exp(-dt / tau) d + white        disturbance: gusts, vibration, what the model lacks
    e after = e + coupling d dt + white       sum of the disturbance, and of the fed-in attitude
    direct  = d + white                       sensor noise
    level   = e + white                       sensor noise; e begins unknown

and a Kalman filter turns it into innovations, white and of variance 1. Its gains depend on the
noise alone, so that it is one linear map for residuals and their slopes. It needs no windows: where
nothing wanders, a level counts from the first row to the last; where much wanders, only its
increments do.
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
# Levenberg damping: at first, its growth after a bad step, its decrease after a good one.
FIRST_DAMPING, MORE, LESS = 1e-2, 10.0, 0.2
MAX_ROUNDS = 12
ENOUGH = 1.0  # of minus twice the log likelihood: the error of one parameter
# Sizes of the compiled programs: rows of chunks, and models, at a time.
NUM_ROWS, NUM_CHUNKS, NUM_MODELS = 200, 8, 8
OUTLIER = 4.0  # innovations beyond count by their size, not its square


class Noise(NamedTuple):
    """Noise by axis, each (NUM_AXES,).

    direct, level: standard deviations of the sensors. wander: of e in a second, as a random walk.
    disturbance: standard deviation of d, unit of the direct channel. tau: its time constant, s.
    coupling: 0 where it is the direct sensor's alone, 1 where the drone feels it.
    """

    direct: jax.Array
    level: jax.Array
    wander: jax.Array
    disturbance: jax.Array
    tau: jax.Array
    coupling: jax.Array


class Gains(NamedTuple):
    """The filter of a noise at every row, (..., NUM_AXES) each; direct channels before levels.

    keep, push: share of the disturbance that is left after a step, and what it adds to the error of
    the level. direct_d, direct_e, level_d, level_e: gains of an innovation. direct_scale,
    level_scale: one over the standard deviations of the innovations.
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
    """Covariance of the filter's state: error of the level, with the disturbance, disturbance."""

    level: Any
    across: Any
    disturbance: Any


class Conditions(NamedTuple):
    """What the filter needs to know of rows besides their residuals; floats.

    step_s: (..., 1), since the row before. is_known: (..., NUM_AXES), 1 where the row continues a
    flight and no lost command acts. counts: (..., NUM_AXES, 2), 1 for what is judged.
    """

    step_s: Any
    is_known: Any
    counts: Any


def gains_of_row(
    noise: "Noise", variances: Variances, row: Conditions, keep: Any
) -> tuple[Variances, Gains]:
    """Return the covariance after a row, and the gains at it; keep: exp(-step / tau)."""
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
    later = Variances(e - level_e * e, across - level_e * across, d - level_d * across)
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
    return later, gains


class Filtered(NamedTuple):
    """State of the filter: summed changes of the level, its error, and the disturbance."""

    level: Any
    error: Any
    disturbance: Any


def innovations_of_row(
    state: Filtered, residuals: Any, gain: Gains, counts: Any
) -> tuple[Filtered, Any, Any]:
    """Return the state after a row, and its innovations, direct and level.

    residuals: (..., NUM_AXES, 2).
    """
    level = state.level + residuals[..., 1]
    disturbance = gain.keep * state.disturbance
    error = state.error + gain.push * disturbance
    direct = (residuals[..., 0] - disturbance) * counts[..., 0]
    disturbance = disturbance + gain.direct_d * direct
    error = error + gain.direct_e * direct
    off = (level - error) * counts[..., 1]
    later = Filtered(level, error + gain.level_e * off, disturbance + gain.level_d * off)
    return later, direct * gain.direct_scale, off * gain.level_scale


def conditions_of(chunks: Chunks) -> Conditions:
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
        """The gains and what counts, by first chunk and first row."""
        nothing = jnp.zeros((NUM_CHUNKS, NUM_AXES))
        found: dict[int, dict[int, tuple[Gains, jax.Array]]] = {}
        for chunk, parts in cut_to_size(conditions_of(self._chunks)).items():
            state, found[chunk] = Variances(nothing, nothing, nothing), {}
            for begin, rows in parts.items():
                state, gains = _gains_of_rows(self._log_noise, state, rows)
                found[chunk][begin] = gains, rows.counts
        return found

    def __call__(self, residuals: np.ndarray, axes: slice = slice(None)) -> np.ndarray:
        """Return residuals (models, rows, chunks, axes, 2) as innovations of variance 1.

        They are 0 where nothing counts. axes: which of ``NUM_AXES`` they are.
        """
        num_models, (num_rows, num_chunks) = len(residuals), self._chunks.row.shape
        filled = -num_models % NUM_MODELS, -num_rows % NUM_ROWS, -num_chunks % NUM_CHUNKS
        size = np.add((num_models, num_rows, num_chunks), filled)
        values = np.zeros((size[1], size[0], size[2], NUM_AXES, 2))
        chosen = values[:num_rows, :num_models, :num_chunks, axes]
        chosen[...] = np.moveaxis(residuals, 0, 1)
        nothing = jnp.zeros((NUM_MODELS, NUM_CHUNKS, NUM_AXES))
        for (chunk, parts), model in product(self._parts.items(), range(0, size[0], NUM_MODELS)):
            state = Filtered(nothing, nothing, nothing)
            for begin, (gains, counts) in parts.items():
                place = (
                    slice(begin, begin + NUM_ROWS),
                    slice(model, model + NUM_MODELS),
                    slice(chunk, chunk + NUM_CHUNKS),
                )
                state, values[place] = _whiten_rows(state, gains, counts, values[place])
        return np.moveaxis(chosen, 0, 1)


def cut_to_size(tree: Any) -> dict[int, dict[int, Any]]:
    """Return leaves (rows, chunks, ...) in parts of one size, by first chunk and first row.

    So one program serves logs of any length and rate. What fills parts up is 0.
    """
    num_rows, num_chunks = jax.tree.leaves(tree)[0].shape[:2]
    fill = [(0, -num_rows % NUM_ROWS), (0, -num_chunks % NUM_CHUNKS)]
    padded = jax.tree.map(lambda leaf: np.pad(leaf, fill + [(0, 0)] * (leaf.ndim - 2)), tree)

    def part(row: int, chunk: int) -> Any:
        place = slice(row, row + NUM_ROWS), slice(chunk, chunk + NUM_CHUNKS)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[place]), padded)

    return {
        chunk: {row: part(row, chunk) for row in range(0, num_rows, NUM_ROWS)}
        for chunk in range(0, num_chunks, NUM_CHUNKS)
    }


def step_to(chunks: Chunks) -> np.ndarray:
    """Return the time from the row before, (rows, chunks) s."""
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
    """Return the state after some rows, and what these add to the misfit of a noise.

    Each axis's misfit (NUM_AXES,), its slopes (6, NUM_AXES) and its expected curvature
    (NUM_AXES, 6, 6). The misfit is minus twice the log likelihood, outliers counted by their size.
    Axes do not depend on each other, so that one difference serves all.
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
        others = jax.lax.slice_in_dim(values, 1, None, axis=axis)
        return (others - jax.lax.slice_in_dim(values, 0, 1, axis=axis)) / DIFFERENCE

    log_slopes = slopes(logs, axis=1)
    error_slopes = slopes(errors, axis=1) * scale[:, :1]
    curvature = jnp.einsum("rjlac,rklac->ajk", log_slopes, log_slopes)
    curvature += 2.0 * jnp.einsum("rjlac,rklac->ajk", error_slopes, error_slopes)
    return state, (misfit[0], slopes(misfit), curvature)


class Likelihood:
    """Residuals of chunks, (rows, chunks, NUM_AXES, 2), whose noise is asked for."""

    def __init__(self, chunks: Chunks, residuals: np.ndarray):
        self._parts = cut_to_size((conditions_of(chunks), residuals))

    def misfit(self, log_noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the sums of ``_misfit_rows`` over all rows."""
        nothing = jnp.zeros((1 + len(log_noise), NUM_CHUNKS, NUM_AXES))
        begin = Variances(*[nothing] * 3), Filtered(*[nothing] * 3)
        sums = []
        for parts in self._parts.values():
            state = begin
            for rows, residuals in parts.values():
                state, added = _misfit_rows(log_noise, state, rows, residuals)
                sums.append(added)
        total, slopes, curvature = (
            np.sum([np.asarray(one) for one in leaves], axis=0)
            for leaves in zip(*sums, strict=True)
        )
        return total, slopes, curvature


def floors_of(chunks: Chunks) -> np.ndarray:
    """Return the least noise of each channel, (2, NUM_AXES): of its last digit, or of float32."""
    return np.maximum(FLOORS, chunks.quanta * UNIFORM)


def least_noise(chunks: Chunks) -> np.ndarray:
    """Return the logarithms of the least noise, (6, NUM_AXES), with which a problem begins."""
    return _bounds(chunks)[0]


def first_guess(chunks: Chunks, left: np.ndarray) -> np.ndarray:
    """Return log noise to start the search from, (6, NUM_AXES), robust against slow residuals."""
    counts, floors = chunks.counts, floors_of(chunks)
    both = counts[1:] & counts[:-1]
    found = np.zeros((6, NUM_AXES))
    for axis in range(NUM_AXES):
        direct = (left[1:, :, axis, 0] - left[:-1, :, axis, 0])[both[..., axis, 0]]
        level = left[1:, :, axis, 1][both[..., axis, 1]]
        for number, change in enumerate((direct, level)):
            spread = np.sqrt(0.5 * np.mean(np.square(change))) if len(change) else 1.0
            found[number, axis] = np.log(max(spread, floors[number, axis]))
    found[2], found[3], found[4], found[5] = np.log(0.1), np.log(0.1), np.log(0.3), 0.0
    return found


def disturbance_gain(chunks: Chunks, left: np.ndarray, log_noise: np.ndarray) -> np.ndarray:
    """Return how much a disturbance lowers minus twice the log likelihood, by axis."""
    still = log_noise.copy()
    still[3] = np.log(MIN_DISTURBANCE_RATIO)
    likelihood = Likelihood(chunks, left)
    return likelihood.misfit(still)[0] - likelihood.misfit(log_noise)[0]


def total_misfit(chunks: Chunks, left: np.ndarray, log_noise: np.ndarray) -> float:
    """Return minus twice the log likelihood of residuals under a noise."""
    return float(np.sum(Likelihood(chunks, left).misfit(log_noise)[0]))


def fit_noise(chunks: Chunks, left: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """Return the likeliest noise, (6, NUM_AXES), of residuals (rows, chunks, NUM_AXES, 2).

    Fisher scoring with Levenberg damping, every axis by itself.
    """
    likelihood, (low, high) = Likelihood(chunks, left), _bounds(chunks)
    best = np.clip(first_guess(chunks, left) if start is None else start, low, high)
    misfit, slopes, curvature = likelihood.misfit(best)
    damping = np.full(NUM_AXES, FIRST_DAMPING)
    for _ in range(MAX_ROUNDS):
        scaled = curvature + 1e-9 * np.eye(6)
        scaled = scaled + damping[:, None, None] * np.eye(6) * np.maximum(
            np.diagonal(curvature, axis1=1, axis2=2)[:, :, None], 1.0
        )
        is_stuck = ((best <= low) & (slopes > 0.0)) | ((best >= high) & (slopes < 0.0))
        pull = np.where(is_stuck, 0.0, slopes)
        scaled = np.where(
            is_stuck.T[:, :, None] | is_stuck.T[:, None, :], np.eye(6) * scaled, scaled
        )
        step = np.linalg.solve(scaled, pull.T[..., None])[..., 0].T
        tried = np.clip(best - np.clip(step, -1.0, 1.0), low, high)
        then, then_slopes, then_curvature = likelihood.misfit(tried)
        is_better = then < misfit
        best = np.where(is_better, tried, best)
        slopes = np.where(is_better, then_slopes, slopes)
        curvature = np.where(is_better[:, None, None], then_curvature, curvature)
        damping = np.where(is_better, damping * LESS, damping * MORE)
        misfit = np.where(is_better, then, misfit)
        expected = 0.5 * np.sum(pull * step, axis=0)
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
        [np.log(floors_of(chunks)), np.repeat(low, NUM_AXES).reshape(-1, NUM_AXES)]
    )
    return lowest, np.array(high)[:, None]
