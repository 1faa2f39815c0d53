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

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_sysid.diagnosis.lanes import NUM_AXES, Lanes

# Variance of a level at its first row, over that of its noise: its first innovation is about 0.
UNKNOWN_START = 1e8
# Least noise, by sensors and float32: direct rad/s, m/s^2; level rad, m/s, V.
FLOORS = np.array([[1e-4] * 3 + [1e-3] * 3 + [1.0], [1e-5] * 3 + [1e-4] * 3 + [1e-4]])
UNIFORM = 12.0**-0.5  # standard deviation of rounding, over the last digit
LEAST_SHARE = 1e-3  # of a disturbance and of a wander, over the noise: smaller ones are neglected
TAU_RANGE_S = (0.02, 5.0)
# Levenberg damping: at first, its growth after a bad step, its decrease after a good one.
FIRST_DAMPING, MORE, LESS = 1e-2, 10.0, 0.2
MOST_ROUNDS = 12
ENOUGH = 1.0  # of minus twice the log likelihood: the error of one parameter
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
    """The filter of a noise, (rows, lanes, NUM_AXES) each; direct before level."""

    keep: jax.Array
    push: jax.Array
    direct_d: jax.Array
    direct_e: jax.Array
    direct_size: jax.Array
    level_d: jax.Array
    level_e: jax.Array
    level_size: jax.Array


def make_gains(noise: Noise, step_s: jax.Array, is_known: jax.Array, counts: jax.Array) -> Gains:
    """Return the gains; step_s (rows, lanes) to the row, counts (rows, lanes, NUM_AXES, 2) bool."""

    def row(carry: tuple[Any, ...], inputs: tuple[Any, ...]) -> tuple[Any, Any]:
        var_e, cov, var_d = carry
        dt, joined, counting, keep = inputs
        dt = dt[:, None]
        push = noise.coupling * dt
        stationary = noise.disturbance**2
        later_d = jnp.where(joined, keep**2 * var_d + stationary * (1.0 - keep**2), stationary)
        later_cov = jnp.where(joined, keep * cov + push * later_d, 0.0)
        walked = var_e + 2.0 * push * keep * cov + push**2 * later_d + noise.wander**2 * dt
        later_e = jnp.where(joined, walked, UNKNOWN_START * noise.level**2)
        size = later_d + noise.direct**2
        inverse = counting[..., 0] / size
        direct_d, direct_e, direct_size = later_d * inverse, later_cov * inverse, size
        later_e, later_cov, later_d = (
            later_e - direct_e * later_cov,
            later_cov - direct_e * later_d,
            later_d - direct_d * later_d,
        )
        size = later_e + noise.level**2
        inverse = counting[..., 1] / size
        level_d, level_e, level_size = later_cov * inverse, later_e * inverse, size
        carry = (
            later_e - level_e * later_e,
            later_cov - level_e * later_cov,
            later_d - level_d * later_cov,
        )
        keep, push = jnp.where(joined, keep, 0.0), jnp.where(joined, push, 0.0)
        return carry, Gains(
            keep, push, direct_d, direct_e, direct_size, level_d, level_e, level_size
        )

    keep = jnp.exp(-step_s[..., None] / noise.tau)
    by_row = (step_s, is_known, counts.astype(step_s.dtype), keep)
    nothing = jnp.zeros((step_s.shape[1], NUM_AXES))
    return jax.lax.scan(row, (nothing, nothing, nothing), by_row)[1]


def innovations(gains: Gains, increments: jax.Array, counts: jax.Array) -> jax.Array:
    """Return residuals (rows, lanes, axes, 2) as innovations of variance 1; 0 if not counted."""

    def row(carry: tuple[Any, ...], inputs: tuple[Any, ...]) -> tuple[Any, Any]:
        sum_e, wandered, disturbed = carry
        values, gain, counting = inputs
        level = sum_e + values[..., 1]
        disturbed = gain.keep * disturbed
        wandered = wandered + gain.push * disturbed
        direct = (values[..., 0] - disturbed) * counting[..., 0]
        disturbed, wandered = disturbed + gain.direct_d * direct, wandered + gain.direct_e * direct
        off = (level - wandered) * counting[..., 1]
        later = level, wandered + gain.level_e * off, disturbed + gain.level_d * off
        sized = jnp.stack(
            [direct / jnp.sqrt(gain.direct_size), off / jnp.sqrt(gain.level_size)], axis=-1
        )
        return later, sized

    nothing = jnp.zeros(increments.shape[1:3])
    by_row = (increments, gains, counts.astype(increments.dtype))
    return jax.lax.scan(row, (nothing, nothing, nothing), by_row)[1]


def step_to(lanes: Lanes) -> np.ndarray:
    """Return the time from the row before, (rows, lanes) s."""
    step_s = lanes.record.step_s
    return np.concatenate([step_s[:1], step_s[:-1]])


