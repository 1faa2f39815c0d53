"""From a selected model to a diagnosis: causes with intervals, limits, errors on held-out rows, warnings."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME, effect_of
from flytrack_sysid.diagnosis.identifiability import advise, unit_of, unseen_effects
from flytrack_sysid.diagnosis.lanes import AXES, voltages_of
from flytrack_sysid.diagnosis.model_selection import (
    BaseChange,
    Marginal,
    base_changes,
    equivalents,
    separation,
)
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.result import (
    CAUSES_FOUND,
    CHANNELS,
    CONSISTENT,
    TO_LOG,
    UNEXPLAINED,
    Cause,
    Errors,
    Estimated,
    NotIdentifiable,
    Unexplained,
)
from flytrack_sysid.diagnosis.score_test import AT_BOUND, Linearization, solve, threshold
from flytrack_sysid.diagnosis.search import FittedModel, SearchState
from flytrack_sysid.diagnosis.vetoes import Selection, held_out_gain, is_base_remainder, is_contradicted
from flytrack_sysid.log import FlightLog
from flytrack_sysid.parameters import DRAIN, MAX_RATES, THRUST_COEFFS, as_float32, from_vector
from flytrack_sysid.parameters import unit_of as unit_of_parameter
from flytrack_sysid.prediction import predict
from flytrack_sysid.prediction_errors import rollout_errors
from flytrack_sysid.record import BATTERY_UNKNOWN_V, fill_gaps

TWO_SIDED_95 = 1.959964
LOOSE = 0.5  # of the prior's width: a parameter that the log knows no better is not determined
SCALE_TWINS = ("thrust_curve",)  # mass, payload, battery and motors all scale the thrust over the mass
HORIZONS_S = (0.5, 1.0, 2.0)
FLIES_WORSE = 1.1  # times the error of free flight
STILL = (*MAX_RATES, DRAIN, *THRUST_COEFFS)  # a model where these are 0 does not move


def estimates(
    problem: Problem, linearization: Linearization, model: FittedModel, fields: Sequence[str]
) -> dict[str, Estimated]:
    """Return values and 95 % intervals of parameters that the log determines, by name without the effect."""
    halves = Marginal(linearization, model, fields).half_widths()
    result, least = {}, halves.min()  # at least one parameter of each effect is listed
    for field, half in zip(fields, halves, strict=True):
        place = problem.names.index(field)
        value, low, high = (float(one[place]) for one in (model.vector, problem.low, problem.high))
        if "." in field and half > LOOSE * (high - low) and half > least:
            continue
        ends = max(value - half, low), min(value + half, high)
        name = field.split(".")[-1]
        result[name] = Estimated(value, (float(ends[0]), float(ends[1])), unit_of_parameter(field))
    return result


def channel_of(problem: Problem, less: np.ndarray, full: np.ndarray) -> str:
    """Return the channel in which two models differ most, in multiples of the noise."""
    white = problem.whitened_residuals(less, full)
    by_axis = np.square(white[1] - white[0]).sum(axis=(0, 1))
    power = {
        name: float(by_axis[axes, channel].sum())
        for axes, names in zip(AXES, CHANNELS, strict=True)
        for channel, name in enumerate(names)
        if name is not None
    }
    return max(power, key=lambda name: power[name])


def effect_causes(selection: Selection, test: Problem, linearization: Linearization) -> list[Cause]:
    """Return the effects of a model as causes, those that explain most first."""
    problem, model = selection.state.problem, selection.model
    causes = []
    for one in model.candidates:
        ablation = selection.ablations[one.effect]
        less = ablation.without.vector
        own = separation(problem, linearization, model, one.effect)
        # Refitted where that was worth it, else to first order.
        rivals = {name: min(ablation.rivals.get(name, size), size) for name, size in own.beside.items()}
        closest = min(rivals, key=lambda name: rivals[name], default="")
        causes.append(
            Cause(
                effect=one.effect,
                equivalent=equivalents(ablation, own),
                channel=channel_of(problem, less, model.vector),
                parameters=estimates(problem, linearization, model, one.fields),
                chi2_gain=ablation.gain,
                heldout_gain=held_out_gain(test, less, model.vector)[0],
                lambda_=own.noncentrality,
                lambda_sep=max(rivals.get(closest, own.noncentrality), 0.0),
                closest=closest,
            )
        )
    # A scale of thrust that was found in place of a thrust curve may be a remainder, too.
    kept = [cause for cause in causes if cause.effect != "thrust_scale" or not _is_remainder(cause, causes)]
    return sorted(kept, key=lambda cause: -cause.chi2_gain)


def _is_remainder(cause: Cause, others: Sequence[Cause]) -> bool:
    return is_base_remainder(cause.chi2_gain, cause.channel, [(one.channel, one.chi2_gain) for one in others])


def base_causes(
    selection: Selection, test: Problem, linearization: Linearization, effects: Sequence[Cause]
) -> tuple[list[Cause], list[str]]:
    """Return base changes that the log shows, as causes, and names that held-out rows contradict.

    effects: the other causes.
    """
    problem, model = selection.state.problem, selection.model
    causes: list[Cause] = []
    contradicted: list[str] = []
    for name, change in base_changes(selection.state, linearization, model).items():
        if name in selection.stand_ins:
            continue
        places = problem.index(change.fields)
        less = model.vector.copy()
        less[places] = problem.start[places]
        channel = channel_of(problem, less, model.vector)
        refitted = _refitted_to_first_order(problem, linearization, model, places)
        gain, expected = held_out_gain(test, refitted, model.vector)
        if is_contradicted(gain, expected, change.marginal.inflation):
            contradicted.append(name)
            continue
        parameters = estimates(problem, linearization, model, change.fields)
        cause = Cause(name, (), channel, parameters, change.gain, gain, change.gain, change.gain)
        if not _is_remainder(cause, effects):
            causes.append(_as_thrust_scale(cause, change, problem, model))
    return sorted(causes, key=lambda cause: -cause.chi2_gain), contradicted


def _refitted_to_first_order(
    problem: Problem, linearization: Linearization, model: FittedModel, places: Sequence[int]
) -> np.ndarray:
    """Return the vector with some parameters at nominal and the rest fitted again, to first order."""
    others = [place for place in model.places if place not in set(places)]
    columns, own = linearization.columns_at(others), linearization.columns_at(places)
    less = model.vector.copy()
    less[list(places)] = problem.start[list(places)]
    change = less[list(places)] - model.vector[list(places)]
    score = linearization.score[columns] - linearization.total[np.ix_(columns, own)] @ change
    less[others] += solve(linearization.total[np.ix_(columns, columns)], score)
    return problem.clipped(less)


def _as_thrust_scale(cause: Cause, change: BaseChange, problem: Problem, model: FittedModel) -> Cause:
    """Return the cause as a scale of thrust if it is a curve, and one factor explains all of its change."""
    if cause.effect != "thrust_curve":
        return cause
    places, information = problem.index(change.fields), change.marginal.information
    nominal, values = problem.start[places], model.vector[places]
    along = nominal @ information
    known = float(along @ nominal)
    if known <= 0.0:
        return cause  # a curve of zeros
    factor = float(along @ values) / known
    rest = values - factor * nominal
    if rest @ information @ rest / change.marginal.inflation > threshold(len(values) - 1):
        return cause
    half = TWO_SIDED_95 * float(np.sqrt(change.marginal.inflation / known))
    scale = {"factor": Estimated(factor, (factor - half, factor + half), "1")}
    return replace(cause, effect="thrust_scale", equivalent=SCALE_TWINS, parameters=scale)


def not_identifiable(
    state: SearchState, linearization: Linearization, model: FittedModel, causes: Sequence[Cause]
) -> tuple[NotIdentifiable, ...]:
    """Return what the log could not have shown, and causes it cannot tell from others, with what to fly."""
    limits = unseen_effects(state, linearization, model)
    twins: dict[str, tuple[str, ...]] = {}
    for cause in causes:
        if cause.effect in BY_NAME and cause.equivalent and cause.effect != "thrust_scale":
            twins[cause.effect] = cause.equivalent
            twins |= {name: (cause.effect,) for name in cause.equivalent}
    wanted = {name: limit.look_alikes for name, limit in limits.items()} | twins
    flights = {name: TO_LOG + " and ".join(BY_NAME[name].needs) for name in state.unobservable}
    asked = {name: alike for name, alike in wanted.items() if name not in state.unobservable}
    flights |= advise(state.problem, model, linearization, asked)
    result = []
    for name, alike in wanted.items():
        # A twin of what was found has no size of its own.
        smallest, unit = limits[name][:2] if name in limits else (float("inf"), unit_of(name))
        result.append(NotIdentifiable(name, smallest, unit, tuple(alike), flights[name]))
    return tuple(result)


def verdict_of(causes: Sequence[Cause], rest: Unexplained) -> str:
    """Return the verdict, as in ``Diagnosis``."""
    if causes and rest.flagged:
        return f"{CAUSES_FOUND}+{UNEXPLAINED}"
    if causes:
        return CAUSES_FOUND
    return UNEXPLAINED if rest.flagged else CONSISTENT


def model_of(problem: Problem, model: FittedModel) -> ModelParameters:
    """Return a fitted model in float32, with the effects that it has and those the nominal one had."""
    found = as_float32(from_vector(model.vector, problem.like))
    kept = model.effects | set(problem.given_effects)
    return found._replace(effects=tuple(one for one in found.effects if effect_of(one).name in kept))


def _by_channel(values: np.ndarray, problem: Problem) -> dict[str, np.ndarray]:
    """Return values (NUM_AXES, 2) by channel that is judged; (axes of it,) each."""
    return {
        name: values[axes, channel]
        for axes, names in zip(AXES, CHANNELS, strict=True)
        for channel, name in enumerate(names)
        if name is not None and problem.counts[..., axes, channel].any()
    }


def sensor_noise(problem: Problem) -> dict[str, list[float]]:
    """Return the fitted standard deviations of the sensors, by channel and axis (world frame)."""
    noise = problem.fitted_noise
    found = np.stack([np.asarray(noise.direct), np.asarray(noise.level)], axis=-1)
    return {
        name: [float(f"{value:.4g}") for value in own] for name, own in _by_channel(found, problem).items()
    }


def _with_voltage_summed(left: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return residuals with those of the battery summed up, less their mean in each lane.

    A voltage changes by less in a step than its last digit, so that a single step tells nothing of it.
    """
    found = left.copy()
    is_counted = counts[..., -1, 1]
    level = np.cumsum(left[..., -1, 1], axis=0)
    mean = np.where(is_counted, level, 0.0).sum(axis=0) / np.maximum(is_counted.sum(axis=0), 1)
    found[..., -1, 1] = level - mean
    return found


