"""Turn a selected model into a diagnosis: causes, limits, errors on held-out rows, warnings."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from flytrack_env.dynamics import ModelParameters, collective_thrust
from flytrack_env.effects import BY_NAME, effect_of
from flytrack_sysid.diagnosis import vetoes
from flytrack_sysid.diagnosis.chunks import voltages_of
from flytrack_sysid.diagnosis.identifiability import advise, unit_of, unseen_effects
from flytrack_sysid.diagnosis.model_selection import (
    BaseChange,
    Marginal,
    base_changes,
    equivalents,
    separation,
)
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.refinement import Refined, at_bounds, errors_at, table_of
from flytrack_sysid.diagnosis.result import (
    CAUSES_FOUND,
    CHANNELS,
    CONSISTENT,
    DRIFT,
    PLACES,
    TO_LOG,
    UNEXPLAINED,
    Cause,
    Changed,
    Errors,
    Estimated,
    HalfResponse,
    NotIdentifiable,
    Prediction,
    Unexplained,
)
from flytrack_sysid.diagnosis.score_test import BASE_CAUSES, Linearization, solve, threshold
from flytrack_sysid.diagnosis.search import FittedModel, SearchState
from flytrack_sysid.diagnosis.unexplained import is_like_drift
from flytrack_sysid.parameters import (
    DRAIN,
    MAX_RATES,
    STICKS,
    THRUST_COEFFS,
    as_float32,
    from_vector,
    range_of,
)
from flytrack_sysid.prediction_windows import HORIZONS_S, QUANTITIES
from flytrack_sysid.response import FULL_STEP, SMALL_STEP, half_responses

TWO_SIDED_95 = 1.959964
LOOSE = 0.5  # of the prior's width: a parameter that the log knows no better is not determined
SCALE_TWINS = (
    "thrust_curve",
)  # mass, payload, battery and motors all scale the thrust over the mass
SLOPE_STEP = 1e-3  # of a parameter's scale, for slopes of times to half response
STILL = (*MAX_RATES, DRAIN, *THRUST_COEFFS)  # a model where these are 0 does not move


def estimates(
    linearization: Linearization, model: FittedModel, fields: Sequence[str]
) -> dict[str, Estimated]:
    """Return values and 95 % intervals of determined parameters, by name without the effect."""
    problem = linearization.problem
    halves = Marginal(linearization, model, fields).half_widths()
    result, least = {}, halves.min()  # at least one parameter of each effect is listed
    for field, half in zip(fields, halves, strict=True):
        place = problem.names.index(field)
        value, low, high = (float(one[place]) for one in (model.vector, problem.low, problem.high))
        if "." in field and half > LOOSE * (high - low) and half > least:
            continue
        name, unit = field.split(".")[-1], range_of(field).unit
        result[name] = Estimated.around(value, float(half), unit, low, high)
    if tuple(fields) == THRUST_COEFFS:
        half = Marginal(linearization, model, fields).half_widths(mean_thrust(problem)[None])
        result |= mean_factor(problem, model.vector, float(half[0]))
    return result


def mean_thrust(problem: Problem) -> np.ndarray:
    """Return the mean thrust of judged rows, N, per unit of each thrust coefficient, (6,)."""
    record, flown = problem.chunks.record, problem.counts.any(axis=(2, 3))
    return np.array(
        [
            np.mean(
                np.asarray(collective_thrust(record.command[..., 3], record.battery_v, coeffs))[
                    flown
                ]
            )
            for coeffs in np.eye(len(THRUST_COEFFS))
        ]
    )


def mean_factor(problem: Problem, vector: np.ndarray, half_n: float) -> dict[str, Estimated]:
    """Return the ratio of the mean thrust to that of the nominal model.

    Individual coefficients are not interpretable.

    half_n: half of the 95 % interval of the mean thrust, N. Empty where the nominal one has none.
    """
    indices, slopes = problem.indices_of(THRUST_COEFFS), mean_thrust(problem)
    before, after = (float(slopes @ own[indices]) for own in (problem.start, vector))
    if before <= 0.0:
        return {}
    return {"mean_factor": Estimated.around(after / before, half_n / before, "1")}


def half_responses_of(
    linearization: Linearization,
    model: FittedModel,
    refined: Refined,
    vectors: Mapping[str, np.ndarray],
) -> dict[str, dict[str, HalfResponse]]:
    """Return the times to half response of models by name, by stick.

    The intervals of the extended model are to first order those of all its parameters together.
    """
    problem, fit = refined.problem, refined.fit
    indices = list(model.indices if fit is None else fit.indices)
    moved, step = problem.nudged(vectors["extended"], indices, SLOPE_STEP)
    found = half_responses(np.stack([*vectors.values(), *moved]), problem.like, SMALL_STEP)
    full = half_responses(np.stack(list(vectors.values())), problem.like, FULL_STEP)
    own = found[list(vectors).index("extended")]
    slopes = np.nan_to_num((found[len(vectors) :] - own) / step[:, None]).T
    if fit is None:
        names = [problem.names[place] for place in indices]
        halves = Marginal(linearization, model, names).half_widths(slopes)
    else:
        halves = np.sqrt(np.diag(slopes @ fit.covariance @ slopes.T))
    result = {
        name: dict(zip(STICKS, map(HalfResponse, small_s.tolist(), full_s.tolist()), strict=True))
        for name, small_s, full_s in zip(vectors, found, full, strict=False)
    }
    for (stick, one), half in zip(result["extended"].items(), halves.tolist(), strict=True):
        result["extended"][stick] = replace(one, ci95=(max(one.time - half, 0.0), one.time + half))
    return result


def channel_of(problem: Problem, less: np.ndarray, full: np.ndarray) -> str:
    """Return the channel in which two models differ most, in multiples of the noise."""
    white = problem.whitened_residuals(less, full)
    by_axis = np.square(white[1] - white[0]).sum(axis=(0, 1))
    power = {name: float(by_axis[place].sum()) for name, place in PLACES.items()}
    return max(power, key=lambda name: power[name])


def effect_causes(
    selection: vetoes.Selection, test: Problem, linearization: Linearization
) -> list[Cause]:
    """Return the effects of a model as causes, those that explain most first.

    A force may as well be one of the laws of velocity or attitude where the log lacks these.
    """
    problem, model = selection.state.problem, selection.model
    causes = []
    for one in model.candidates:
        ablation = selection.ablations[one.effect]
        less = ablation.without.vector
        own = separation(linearization, model, one.effect)
        # Refitted where that was worth it, else to first order.
        rivals = {
            name: min(ablation.rivals.get(name, size), size) for name, size in own.beside.items()
        }
        closest = min(rivals, key=lambda name: rivals[name], default="")
        alike = equivalents(ablation, own)
        channel = channel_of(problem, less, model.vector)
        if channel in CHANNELS[1]:
            alike += tuple(
                name
                for name in selection.state.unobservable
                if vetoes.is_force_law(name)
                and not {"v", "q"}.isdisjoint(BY_NAME[name].search.needs)
            )
        causes.append(
            Cause(
                effect=one.effect,
                equivalent=alike,
                channel=channel,
                parameters=estimates(linearization, model, one.fields),
                chi2_gain=ablation.gain,
                heldout_gain=vetoes.held_out_gain(test, less, model.vector)[0],
                lambda_=own.noncentrality,
                lambda_sep=max(rivals.get(closest, own.noncentrality), 0.0),
                closest=closest,
            )
        )
    # A scale of thrust that was found in place of a thrust curve may be a remainder, too.
    kept = [
        cause
        for cause in causes
        if cause.effect != "thrust_scale" or not _is_remainder(cause, causes)
    ]
    return sorted(kept, key=lambda cause: -cause.chi2_gain)


def _is_remainder(cause: Cause, others: Sequence[Cause]) -> bool:
    """Return whether a cause gains next to nothing beside another one in the same channels."""
    side = next(names for names in CHANNELS if cause.channel in names)
    most = max((one.chi2_gain for one in others if one.channel in side), default=0.0)
    return cause.chi2_gain < vetoes.BASE_REMAINDER * most


def base_causes(
    selection: vetoes.Selection,
    test: Problem,
    linearization: Linearization,
    effects: Sequence[Cause],
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
        channel = channel_of(problem, problem.at_start(model.vector, change.fields), model.vector)
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
    """Return the extended model without one of its causes, the rest fitted again."""
    if cause.effect in selection.ablations:
        return selection.ablations[cause.effect].without.vector
    name = "thrust_curve" if cause.effect == "thrust_scale" else cause.effect
    return _refitted_to_first_order(linearization, selection.model, BASE_CAUSES[name])


def _refitted_to_first_order(
    linearization: Linearization, model: FittedModel, fields: Sequence[str]
) -> np.ndarray:
    """Return the vector with some parameters at nominal, the rest refitted to first order."""
    problem = linearization.problem
    indices, less = problem.indices_of(fields), problem.at_start(model.vector, fields)
    others = [place for place in model.indices if place not in set(indices)]
    columns, own = linearization.columns_at(others), linearization.columns_at(indices)
    change = less[indices] - model.vector[indices]
    score = linearization.score[columns] - linearization.total[np.ix_(columns, own)] @ change
    less[others] += solve(linearization.total[np.ix_(columns, columns)], score)
    return problem.clipped(less)


def _as_thrust_scale(
    cause: Cause, change: BaseChange, problem: Problem, model: FittedModel
) -> Cause:
    """Return a thrust curve as a scale of thrust if one factor explains all of its change."""
    if cause.effect != "thrust_curve":
        return cause
    indices, information = problem.indices_of(change.fields), change.marginal.information
    nominal, values = problem.start[indices], model.vector[indices]
    along = nominal @ information
    known = float(along @ nominal)
    if known <= 0.0:
        return cause  # a curve of zeros
    factor = float(along @ values) / known
    rest = values - factor * nominal
    if rest @ information @ rest / change.marginal.inflation > threshold(len(values) - 1):
        return cause
    half = TWO_SIDED_95 * float(np.sqrt(change.marginal.inflation / known))
    scale = {"factor": Estimated.around(factor, half, "1")}
    return replace(cause, effect="thrust_scale", equivalent=SCALE_TWINS, parameters=scale)


def not_identifiable(
    state: SearchState, linearization: Linearization, model: FittedModel, causes: Sequence[Cause]
) -> tuple[NotIdentifiable, ...]:
    """Return effects that the log could not show or tell from others, with what to fly."""
    limits = unseen_effects(state, linearization, model)
    twins: dict[str, tuple[str, ...]] = {}
    for cause in causes:
        if cause.effect in BY_NAME and cause.equivalent and cause.effect != "thrust_scale":
            twins[cause.effect] = (*twins.get(cause.effect, ()), *cause.equivalent)
            twins |= {name: (*twins.get(name, ()), cause.effect) for name in cause.equivalent}
    wanted = {name: limit.confused_with for name, limit in limits.items()} | twins
    flights = {
        name: TO_LOG + " and ".join(BY_NAME[name].search.needs) for name in state.unobservable
    }
    asked = {name: alike for name, alike in wanted.items() if name not in state.unobservable}
    flights |= advise(state.problem, model, linearization, asked)
    result = []
    for name, alike in wanted.items():
        # A twin of what was found has no size of its own.
        twin = NotIdentifiable(name, float("inf"), unit_of(name), (), "")
        result.append(
            replace(limits.get(name, twin), confused_with=tuple(alike), fly=flights[name])
        )
    return tuple(result)


def verdict_of(causes: Sequence[Cause], rest: Unexplained) -> str:
    """Return the verdict, as in ``Diagnosis``."""
    if causes and rest.flagged:
        return f"{CAUSES_FOUND}+{UNEXPLAINED}"
    if causes:
        return CAUSES_FOUND
    return UNEXPLAINED if rest.flagged else CONSISTENT


def model_of(problem: Problem, model: FittedModel) -> ModelParameters:
    """Return a fitted model in float32, with its effects and those of the nominal model."""
    found = as_float32(from_vector(model.vector, problem.like))
    kept = model.effects | set(problem.given_effects)
    return found._replace(
        effects=tuple(one for one in found.effects if effect_of(one).name in kept)
    )


def _by_channel(values: np.ndarray, problem: Problem) -> dict[str, np.ndarray]:
    """Return values (NUM_AXES, 2) by channel that is judged; (axes of it,) each."""
    return {
        name: values[place] for name, place in PLACES.items() if problem.counts[..., *place].any()
    }


def sensor_noise(problem: Problem) -> dict[str, list[float]]:
    """Return the fitted standard deviations of the sensors, by channel and axis (world frame)."""
    noise = problem.fitted_noise
    found = np.stack([np.asarray(noise.direct), np.asarray(noise.level)], axis=-1)
    return {
        name: [float(f"{value:.4g}") for value in own]
        for name, own in _by_channel(found, problem).items()
    }


def _with_voltage_summed(left: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return residuals with those of the battery summed up, less their mean in each chunk.

    A voltage changes by less in a step than its last digit, so that a single step tells nothing of
    it.
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


def _free_flight_floor(problem: Problem) -> dict[str, float]:
    """Return the free-flight position errors due to noise at the start alone, m, by horizon."""
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

    One-step errors are relative to those of a model that does not move, whose residuals are the
    measured changes themselves, less their mean.
    """
    still = test.start.copy()
    still[test.indices_of(STILL)] = 0.0
    left = [
        _with_voltage_summed(one, test.counts)
        for one in test.residuals(np.stack([still, *vectors.values()]))
    ]
    scales = _by_channel(_rms(left[0], test.counts, is_centred=True), test)

    def relative(errors: np.ndarray) -> dict[str, float]:
        return {
            name: float(np.linalg.norm(own)) / max(float(np.linalg.norm(scales[name])), 1e-12)
            for name, own in _by_channel(errors, test).items()
        }

    result, flights = {}, prediction.errors
    for name, one in zip(vectors, left[1:], strict=True):
        flown = flights.get(name, {}).get("position_m", {})
        result[name] = Errors(relative(_rms(one, test.counts)), flown)
    noise = test.fitted_noise
    floor = np.stack([np.asarray(noise.direct), np.sqrt(2.0) * np.asarray(noise.level)], axis=-1)
    floor[-1, 1] = noise.level[-1]  # summed up, not a difference of two
    flown = _free_flight_floor(test) if result["extended"].position_m else {}
    result["noise_floor"] = Errors(relative(floor), flown)
    return result


