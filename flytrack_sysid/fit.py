"""Fitting the minimal model: four lags and six thrust coefficients, in float64."""

from typing import NamedTuple

import numpy as np
from scipy import optimize, signal
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.state import ACCELERATION, APPLIED_ACTION, BATTERY, QUATERNION, RATES
from flytrack_sysid.collect import DT, Excitation

TAU_BOUNDS = (1e-3, 0.5)
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


def specific_force_z(data: Excitation, gravity: float) -> np.ndarray:
    """Return the specific force along the thrust axis, m/s^2, of every step.

    World acceleration plus gravity, projected on body z with the attitude before the step.
    """
    acc_w = data.next_states[..., ACCELERATION].astype(float) + np.array([0.0, 0.0, gravity])
    w_first = data.states[..., QUATERNION].reshape(-1, 4)
    axis_w = Rotation.from_quat(w_first, scalar_first=True).apply([0.0, 0.0, 1.0])
    return (acc_w.reshape(-1, 3) * axis_w).sum(axis=1).reshape(acc_w.shape[:-1])


def _minimise_over_tau(residual: "np.ufunc") -> tuple[float, np.ndarray]:
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


def fit(data: Excitation, start: ModelParameters | None = None) -> Fit:
    """Identify lags and thrust map; mass, gravity, maximum rates and drain are taken as given.

    The rates are compared with the lag driven by the commands, from the first state of each manoeuvre
    on; the thrust map is solved linearly inside the search for its lag.

    Raises:
        FitError: an axis that the commands never moved, or a search that did not converge.
    """
    given = nominal_parameters() if start is None else start
    for axis, name in enumerate(AXES):
        if np.ptp(data.actions[..., axis]) < 1e-3:
            raise FitError(f"{name}: the commands never change; this lag cannot be identified")
    applied_start = data.states[:, 0, APPLIED_ACTION].astype(float)
    commands = data.actions.astype(float)
    rates_b = data.next_states[..., RATES].astype(float)
    full_stick = np.deg2rad(np.asarray(given.max_rate, float))
    taus, rms = [], []
    for axis in range(3):

        def rate_residual(tau: float, axis: int = axis) -> np.ndarray:
            applied = lagged(commands[..., axis], applied_start[:, axis], tau)
            return rates_b[..., axis] - full_stick[axis] * applied

        tau, left = _minimise_over_tau(rate_residual)
        taus.append(tau)
        rms.append(float(np.sqrt(np.mean(left**2))))

    thrust = given.m * specific_force_z(data, given.g)
    battery_v = data.states[..., BATTERY].astype(float)

    def solve_map(tau: float) -> tuple[np.ndarray, np.ndarray]:
        applied = lagged(commands[..., 3], applied_start[:, 3], tau)
        regressors = thrust_terms(applied, battery_v).reshape(-1, 6)
        coefficients = np.linalg.lstsq(regressors, thrust.ravel(), rcond=None)[0]
        return coefficients, thrust.ravel() - regressors @ coefficients

    tau, left = _minimise_over_tau(lambda tau: solve_map(tau)[1])
    taus.append(tau)
    rms.append(float(np.sqrt(np.mean(left**2))))
    model = given._replace(tau=np.array(taus, np.float32), thrust_coeffs=solve_map(tau)[0].astype(np.float32))
    return Fit(model, tuple(rms))  # type: ignore[arg-type]