def _rms(left: np.ndarray, counts: np.ndarray, is_centred: bool = False) -> np.ndarray:
    number = np.maximum(counts.sum(axis=(0, 1)), 1)
    mean = np.where(counts, left, 0.0).sum(axis=(0, 1)) / number if is_centred else 0.0
    return np.sqrt(np.where(counts, (left - mean) ** 2, 0.0).sum(axis=(0, 1)) / number)


def _free_flight_errors(model: ModelParameters, log: FlightLog, rows: np.ndarray) -> dict[str, float]:
    """Return rms position errors of free flight, m, by horizon.

    The model has all effects, so that one program flies every one.
    """
    filled = fill_gaps(log)
    found = rollout_errors(model, filled.log, predict(model, filled), rows[filled.behind])
    return {
        f"{one.horizon_s:g}": one.errors["position"].rms
        for one in found
        if one.horizon_s in HORIZONS_S and "position" in one.errors
    }


def _free_flight_floor(problem: Problem) -> dict[str, float]:
    """Return the position errors of free flight that come from noise in its start alone, m, by horizon."""
    level = np.asarray(problem.fitted_noise.level)
    speed, tilt = np.sqrt(np.sum(level[3:6] ** 2)), np.sqrt(np.sum(level[:2] ** 2))
    gravity = float(problem.like.g)
    return {
        f"{horizon:g}": float(np.hypot(speed * horizon, 0.5 * gravity * tilt * horizon**2))
        for horizon in HORIZONS_S
    }