def _is_beyond(problem: Problem, vector: np.ndarray, field: str) -> str:
    """Return which way a parameter would go beyond its range; empty within the range."""
    if not at_bounds(problem, vector, [field]):
        return ""
    place = problem.names.index(field)
    is_low = vector[place] - problem.low[place] < problem.high[place] - vector[place]
    unit = range_of(field).unit
    size = f"{vector[place]:.3g}" + ("" if unit == "1" else f" {unit}")
    return f"{field.split('.')[-1]} at {'most' if is_low else 'least'} {size}"


def causes_at_end(
    selection: vetoes.Selection, refined: Refined, test: Problem
) -> tuple[Cause, ...]:
    """Return effects with a value at the end of its range, as causes that say which end.

    Left out are values that the log does not determine, which end anywhere, and delays that end at
    how many rows are remembered: their law holds.
    """
    problem, model = selection.state.problem, selection.model
    searched, vector = problem, model.vector
    if refined.fit is not None:
        searched, vector = refined.problem, refined.fit.vector
    ranges = dict(zip(problem.names, problem.high - problem.low, strict=True))
    stuck: dict[str, str] = {}
    for one in refined.kept:
        steps = [f"{one.effect}.{field}" for field in BY_NAME[one.effect].max_steps]
        fields = [field for field in at_bounds(searched, vector, one.fields) if field not in steps]
        if not fields:
            continue
        marginal = Marginal(selection.state.linearized(model.vector)[1], model, one.fields)
        widths = dict(zip(one.fields, marginal.half_widths(), strict=True))
        where = [
            _is_beyond(searched, vector, field)
            for field in fields
            if widths[field] < LOOSE * ranges[field]
        ]
        if where:
            stuck[one.effect] = ", ".join(where)
    if not stuck:
        return ()
    state, linearization = selection.state.linearized(model.vector)
    causes = effect_causes(selection._replace(state=state), test, linearization)
    refused = with_refined_values([one for one in causes if one.effect in stuck], refined, vector)
    return tuple(replace(one, beyond=stuck[one.effect]) for one in refused)


