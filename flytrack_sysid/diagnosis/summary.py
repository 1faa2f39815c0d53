"""Turn a selected model into a diagnosis: causes, limits, errors on held-out rows, warnings."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME, effect_of
from flytrack_sysid.diagnosis import vetoes
from flytrack_sysid.diagnosis.flight_errors import tabulate_errors
from flytrack_sysid.diagnosis.flight_fit import at_bounds
from flytrack_sysid.diagnosis.identifiability import advise, unit_of, unseen_effects
from flytrack_sysid.diagnosis.model_selection import (
    BaseChange,
    Marginal,
    base_changes,
    commanded_thrust,
    equivalents,
    separation,
)
from flytrack_sysid.diagnosis.refinement import Refined
from flytrack_sysid.diagnosis.result import (
    CAUSES_FOUND,
    CHANNELS,
    CONSISTENT,
    DRIFT,
    PLACES,
    TO_LOG,
    TWO_SIDED_95,
    UNEXPLAINED,
    Cause,
    Changed,
    Errors,
    Estimated,
    Joint,
    NotIdentifiable,
    Prediction,
    Unexplained,
)
from flytrack_sysid.diagnosis.unexplained import is_like_drift
from flytrack_sysid.inference.chunks import measured_voltage_range
from flytrack_sysid.inference.free_flight import HORIZONS_S, QUANTITIES
from flytrack_sysid.inference.parameters import (
    DRAIN,
    MAX_RATES,
    THRUST_COEFFS,
    as_float32,
    from_vector,
    range_of,
)
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.score_test import (
    ALL_BASE_CAUSES,
    Linearization,
    base_fields,
    solve,
    threshold,
)
from flytrack_sysid.inference.search import FittedModel, SearchState, channels_for

LOOSE = 0.5  # of the prior's width: a parameter with a wider interval is not determined
NO_WIDTH = 1e-9  # of a parameter's scale: no flight depends on a value with a narrower interval
SCALE_TWINS = (
    "thrust_curve",
)  # mass, payload, battery and motors all scale the thrust over the mass
STILL = (*MAX_RATES, DRAIN, *THRUST_COEFFS)  # a model where these are 0 does not move


def estimates(
    linearization: Linearization, model: FittedModel, fields: Sequence[str]
) -> dict[str, Estimated]:
    """Return values and 95 % intervals of determined parameters, by name without the effect."""
    problem = linearization.problem
    halves = Marginal(linearization, model, fields).half_widths()
    result, smallest = {}, halves.min()  # at least one parameter of each effect is listed
    for field, half in zip(fields, halves, strict=True):
        index = problem.names.index(field)
        value, low, high = (
            float(values[index]) for values in (model.vector, problem.low, problem.high)
        )
        if "." in field and half > LOOSE * (high - low) and half > smallest:
            continue
        name, unit = field.split(".")[-1], range_of(field).unit
        result[name] = Estimated.around(value, float(half), unit, low, high)
    if tuple(fields) == THRUST_COEFFS:
        half = Marginal(linearization, model, fields).half_widths(mean_thrust(problem)[None])
        result |= mean_factor(problem, model.vector, float(half[0]))
    return result


def mean_thrust(problem: Problem) -> np.ndarray:
    """Return the mean thrust of scored rows (N) per unit of each thrust coefficient, (6,)."""
    is_scored = problem.counts.any(axis=(2, 3))
    return np.array(
        [
            np.mean(commanded_thrust(problem, coeffs)[is_scored])
            for coeffs in np.eye(len(THRUST_COEFFS))
        ]
    )


def mean_factor(problem: Problem, vector: np.ndarray, half_n: float) -> dict[str, Estimated]:
    """Return the ratio of the mean thrust to that of the nominal model.

    Individual coefficients are not interpretable.

    Args:
        half_n: half of the 95 % interval of the mean thrust (N).

    Returns:
        The ratio as ``mean_factor``; empty if the nominal model has no thrust.
    """
    indices, slopes = problem.parameter_indices(THRUST_COEFFS), mean_thrust(problem)
    before, after = (float(slopes @ parameters[indices]) for parameters in (problem.start, vector))
    if before <= 0.0:
        return {}
    return {"mean_factor": Estimated.around(after / before, half_n / before, "1")}


def find_channel(problem: Problem, reduced: np.ndarray, full: np.ndarray) -> str:
    """Return the channel in which two models differ most, in multiples of the noise."""
    white = problem.whitened_residuals(reduced, full)
    by_axis = np.square(white[1] - white[0]).sum(axis=(0, 1))
    power = {name: float(by_axis[index].sum()) for name, index in PLACES.items()}
    return max(power, key=lambda name: power[name])


def effect_causes(
    selection: vetoes.Selection, test: Problem, linearization: Linearization
) -> list[Cause]:
    """Return the effects of a model as causes, sorted by what they explain, largest first.

    If the log lacks velocity or attitude, the laws that need these are equivalents of every force.
    """
    problem, model = selection.state.problem, selection.model
    causes = []
    for candidate in model.candidates:
        ablation = selection.ablations[candidate.effect]
        reduced = ablation.without.vector
        separated = separation(linearization, model, candidate.effect)
        # Rivals are refitted where that was worth it, and compared to first order elsewhere.
        rivals = {
            name: min(ablation.rivals.get(name, size), size)
            for name, size in separated.beside.items()
        }
        closest = min(rivals, key=lambda name: rivals[name], default="")
        equivalent = equivalents(ablation, separated)
        channel = find_channel(problem, reduced, model.vector)
        if channel in CHANNELS[1]:
            equivalent += tuple(
                name
                for name in selection.state.unobservable
                if vetoes.is_force_law(name)
                and not {"v", "q"}.isdisjoint(BY_NAME[name].search.needs)
            )
        causes.append(
            Cause(
                effect=candidate.effect,
                equivalent=equivalent,
                channel=channel,
                parameters=estimates(linearization, model, candidate.fields),
                chi2_gain=ablation.gain,
                heldout_gain=vetoes.held_out_gain(test, reduced, model.vector)[0],
                lambda_=separated.noncentrality,
                lambda_sep=max(rivals.get(closest, separated.noncentrality), 0.0),
                closest=closest,
            )
        )
    # A thrust scale that was selected in place of a thrust curve may be a remainder, too.
    kept = [
        cause
        for cause in causes
        if cause.effect != "thrust_scale" or not _is_remainder(cause, causes)
    ]
    return sorted(kept, key=lambda cause: -cause.chi2_gain)


def _is_remainder(cause: Cause, causes: Sequence[Cause]) -> bool:
    """Return whether a cause gains next to nothing compared with one in the same channels."""
    side = next(names for names in CHANNELS if cause.channel in names)
    largest = max((peer.chi2_gain for peer in causes if peer.channel in side), default=0.0)
    return cause.chi2_gain < vetoes.BASE_REMAINDER * largest


def base_causes(
    selection: vetoes.Selection,
    test: Problem,
    linearization: Linearization,
    effects: Sequence[Cause],
) -> tuple[list[Cause], list[str]]:
    """Return base changes that the log shows, as causes, and names that held-out rows contradict.

    Args:
        effects: the causes that are effects. Base changes that are remainders of them are omitted.
    """
    problem, model = selection.state.problem, selection.model
    causes: list[Cause] = []
    contradicted: list[str] = []
    for name, change in base_changes(selection.state, linearization, model).items():
        if name in selection.stand_ins:
            continue
        channel = find_channel(problem, problem.at_start(model.vector, change.fields), model.vector)
        refitted = _refitted_to_first_order(linearization, model, change.fields)
        gain, expected = vetoes.held_out_gain(test, refitted, model.vector)
        if vetoes.is_contradicted(gain, expected, change.marginal.inflation):
            contradicted.append(name)
            continue
        parameters = estimates(linearization, model, change.fields)
        cause = Cause(name, (), channel, parameters, change.gain, gain, change.gain, change.gain)
        if _is_remainder(cause, effects):
            continue
        cause = _as_thrust_scale(cause, change, problem, model)
        if cause.effect == "thrust_curve" and is_like_drift(problem, model, change.fields):
            cause = replace(cause, equivalent=(DRIFT,))
        causes.append(cause)
    return sorted(causes, key=lambda cause: -cause.chi2_gain), contradicted


def vector_without(
    cause: Cause, selection: vetoes.Selection, linearization: Linearization
) -> np.ndarray:
    """Return the extended model without one of its causes, all other parameters refitted."""
    if cause.effect in selection.ablations:
        return selection.ablations[cause.effect].without.vector
    return _refitted_to_first_order(linearization, selection.model, base_fields(cause.effect))


def _refitted_to_first_order(
    linearization: Linearization, model: FittedModel, fields: Sequence[str]
) -> np.ndarray:
    """Return the vector with some parameters at nominal, the others refitted to first order."""
    problem = linearization.problem
    indices, vector = problem.parameter_indices(fields), problem.at_start(model.vector, fields)
    free = [index for index in model.indices if index not in set(indices)]
    free_columns, held_columns = linearization.columns_at(free), linearization.columns_at(indices)
    change = vector[indices] - model.vector[indices]
    score = (
        linearization.score[free_columns]
        - linearization.total[np.ix_(free_columns, held_columns)] @ change
    )
    vector[free] += solve(linearization.total[np.ix_(free_columns, free_columns)], score)
    return problem.clipped(vector)


def _as_thrust_scale(
    cause: Cause, change: BaseChange, problem: Problem, model: FittedModel
) -> Cause:
    """Convert a thrust curve to a scale of thrust if one factor explains all of its change."""
    if cause.effect != "thrust_curve":
        return cause
    indices, information = problem.parameter_indices(change.fields), change.marginal.information
    nominal, values = problem.start[indices], model.vector[indices]
    projection = nominal @ information
    norm = float(projection @ nominal)
    if norm <= 0.0:
        return cause  # a curve of zeros
    factor = float(projection @ values) / norm
    residual = values - factor * nominal
    if residual @ information @ residual / change.marginal.inflation > threshold(len(values) - 1):
        return cause
    half = TWO_SIDED_95 * float(np.sqrt(change.marginal.inflation / norm))
    scale = {"factor": Estimated.around(factor, half, "1")}
    return replace(cause, effect="thrust_scale", equivalent=SCALE_TWINS, parameters=scale)


def not_identifiable(
    state: SearchState, linearization: Linearization, model: FittedModel, causes: Sequence[Cause]
) -> tuple[NotIdentifiable, ...]:
    """Return effects that the log cannot show or distinguish from others, with what to fly."""
    limits = unseen_effects(state, linearization, model)
    twins: dict[str, tuple[str, ...]] = {}
    for cause in causes:
        if cause.effect in BY_NAME and cause.equivalent and cause.effect != "thrust_scale":
            twins[cause.effect] = (*twins.get(cause.effect, ()), *cause.equivalent)
            twins |= {name: (*twins.get(name, ()), cause.effect) for name in cause.equivalent}
    confusions = {name: limit.confused_with for name, limit in limits.items()} | twins
    flights = {
        name: TO_LOG + " and ".join(channels_for(BY_NAME[name], state.problem.like))
        for name in state.unobservable
    }
    observable = {
        name: equivalent
        for name, equivalent in confusions.items()
        if name not in state.unobservable
    }
    flights |= advise(state.problem, model, linearization, observable)
    result = []
    for name, equivalent in confusions.items():
        # An equivalent of a named cause has no detectable size of its own.
        twin = NotIdentifiable(name, float("inf"), unit_of(name), (), "")
        result.append(
            replace(limits.get(name, twin), confused_with=tuple(equivalent), fly=flights[name])
        )
    return tuple(result)


def classify(causes: Sequence[Cause], unexplained: Unexplained) -> str:
    """Return the verdict, as in ``Diagnosis``."""
    if causes and unexplained.flagged:
        return f"{CAUSES_FOUND}+{UNEXPLAINED}"
    if causes:
        return CAUSES_FOUND
    return UNEXPLAINED if unexplained.flagged else CONSISTENT


def model_of(problem: Problem, model: FittedModel) -> ModelParameters:
    """Return a fitted model in float32, with its effects and those of the nominal model."""
    parameters = as_float32(from_vector(model.vector, problem.like))
    kept = model.effects | set(problem.given_effects)
    return parameters._replace(
        effects=tuple(effect for effect in parameters.effects if effect_of(effect).name in kept)
    )


def _by_channel(values: np.ndarray, problem: Problem) -> dict[str, np.ndarray]:
    """Return values, (NUM_AXES, 2), by scored channel, each (num_axes of the channel,)."""
    return {
        name: values[index] for name, index in PLACES.items() if problem.counts[..., *index].any()
    }


def sensor_noise(problem: Problem) -> dict[str, list[float]]:
    """Return the fitted standard deviations of the sensors, by channel and axis (world frame)."""
    noise = problem.fitted_noise
    deviations = np.stack([np.asarray(noise.direct), np.asarray(noise.level)], axis=-1)
    return {
        name: [float(f"{value:.4g}") for value in by_axis]
        for name, by_axis in _by_channel(deviations, problem).items()
    }


def _with_voltage_summed(residuals: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return residuals with those of the voltage summed up, less their mean in each chunk.

    In one step a voltage changes by less than its last digit, so that the residual of one step
    contains no information about it.
    """
    result = residuals.copy()
    is_counted = counts[..., -1, 1]
    level = np.cumsum(residuals[..., -1, 1], axis=0)
    mean = np.where(is_counted, level, 0.0).sum(axis=0) / np.maximum(is_counted.sum(axis=0), 1)
    result[..., -1, 1] = level - mean
    return result


