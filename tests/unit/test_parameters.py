"""Every number of a model has a name, a unit and bounds, and comes back from the vector as it was."""

import jax
import numpy as np
import pytest

from flytrack_env.dynamics import nominal_parameters
from flytrack_env.effects import EFFECTS
from flytrack_sysid.parameters import (
    BASE,
    as_float32,
    bounds_of,
    from_vector,
    names_of,
    neutral_value,
    to_vector,
    unit_of,
    with_neutral_effects,
    with_values,
)

ALL = tuple(effect.name for effect in EFFECTS)


@pytest.mark.parametrize("effects", [(), ("linear_drag",), ALL, ALL[::-1]])
def test_vector_and_names_round_trip(effects):
    model = with_neutral_effects(nominal_parameters(), effects)
    model = with_values(model, {name: index + 1.0 for index, name in enumerate(names_of(model))})
    vector = to_vector(model)
    np.testing.assert_array_equal(vector, np.arange(1.0, len(names_of(model)) + 1))
    assert names_of(model)[: len(BASE)] == BASE
    again = from_vector(vector, model)
    assert jax.tree.structure(again) == jax.tree.structure(model)
    np.testing.assert_array_equal(to_vector(again), vector)
    # The names point at the numbers they say.
    assert model.tau[2] == names_of(model).index("tau_yaw") + 1
    assert model.thrust_coeffs[5] == names_of(model).index("c5") + 1
    assert model.max_rate[1] == names_of(model).index("max_rate_pitch") + 1
    assert (model.m, model.g) == (names_of(model).index("m") + 1, names_of(model).index("g") + 1)
    if effects:
        assert model.effect("linear_drag").d_z == names_of(model).index("linear_drag.d_z") + 1


def test_every_name_has_unit_bounds_and_neutral_value_within():
    model = with_neutral_effects(nominal_parameters(), ALL)
    vector = to_vector(model)
    for name, value in zip(names_of(model), vector, strict=True):
        low, high = bounds_of(name)
        assert unit_of(name) and low < high and low <= value <= high, name
        if "." in name:
            assert neutral_value(name) == value
    assert neutral_value("linear_drag.d_x") == 0.0 and neutral_value("thrust_scale.factor") == 1.0
    assert bounds_of("tau_yaw").low > 0.0 and bounds_of("c3") == (-np.inf, np.inf)


def test_replacing_changes_those_alone_and_refuses_unknown_names():
    model = nominal_parameters()
    changed = to_vector(with_values(model, {"tau_yaw": 0.07, "c4": 0.5}))
    at = [BASE.index("tau_yaw"), BASE.index("c4")]
    np.testing.assert_array_equal(changed[at], [0.07, 0.5])
    np.testing.assert_array_equal(np.delete(changed, at), np.delete(to_vector(model), at))
    for name in ("tau_jaw", "linear_drag.d_x", ""):
        with pytest.raises(KeyError, match=f"{name}: unknown; expected of tau_roll"):
            with_values(model, {name: 1.0})
    with pytest.raises(KeyError, match="rag"):
        with_neutral_effects(model, ["rag"])


def test_effects_that_are_there_keep_their_values():
    model = with_values(with_neutral_effects(nominal_parameters(), ["linear_drag"]), {"linear_drag.d_y": 0.4})
    extended = with_neutral_effects(model, ["wind", "linear_drag"])
    assert extended.effect("linear_drag").d_y == 0.4 and len(extended.effects) == 2


def test_float32_is_what_the_environment_takes():
    model = as_float32(with_values(nominal_parameters(), {"tau_roll": 0.1, "m": 0.1}))
    assert model.tau.dtype == np.float32 and type(model.m) is float and model.m == float(np.float32(0.1))