def noise_of(log_noise: jax.Array | np.ndarray) -> Noise:
    """Return the noise from its logarithms and a logit, (6, NUM_AXES)."""
    direct, level = jnp.exp(log_noise[0]), jnp.exp(log_noise[1])
    disturbance, wander = direct * jnp.exp(log_noise[3]), level * jnp.exp(log_noise[2])
    return Noise(
        direct, level, wander, disturbance, jnp.exp(log_noise[4]), jax.nn.sigmoid(log_noise[5])
    )


DIFFERENCE = 1e-4  # of logarithms, for slopes


class _Misfit(NamedTuple):
    """Minus twice the log likelihood of each axis, with outliers linear in size, and its parts."""

    total: jax.Array
    log_sizes: jax.Array
    errors: jax.Array
    sizes: jax.Array


def _misfit(
    log_noise: jax.Array, step_s: jax.Array, joined: jax.Array, counts: jax.Array, left: jax.Array
) -> _Misfit:
    gains = make_gains(noise_of(log_noise), step_s, joined, counts)
    found = innovations(gains, left, counts)
    size = jnp.abs(found)
    squares = jnp.where(size < OUTLIER, size**2, OUTLIER * (2.0 * size - OUTLIER))
    sizes = jnp.stack([gains.direct_size, gains.level_size], axis=-1)
    logs = jnp.where(counts, jnp.log(sizes), 0.0)
    return _Misfit((squares + logs).sum(axis=(0, 1, 3)), logs, found * jnp.sqrt(sizes), sizes)


@jax.jit
def _misfit_and_slopes(
    log_noise: jax.Array, *given: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return each axis's misfit, slopes and expected curvature.

    Shapes are (NUM_AXES,), (6, NUM_AXES) and (NUM_AXES, 6, 6).

    Axes do not depend on each other, so that one difference serves all.
    """
    shifts = DIFFERENCE * jnp.eye(len(log_noise))[:, :, None]
    found = jax.vmap(lambda values: _misfit(values, *given))(
        jnp.concatenate([log_noise[None], log_noise + shifts])
    )

    def slopes(values: jax.Array) -> jax.Array:
        return (values[1:] - values[0]) / DIFFERENCE

    logs, errors = slopes(found.log_sizes), slopes(found.errors) / jnp.sqrt(found.sizes[0])
    curvature = jnp.einsum("jlrac,klrac->ajk", logs, logs) + 2.0 * jnp.einsum(
        "jlrac,klrac->ajk", errors, errors
    )
    return found.total[0], slopes(found.total), curvature


def floors_of(lanes: Lanes) -> np.ndarray:
    """Return the least noise of each channel, (2, NUM_AXES): of its last digit, or of float32."""
    return np.maximum(FLOORS, lanes.quanta * UNIFORM)


def first_guess(lanes: Lanes, left: np.ndarray) -> np.ndarray:
    """Return log noise to start the search from, (6, NUM_AXES), robust against slow residuals."""
    counts, floors = lanes.counts, floors_of(lanes)
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


def disturbance_gain(lanes: Lanes, left: np.ndarray, log_noise: np.ndarray) -> np.ndarray:
    """Return how much a disturbance lowers minus twice the log likelihood, by axis."""
    still = log_noise.copy()
    still[3] = np.log(LEAST_SHARE)
    return np.subtract(*(_total(one, *_given(lanes, left)) for one in (still, log_noise)))


def total_misfit(lanes: Lanes, left: np.ndarray, log_noise: np.ndarray) -> float:
    """Return minus twice the log likelihood of residuals under a noise."""
    return float(np.sum(_total(log_noise, *_given(lanes, left))))


def _given(lanes: Lanes, left: np.ndarray) -> tuple[jax.Array, ...]:
    return tuple(jnp.asarray(part) for part in (step_to(lanes), lanes.is_known, lanes.counts, left))


@jax.jit
def _total(log_noise: jax.Array, *given: jax.Array) -> jax.Array:
    return _misfit(log_noise, *given).total


def fit_noise(lanes: Lanes, left: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """Return the likeliest noise, (6, NUM_AXES), of residuals (rows, lanes, NUM_AXES, 2).

    Fisher scoring with Levenberg damping, every axis by itself.
    """
    given, (low, high) = _given(lanes, left), _bounds(lanes)
    best = np.clip(first_guess(lanes, left) if start is None else start, low, high)
    misfit, slopes, curvature = (np.asarray(part) for part in _misfit_and_slopes(best, *given))
    damping = np.full(NUM_AXES, FIRST_DAMPING)
    for _ in range(MOST_ROUNDS):
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
        then, then_slopes, then_curvature = (
            np.asarray(part) for part in _misfit_and_slopes(tried, *given)
        )
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


def _bounds(lanes: Lanes) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of the search, (6, NUM_AXES) and (6, 1), as logarithms and a logit."""
    low = [np.log(LEAST_SHARE), np.log(LEAST_SHARE), np.log(TAU_RANGE_S[0]), -5.0]
    high = [np.log(1e3)] * 4 + [np.log(TAU_RANGE_S[1]), 5.0]
    lowest = np.concatenate(
        [np.log(floors_of(lanes)), np.repeat(low, NUM_AXES).reshape(-1, NUM_AXES)]
    )
    return lowest, np.array(high)[:, None]
