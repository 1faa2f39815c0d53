"""Whether a cause matters: a significant cause may still be too small to be named.

A cause matters if a parameter differs from the nominal model's by a notable size (an effect's
``notable``; for the base, the sizes here), if the error of flight without it, all else refitted,
is at least 2 % larger on held-out rows, or if a value of a cause of notable size is then beyond its
95 % interval: who leaves it out gets another value wrong.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from flytrack_env.effects import BY_NAME
from flytrack_env.state import BATTERY_FULL_V
from flytrack_sysid.diagnosis.model_selection import thrust_over_weight
from flytrack_sysid.diagnosis.result import Cause
from flytrack_sysid.inference.parameters import DRAIN, THRUST_COEFFS, range_of
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.score_test import ALL_BASE_CAUSES

MIN_ERROR_FRACTION = 0.02  # of the error of free flight, held out
NOTABLE_LAG_S = 0.005  # as of the effects that delay
NOTABLE_CENTER_M = 0.002  # of the centre of mass
NOTABLE_RADIUS = 0.02  # of a radius of gyration: 4 % of the inertia
NOTABLE_THRUST = 0.02  # of the weight, as of a scale of thrust
NOTABLE_DRAIN_PER_MIN = 0.1  # of the battery, from full to empty: 0.2 V/min of the handout's


def split_by_size(
    causes: Sequence[Cause],
    problem: Problem,
    vector: np.ndarray,
    flight_error: Callable[[np.ndarray], Mapping[str, float]],
    without: Callable[[Cause], np.ndarray],
) -> tuple[tuple[Cause, ...], tuple[Cause, ...]]:
    """Return the causes that matter, and those that are negligible.

    Args:
        causes: to split.
        problem: of the extended model.
        vector: the extended model.
        flight_error: returns the error of a vector, by horizon, on held-out rows; empty if the log
            cannot show it.
        without: returns the vector that is refitted without a cause.
    """
    small = [cause for cause in causes if not is_notable(cause.effect, problem, vector)]
    notable = [cause for cause in causes if cause not in small]
    full_error = flight_error(vector) if small else {}
    negligible = []
    for cause in small:
        reduced = without(cause)
        error = flight_error(reduced)
        flies_as_well = all(
            error[horizon] < (1.0 + MIN_ERROR_FRACTION) * full_error[horizon]
            for horizon in full_error
        )
        if flies_as_well and not any(is_bent(one, problem, vector, reduced) for one in notable):
            negligible.append(cause)
    return tuple(cause for cause in causes if cause not in negligible), tuple(negligible)


def is_bent(cause: Cause, problem: Problem, vector: np.ndarray, reduced: np.ndarray) -> bool:
    """Return whether a reduced model has a value of a cause beyond the interval that it has.

    Coefficients of the thrust curve trade off, so that theirs tell nothing.
    """
    prefix = f"{cause.effect}." if cause.effect in BY_NAME else ""
    for name, estimate in cause.parameters.items():
        field = prefix + name
        if field in problem.names and field not in THRUST_COEFFS:
            index = problem.names.index(field)
            low, high = estimate.ci95
            if low <= vector[index] <= high and not low <= reduced[index] <= high:
                return True
    return False


def is_notable(name: str, problem: Problem, vector: np.ndarray) -> bool:
    """Return whether a cause differs from the nominal model by a notable size."""
    if name == "thrust_scale" and "thrust_scale.factor" in problem.names:
        change = _change(problem, vector, ["thrust_scale.factor"])[0]
        if abs(change) >= BY_NAME[name].notable["factor"]:
            return True
        name = "thrust_curve"  # found as one factor between two curves
    if name in ALL_BASE_CAUSES:
        return _is_base_notable(ALL_BASE_CAUSES[name], problem, vector)
    effect = BY_NAME[name]
    # Notable voltages are of the handout's battery: the same share of a smaller one matters as
    # much.
    volt = float(problem.like.battery.full_v) / BATTERY_FULL_V
    sizes = {
        field: size * (volt if effect.ranges[field].unit == "V" else 1.0)
        for field, size in effect.notable.items()
    }
    changes = _change(problem, vector, [f"{name}.{field}" for field in sizes])
    return bool(np.any(np.abs(changes) >= list(sizes.values())))


def _change(problem: Problem, vector: np.ndarray, fields: Sequence[str]) -> np.ndarray:
    indices = problem.parameter_indices(fields)
    return vector[indices] - problem.start[indices]


def _is_base_notable(fields: Sequence[str], problem: Problem, vector: np.ndarray) -> bool:
    if fields == THRUST_COEFFS:
        return thrust_over_weight(problem, _change(problem, vector, fields)) >= NOTABLE_THRUST
    battery = problem.like.battery
    notable_drain = NOTABLE_DRAIN_PER_MIN * float(battery.full_v - battery.empty_v)
    radii_m = np.abs(problem.start[problem.parameter_indices(fields)])
    sizes = {
        **{
            field: NOTABLE_LAG_S if range_of(field).unit == "s" else NOTABLE_RADIUS * radius_m
            for field, radius_m in zip(fields, radii_m, strict=True)
        },
        **dict.fromkeys(ALL_BASE_CAUSES["center_of_mass"], NOTABLE_CENTER_M),
        DRAIN: notable_drain,
    }
    changes = _change(problem, vector, fields)
    return bool(np.any(np.abs(changes) >= [sizes[field] for field in fields]))
