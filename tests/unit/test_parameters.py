"""Numbers of a model are replaced alone, by name."""

import numpy as np
import pytest

from flytrack_env.dynamics import nominal_parameters
from flytrack_sysid.parameters import BASE, to_vector, with_neutral_effects, with_values


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