def _rms(residuals: np.ndarray, counts: np.ndarray, is_centred: bool = False) -> np.ndarray:
    num_rows = np.maximum(counts.sum(axis=(0, 1)), 1)
    mean = np.where(counts, residuals, 0.0).sum(axis=(0, 1)) / num_rows if is_centred else 0.0
    return np.sqrt(np.where(counts, (residuals - mean) ** 2, 0.0).sum(axis=(0, 1)) / num_rows)


def _free_flight_floor(problem: Problem) -> dict[str, float]:
    """Return the free-flight position errors (m) due to noise at the start alone, by horizon."""
    level = np.asarray(problem.fitted_noise.level)
    speed, tilt = np.sqrt(np.sum(level[3:6] ** 2)), np.sqrt(np.sum(level[:2] ** 2))
    gravity = float(problem.like.g)
    return {
        f"{horizon:g}": float(np.hypot(speed * horizon, 0.5 * gravity * tilt * horizon**2))
        for horizon in HORIZONS_S
    }


def errors_of(
    test: Problem, vectors: Mapping[str, np.ndarray], prediction: Prediction
) -> dict[str, Errors]:
    """Return errors of models on held-out rows, by name, and those of sensor noise alone.

    One-step errors are relative to those of a model that does not move. Its residuals are the
    measured changes themselves, less their mean.

    Args:
        test: the problem of the held-out rows.
        vectors: parameters of each model, by name.
        prediction: errors of free flight; only the position errors are read.
    """
    motionless = test.start.copy()
    motionless[test.parameter_indices(STILL)] = 0.0
    residuals = [
        _with_voltage_summed(model_residuals, test.counts)
        for model_residuals in test.residuals(np.stack([motionless, *vectors.values()]))
    ]
    scales = _by_channel(_rms(residuals[0], test.counts, is_centred=True), test)

    def relative(errors: np.ndarray) -> dict[str, float]:
        return {
            name: float(np.linalg.norm(values)) / max(float(np.linalg.norm(scales[name])), 1e-12)
            for name, values in _by_channel(errors, test).items()
        }

    result, flights = {}, prediction.errors
    for name, model_residuals in zip(vectors, residuals[1:], strict=True):
        position_errors = flights.get(name, {}).get("position_m", {})
        result[name] = Errors(relative(_rms(model_residuals, test.counts)), position_errors)
    noise = test.fitted_noise
    floor = np.stack([np.asarray(noise.direct), np.sqrt(2.0) * np.asarray(noise.level)], axis=-1)
    floor[-1, 1] = noise.level[-1]  # summed up, not a difference of two
    position_errors = _free_flight_floor(test) if result["extended"].position_m else {}
    result["noise_floor"] = Errors(relative(floor), position_errors)
    return result