def with_refined_values(
    causes: Sequence[Cause], refined: Refined, vector: np.ndarray
) -> tuple[Cause, ...]:
    """Return causes with refined values and intervals, and which of the values are at a bound."""
    problem, fit = refined.problem, refined.fit
    half = {} if fit is None else dict(zip(fit.indices, fit.half_widths, strict=True))
    result = []
    for cause in causes:
        prefix = f"{cause.effect}." if cause.effect in BY_NAME else ""
        fields = [prefix + name for name in cause.parameters if prefix + name in problem.names]
        values = dict(cause.parameters)
        for field in fields:
            place, name = problem.names.index(field), field.split(".")[-1]
            if half.get(place) == 0.0 and len(values) > 1:
                del values[name]  # no flight depends on it
            elif place in half:
                value, low, high = (
                    float(one[place]) for one in (vector, problem.low, problem.high)
                )
                values[name] = Estimated.around(value, half[place], range_of(field).unit, low, high)
        fields = [field for field in fields if field.split(".")[-1] in values]
        if "mean_factor" in values and fit is not None:
            own = [fit.indices.index(place) for place in problem.indices_of(THRUST_COEFFS)]
            slopes = mean_thrust(problem)
            half_n = float(np.sqrt(slopes @ fit.covariance[np.ix_(own, own)] @ slopes))
            values |= mean_factor(problem, vector, half_n)
        if len(fields) == 1 and fit is not None and "." not in fields[0]:
            low, high = values[fields[0]].ci95
            if low <= problem.start[problem.names.index(fields[0])] <= high:
                continue  # a lag that single steps show and flights do not
        beyond = ", ".join(filter(None, (_is_beyond(problem, vector, field) for field in fields)))
        result.append(replace(cause, parameters=values, beyond=beyond))
    return tuple(result)


