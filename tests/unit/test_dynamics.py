"""The simulator against the handout's equations, written again in NumPy; their consequences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose

from flytrack_env.battery import Battery
from flytrack_env.dynamics import collective_thrust, step
from tests.support.black_boxes import random_inputs
from tests.support.handout_plant import HandoutPlant
from tests.support.simulated_flights import NOMINAL, UNEVEN

step_all = jax.jit(jax.vmap(step, in_axes=(0, 0, None, None)))


def test_nominal_drone_has_no_thrust_at_minus_one_and_the_stated_maximum():
    weight = NOMINAL.m * NOMINAL.g
    for volt, ratio in ((24.0, 3.5), (22.0, 3.1)):
        assert collective_thrust(-1.0, volt, NOMINAL.thrust_coeffs) == pytest.approx(0.0, abs=1e-4)
        full = collective_thrust(1.0, volt, NOMINAL.thrust_coeffs) / weight
        assert full == pytest.approx(ratio, abs=0.1)


@pytest.mark.parametrize("dt", [0.0005, 0.05])
def test_agrees_with_the_handouts_equations(dt):
    x, u = (rows.astype(float) for rows in random_inputs(64))
    x[:, 9:13] /= np.linalg.norm(x[:, 9:13], axis=1, keepdims=True)
    coeffs = UNEVEN.thrust_coeffs / UNEVEN.m
    drain = UNEVEN.battery_drain_v_per_min
    plant = HandoutPlant(UNEVEN.tau, coeffs, UNEVEN.max_rate, drain, gravity=UNEVEN.g)
    expected = plant(x, u, dt)
    with jax.enable_x64(True):
        assert_allclose(step_all(x, u, dt, UNEVEN), expected, rtol=1e-12, atol=1e-12)
    single = step_all(jnp.asarray(x), jnp.asarray(u), dt, UNEVEN)
    assert single.dtype == jnp.float32
    assert_allclose(single, expected, rtol=2e-5, atol=2e-5)


def test_float32_loses_less_than_half_a_percent_of_the_battery_drain():
    """A step's 0.17 mV is rounded to the spacing of floats near 24 V, 1.9 uV."""
    x = jnp.zeros(21).at[9].set(1.0).at[20].set(24.0)
    num_steps = 12_000  # two minutes of 100 Hz, from full to empty
    flight = jax.jit(
        lambda x: jax.lax.fori_loop(
            0, num_steps, lambda _, x: step(x, jnp.zeros(4), 0.01, NOMINAL), x
        )
    )
    drained_v = 24.0 - float(flight(x)[20])
    assert drained_v == pytest.approx(2.0, rel=0.005)


def test_gradients_equal_finite_differences():
    with jax.enable_x64(True):
        flat, unravel = ravel_pytree(UNEVEN)

        @jax.jit
        def packed(vector):
            x, u, rest = jnp.split(vector, [21, 25])
            return step(x, u, rest[0], unravel(rest[1:]))

        jacobian = jax.jit(jax.jacfwd(packed))
        for x, u in zip(*random_inputs(3, seed=5), strict=True):
            vector = np.concatenate([x, u, [0.02], flat])
            shifts = 1e-6 * np.eye(vector.size)
            numeric = np.stack(
                [(packed(vector + s) - packed(vector - s)) / 2e-6 for s in shifts], -1
            )
            assert_allclose(jacobian(vector), numeric, rtol=1e-5, atol=1e-5)
    # Everything matters but the old acceleration and rates, and the ends of the battery.
    unused = {*range(6, 9), *range(13, 16), *range(vector.size - len(Battery()), vector.size)}
    assert set(np.flatnonzero(~np.abs(numeric).any(axis=0)).tolist()) == unused


@pytest.mark.parametrize(
    ("x_shape", "u_shape", "name"), [((20,), (4,), "x"), ((21,), (3,), "action")]
)
def test_wrong_shapes_are_refused(x_shape, u_shape, name):
    with pytest.raises(ValueError, match=rf"^{name}: found shape .* expected"):
        step(np.zeros(x_shape), np.zeros(u_shape), 0.01, NOMINAL)