def _is_beyond(problem: Problem, vector: np.ndarray, field: str) -> str:
    """Describe the end of the range at which a parameter is; empty within the range."""
    if not at_bounds(problem, vector, [field]):
        return ""
    index = problem.names.index(field)
    is_low = vector[index] - problem.low[index] < problem.high[index] - vector[index]
    unit = range_of(field).unit
    size = f"{vector[index]:.3g}" + ("" if unit == "1" else f" {unit}")
    return f"{field.split('.')[-1]} at {'most' if is_low else 'least'} {size}"


def causes_at_end(
    selection: vetoes.Selection, refined: Refined, test: Problem
) -> tuple[Cause, ...]:
    """Return effects with a value at the end of its range, as causes that say which end.

    Two kinds of values are omitted: those that the log does not determine, which a fit leaves
    anywhere, and delays that are as long as the rows that are remembered, whose law holds.
    """
    problem, model = selection.state.problem, selection.model
    searched, vector = problem, model.vector
    if refined.fit is not None:
        searched, vector = refined.problem, refined.fit.vector
    ranges = dict(zip(problem.names, problem.high - problem.low, strict=True))
    stuck: dict[str, str] = {}
    for candidate in refined.kept:
        steps = [f"{candidate.effect}.{field}" for field in BY_NAME[candidate.effect].max_steps]
        fields = [
            field for field in at_bounds(searched, vector, candidate.fields) if field not in steps
        ]
        if not fields:
            continue
        marginal = Marginal(selection.state.linearized(model.vector)[1], model, candidate.fields)
        widths = dict(zip(candidate.fields, marginal.half_widths(), strict=True))
        ends = [
            _is_beyond(searched, vector, field)
            for field in fields
            if widths[field] < LOOSE * ranges[field]
        ]
        if ends:
            stuck[candidate.effect] = ", ".join(ends)
    if not stuck:
        return ()
    state, linearization = selection.state.linearized(model.vector)
    causes = effect_causes(selection._replace(state=state), test, linearization)
    refused = with_refined_values(
        [cause for cause in causes if cause.effect in stuck], refined, vector
    )
    return tuple(replace(cause, beyond=stuck[cause.effect]) for cause in refused)


