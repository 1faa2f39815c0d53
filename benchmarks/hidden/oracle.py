"""What a log could show of a truth: lambda of each hidden effect, and beside its closest rival.

From the clean log (the same rows, no noise) and the sensors' true noise: the residual of a model
that lacks an effect is then the effect's signature, whatever its law, and minus twice the log
likelihood its squared length. All else is fitted again, each rival in the effect's place too.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from scipy import optimize

from benchmarks.misspec.replay import lagged
from flytrack_bench.hidden import Truth
from flytrack_bench.hidden.drone import SECONDS_PER_MINUTE
from flytrack_bench.hidden.noise import DIGIT, STD
from flytrack_env.dynamics import ModelParameters
from flytrack_env.thrust import collective_thrust
from flytrack_sysid.diagnosis.model_selection import MAX_RIVALS, ablate_all
from flytrack_sysid.inference.chunks import NUM_AXES, cut_chunks
from flytrack_sysid.inference.noise import fit_noise
from flytrack_sysid.inference.parameters import THRUST_COEFFS
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.score_test import CANDIDATES
from flytrack_sysid.inference.search import (
    FittedModel,
    SearchState,
    add_effect,
    score_candidates,
)
from flytrack_sysid.log import FlightLog

TURNED_MS2 = 10.0  # about the thrust that attitude noise turns
NO_DISTURBANCE, ANY_TAU, COUPLED = np.log(1e-3), np.log(0.3), 0.0
FIRST_ROW = 100  # before it, lags depend on commands from before the log
SCALES = np.array([STD["f"]] * 3 + [STD["w"]] * 3 + [DIGIT["v_bat"]])


class Known(NamedTuple):
    """What a log could show of an effect: lambda, beside its closest rival, and that rival."""

    lambda_: float
    lambda_sep: float
    rival: str


def true_noise(step_s: float) -> np.ndarray:
    """Return the sensors' true noise as the diagnosis has it, (6, NUM_AXES)."""
    # Attitude noise turns the thrust that is fed in: m/s of velocity in a second, as a random walk.
    wandered = STD["q"] * TURNED_MS2 * np.sqrt(step_s)
    direct = np.repeat([STD["w"], STD["f"], 1.0], [3, 3, 1])
    level = np.repeat([STD["q"], STD["v"], DIGIT["v_bat"]], [3, 3, 1])
    wander = np.repeat([1e-3 * STD["q"], wandered, 1e-3], [3, 3, 1]) / level
    rest = np.repeat([[NO_DISTURBANCE], [ANY_TAU], [COUPLED]], NUM_AXES, axis=1)
    return np.stack([np.log(direct), np.log(level), np.log(wander), *rest])


def clean_problem(
    clean: FlightLog, log: FlightLog, is_scored: np.ndarray, model: ModelParameters
) -> Problem:
    """Return the problem of the clean rows that a measured log kept, with the sensors' true noise.

    Of the voltage that is rounding, which lasts while the battery drains by a digit: it is fitted.
    """
    kept = clean.select(np.isin(np.round(clean.time, 6), np.round(log.time, 6)))
    problem = Problem.of(cut_chunks(kept, is_scored, model), model)
    measured = Problem.of(cut_chunks(log, is_scored, model), model)
    errors = measured.residuals(problem.start[None])[0] - problem.residuals(problem.start[None])[0]
    noise = true_noise(float(np.median(np.diff(clean.time))))
    noise[:, -1] = fit_noise(measured.chunks, errors, noise)[:, -1]
    return problem.with_noise(noise)


def fit_all(state: SearchState, effects: Mapping[str, Mapping[str, float]]) -> FittedModel:
    """Return the model with all true effects, fitted to the clean log from the true parameters.

    Each is parameterised with its true parameters and the fewest others.
    """
    problem, chosen = state.problem, []
    vector = problem.start.copy()
    for name, values in effects.items():
        fields = {f"{name}.{field}" for field in values}
        candidates = [
            candidate
            for candidate in CANDIDATES
            if candidate.effect == name and name != "thrust_scale"
        ]
        candidates.sort(key=lambda one: (-len(fields & {*one.fields}), len(one.fields)))
        for candidate in candidates[:1]:
            chosen.append(candidate)
            for field in fields & {*candidate.fields}:
                vector[problem.names.index(field)] = values[field.split(".")[1]]
    return state.fitted(chosen, problem.clipped(vector))


def _known(gain: float, rivals: Mapping[str, float]) -> Known:
    """Return what a log could show of an effect, by its gain and its gains beside rivals."""
    rival = min(rivals, key=rivals.__getitem__, default="")
    return Known(gain, max(min(rivals.get(rival, gain), gain), 0.0), rival)


