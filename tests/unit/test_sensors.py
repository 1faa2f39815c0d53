"""Sensors add the noise that they state, in the steps that they state, and lose rows."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_sysid import sensors
from flytrack_sysid.log import FlightLog
from tests.support.handout_plant import GRAVITY, HandoutPlant, excited, rotation


@pytest.fixture(scope="module")
def truth() -> FlightLog:
    return excited(HandoutPlant())


def test_noise_is_as_stated(truth):
    log = sensors.measure(truth, 2.0, GRAVITY, np.random.default_rng(0))
    keys = [np.round(one.time * 100).astype(int) + 1000 * one.segment for one in (truth, log)]
    kept = np.isin(*keys)
    assert "uprev" not in log and "a" not in log
    assert len(log) == kept.sum() and 0.03 < 1.0 - kept.mean() < 0.05
    np.testing.assert_array_equal(log["u"], truth["u"][kept])
    force = sensors.specific_force_b(truth, GRAVITY)[kept]
    stated = {
        "w": (truth["w"][kept], sensors.GYRO_NOISE),
        "f": (force, sensors.ACCELEROMETER_NOISE),
        "v": (truth["v"][kept], sensors.VELOCITY_NOISE),
        "p": (truth["p"][kept], sensors.POSITION_NOISE),
    }
    for name, (values, noise) in stated.items():
        left = log[name] - values
        np.testing.assert_allclose(left.std(axis=0), 2.0 * noise, rtol=0.05, err_msg=name)
        assert np.abs(left.mean(axis=0)).max() < 0.1 * noise, name
    turn = Rotation.from_quat(truth["q"][kept], scalar_first=True).inv() * Rotation.from_quat(
        log["q"], scalar_first=True
    )
    np.testing.assert_allclose(np.rad2deg(turn.as_rotvec()).std(axis=0), 1.0, rtol=0.05)
    np.testing.assert_allclose(np.linalg.norm(log["q"], axis=1), 1.0, rtol=1e-12)


def test_accelerometer_measures_what_is_not_gravity_in_the_attitude_before(truth):
    force = sensors.specific_force_b(truth, GRAVITY)
    before = rotation(truth["q"][:-1])
    expected = np.einsum("nji,nj->ni", before, truth["a"][1:] + np.array([0.0, 0.0, GRAVITY]))
    inside = ~truth.is_start()[1:]
    np.testing.assert_allclose(force[1:][inside], expected[inside], atol=1e-12)
    np.testing.assert_allclose(force[1:][inside][:, :2], 0.0, atol=1e-9)  # without drag, thrust alone
