"""The rivals: functions of log and nominal model.

==================  ==================================================================  ============
method              what it does                                                        names
==================  ==================================================================  ============
nominal             nothing: the given model                                            none
refit               ``flytrack fit``: base parameters, least squares                    none
forward             forward selection by likelihood ratio, over the package's effects   effects
sparse              STLSQ of pysindy over a library of effects, chosen by BIC           effects
gaussian_process    GP of scikit-learn on what gyro and accelerometer have beyond       none
residual_network    multi-layer perceptron of scikit-learn on the same                  none
random_distortion   test of distortions of a tolerated size, global p-value (SciPy)     a flag only
==================  ==================================================================  ============

pysindy and scikit-learn: ``pip install 'flytrack[rivals]'``.
"""

import warnings
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from scipy import stats
from threadpoolctl import threadpool_limits

from benchmarks.misspec.regressors import column, moving, sensing, targets
from benchmarks.misspec.replay import State, fly, replay
from flytrack_bench.misspec import Answer
from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import effect_of
from flytrack_sysid import FlightLog, fit
from flytrack_sysid.diagnosis import motion_of
from flytrack_sysid.diagnosis.result import TWO_SIDED_95
from flytrack_sysid.inference import noise as noises
from flytrack_sysid.inference.chunks import cut_chunks, thinned
from flytrack_sysid.inference.parameters import DRAIN, THRUST_COEFFS, as_float32, from_vector
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.score_test import Linearization
from flytrack_sysid.inference.search import (
    FittedModel,
    SearchState,
    add_effect,
    score_candidates,
)

FORWARD_P = 1e-3  # of a step, over all candidates tried in it (Bonferroni)
MAX_EFFECTS, NUM_REFITTED = 6, 3
THRESHOLDS = np.geomspace(1.0, 300.0, 25)  # of columns scaled to length 1, in units of the noise
GP_ROWS, LAYERS, NUM_INPUTS = 15, (32, 32), 11
TOLERATED, DISTORTION_P, RDT_ROWS = 0.1, 0.01, 10  # of a sensor's noise; global p-value; 0.1 s
Values = dict[str, tuple[float, float, float]]


def nominal(log: FlightLog, model: ModelParameters) -> Answer:
    """Return the given model: what a team has that does nothing."""
    return Answer(model=model)


def refit(log: FlightLog, model: ModelParameters) -> Answer:
    """Return the model with its base parameters fitted to the log, as ``flytrack fit`` does."""
    return Answer(model=fit(log, model).model)


def forward(log: FlightLog, model: ModelParameters) -> Answer:
    """Add effects one by one while the likelihood ratio is significant, all refitted each time.

    Effects, replay, noise and choice of motion are the package's; thrust curve and drain are as
    given, which they are on this suite, and lags are free. None of the diagnosis' rules: no robust
    variance, held-out part, elimination, exchange, veto or class.
    """
    with threadpool_limits(1, "blas"), jax.enable_x64(True):
        model = model._replace(motion=motion_of(log, model))
        chunks = thinned(cut_chunks(log, np.ones(len(log), bool), model))
        state = SearchState.start(log, Problem.of(chunks, model))
        state = replace(state, held=(*THRUST_COEFFS, DRAIN))
        fitted = state.fitted((), state.problem.start)
        residuals = state.problem.residuals(fitted.vector[None])[0]
        state = state.with_noise(noises.fit_noise(chunks, residuals, state.problem.noise))
        fitted = state.fitted((), fitted.vector)
        while len(fitted.candidates) < MAX_EFFECTS:
            state, extended = _with_next(state, fitted)
            if extended is None:
                break
            fitted = extended
        values = _values(state, fitted)
        found = as_float32(from_vector(fitted.vector, state.problem.like))
    chosen = tuple(one for one in found.effects if effect_of(one).name in fitted.effects)
    return Answer(tuple(fitted.effects), values=values, model=found._replace(effects=chosen))


def _with_next(state: SearchState, fitted: FittedModel) -> tuple[SearchState, FittedModel | None]:
    """Return the model with the likeliest next effect; None if none is significant."""
    state, linearization = state.linearized(fitted.vector)
    ranked = score_candidates(state, linearization, fitted)
    ranked = sorted(ranked, key=lambda scored: -scored.gain.chi2)
    trials = []
    for scored in ranked[:NUM_REFITTED]:
        trial = add_effect(state, linearization, fitted, scored)
        # The logarithm: a clear effect's p is below the smallest float.
        log_p = stats.chi2.logsf(fitted.cost - trial.cost, len(scored.candidate.fields))
        trials.append((log_p + np.log(len(ranked)), trial))
    if not trials:
        return state, None
    log_p, best = min(trials, key=lambda one: one[0])
    return state, best if log_p < np.log(FORWARD_P) else None


def _values(state: SearchState, fitted: FittedModel) -> Values:
    """Return the effects' parameters with the intervals of the inverse Hessian."""
    problem, indices = state.problem, list(fitted.indices)
    linearization = Linearization(problem, problem.slopes(fitted.vector, indices))
    deviations = np.sqrt(np.diag(np.linalg.pinv(linearization.total)))
    return {
        problem.names[index]: _interval(float(fitted.vector[index]), float(deviation))
        for index, deviation in zip(indices, deviations, strict=True)
        if "." in problem.names[index]
    }


def _interval(value: float, deviation: float) -> tuple[float, float, float]:
    half = TWO_SIDED_95 * deviation
    return value, value - half, value + half