def prediction_of(refined: Refined, vectors: Mapping[str, np.ndarray]) -> Prediction:
    """Return how far ahead models predict held-out flights; empty if too few could be judged."""
    flight_test = refined.flight_test
    if flight_test is None:
        return Prediction()
    models = dict(vectors)
    if refined.base is not None:
        models["refitted_to_flights"] = refined.base
    found = errors_at(refined.problem, np.stack(list(models.values())), flight_test.windows).rms()
    errors = {name: table_of(one) for name, one in zip(models, found, strict=True)}
    errors["placebo"] = table_of(flight_test.placebo.rms()[0])
    evidence = {
        quantity: tuple(float(one) for one in np.array(HORIZONS_S)[flight_test.matters[:, index]])
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
        place for place in extended.indices if abs(vector[place] - problem.start[place]) > 0.0
    ]
    if fit is not None:
        widths = dict(zip(fit.indices, fit.half_widths, strict=True))
    else:
        acting = [
            place for place in indices if linearization.acting([linearization.indices.index(place)])
        ]
        halves = Marginal(
            linearization, extended, [problem.names[place] for place in acting]
        ).half_widths()
        widths = dict(zip(acting, halves, strict=True))
    result = []
    for place in indices:
        name, value, half = (
            problem.names[place],
            float(vector[place]),
            float(widths.get(place, np.inf)),
        )
        bound = bool(at_bounds(problem, vector, [name]))
        ends, unit = (value - half, value + half), range_of(name).unit
        result.append(Changed(name, float(problem.start[place]), value, ends, unit, bound))
    return tuple(result)


