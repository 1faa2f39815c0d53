"""The diagnosis of measured flights."""

import json

import pytest

from flytrack_sysid import diagnose, import_log
from tests.support.real_logs import CRAZYFLIE, shared

AS_GOOD = 1.02  # times another model's error
PARTS = ("seed00053_log2", "seed00067_log1", "seed00066_log1", "seed00052_log3")  # 23 s of four policies
NEEDS_ACCELEROMETER = {"accelerometer_bias", "accelerometer_scale", "imu_offset"}


@pytest.fixture(scope="module")
def crazyflie():
    """The diagnosis of four short flights of a Crazyflie, from the nominal model of the importer."""
    files = [shared(CRAZYFLIE) / f"{name}.csv.gz" for name in PARTS]
    found = import_log(files, "csv", "crazyflie_phoenix")
    return diagnose(found.log, found.nominal_model())


@pytest.mark.slow
def test_what_the_nominal_crazyflie_certainly_lacks_is_named(crazyflie):
    assert crazyflie.verdict.startswith("causes_found")
    causes = {cause.effect: cause for cause in crazyflie.causes}
    thrust = causes.get("thrust_curve", causes.get("thrust_scale"))
    assert thrust is not None and thrust.heldout_gain > 0.0  # the nominal one hovers at another stick
    assert not NEEDS_ACCELEROMETER & set(causes)
    assert json.loads(json.dumps(crazyflie.as_json(), allow_nan=False))["verdict"] == crazyflie.verdict


@pytest.mark.slow
def test_the_extended_crazyflie_flies_better_where_it_was_not_fitted(crazyflie):
    nominal, extended = crazyflie.error["nominal"], crazyflie.error["extended"]
    for channel in ("rates", "velocity"):
        assert extended.one_step_nrmse[channel] < nominal.one_step_nrmse[channel]
    for horizon in ("0.5", "1", "2"):  # before, the noise of the start decides
        assert extended.position_m[horizon] < 0.5 * nominal.position_m[horizon]


@pytest.mark.slow
def test_no_horizon_is_predicted_worse_than_by_the_refitted_base(crazyflie):
    base, extended = (crazyflie.prediction.errors[name] for name in ("refitted_base", "extended"))
    for quantity, by_horizon in extended.items():
        for horizon, error in by_horizon.items():
            assert error <= AS_GOOD * base[quantity][horizon]


@pytest.mark.slow
def test_a_crazyflie_on_its_slow_circle_cannot_show_everything(crazyflie):
    unseen = {one.effect for one in crazyflie.not_identifiable}
    assert {"ground_effect", "translational_lift"} <= unseen  # at 1 m, below 2 m/s
