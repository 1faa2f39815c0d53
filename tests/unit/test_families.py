"""Names of a response stand for their family only where something in it is unexplained."""

import pytest

from flytrack_env.dynamics import nominal_motor_parameters
from flytrack_env.effects import BY_NAME
from flytrack_sysid.diagnosis.families import FAMILIES, FAMILIES_OF_MOTORS, with_families
from flytrack_sysid.diagnosis.result import Cause, Unexplained
from flytrack_sysid.inference.parameters import TAUS, fields_of_sticks
from flytrack_sysid.inference.score_test import ALL_BASE_CAUSES
from tests.support.tables import table


@pytest.mark.parametrize(
    ("effect", "sides", "has_motors", "family"), table("diagnoses")["families"]
)
def test_a_family_is_of_the_side_that_is_unexplained(effect, sides, has_motors, family):
    shares = {f"{side}: stochastic": 1.0 for side in sides}
    named = Cause(effect, (), "rates", {}, 1.0, 1.0, 1.0, 1.0)
    (cause,) = with_families([named], Unexplained(bool(shares), shares=shares), has_motors)
    assert list(cause.family) == family


def members(families):
    """Return the names of all laws of some families."""
    return {name for _, laws in families for name in laws}


def test_members_are_effects_or_lags_and_those_of_motors_no_laws_of_sticks():
    assert members(FAMILIES) <= {*BY_NAME, *ALL_BASE_CAUSES}
    of_sticks = {field.split(".")[0] for field in fields_of_sticks(nominal_motor_parameters())}
    of_motors = members(FAMILIES_OF_MOTORS)
    assert of_motors.isdisjoint(of_sticks - {"command_delay"}) and of_motors.isdisjoint(TAUS)
