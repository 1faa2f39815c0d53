"""Parameters that no episode can be flown with are refused by name."""

import dataclasses
import re
from operator import attrgetter

import jax
import numpy as np
import pytest

from flytrack_env import FlyTrack
from flytrack_env.params import RANGES, EnvParams
from flytrack_env.plants import Simulator

PARAMS = FlyTrack().default_params


def test_reset_refuses_another_step_than_the_plant_has():
    class OneStep(Simulator):
        dt = 0.02

    env = FlyTrack(plant=OneStep())
    with pytest.raises(ValueError, match=r"dt: found 0\.01 s, expected 0\.02 s"):
        env.reset(jax.random.key(0), PARAMS)
    env.reset(jax.random.key(0), PARAMS.replace(dt=0.02))


def with_value(name, value):
    """Return the default parameters with another value of a field of RANGES."""
    part, _, field = name.rpartition(".")
    if not part:
        return PARAMS.replace(**{field: value})
    return PARAMS.replace(**{part: getattr(PARAMS, part)._replace(**{field: value})})


@pytest.mark.parametrize("name", RANGES)
def test_ends_of_ranges_pass_and_what_lies_beyond_is_refused(name):
    bounds, shape = RANGES[name], np.shape(attrgetter(name)(PARAMS))
    for end in (bounds.low, bounds.high):
        try:
            with_value(name, np.full(shape, end, np.float32)).check()
        except ValueError as error:  # a drone that is wider than the opening of a gate
            assert name == "drone_radius" and "half of every gate's opening" in str(error)
    below, above = bounds.low - 0.01 * abs(bounds.low) - 1e-9, bounds.high * 1.01
    for value in (below, above, np.nan, np.inf, -np.inf):
        wrong = np.full(shape, attrgetter(name)(PARAMS), float)
        wrong.reshape(-1)[-1] = value
        with pytest.raises(
            ValueError, match=rf"(?s)^{name}: found .* to .* {re.escape(bounds.unit)}$"
        ):
            with_value(name, wrong).check()


def test_every_number_of_the_parameters_has_a_range():
    parts = ("model", "reset", "reward")
    fields = {f"{part}.{name}" for part in parts for name in getattr(PARAMS, part)._fields}
    direct = {field.name for field in dataclasses.fields(EnvParams)} - {
        *parts,
        "course",
        "wrappers",
    }
    assert set(RANGES) == (fields | direct) - {"model.battery", "model.effects", "model.motion"}


def test_courses_that_cannot_be_flown():
    course = PARAMS.course
    single = jax.tree.map(lambda leaf: leaf[:1], course.gates)
    far = course.bounds_high._replace(y=np.float32(np.inf))
    crooked = course.start_quat._replace(w=np.float32(0.01))
    cases = (
        (course._replace(gates=single), r"course\.gates: found 1, expected at least 2"),
        (
            course._replace(bounds_high=far),
            r"course\.bounds_high\.y: found inf, expected finite numbers within \+-1e\+06",
        ),
        (
            course._replace(start_quat=crooked),
            r"course\.start_quat: found norm 1\.0000\d+, expected 1",
        ),
    )
    for wrong, reason in cases:
        with pytest.raises(ValueError, match=reason):
            PARAMS.replace(course=wrong).check()
