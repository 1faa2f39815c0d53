"""Names of a response stand for their family only where something in it is unexplained."""

import pytest

from flytrack_env.dynamics import nominal_motor_parameters
from flytrack_env.effects import BY_NAME
from flytrack_sysid.diagnosis.families import FAMILIES, FAMILIES_OF_MOTORS, with_families
from flytrack_sysid.diagnosis.result import Cause, Unexplained
from flytrack_sysid.inference.parameters import TAUS, fields_of_sticks
from flytrack_sysid.inference.score_test import ALL_BASE_CAUSES
from tests.support.tables import table


@pytest.mark.parametrize(("cause", "sides", "family"), table("diagnoses")["families"])
def test_a_family_is_of_the_side_that_is_unexplained(cause, sides, family):
    shares = {f"{side}: stochastic": 1.0 for side in sides}
    named = Cause(cause, (), "rates", {}, 1.0, 1.0, 1.0, 1.0)
    (found,) = with_families([named], Unexplained(bool(shares), shares=shares), False)
    assert {*family} <= {*found.family} and cause not in found.family
    assert bool(found.family) == bool(family)


def test_members_are_effects_or_lags():
    members = {name for _, family in FAMILIES for name in family}
    assert members <= {*BY_NAME, *ALL_BASE_CAUSES}


def test_families_of_motors_have_no_laws_of_sticks():
    unexplained = Unexplained(True, shares={"rate: stochastic": 1.0})
    named = Cause("command_delay", (), "rates", {}, 1.0, 1.0, 1.0, 1.0)
    (found,) = with_families([named], unexplained, True)
    assert found.family == ("motor_lag", "imu_latency")
    members = {name for _, family in FAMILIES_OF_MOTORS for name in family}
    of_sticks = {field.split(".")[0] for field in fields_of_sticks(nominal_motor_parameters())}
    assert members.isdisjoint(of_sticks - {"command_delay"}) and members.isdisjoint(TAUS)