def with_refined_values(
    causes: Sequence[Cause], refined: Refined, vector: np.ndarray
) -> tuple[Cause, ...]:
    """Return causes with refined values and intervals, and with the values that are at a bound.

    A cause lists all parameters that were fitted to flights. Those whose intervals all hold the
    nominal values are omitted: single steps show them, and flights do not.
    """
    problem, fit = refined.problem, refined.fit
    half = {} if fit is None else fit.half_widths_by_index
    result = []
    for cause in causes:
        prefix = f"{cause.effect}." if cause.effect in BY_NAME else ""
        determined = [prefix + name for name in cause.parameters if prefix + name in problem.names]
        fitted = [problem.names[index] for index in half if prefix]
        of_cause = (field for field in fitted if field.startswith(prefix))
        fields = list(dict.fromkeys([*determined, *of_cause]))
        values = dict(cause.parameters)
        for field in fields:
            index, name = problem.names.index(field), field.split(".")[-1]
            if half.get(index, np.inf) < NO_WIDTH * problem.scale[index] and len(values) > 1:
                values.pop(name, None)  # no flight depends on it
            elif index in half:
                value, low, high = (
                    float(array[index]) for array in (vector, problem.low, problem.high)
                )
                values[name] = Estimated.around(value, half[index], range_of(field).unit, low, high)
        fields = [field for field in fields if field.split(".")[-1] in values]
        thrust = problem.parameter_indices(THRUST_COEFFS)
        if "mean_factor" in values and fit is not None and half.keys() >= {*thrust}:
            thrust_columns = [fit.indices.index(index) for index in thrust]
            slopes = mean_thrust(problem)
            half_n = float(
                np.sqrt(slopes @ fit.covariance[np.ix_(thrust_columns, thrust_columns)] @ slopes)
            )
            values |= mean_factor(problem, vector, half_n)
        elif fields and all(_holds_nominal(problem, half, values, field) for field in fields):
            continue
        beyond = ", ".join(filter(None, (_is_beyond(problem, vector, field) for field in fields)))
        result.append(replace(cause, parameters=values, beyond=beyond))
    return tuple(result)


