"""Least squares over all channels of a log, each weighted by the noise that it turns out to have."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid import parameters
from flytrack_sysid.log import FlightLog
from flytrack_sysid.record import make_record
from flytrack_sysid.residuals import CENTRED, Problem, make_problem, residuals

# Noise that the first round assumes, in the channels' units: that of common sensors.
FIRST_NOISE = {"w": 0.1, "f": 1.5, "v": 0.05, "p": 0.01, "q": 0.01, "v_bat": 0.02}
LEAST_NOISE = 1e-12
LEAST_INFORMATION = 1e-13  # about a direction, against what is known best: rounding hides less
# Relative to cost and step, of each round: only the last is to be exact.
TOLERANCES = (1e-4, 1e-4, 1e-14)
MOST_EVALUATIONS = 200  # about ten times what a search takes that ends
LAST_RISE = 1e-10  # of the cost, which rounding may add to such a step
LAST_STEPS = 3  # from an error of 1e-8, where the cost is flat to rounding, to that of the slopes
# How far thrust coefficients may lie from where the search starts, in weights of the drone (per volt for
# the last two): weak enough to move nothing that the data determine, and it keeps the rest finite.
PRIOR_WEIGHTS = {
    **dict.fromkeys(parameters.THRUST_COEFFS[:4], 10.0),
    **dict.fromkeys(parameters.THRUST_COEFFS[4:], 1.0),
}


class FitError(ValueError):
    """Data that do not determine the model, or that no model of this structure fits."""


class Estimate(NamedTuple):
    """What a fit found, in float64.

    model: with the estimate in it. free: names of what was estimated. covariance: of the free
    parameters. noise: rms left of each channel, per component. measured: rms of what each channel
    measured, likewise. count: numbers that were explained.
    """

    model: ModelParameters
    free: tuple[str, ...]
    covariance: np.ndarray
    noise: dict[str, np.ndarray]
    measured: dict[str, np.ndarray]
    count: int  # type: ignore[assignment]  # hides tuple.count


@jax.jit
def _weighted(
    values: jax.Array,
    where: jax.Array,
    vector: jax.Array,
    like: ModelParameters,
    problem: Problem,
    weights: dict[str, jax.Array],
) -> jax.Array:
    """Return all residuals times their weights, flat, with ``values`` in these places of the vector."""
    found = residuals(parameters.from_vector(vector.at[where].set(values), like), problem)
    return jnp.concatenate([(found[name] * weights[name]).ravel() for name in sorted(found)])


_slopes = jax.jit(jax.jacfwd(_weighted))


class _Search:
    """One round: the least squares problem with given weights, in the free parameters' own scale.

    Time constants are searched for by their logarithm, so that none becomes negative.
    """

    def __init__(
        self, start: ModelParameters, free: tuple[str, ...], problem: Problem, noise: dict[str, np.ndarray]
    ):
        self.free, self.problem = free, problem
        names = parameters.names_of(start)
        where = np.array([names.index(name) for name in free])
        vector = parameters.to_vector(start)
        self.given = where, vector, start, problem, {name: 1.0 / sigma for name, sigma in noise.items()}
        self.centre = vector[where]
        self.is_log = np.array([name in parameters.TAUS for name in free])
        channels = [problem.channels[name] for name in sorted(problem.channels)]
        self.counting = np.concatenate([channel.counts.ravel() > 0 for channel in channels])
        scale = [PRIOR_WEIGHTS.get(name, np.inf) for name in free]
        self.prior_weight = 1.0 / (np.array(scale) * float(start.m) * float(start.g))

    def values(self, params: np.ndarray) -> np.ndarray:
        """Return the free parameters in their own units."""
        return np.where(self.is_log, np.exp(np.where(self.is_log, params, 0.0)), params)

    def residual(self, params: np.ndarray) -> np.ndarray:
        """Return the weighted residuals of rows that count, and the pull of the prior."""
        values = self.values(params)
        weighted = np.asarray(_weighted(values, *self.given))[self.counting]
        return np.concatenate([weighted, self.prior_weight * (values - self.centre)])

    def slopes(self, params: np.ndarray) -> np.ndarray:
        """Return the derivative of ``residual``."""
        values = self.values(params)
        slopes = np.asarray(_slopes(values, *self.given))[self.counting]
        chain = np.where(self.is_log, values, 1.0)
        return np.concatenate([slopes, np.diag(self.prior_weight)]) * chain

    def acting(self) -> tuple[str, ...]:
        """Return the free parameters on which anything that counts depends, at the start."""
        slopes = np.asarray(_slopes(self.centre, *self.given))[self.counting]
        return tuple(name for name, acts in zip(self.free, slopes.any(axis=0), strict=True) if acts)

    def run(self, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers found, and their covariance in the scale of the search."""
        bounds = np.array([parameters.bounds_of(name) for name in self.free])
        bounds[self.is_log] = np.log(bounds[self.is_log])
        start = np.where(self.is_log, np.log(np.abs(self.centre) + LEAST_NOISE), self.centre)
        try:
            result = optimize.least_squares(
                self.residual,
                np.clip(start, bounds[:, 0], bounds[:, 1]),
                self.slopes,
                bounds=bounds.T,
                x_scale="jac",
                xtol=tolerance,
                ftol=tolerance,
                gtol=None,
                max_nfev=MOST_EVALUATIONS,
            )
        except ValueError as error:  # scipy's word for residuals that are not finite
            raise FitError(f"the fit diverged: {error}") from error
        if not result.success or not np.isfinite(result.cost):
            raise FitError(f"the fit did not converge: {result.message}")
        if tolerance == TOLERANCES[-1]:
            result.x = self.polished(result.x, bounds.T)
        return result.x, self.covariance(result.jac, result.fun)

    def polished(self, params: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        """Return where the slope of the cost, and not only its change, is rounding: full Gauss-Newton steps.

        The cost is flat at its least, so that a search which compares costs ends a 1e-8 away from it,
        in a direction that the order of summation decides: another number of threads, another model.
        """
        left = self.residual(params)
        for _ in range(LAST_STEPS):
            slopes = self.slopes(params)
            size = np.linalg.norm(slopes, axis=0)
            size = np.where(size > 0.0, size, 1.0)
            step = np.linalg.lstsq(slopes / size, -left, rcond=LEAST_INFORMATION)[0] / size
            moved = np.clip(params + step, *bounds)
            then = self.residual(moved)
            if not then @ then <= (left @ left) * (1.0 + LAST_RISE):
                break
            params, left = moved, then
        return params

    def covariance(self, slopes: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Return the covariance of the parameters, widened where residuals within a flight are correlated.

        That of independent residuals of the noise assumed, in which each standard deviation is raised to
        that of the cluster-robust (sandwich) estimate over pieces of a flight, if that is larger: what
        the model lacks shows as residuals that agree within a piece.
        """
        size = np.sqrt(np.sum(slopes**2, axis=0))
        scale = np.where(size > 0.0, size, 1.0)
        scaled = slopes / scale
        information, directions = np.linalg.eigh(scaled.T @ scaled)
        # A floor and no pseudo-inverse, so that what the data say nothing of is very uncertain.
        information = np.maximum(information, LEAST_INFORMATION * information[-1])
        bread = directions / information @ directions.T
        widths = [self.problem.channels[name].counts.shape[1] for name in sorted(self.problem.channels)]
        pieces = np.concatenate([np.repeat(self.problem.record.piece, width) for width in widths])
        pieces = pieces[self.counting]
        pulls = np.zeros((pieces.max() + 1, len(scale)))
        np.add.at(pulls, pieces, scaled[: len(pieces)] * left[: len(pieces), None])
        count = len(np.unique(pieces))
        robust = bread @ (pulls.T @ pulls) @ bread * (count / max(count - 1, 1))
        widen = np.sqrt(np.maximum(np.diag(robust) / np.maximum(np.diag(bread), LEAST_NOISE), 1.0))
        wide = bread * np.outer(widen, widen)
        return wide / np.outer(scale, scale)


def _acting_search(
    model: ModelParameters,
    free: tuple[str, ...],
    problem: Problem,
    noise: dict[str, np.ndarray],
    may_be_idle: bool,
) -> _Search:
    """Return a search without parameters that nothing depends on, which would lead it astray.

    Wind, say, acts only once there is some drag; what is idle after the first round too is refused.
    """
    search = _Search(model, free, problem, noise)
    acting = search.acting()
    idle = [name for name in free if name not in acting]
    if idle and not may_be_idle:
        raise FitError(f"{', '.join(idle)}: nothing that the log measured depends on it; expected it fixed")
    return _Search(model, acting, problem, noise) if idle else search


def _spread(values: np.ndarray, channel_name: str, problem: Problem) -> np.ndarray:
    """Return the rms of residuals per component, with the means that were taken out counted as fitted."""
    channel = problem.channels[channel_name]
    count = channel.counts.sum(axis=0)
    if channel_name in CENTRED:
        used = channel.counts.any(axis=1)
        sizes = np.unique(channel.window[used], return_counts=True)[1]
        count = count - np.minimum(sizes, 2 if channel_name == "p" else 1).sum()
    return np.sqrt(np.sum(values**2, axis=0) / np.maximum(count, 1.0))


def estimate(
    log: FlightLog,
    judged: np.ndarray,
    start: ModelParameters,
    free: tuple[str, ...],
    report: Callable[[int, int], None] = lambda done, rounds: None,
) -> Estimate:
    """Return the least squares estimate of a model's free parameters from the judged rows of a log.

    Weights and the rows that lost commands spoil follow from the estimate of the round before.

    Raises:
        FitError: a search that diverged or ended at a bound.
    """
    with jax.enable_x64(True):
        record = make_record(log)
        model = jax.tree.map(lambda leaf: np.asarray(leaf, float), start)
        noise: dict[str, np.ndarray] = {}
        for number, tolerance in enumerate(TOLERANCES):
            problem = make_problem(log, record, judged, model)
            widths = {name: channel.counts.shape[1] for name, channel in problem.channels.items()}
            noise = noise or {name: np.full(width, FIRST_NOISE[name]) for name, width in widths.items()}
            search = _acting_search(model, free, problem, noise, may_be_idle=number == 0)
            params, covariance = search.run(tolerance)
            model = parameters.with_values(model, dict(zip(search.free, search.values(params), strict=True)))
            noise = {  # the rms of what the model leaves
                name: np.maximum(_spread(np.asarray(left), name, problem), LEAST_NOISE)
                for name, left in jax.jit(residuals)(model, problem).items()
            }
            report(number + 1, len(TOLERANCES))
    chain = np.where(search.is_log, np.exp(np.where(search.is_log, params, 0.0)), 1.0)
    still = {
        name: np.sqrt(
            np.sum(channel.measured[:, : channel.counts.shape[1]] ** 2 * channel.counts, axis=0)
            / np.maximum(channel.counts.sum(axis=0), 1.0)
        )
        for name, channel in problem.channels.items()
    }
    return Estimate(
        model, free, covariance * np.outer(chain, chain), noise, still, int(search.counting.sum())
    )