def sparse(log: FlightLog, model: ModelParameters) -> Answer:
    """Regress all residuals at once on the library by pysindy's STLSQ.

    The threshold is that of the lowest BIC (Mangan et al., 2017). An effect is named if one of its
    parameters is left. The motion is the package's choice, here and in all that follow.
    """
    from pysindy import STLSQ

    model = model._replace(motion=motion_of(log, model))
    found = replay(log, model)
    full_rates = np.radians(np.asarray(model.max_rate, float))
    features = [*moving(found.state, full_rates), *sensing(found.state)]
    measured, scales = targets(found)
    columns = np.stack([column(found, feature, scales) for feature in features], axis=1)
    lengths = np.linalg.norm(columns, axis=0)
    columns = columns / lengths
    rest, *_ = np.linalg.lstsq(columns, measured, rcond=None)
    variance = np.mean((measured - columns @ rest) ** 2)
    best: tuple[float, np.ndarray] = np.inf, np.zeros(len(features))
    for threshold in THRESHOLDS * np.sqrt(variance):
        with warnings.catch_warnings():  # where a threshold leaves nothing
            warnings.simplefilter("ignore")
            coefficients = STLSQ(threshold=threshold, alpha=0.0).fit(columns, measured).coef_[0]
        misfit = np.sum((measured - columns @ coefficients) ** 2) / variance
        bic = misfit + np.count_nonzero(coefficients) * np.log(len(measured))
        best = min(best, (bic, coefficients), key=lambda one: one[0])
    kept = np.flatnonzero(best[1])
    deviations = np.sqrt(variance * np.diag(np.linalg.pinv(columns[:, kept].T @ columns[:, kept])))
    values, weights = {}, {}
    for index, deviation in zip(kept, deviations, strict=True):
        feature, length = features[index], lengths[index]
        weights[feature.name] = best[1][index] / length
        value = feature.neutral + weights[feature.name]
        values[feature.name] = _interval(float(value), float(deviation / length))
    names = tuple(dict.fromkeys(name.partition(".")[0] for name in values))

    def beyond(state: State) -> tuple[np.ndarray, np.ndarray]:
        force_b, rates_b = np.zeros((2, len(state.thrust), 3))
        for feature in moving(state, full_rates):
            weight = weights.get(feature.name, 0.0)
            force_b += weight * feature.force_b
            rates_b += weight * feature.rates_b
        return force_b, rates_b

    return Answer(names, values=values, predict=lambda flights: fly(model, flights, beyond))


def _inputs(state: State) -> np.ndarray:
    return np.column_stack([state.vel_b, state.applied, state.slope])


def _learned(log: FlightLog, model: ModelParameters, learner: Any, rows: int) -> Answer:
    """Return predictions with what a learner makes of gyro and accelerometer beyond the model.

    Args:
        rows: of which inputs and targets are averaged, as the sensors are noisy.
    """
    model = model._replace(motion=motion_of(log, model))
    found = replay(log, model)
    inputs, outputs = (
        _averaged(values, rows)
        for values in (_inputs(found.state), np.column_stack([found.force, found.gyro]))
    )
    scale = outputs.std(axis=0)
    with warnings.catch_warnings():  # of bounds of length scales that are reached
        warnings.simplefilter("ignore")
        learner.fit(inputs, outputs / scale)

    def beyond(state: State) -> tuple[np.ndarray, np.ndarray]:
        residual = scale * learner.predict(_inputs(state))
        return residual[:, :3], residual[:, 3:]

    return Answer(predict=lambda flights: fly(model, flights, beyond))


def _averaged(values: np.ndarray, rows: int) -> np.ndarray:
    count = len(values) // rows
    return np.asarray(values[: count * rows].reshape(count, rows, -1).mean(axis=1))


def gaussian_process(log: FlightLog, model: ModelParameters) -> Answer:
    """Learn the discrepancy by a Gaussian process with a length scale for each input."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    kernel = ConstantKernel() * RBF(np.full(NUM_INPUTS, 3.0)) + WhiteKernel()
    process = GaussianProcessRegressor(kernel, normalize_y=True, random_state=0)
    return _learned(log, model, make_pipeline(StandardScaler(), process), GP_ROWS)


def residual_network(log: FlightLog, model: ModelParameters) -> Answer:
    """Learn the discrepancy by a small network that stops early."""
    from sklearn.neural_network import MLPRegressor
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    network = MLPRegressor(
        hidden_layer_sizes=LAYERS, early_stopping=True, max_iter=500, random_state=0
    )
    return _learned(log, model, make_pipeline(StandardScaler(), network), 1)


def random_distortion(log: FlightLog, model: ModelParameters) -> Answer:
    """Flag a distortion of the residuals beyond a tolerated size.

    Means of gyro and accelerometer over 0.1 s, over their white noise, are a signal plus normal
    noise; the test is that of D. Pastor and Q.-T. Nguyen ("Random distortion testing and optimality
    of thresholding tests", 2013): is the signal's norm beyond the tolerance? The sum over all
    blocks gives one p-value, of a non-central chi2.
    """
    model = model._replace(motion=motion_of(log, model))
    found = replay(log, model)
    residuals = np.column_stack([found.force, found.gyro])
    noise = np.diff(residuals, axis=0).std(axis=0) / np.sqrt(2.0)
    means = _averaged(residuals, RDT_ROWS) / (noise / np.sqrt(RDT_ROWS))
    noncentrality = RDT_ROWS * TOLERATED**2 * means.size
    p = stats.ncx2.sf(np.sum(means**2), means.size, noncentrality)
    return Answer(flagged=bool(p < DISTORTION_P), model=model)
