"""Names of a response stand for their family only where something in it is unexplained."""

import pytest

from flytrack_env.effects import BY_NAME
from flytrack_sysid.diagnosis.families import FAMILIES, with_families
from flytrack_sysid.diagnosis.result import Cause, Unexplained
from flytrack_sysid.inference.parameters import TAUS
from tests.support.tables import table


@pytest.mark.parametrize(("cause", "sides", "family"), table("diagnoses")["families"])
def test_a_family_is_of_the_side_that_is_unexplained(cause, sides, family):
    shares = {f"{side}: stochastic": 1.0 for side in sides}
    named = Cause(cause, (), "rates", {}, 1.0, 1.0, 1.0, 1.0)
    (found,) = with_families([named], Unexplained(bool(shares), shares=shares))
    assert {*family} <= {*found.family} and cause not in found.family
    assert bool(found.family) == bool(family)


def test_members_are_effects_or_lags():
    members = {name for family in FAMILIES.values() for name in family}
    assert members <= {*BY_NAME, *TAUS}
