"""The step in settings that our baseline lacks: float64, strict types, NaN checks, devices."""

import os
import subprocess
import sys
from functools import cache, partial

import gymnax
import jax
import numpy as np
import pytest

from tests.support.slow import slow_but
from tests.support.stepping import XLA_FLAGS, digest, flight, fly, inputs

PLAIN, EVERY_WRAPPER, SEVERAL_DRONES = "FlyTrack-v0", "FlyTrackRobust-v0", "FlyTrackDuel-v0"
KINDS = (PLAIN, EVERY_WRAPPER, SEVERAL_DRONES)
OVER_KINDS = pytest.mark.parametrize("env_id", slow_but([PLAIN], KINDS))


@OVER_KINDS
def test_with_x64_a_step_keeps_the_types_of_the_state(env_id):
    env = gymnax.make(env_id)[0]
    with jax.enable_x64(True):
        keys, actions, params = inputs(env)
        begun = jax.eval_shape(jax.vmap(env.reset, (0, None)), keys, params)
        assert {leaf.dtype.itemsize for leaf in jax.tree.leaves(begun)} <= {1, 4}
        doubles = actions.astype(float)
        assert doubles.dtype == np.float64
        for state_type in (np.float32, np.float64):
            typed = jax.tree.map(partial(as_type, state_type), begun)
            stepped = jax.eval_shape(env.step_batch, keys[0], typed[1], doubles, params)
            assert stepped[:2] == typed and stepped[2].dtype == state_type


def as_type(dtype, leaf):
    """Return the shape of a leaf, with another type if it is a float."""
    is_float = np.issubdtype(leaf.dtype, np.floating)
    return jax.ShapeDtypeStruct(leaf.shape, dtype if is_float else leaf.dtype)


@pytest.mark.slow
def test_with_x64_a_flight_is_the_same():
    env = gymnax.make(EVERY_WRAPPER)[0]
    keys, actions, params = inputs(env)
    with jax.enable_x64(True):
        flight_in_x64 = jax.jit(flight(env))(keys, actions.astype(float), params)
    for leaf, expected_leaf in zip(
        *map(jax.tree.leaves, (flight_in_x64, flown(EVERY_WRAPPER))), strict=True
    ):
        np.testing.assert_allclose(leaf, expected_leaf, rtol=1e-5, atol=1e-5)


@OVER_KINDS
def test_with_strict_promotion_reset_and_step_are_traced(env_id):
    env = gymnax.make(env_id)[0]
    with jax.numpy_dtype_promotion("strict"):
        arguments = inputs(env)
        jax.eval_shape(flight(env), *arguments)


@cache
def flown(env_id):
    """Return a flight without NaN, compiled once for all tests of an id."""
    with jax.debug_nans(True):
        return jax.block_until_ready(fly(env_id))


@pytest.mark.slow
@pytest.mark.parametrize("env_id", [EVERY_WRAPPER, SEVERAL_DRONES])
def test_identical_seeds_fly_identically_in_another_process_and_without_nan(env_id):
    code = f"from tests.support.stepping import digest, fly; print(digest(fly({env_id!r})))"
    elsewhere = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert elsewhere.stdout.strip().splitlines()[-1] == digest(flown(env_id))


# JAX's maps run the whole program on each device, so that they do not depend on the environment.
DIVIDED = (
    (PLAIN, "sharding", "explicit", "shard_map", "pmap"),
    (EVERY_WRAPPER, "sharding"),
    (SEVERAL_DRONES, "sharding"),
)


@pytest.mark.slow
@pytest.mark.parametrize("case", DIVIDED, ids="-".join)
def test_flights_on_four_devices_are_those_on_one(case, tmp_path):
    env_id, *ways = case
    np.savez(tmp_path / "expected.npz", *jax.tree.leaves(flown(env_id)))
    environment = {**os.environ, "XLA_FLAGS": XLA_FLAGS}
    words = [env_id, str(tmp_path / "expected.npz"), *ways]
    command = [sys.executable, "-m", "tests.support.stepping", *words]
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert result.returncode == 0, result.stderr[-3000:]
