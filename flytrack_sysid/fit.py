"""Fitting the minimal model: four lags and six thrust coefficients, in float64."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import optimize, signal
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.effects import LinearDrag
from flytrack_env.state import ACCELERATION, APPLIED_ACTION, BATTERY, QUATERNION, RATES, VELOCITY
from flytrack_sysid.collect import DT, Excitation

TAU_BOUNDS = (1e-3, 0.5)
SLOWEST = 0.1  # m/s, rms along each body axis
AXES = ("roll", "pitch", "yaw", "thrust")


class FitError(ValueError):
    """Data that do not determine the model."""


class Fit(NamedTuple):
    """An identified model; rms: of what the fit left, rad/s for the three rates and N for thrust."""

    model: ModelParameters
    rms: tuple[float, float, float, float]


def lagged(commands: np.ndarray, applied_start: np.ndarray, tau: float) -> np.ndarray:
    """Return the applied actions after each step of a first-order lag.

    commands: (num_manoeuvres, num_steps), held over each step. applied_start: (num_manoeuvres,). tau: s.
    """
    keep = np.exp(-DT / tau)
    start = keep * applied_start[:, None]
    return signal.lfilter([1.0 - keep], [1.0, -keep], commands, axis=1, zi=start)[0]


def thrust_terms(action: np.ndarray, battery_v: np.ndarray) -> np.ndarray:
    """Return the six regressors 1, u, u^2, u^3, V, u V of the thrust map; (..., 6)."""
    one = np.ones_like(action)
    terms = (one, action, action**2, action**3, battery_v, action * battery_v)
    return np.stack(terms, axis=-1)


def specific_force_b(data: Excitation, gravity: float) -> np.ndarray:
    """Return the specific force of every step, body frame, (num_manoeuvres, num_steps, 3) m/s^2.

    World acceleration plus gravity, rotated with the attitude before the step.
    """
    acc_w = data.next_states[..., ACCELERATION].astype(float) + np.array([0.0, 0.0, gravity])
    return to_body(data, acc_w)


def to_body(data: Excitation, vectors_w: np.ndarray) -> np.ndarray:
    """Return world-frame vectors, one per step, in the body frame before the step."""
    attitude = Rotation.from_quat(data.states[..., QUATERNION].reshape(-1, 4), scalar_first=True)
    return attitude.inv().apply(vectors_w.reshape(-1, 3)).reshape(vectors_w.shape)


def _minimise_over_tau(residual: Callable[[float], np.ndarray]) -> tuple[float, np.ndarray]:
    """Return the time constant with the least squared residual, and that residual."""
    result = optimize.least_squares(
        lambda log_tau: residual(np.exp(log_tau[0])).ravel(),
        x0=[np.log(0.04)],
        bounds=np.log(TAU_BOUNDS).reshape(2, 1),
        xtol=1e-12,
        ftol=1e-12,
    )
    if not result.success or not np.isfinite(result.cost):
        raise FitError(f"the fit did not converge: {result.message}")
    tau = float(np.exp(result.x[0]))
    return tau, residual(tau)


def fit(data: Excitation, start: ModelParameters | None = None, with_drag: bool = False) -> Fit:
    """Identify lags and thrust map; mass, gravity, maximum rates and drain are taken as given.

    with_drag: identify linear drag too, which the handout's minimal structure lacks; else it stays as
    in ``start``, 0 by default.

    Raises:
        FitError: an axis that the commands never moved, or a search that did not converge.
    """
    given = nominal_parameters() if start is None else start
    for axis, name in enumerate(AXES):
        if np.ptp(data.actions[..., axis]) < 1e-3:
            raise FitError(f"{name}: the commands never change; this lag cannot be identified")
    if not all(np.isfinite(array).all() for array in data[:3]):
        raise FitError("data: found values that are not finite")
    rate_fits = [_fit_rate(data, axis, float(given.max_rate[axis])) for axis in range(3)]
    force_b = specific_force_b(data, given.g)
    vel_b = to_body(data, data.states[..., VELOCITY].astype(float))
    linear_drag = np.array(given.effect("linear_drag"), float)
    if with_drag:
        if np.any(np.mean(vel_b**2, axis=(0, 1)) < SLOWEST**2):
            raise FitError("velocity: the drone hardly moves along some axis; drag cannot be identified")
        lateral = [-np.sum(force_b[..., i] * vel_b[..., i]) / np.sum(vel_b[..., i] ** 2) for i in (0, 1)]
        linear_drag = np.array([*lateral, 0.0])
    thrust = given.m * (force_b[..., 2] + linear_drag[2] * vel_b[..., 2])
    drag_terms = -given.m * vel_b[..., 2:] if with_drag else vel_b[..., :0]
    tau, coefficients, rms = _fit_thrust(data, thrust, drag_terms)
    if with_drag:
        linear_drag[2] = coefficients[-1]
    model = given._replace(
        tau=np.array([*(tau for tau, _ in rate_fits), tau], np.float32),
        thrust_coeffs=coefficients[:6].astype(np.float32),
    )
    if with_drag:
        model = model.with_effects(LinearDrag(*map(float, linear_drag)))
    return Fit(model, (rate_fits[0][1], rate_fits[1][1], rate_fits[2][1], rms))


def _fit_rate(data: Excitation, axis: int, max_rate_deg: float) -> tuple[float, float]:
    """Return the lag of one rate axis, s, and the rms of what is left, rad/s.

    The measured rate is compared with the lag driven by the commands (which are exact), from the first
    state of each manoeuvre on.
    """
    start = data.states[:, 0, APPLIED_ACTION][:, axis].astype(float)
    commands = data.actions[..., axis].astype(float)
    measured = data.next_states[..., RATES][..., axis].astype(float)

    def residual(tau: float) -> np.ndarray:
        return measured - np.deg2rad(max_rate_deg) * lagged(commands, start, tau)

    tau, left = _minimise_over_tau(residual)
    return tau, float(np.sqrt(np.mean(left**2)))


def _fit_thrust(
    data: Excitation, thrust: np.ndarray, extra_terms: np.ndarray
) -> tuple[float, np.ndarray, float]:
    """Return the lag of thrust, s, its coefficients and those of the extra terms, and the rms left, N.

    thrust: (num_manoeuvres, num_steps), N. The coefficients are solved linearly inside the search.
    """
    start = data.states[:, 0, APPLIED_ACTION][:, 3].astype(float)
    commands = data.actions[..., 3].astype(float)
    battery_v = data.states[..., BATTERY].astype(float)

    def solve(tau: float) -> tuple[np.ndarray, np.ndarray]:
        terms = thrust_terms(lagged(commands, start, tau), battery_v)
        regressors = np.concatenate([terms, extra_terms], axis=-1)
        regressors = regressors.reshape(-1, regressors.shape[-1])
        coefficients = np.linalg.lstsq(regressors, thrust.ravel(), rcond=None)[0]
        return coefficients, thrust.ravel() - regressors @ coefficients

    tau, left = _minimise_over_tau(lambda tau: solve(tau)[1])
    return tau, solve(tau)[0], float(np.sqrt(np.mean(left**2)))
