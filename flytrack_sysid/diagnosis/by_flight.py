"""Whether several flights agree on the value of a cause.

A value is of the craft only if its other flights give it too. A flight's own estimate is one step
of Gauss-Newton from the common one, on its own blocks of the linearization: nothing is replayed.
Where the estimates differ by more than chance (Q of W. Cochran, Biometrics 10, 1954), the interval
of the common value is at least that of their mean, wider by the Birge ratio sqrt(Q / degrees of
freedom), as those of the Particle Data Group are.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from flytrack_sysid.diagnosis.model_selection import Marginal
from flytrack_sysid.diagnosis.result import TWO_SIDED_95, Cause, Estimated
from flytrack_sysid.diagnosis.summary import LOOSE, mean_thrust
from flytrack_sysid.inference.chunks import CHUNK_S, Chunks, count_lead_in
from flytrack_sysid.inference.parameters import THRUST_COEFFS
from flytrack_sysid.inference.score_test import (
    FALSE_POSITIVE_RATE,
    Linearization,
    base_fields,
    solve,
)
from flytrack_sysid.inference.search import FittedModel
from flytrack_sysid.log import FlightLog

OF_THRUST = ("mean_factor", "factor")  # values of a thrust curve as a whole
SMALLEST_N = 1e-9  # of a nominal thrust, so that none divides by zero: such a curve has no factor


def flight_of_blocks(chunks: Chunks, log: FlightLog) -> np.ndarray:
    """Return the number of the flight of each block; a flight begins where the time goes back."""
    number = np.cumsum(np.diff(log.time, prepend=log.time[0]) < 0.0)
    source = chunks.record.source_row[count_lead_in(len(chunks.row)) :]
    last = source.reshape(CHUNK_S, -1, source.shape[1]).max(axis=1)
    return np.asarray(number[np.maximum(last, 0).ravel()])


class OfFlights(NamedTuple):
    """Estimates of some parameters by flight, less the common ones.

    Attributes:
        steps: (flights, parameters).
        marginals: what each flight tells of the parameters.
        birge_ratio: the Birge ratio of all parameters; 1 where the flights differ by chance.
    """

    steps: np.ndarray
    marginals: Sequence[Marginal]
    birge_ratio: float


def compare_flights(
    linearization: Linearization, model: FittedModel, fields: Sequence[str], flights: np.ndarray
) -> OfFlights:
    """Return the estimates of some parameters of a model by flight.

    Args:
        linearization: of the model.
        model: with these parameters.
        fields: the parameters.
        flights: the number of each block's flight, (blocks,).
    """
    indices = list(model.indices)
    columns = [indices.index(index) for index in linearization.problem.parameter_indices(fields)]
    fitted = [
        linearization.of_blocks(flights == number).stepped(indices)
        for number in range(int(flights.max()) + 1)
    ]
    steps = np.stack([step[columns] for step, _ in fitted])
    marginals = [Marginal(part, model, fields) for _, part in fitted]
    weights = np.stack([one.information / one.inflation for one in marginals])
    common = solve(weights.sum(axis=0), np.einsum("fpq,fq->p", weights, steps))
    changes = steps - common
    q = float(np.einsum("fp,fpq,fq->", changes, weights, changes))
    freedom = (len(steps) - 1) * len(columns)
    is_chance = stats.chi2.sf(q, freedom) > FALSE_POSITIVE_RATE
    return OfFlights(steps, marginals, 1.0 if is_chance else float(np.sqrt(q / freedom)))


def with_flights(
    causes: Sequence[Cause], linearization: Linearization, model: FittedModel, log: FlightLog
) -> tuple[Cause, ...]:
    """Return causes with the values of each flight, and intervals that cover how these differ.

    Those of one flight are returned as they are.

    Args:
        causes: of a log.
        linearization: of the model that single steps select.
        model: that model.
        log: of flights, one after the other.
    """
    flights = flight_of_blocks(linearization.problem.chunks, log)
    if not flights.any():
        return tuple(causes)
    return tuple(_with_flights(cause, linearization, model, flights) for cause in causes)


def _with_flights(
    cause: Cause, linearization: Linearization, model: FittedModel, flights: np.ndarray
) -> Cause:
    problem = linearization.problem
    of_base = base_fields(cause.effect)
    known = of_base or tuple(f"{cause.effect}.{name}" for name in cause.parameters)
    fields = [field for field in known if problem.names.index(field) in model.indices]
    if not fields:
        return cause
    compared = compare_flights(linearization, model, fields, flights)
    if tuple(fields) == THRUST_COEFFS:  # single coefficients trade off
        slopes = mean_thrust(problem)
        nominal_n = float(slopes @ problem.start[problem.parameter_indices(fields)])
        weights = dict.fromkeys(OF_THRUST, slopes / max(nominal_n, SMALLEST_N))
    else:
        indices = problem.parameter_indices(fields)
        loose = LOOSE * (problem.high - problem.low)[indices]
        is_shown = np.min([one.half_widths() for one in compared.marginals], axis=0) < loose
        short = np.array([field.split(".")[-1] for field in fields])
        weights = dict(zip(short[is_shown].tolist(), np.eye(len(fields))[is_shown], strict=True))
    by_flight = {
        name: tuple(
            Estimated.around(
                one.value + float(step @ weights[name]),
                float(marginal.half_widths(weights[name][None])[0]),
                one.unit,
            )
            for step, marginal in zip(compared.steps, compared.marginals, strict=True)
        )
        for name, one in cause.parameters.items()
        if name in weights
    }
    if not by_flight:
        return cause
    parameters = dict(cause.parameters)
    if compared.birge_ratio > 1.0:
        parameters |= {name: _covering(parameters[name], of) for name, of in by_flight.items()}
    return replace(
        cause, parameters=parameters, by_flight=by_flight, birge_ratio=compared.birge_ratio
    )


def _covering(common: Estimated, flights: Sequence[Estimated]) -> Estimated:
    """Return a value with an interval at least as wide as flights that differ ask for."""
    values, halves = np.array([(one.value, one.half_width) for one in flights]).T
    weights = halves**-2.0
    changes = values - np.average(values, weights=weights)
    q = TWO_SIDED_95**2 * float(weights @ changes**2)
    half = np.sqrt(max(q / (len(values) - 1), 1.0) / weights.sum())
    if half <= common.half_width:
        return common
    return Estimated.around(common.value, float(half), common.unit)


def notes_on_flights(causes: Sequence[Cause]) -> list[str]:
    """Return a note on each cause whose value differs between flights by more than chance."""
    notes = []
    for cause in causes:
        if cause.birge_ratio > 1.0:
            ranges = (
                f"{name} {min(values):.3g} to {max(values):.3g}"
                for name, flights in cause.by_flight.items()
                for values in [[one.value for one in flights]]
            )
            notes.append(
                f"{cause.effect} differs between the flights by more than chance "
                f"({', '.join(ranges)}): its values are means, and their intervals cover that"
            )
    return notes
