"""Vectors and quaternions against SciPy's rotations."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from flytrack_env.quaternion import Quaternion, Vec3

NUM_CASES = 500


@pytest.fixture(scope="module")
def quats():
    """Random unit quaternions (N, 4), w first, with the half turns and the identity among them."""
    quats = np.random.default_rng(0).normal(size=(NUM_CASES, 4))
    quats[:4] = np.eye(4)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def rotations(quats):
    """Return SciPy's rotations of quaternions (N, 4), w first."""
    return Rotation.from_quat(quats, scalar_first=True)


def columns(array):
    """Return the columns of an array (N, K) as K arrays (N,)."""
    return tuple(jnp.asarray(array[:, i]) for i in range(array.shape[1]))


def matrices(quats):
    """Return the rotation matrices (N, 3, 3) of quaternions."""
    return np.stack([np.stack(axis, -1) for axis in quats.axes()], axis=-1)


def test_axes_turned_vectors_and_products_are_those_of_rotations(quats):
    left, right = Quaternion(*columns(quats)), np.roll(quats, 7, axis=0)
    assert_allclose(matrices(left), rotations(quats).as_matrix(), atol=1e-6)
    vectors = np.random.default_rng(1).normal(size=(NUM_CASES, 3))
    rotated = np.stack(left.rotate(Vec3(*columns(vectors))), -1)
    assert_allclose(rotated, rotations(quats).apply(vectors), atol=5e-6)
    product = np.stack(left.multiply(Quaternion(*columns(right))), -1)
    expected = (rotations(quats) * rotations(right)).as_quat(scalar_first=True)
    sign = np.sign(np.sum(product * expected, axis=1, keepdims=True))
    assert_allclose(product, sign * expected, atol=1e-6)


def test_from_yaw_tilt_leans_the_thrust_axis_towards_the_heading():
    rng = np.random.default_rng(2)
    yaw, heading = rng.uniform(-np.pi, np.pi, (2, NUM_CASES))
    tilt = rng.uniform(0.0, np.pi, NUM_CASES)
    lean = np.stack([-np.sin(heading), np.cos(heading), np.zeros(NUM_CASES)], -1) * tilt[:, None]
    expected = Rotation.from_euler("z", yaw[:, None]) * Rotation.from_rotvec(lean)
    result = Quaternion.from_yaw_tilt(*map(jnp.asarray, (yaw, tilt, heading)))
    assert_allclose(matrices(result), expected.as_matrix(), atol=1e-5)