def refinement_notes(refined: Refined, model: FittedModel) -> list[str]:
    """Return what a refinement found out beside values; model: what is left of the selected one."""
    flight_test = refined.flight_test
    if flight_test is None:
        return []
    notes = []
    removed = [
        *refined.removed,
        *(one.effect for one in refined.kept if one not in model.candidates),
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
            f"after {', '.join(silent)} a placebo that knows the state at the start and no "
            "commands predicts these flights as well as the models: nothing is named from there"
        )
    return notes


def warnings_of(
    problem: Problem, causes: Sequence[Cause], contradicted: Sequence[str]
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
        *(_at_bound(cause) for cause in causes if cause.beyond),
    ]


def stand_in_notes(selection: vetoes.Selection, vector: np.ndarray) -> list[str]:
    """Return base changes that are not named since something unknown may be their cause.

    vector: of the extended model. In hover, a constant push passes for thrust.
    """
    problem, notes = selection.state.problem, []
    for name in (one for one in selection.stand_ins if one in BASE_CAUSES):
        size = ""
        if name == "thrust_curve":
            for factor in mean_factor(problem, vector, 0.0).values():
                size = f" (thrust or your mass by {factor.value - 1.0:+.1%} in the mean)"
        notes.append(
            f"{name} differs in the extended model{size}, but is not named: "
            "what remains unexplained could pass for it"
        )
    return notes