def _holds_nominal(
    problem: Problem, half: Mapping[int, float], values: Mapping[str, Estimated], field: str
) -> bool:
    """Return whether a parameter was fitted to flights and its interval holds the nominal value."""
    index = problem.names.index(field)
    low, high = values[field.split(".")[-1]].ci95
    return index in half and low <= problem.start[index] <= high


def summarize_prediction(refined: Refined, vectors: Mapping[str, np.ndarray]) -> Prediction:
    """Return the errors of models on held-out flights, by horizon; empty without a flight test."""
    flight_test = refined.flight_test
    if flight_test is None:
        return Prediction()
    models = dict(vectors)
    if refined.base is not None:
        models["refitted_to_flights"] = refined.base
    rms = flight_test.flights.errors_at(refined.problem, np.stack(list(models.values()))).rms()
    errors = {name: tabulate_errors(value) for name, value in zip(models, rms, strict=True)}
    errors["placebo"] = tabulate_errors(flight_test.placebo.rms()[0])
    evidence = {
        quantity: tuple(
            float(value) for value in np.array(HORIZONS_S)[flight_test.matters[:, index]]
        )
        for index, quantity in enumerate(QUANTITIES)
        if flight_test.is_known[:, index].any()
    }
    return Prediction(errors, evidence, refined.removal_costs)


