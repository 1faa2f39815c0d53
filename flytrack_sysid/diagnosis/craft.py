"""Quantities of the craft that hold in any flight: times to half response, and what it lifts.

Parameters trade off against each other, and a mean over one flight depends on how full its battery
was. These do not: they are compared between flights.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from flytrack_env.dynamics import collective_thrust
from flytrack_env.thrust import hover_action
from flytrack_sysid.diagnosis.flight_fit import LAG_STEP
from flytrack_sysid.diagnosis.model_selection import Marginal
from flytrack_sysid.diagnosis.refinement import Refined
from flytrack_sysid.diagnosis.result import Estimated, HalfResponse, Lift
from flytrack_sysid.inference.parameters import STICKS, THRUST_COEFFS
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.score_test import Linearization
from flytrack_sysid.inference.search import FittedModel
from flytrack_sysid.response import FULL_STEP, SMALL_STEP, half_responses

SLOPE_STEP = 1e-3  # of a parameter's scale
THRUST_FACTOR = "thrust_scale.factor"
AT_TOP = 1e-6  # of a parameter's scale: this near to the top of its range it is there
SHAPES_S = 1e-6  # a parameter that changes a time by less, over its scale, does not shape it
MIDDLE = 0.5  # of a battery's voltages, from empty to full


def propagated(
    slopes: np.ndarray, linearization: Linearization, model: FittedModel, refined: Refined
) -> np.ndarray:
    """Return half of the 95 % intervals of quantities, to first order.

    Args:
        slopes: of the quantities, along the free parameters, (num_quantities, num_free).
        linearization: of the model that single steps select.
        model: that single steps select.
        refined: its refinement.
    """
    fit = refined.fit
    if fit is not None:
        return np.sqrt(np.diag(slopes @ fit.covariance @ slopes.T))
    names = [refined.problem.names[index] for index in model.indices]
    return Marginal(linearization, model, names).half_widths(slopes)


def free_indices(model: FittedModel, refined: Refined) -> list[int]:
    """Return the indices of the free parameters of an extended model."""
    return list(model.indices if refined.fit is None else refined.fit.indices)


def summarize_half_responses(
    linearization: Linearization,
    model: FittedModel,
    refined: Refined,
    vectors: Mapping[str, np.ndarray],
) -> dict[str, dict[str, HalfResponse]]:
    """Return the times to half response by model and stick; the extended model's with intervals.

    An interval has no upper end where no fitted parameter shapes the response, or where one that
    does ended at the top of its range: the log then shows at most that the response is not faster.
    """
    problem, indices = refined.problem, free_indices(model, refined)
    least_lag_s = LAG_STEP * problem.chunks.record.median_step_s
    nudged, step = problem.nudged(vectors["extended"], indices, SLOPE_STEP, least_lag_s)
    small = half_responses(np.stack([*vectors.values(), *nudged]), problem.like, SMALL_STEP)
    full = half_responses(np.stack(list(vectors.values())), problem.like, FULL_STEP)
    extended = small[list(vectors).index("extended")]
    slopes = np.nan_to_num((small[len(vectors) :] - extended) / step[:, None]).T
    halves = propagated(slopes, linearization, model, refined)
    scale = problem.scale[indices]
    is_at_top = (problem.high - vectors["extended"])[indices] < AT_TOP * scale
    shapes = np.abs(slopes) * scale > SHAPES_S
    is_open = (halves == 0.0) | shapes[:, is_at_top].any(axis=1)
    result = {
        name: dict(zip(STICKS, map(HalfResponse, small_s.tolist(), full_s.tolist()), strict=True))
        for name, small_s, full_s in zip(vectors, small, full, strict=False)
    }
    highest = np.where(is_open, np.inf, extended + halves)
    for stick, low, high in zip(STICKS, extended - halves, highest.tolist(), strict=True):
        response = result["extended"][stick]
        result["extended"][stick] = replace(response, ci95=(max(float(low), 0.0), high))
    return result


def summarize_lift(
    linearization: Linearization,
    model: FittedModel,
    refined: Refined,
    vectors: Mapping[str, np.ndarray],
) -> dict[str, Lift]:
    """Return what models lift, the extended one with intervals; empty if no thrust is fitted."""
    problem, of_thrust = refined.problem, {*THRUST_COEFFS, THRUST_FACTOR}
    if not of_thrust.intersection(problem.names[index] for index in free_indices(model, refined)):
        refined = refined._replace(fit=None)  # flights do not show it, and single steps do
    indices = free_indices(model, refined)
    columns = [column for column, index in enumerate(indices) if problem.names[index] in of_thrust]
    if not columns:
        return {}
    vector = vectors["extended"]
    nudged, step = problem.nudged(vector, [indices[column] for column in columns], SLOPE_STEP)
    lifted = lift_of(problem, vector)
    slopes = np.zeros((len(lifted), len(indices)))
    slopes[:, columns] = np.stack([lift_of(problem, one) - lifted for one in nudged], 1) / step
    halves = {"extended": propagated(slopes, linearization, model, refined)}
    battery = problem.like.battery
    full_v, middle_v = float(battery.full_v), float(battery.voltage(MIDDLE))
    result = {}
    for name, of_model in vectors.items():
        half = halves.get(name, np.zeros(len(lifted)))
        ratio, hover = map(Estimated.around, lift_of(problem, of_model), half, ("1", "1"))
        result[name] = Lift(full_v, ratio, middle_v, hover)
    return result


def lift_of(problem: Problem, vector: np.ndarray) -> np.ndarray:
    """Return thrust over weight at full stick and full battery, and the stick of the hover, (2,).

    The hover is at the middle of the battery's voltages.
    """
    battery = problem.like.battery
    coeffs = vector[problem.parameter_indices(THRUST_COEFFS)]
    if THRUST_FACTOR in problem.names:
        coeffs = coeffs * vector[problem.names.index(THRUST_FACTOR)]
    weight_n = float(problem.like.m) * float(problem.like.g)
    full_n = float(collective_thrust(1.0, float(battery.full_v), coeffs))
    hover = hover_action(coeffs, weight_n, float(battery.voltage(MIDDLE)))
    return np.array([full_n / weight_n, hover])