def given_law_notes(problem: Problem, rest: Unexplained) -> list[str]:
    """Return that no law is looked for beside one that the nominal model has from another log."""
    if not problem.has_given_law or not rest.shares:
        return []
    return [
        "the model has learned_law from another log: nothing is learnt beside that; diagnose the "
        "model without it to learn from this log"
    ]


def unseen_at_rest_notes(rejected: Mapping[str, vetoes.Veto]) -> list[str]:
    """Return laws of the sticks that were rejected for what they do while those rest."""
    names = ", ".join(name for name, veto in rejected.items() if veto is vetoes.not_seen_at_rest)
    if not names:
        return []
    return [
        f"{names}: not named, since dynamics of the rate loop that no list has would look the same "
        "while sticks move; fly stick_amplitudes, and hold each stick for a second"
    ]


def _at_bound(cause: Cause) -> str:
    """Return a warning of a value at the end of its range: the true cause may be another one."""
    why = "its law may stand in for something else"
    if cause.effect in BY_NAME:
        why += ", and is not in the extended model"
    if cause.effect in BY_NAME and any(
        name in cause.beyond for name in BY_NAME[cause.effect].max_steps
    ):
        why = "only so many rows of the log are remembered; import it with fewer rows per second"
    return f"{cause.effect} is beyond the list: {cause.beyond}, the end of what is searched; {why}"


def _voltage_unknown(problem: Problem, causes: Sequence[Cause]) -> list[str]:
    """Return a warning where thrust is named and the voltage it depends on was not measured."""
    thrust = [cause.effect for cause in causes if cause.effect in ("thrust_curve", "thrust_scale")]
    if not thrust or voltages_of(problem.chunks) is not None:
        return []
    assumed = (
        f"no voltage was logged and {problem.chunks.record.battery_v.flat[0]:.4g} V were assumed"
    )
    return [f"{assumed}: {thrust[0]} may only be the error of that"]


def with_lost_causes(rest: Unexplained, contradicted: Sequence[str]) -> Unexplained:
    """Return what is unexplained; it depends on time where a cause was there for a time only."""
    if not contradicted or "time" in rest.depends_on:
        return rest
    return replace(rest, flagged=True, depends_on=(*rest.depends_on, "time"))
