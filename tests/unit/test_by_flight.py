"""Flights of one craft agree on a value, and those of craft that differ do not."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from benchmarks.diagnosis import model_of
from benchmarks.hidden import draw_base, fly, measure
from flytrack_sysid.diagnosis.by_flight import notes_on_flights, with_flights
from flytrack_sysid.diagnosis.diagnose import joined
from flytrack_sysid.diagnosis.result import Cause, Estimated
from flytrack_sysid.inference.chunks import cut_chunks
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.score_test import CANDIDATES
from flytrack_sysid.inference.search import SearchState, with_refitted_noise

DRAG = next(one for one in CANDIDATES if one.effect == "linear_drag")
SECONDS = 15.0


def diagnosed(*drags: float) -> tuple[Cause, np.ndarray]:
    """Return the drag of flights with these drags, with its values of each, and common ones."""
    base, logs = draw_base(np.random.default_rng(3)), []
    for number, drag in enumerate(drags):
        effect = {"d_x": drag, "d_y": drag, "d_z": 0.2}
        rng = np.random.default_rng(number)
        flight = fly(replace(base, effects={"linear_drag": effect}), SECONDS, rng)
        logs.append(measure(flight, "sensors", rng))
    log = joined(logs)
    with jax.enable_x64(True):
        problem = Problem.of(
            cut_chunks(log, np.ones(len(log), bool), model_of(base)), model_of(base)
        )
        state = SearchState.start(log, problem)
        state, model = with_refitted_noise(state, state.fitted((DRAG,), problem.start))
        _, linearization = state.linearized(model.vector)
        values = model.vector[problem.parameter_indices(DRAG.fields)]
        parameters = {
            name.split(".")[1]: Estimated.around(float(value), 0.01, "1/s")
            for name, value in zip(DRAG.fields, values, strict=True)
        }
        cause = Cause("linear_drag", (), "force", parameters, 0.0, 0.0, 0.0, 0.0)
        (result,) = with_flights((cause,), linearization, model, log)
    return result, values


def test_flights_of_one_craft_agree() -> None:
    cause, common = diagnosed(0.3, 0.3)
    assert cause.birge_ratio == 1.0 and notes_on_flights((cause,)) == []
    assert cause.parameters["d_x"].half_width == pytest.approx(0.01)
    for of_flight in cause.by_flight["d_x"]:
        assert of_flight.ci95[0] < 0.3 < of_flight.ci95[1]
        assert of_flight.value == pytest.approx(common[0], abs=0.03)


def test_flights_of_craft_that_differ_are_told_with_the_values_of_each() -> None:
    cause, _ = diagnosed(0.2, 0.4, 0.2)
    for of_flight, drag in zip(cause.by_flight["d_x"], (0.2, 0.4, 0.2), strict=True):
        assert of_flight.value == pytest.approx(drag, abs=0.04)
        assert of_flight.half_width < 0.05
    assert cause.birge_ratio > 2.0
    assert cause.parameters["d_x"].half_width == pytest.approx(0.1, abs=0.06)
    assert cause.parameters["d_z"].half_width < 0.03
    (note,) = notes_on_flights((cause,))
    assert note.startswith("linear_drag differs between the flights by more than chance (d_x 0.")


def test_one_flight_has_no_values_by_flight() -> None:
    cause, _ = diagnosed(0.3)
    assert cause.by_flight == {} and cause.birge_ratio == 1.0