def changed_parameters(
    linearization: Linearization, extended: FittedModel, refined: Refined
) -> tuple[Changed, ...]:
    """Return every parameter of the extended model whose value differs from the nominal one."""
    problem, fit, vector = refined.problem, refined.fit, extended.vector
    indices = [
        index for index in extended.indices if abs(vector[index] - problem.start[index]) > 0.0
    ]
    widths = {} if fit is None else fit.half_widths_by_index
    acting = [
        index
        for index in indices
        if index not in widths and linearization.acting([linearization.indices.index(index)])
    ]
    if acting:
        names = [problem.names[index] for index in acting]
        halves = Marginal(linearization, extended, names).half_widths()
        widths |= dict(zip(acting, halves, strict=True))
    result = []
    for index in indices:
        name, value, half = (
            problem.names[index],
            float(vector[index]),
            float(widths.get(index, np.inf)),
        )
        bound = bool(at_bounds(problem, vector, [name]))
        ends, unit = (value - half, value + half), range_of(name).unit
        result.append(Changed(name, float(problem.start[index]), value, ends, unit, bound))
    return tuple(result)


def estimate_joint(linearization: Linearization, extended: FittedModel, refined: Refined) -> Joint:
    """Return the joint uncertainty of the parameters that the log was fitted by.

    Single steps say what the log determines at all. Flights, where they were fitted, add how much
    parts of the log disagree, which few parts show in few directions only: so both are summed.
    """
    problem, fit = refined.problem, refined.fit
    columns = linearization.columns_at(extended.indices)
    acting = [linearization.indices[column] for column in linearization.acting(columns)]
    if not acting:
        return Joint()
    names = tuple(problem.names[index] for index in acting)
    covariance = Marginal(linearization, extended, names).covariance()
    if fit is not None:
        rows = [row for row, index in enumerate(acting) if index in fit.indices]
        own = [fit.indices.index(acting[row]) for row in rows]
        of_flights = fit.covariance[np.ix_(own, own)] / fit.quantile**2
        covariance[np.ix_(rows, rows)] += of_flights
    return Joint(names, covariance)


def refinement_notes(refined: Refined, model: FittedModel) -> list[str]:
    """Return notes on a refinement: removed effects, and horizons without evidence.

    Args:
        model: the extended model after the refinement.
    """
    flight_test = refined.flight_test
    if flight_test is None:
        return []
    notes = []
    removed = [
        *refined.removed,
        *(candidate.effect for candidate in refined.kept if candidate not in model.candidates),
    ]
    if removed:
        names = ", ".join(removed)
        notes.append(
            f"not in the extended model: {names}; single steps show them, but held-out flights are "
            "predicted no better with them, or worse at some horizon"
        )
        if refined.fit is None:
            notes.append(
                "no effect predicts held-out flights better: the extended model is the refitted one"
            )
    silent = [
        f"{HORIZONS_S[index]:g} s"
        for index in range(len(HORIZONS_S))
        if flight_test.is_known[index].any() and not flight_test.matters[index].any()
    ]
    if silent and refined.fit is not None:
        notes.append(
            f"after {', '.join(silent)} the held-out flights do not show that a model predicts "
            "better than the state at the start without commands: nothing is named from there"
        )
    return notes


