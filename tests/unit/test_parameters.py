"""Every number of a model has a name, a unit and bounds, and is replaced alone."""

import numpy as np
import pytest

from flytrack_env.dynamics import nominal_parameters
from flytrack_env.effects import EFFECTS
from flytrack_sysid.parameters import (
    BASE,
    names_of,
    neutral_value,
    range_of,
    to_vector,
    with_neutral_effects,
    with_values,
)

ALL = tuple(effect.name for effect in EFFECTS)


def test_every_name_has_unit_bounds_and_neutral_value_within():
    model = with_neutral_effects(nominal_parameters(), ALL)
    vector = to_vector(model)
    for name, value in zip(names_of(model), vector, strict=True):
        low, high, unit = range_of(name)
        assert unit and low < high and low <= value <= high, name
        if "." in name:
            assert neutral_value(name) == value
    assert neutral_value("linear_drag.d_x") == 0.0 and neutral_value("thrust_scale.factor") == 1.0
    assert range_of("tau_yaw").low > 0.0 and range_of("c3") == (-np.inf, np.inf, "N")


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
