"""Linear drag: neutral is absent, it acts along the body's axes, and it only takes energy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import nominal_parameters, step

GRAVITY = np.array([0.0, 0.0, 9.80665])
NO_THRUST = nominal_parameters()._replace(thrust_coeffs=np.zeros(6, np.float32))
DRAG = np.array([0.1, 0.2, 0.3], np.float32)


def state(vel_w, quat=(1.0, 0.0, 0.0, 0.0)) -> np.ndarray:
    x = np.zeros(21, np.float32)
    x[3:6], x[9:13], x[20] = vel_w, quat, 24.0
    return x


def acceleration(vel_w, quat=(1.0, 0.0, 0.0, 0.0), params=NO_THRUST) -> np.ndarray:
    return np.asarray(step(state(vel_w, quat), np.zeros(4, np.float32), 0.01, params))[6:9]


def test_neutral_is_absent_to_the_bit():
    params = nominal_parameters()
    np.testing.assert_array_equal(
        acceleration([20.0, -7.0, 3.0], params=params), acceleration([0.0, 0.0, 0.0], params=params)
    )


def test_acts_along_body_axes():
    params = NO_THRUST._replace(linear_drag=DRAG)
    np.testing.assert_allclose(
        acceleration([1.0, 2.0, 3.0], params=params), [-0.1, -0.4, -0.9 - 9.80665], rtol=1e-6
    )
    # Yawed by 90 degrees, the world's x is the body's -y.
    yawed = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    np.testing.assert_allclose(
        acceleration([1.0, 0.0, 0.0], yawed, params) + GRAVITY, [-0.2, 0.0, 0.0], atol=1e-6
    )


@pytest.mark.parametrize("seed", range(5))
def test_takes_energy_in_any_attitude(seed):
    rng = np.random.default_rng(seed)
    quat = Rotation.random(rng=rng).as_quat(scalar_first=True)
    velocity = rng.normal(size=3) * 10
    drag = acceleration(velocity, quat, NO_THRUST._replace(linear_drag=DRAG)) + GRAVITY
    power = drag @ velocity
    assert -0.3 * velocity @ velocity <= power * (1 - 1e-5) < 0.0
    assert power <= -0.1 * velocity @ velocity * (1 - 1e-5)
