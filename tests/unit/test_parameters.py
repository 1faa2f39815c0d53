"""Every number of a model has a name, a unit and bounds, and is replaced alone."""

import numpy as np
import pytest

from flytrack_env.dynamics import nominal_parameters
from flytrack_env.effects import EFFECTS
from flytrack_sysid import parameters

ALL = tuple(effect.name for effect in EFFECTS)


def test_every_name_has_unit_bounds_and_neutral_value_within():
    model = parameters.with_neutral_effects(nominal_parameters(), ALL)
    vector = parameters.to_vector(model)
    for name, value in zip(parameters.names_of(model), vector, strict=True):
        low, high = parameters.bounds_of(name)
        assert parameters.unit_of(name) and low < high and low <= value <= high, name
        if "." in name:
            assert parameters.neutral_value(name) == value
    assert (
        parameters.neutral_value("linear_drag.d_x") == 0.0
        and parameters.neutral_value("thrust_scale.factor") == 1.0
    )
    assert parameters.bounds_of("tau_yaw").low > 0.0 and parameters.bounds_of("c3") == (-np.inf, np.inf)


def test_replacing_changes_those_alone_and_refuses_unknown_names():
    model = nominal_parameters()
    changed = parameters.to_vector(parameters.with_values(model, {"tau_yaw": 0.07, "c4": 0.5}))
    at = [parameters.BASE.index("tau_yaw"), parameters.BASE.index("c4")]
    np.testing.assert_array_equal(changed[at], [0.07, 0.5])
    np.testing.assert_array_equal(np.delete(changed, at), np.delete(parameters.to_vector(model), at))
    for name in ("tau_jaw", "linear_drag.d_x", ""):
        with pytest.raises(KeyError, match=f"{name}: unknown; expected of tau_roll"):
            parameters.with_values(model, {name: 1.0})
    with pytest.raises(KeyError, match="rag"):
        parameters.with_neutral_effects(model, ["rag"])