def errors_of(
    test: Problem, vectors: Mapping[str, np.ndarray], log: FlightLog, rows: np.ndarray
) -> dict[str, Errors]:
    """Return errors of models on held-out rows, by name, and what the sensors' noise alone would leave.

    One-step errors are relative to those of a model that does not move, whose residuals are the measured
    changes themselves, less their mean.
    """
    still = test.start.copy()
    still[test.index(STILL)] = 0.0
    left = [
        _with_voltage_summed(one, test.counts) for one in test.residuals(np.stack([still, *vectors.values()]))
    ]
    scales = _by_channel(_rms(left[0], test.counts, is_centred=True), test)

    def relative(errors: np.ndarray) -> dict[str, float]:
        return {
            name: float(np.linalg.norm(own)) / max(float(np.linalg.norm(scales[name])), 1e-12)
            for name, own in _by_channel(errors, test).items()
        }

    can_fly = {"p", "v", "q"} <= set(log.channels)
    result = {}
    for (name, vector), one in zip(vectors.items(), left[1:], strict=True):
        flight = _free_flight_errors(from_vector(vector, test.like), log, rows) if can_fly else {}
        result[name] = Errors(relative(_rms(one, test.counts)), flight)
    noise = test.fitted_noise
    floor = np.stack([np.asarray(noise.direct), np.sqrt(2.0) * np.asarray(noise.level)], axis=-1)
    floor[-1, 1] = noise.level[-1]  # summed up, not a difference of two
    result["noise_floor"] = Errors(relative(floor), _free_flight_floor(test) if can_fly else {})
    return result