def collect_warnings(
    problem: Problem, causes: Sequence[Cause], contradicted: Sequence[str]
) -> list[str]:
    """Return what a reader must know before trusting causes or the extended model.

    Args:
        contradicted: names that were rejected because held-out rows contradict them.
    """
    return [
        *_voltage_unknown(problem, causes),
        *(
            f"{name} gained nothing on the held-out part: it was there for a time only, or never"
            for name in contradicted
        ),
        *(_at_bound(cause) for cause in causes if cause.beyond),
    ]


def stand_in_notes(selection: vetoes.Selection, vector: np.ndarray) -> list[str]:
    """Return notes on base changes that are not named since something unknown may be their cause.

    In hover, for example, a constant force is equivalent to a change of thrust.

    Args:
        vector: parameters of the extended model, (num_parameters,).
    """
    problem, notes = selection.state.problem, []
    for name in (cause for cause in selection.stand_ins if cause in ALL_BASE_CAUSES):
        size = ""
        if name == "thrust_curve":
            for factor in mean_factor(problem, vector, 0.0).values():
                size = f" (thrust or your mass by {factor.value - 1.0:+.1%} in the mean)"
        notes.append(
            f"{name} differs in the extended model{size}, but is not named: "
            "what remains unexplained could pass for it"
        )
    return notes


def given_law_notes(problem: Problem, unexplained: Unexplained) -> list[str]:
    """Return a note that no law is learnt if the nominal model has one from another log."""
    if not problem.has_given_law or not unexplained.shares:
        return []
    return [
        "the model has learned_law from another log: nothing is learnt beside that; diagnose the "
        "model without it to learn from this log"
    ]


def unsettled(
    selection: vetoes.Selection, rejected: Mapping[str, str], unflown: Sequence[str]
) -> tuple[str, ...]:
    """Return names that the log suggests and does not settle, each once.

    Args:
        selection: of the extended model.
        rejected: the veto's name of each rejected effect. Those that held-out rows contradict are
            settled.
        unflown: what single steps show, and free flights do not.
    """
    stand_ins = (name for name in selection.stand_ins if name in ALL_BASE_CAUSES)
    doubted = (name for name, veto in rejected.items() if veto in vetoes.REASONS)
    return tuple(dict.fromkeys((*stand_ins, *doubted, *unflown)))


def neutral_notes(names: Sequence[str]) -> list[str]:
    """Return a note on causes that flights do not show, if there are any."""
    if not names:
        return []
    return [
        f"{', '.join(names)}: not named, since single steps show it and free flights do not: with "
        "all else refitted, its intervals hold the nominal values"
    ]


def veto_notes(rejected: Mapping[str, str]) -> list[str]:
    """Return a note for each reason on the effects that were rejected for it."""
    names: dict[str, list[str]] = {}
    for effect, veto in rejected.items():
        reason = vetoes.REASONS.get(veto)
        if reason is not None:
            names.setdefault(reason, []).append(effect)
    return [f"{', '.join(effects)}: not named, since {reason}" for reason, effects in names.items()]


def _at_bound(cause: Cause) -> str:
    """Return a warning about a value at the end of its range: the true cause may be another."""
    why = "its law may stand in for something else"
    if cause.effect in BY_NAME:
        why += ", and is not in the extended model"
        if any(name in cause.beyond for name in BY_NAME[cause.effect].max_steps):
            why = "the model remembers a limited number of rows; import fewer rows per second"
    return f"{cause.effect} is beyond the list: {cause.beyond}, the end of what is searched; {why}"


def _voltage_unknown(problem: Problem, causes: Sequence[Cause]) -> list[str]:
    """Return a warning if thrust is named and the voltage that it depends on was not measured."""
    thrust = [cause.effect for cause in causes if cause.effect in ("thrust_curve", "thrust_scale")]
    if not thrust or measured_voltage_range(problem.chunks) is not None:
        return []
    assumed = (
        f"no voltage was logged and {problem.chunks.record.battery_v.flat[0]:.4g} V were assumed"
    )
    return [f"{assumed}: {thrust[0]} may only be the error of that"]


def with_lost_causes(unexplained: Unexplained, contradicted: Sequence[str]) -> Unexplained:
    """Add a dependence on time to what is unexplained if held-out rows contradict a cause.

    Such a cause acted for a part of the flight only.
    """
    if not contradicted or "time" in unexplained.depends_on:
        return unexplained
    return replace(unexplained, flagged=True, depends_on=(*unexplained.depends_on, "time"))