def _scale_known(state: SearchState, model: FittedModel) -> Known:
    """Return what the log could show of a scale of thrust, which a free thrust curve explains.

    Against the nominal curve, all else fitted, and the best rival beside that.
    """
    curve = state.problem.parameter_indices(THRUST_COEFFS)
    vector = model.vector.copy()
    vector[curve] = state.problem.start[curve]
    state = replace(state, held=THRUST_COEFFS)
    nominal = state.fitted(model.candidates, vector)
    state, linearization = state.linearized(nominal.vector)
    scores = [
        score
        for score in score_candidates(state, linearization, nominal)
        if score.candidate.effect != "thrust_scale"
    ]
    gains = {}
    for score in scores[:MAX_RIVALS]:
        extended = add_effect(state, linearization, nominal, score)
        gains[score.candidate.effect] = extended.cost - model.cost
    return _known(nominal.cost - model.cost, gains)


def known(
    clean: FlightLog,
    log: FlightLog,
    is_scored: np.ndarray,
    model: ModelParameters,
    effects: Mapping[str, Mapping[str, float]],
) -> dict[str, Known]:
    """Return, by hidden effect, what the scored rows of a log could show of it."""
    with jax.enable_x64(True):
        state = SearchState(clean_problem(clean, log, is_scored, model))
        fitted = fit_all(state, effects)
        state, linearization = state.linearized(fitted.vector)
        result = {}
        for effect, ablation in ablate_all(state, fitted, linearization).items():
            result[effect] = _known(ablation.gain, ablation.rivals)
        if "thrust_scale" in effects:
            result["thrust_scale"] = _scale_known(state, fitted)
    return result


def removed(
    clean: FlightLog, base: ModelParameters, extended: ModelParameters
) -> tuple[float, float]:
    """Return the share of explainable error that a model removes on a clean flight, and the error.

    The error is the rms whitened residual of the base; 1 is the noise.

    Args:
        base: refitted, without effects, in the same motion.
    """
    with jax.enable_x64(True):
        chunks = cut_chunks(clean, np.ones(len(clean), bool), base)
        problems = [Problem.of(chunks, model) for model in (base, extended)]
        residuals = np.stack([one.residuals(one.start[None])[0] for one in problems])
    whitened = residuals[..., :6, 0] / np.repeat([STD["w"], STD["f"]], 3)
    is_counted = chunks.counts[..., :6, 0]
    base_power, power = (float(np.mean(np.square(values[is_counted]))) for values in whitened)
    return 1.0 - power / max(base_power, 1e-300), float(np.sqrt(base_power))


# How visible an effect outside the list is, which has no law to fit


def _expected(truth: Truth, log: FlightLog, tau: np.ndarray, coeffs: np.ndarray) -> np.ndarray:
    """Return specific force, body rates and voltage of the plant without effects, (num_rows, 7).

    Args:
        tau, coeffs: lags, s, from the first command on, and coefficients of thrust, in place of the
            truth's.
    """
    before = np.maximum(np.arange(len(log)) - 1, 0)
    applied = lagged(tau, log["u"], float(log.time[1] - log.time[0]))
    thrust = collective_thrust(applied[:, 3], log["v_bat"][before, 0], coeffs)
    expected = np.zeros((len(log), len(SCALES)))
    expected[:, 2] = np.asarray(thrust) / truth.mass
    expected[:, 3:6] = np.radians(truth.max_rate) * applied[:, :3]
    expected[:, 6] = log["v_bat"][0, 0] - truth.drain / SECONDS_PER_MINUTE * log.time
    return expected


def signal_to_noise(truth: Truth, log: FlightLog) -> float:
    """Return how far clean sensors are from those of the plant without effects.

    The sensors are accelerometer, gyro and voltage.

    The root of the sum of squared differences, each over the sensors' noise
    (voltage: over its resolution): by about how many standard deviations the effects are visible to
    an observer who knows their shape. Position, velocity and attitude are not used and would show
    more of some effects. Only what other lags and another thrust curve cannot explain counts. log:
    clean, from ``fly``.
    """
    measured = np.column_stack([log["f"], log["w"], log["v_bat"]])

    def missing(change: np.ndarray) -> np.ndarray:
        tau, coeffs = truth.tau * np.exp(change[:4]), truth.coeffs + change[4:]
        return ((measured - _expected(truth, log, tau, coeffs)) / SCALES)[FIRST_ROW:].ravel()

    fit = optimize.least_squares(missing, np.zeros(10), method="lm")
    return float(np.sqrt(2.0 * fit.cost))