def warnings_of(
    problem: Problem,
    model: FittedModel,
    causes: Sequence[Cause],
    errors: Mapping[str, Errors],
    contradicted: Sequence[str],
) -> list[str]:
    """Return what a reader must know before trusting causes or the extended model.

    contradicted: names that were rejected because held-out rows contradict them.
    """
    return [
        *_voltage_unknown(problem, causes),
        *(
            f"{name} gained nothing on the held-out part: it was there for a time only, or never"
            for name in contradicted
        ),
        *_at_bounds(problem, model, causes),
        *_flies_worse(errors),
    ]


def _voltage_unknown(problem: Problem, causes: Sequence[Cause]) -> list[str]:
    """Return a warning where thrust is named and the voltage it depends on was not measured."""
    thrust = [cause.effect for cause in causes if cause.effect in ("thrust_curve", "thrust_scale")]
    if not thrust or voltages_of(problem.lanes) is not None:
        return []
    assumed = f"no voltage was logged and {BATTERY_UNKNOWN_V:g} V were assumed"
    return [f"{assumed}: {thrust[0]} may only be the error of that"]


def _at_bounds(problem: Problem, model: FittedModel, causes: Sequence[Cause]) -> list[str]:
    """Return a warning for each value at the end of its range: the true cause may be another one."""
    result = []
    for cause in causes:
        for name, one in cause.parameters.items():
            field = f"{cause.effect}.{name}"
            if field not in problem.names or name in BY_NAME[cause.effect].shapes:
                continue  # a base parameter, or one that may well be as sharp as it gets
            place = problem.names.index(field)
            low, high, value = problem.low[place], problem.high[place], model.vector[place]
            room = AT_BOUND * max(abs(value), 1.0)
            if low + room < value < high - room:
                continue
            why = "its law may stand in for something else"
            if name in BY_NAME[cause.effect].most_steps:
                why = "only so many rows of the log are remembered; import it with fewer rows per second"
            result.append(
                f"{field} = {one.value:.3g} is at the end of the searched range ({low:g} to {high:g}): {why}"
            )
    return result


def _flies_worse(errors: Mapping[str, Errors]) -> list[str]:
    """Return a warning where the extended model ends up farther off in free flight, held out."""
    base, extended = errors["refitted_base"].position_m, errors["extended"].position_m
    worse = [horizon for horizon in extended if extended[horizon] > FLIES_WORSE * base[horizon]]
    if not worse:
        return []
    compared = ", ".join(
        f"{extended[horizon]:.3g} m against {base[horizon]:.3g} m after {horizon} s" for horizon in worse
    )
    return [
        f"in free flight the extended model ends farther off than the refitted one without effects "
        f"({compared}, held out): the named causes are right step by step, or stand in for something else"
    ]


def with_lost_causes(rest: Unexplained, contradicted: Sequence[str]) -> Unexplained:
    """Return what is unexplained; it depends on time where a cause was there for a time only."""
    if not contradicted or "time" in rest.depends_on:
        return rest
    return replace(rest, flagged=True, depends_on=(*rest.depends_on, "time"))
