"""Diagnoses of flights of one craft are compared by names, classes and intervals."""

import numpy as np
import pytest

from benchmarks.repeatability import agree, compare, hover_without_model, is_same_class
from flytrack_sysid.log import log_of_states
from tests.support.black_boxes import start
from tests.support.handout_plant import GRAVITY, HandoutPlant
from tests.support.tables import table


@pytest.mark.parametrize(("one", "other", "expected"), table("diagnoses")["classes"])
def test_causes_are_of_one_class_if_each_is_an_equivalent_of_the_other(one, other, expected):
    one, other = ({"causes": causes, "unsettled": []} for causes in (one, other))
    assert is_same_class(one, other) is expected and is_same_class(other, one) is expected
    assert agree(one, other) >= expected


def test_flights_agree_where_one_leaves_open_what_the_other_names():
    one = {"causes": {"wind": []}, "unsettled": []}
    other = {"causes": {}, "unsettled": ["wind", "linear_drag"]}
    assert agree(one, other) and agree(other, one) and not is_same_class(one, other)
    assert not agree(one, {"causes": {}, "unsettled": []})


def test_a_craft_counts_pairs_values_and_widths():
    def line(causes, low_s):
        values = {"linear_drag.b_xy": [0.2, 0.1, 0.3], "thrust_curve.c0": [low_s, low_s, low_s]}
        return {
            "craft": "one",
            "unsettled": [],
            "causes": {name: [] for name in causes},
            "values": values,
            "lift": {},
            "half_responses_s": {"roll": [low_s + 0.001, low_s, low_s + 0.002]},
        }

    lines = [line(["linear_drag"], 0.02), line(["linear_drag"], 0.021), line(["wind"], 0.03)]
    flights, *alike, overlapping, roll, pitch, _, _ = compare(lines)
    assert (flights, alike, overlapping) == (3, 3 * ["1 of 3"], "4 of 6")
    assert (roll, pitch) == ("± 1.0; 1 of 3", "none")


def test_the_hover_of_a_log_is_found_without_a_model():
    """The thrust of a drone that stays level is 8 + 4 u m/s^2 after a lag of 0.03 s."""
    plant = HandoutPlant(tau=(0.03,) * 4, coeffs=(8.0, 4.0, 0.0, 0.0, 0.0, 0.0))
    stick = np.repeat(np.random.default_rng(0).uniform(-0.5, 1.0, 100), 20)
    commands = np.pad(stick[:, None], ((0, 0), (3, 0)))
    states = [start((0.0, 0.0, 0.0, stick[0]))]
    for command in commands[:-1]:
        states.append(plant(states[-1], command))
    log = log_of_states([(np.array(states), commands)], 0.01)
    assert hover_without_model(log) == pytest.approx((GRAVITY - 8.0) / 4.0, abs=0.01)
