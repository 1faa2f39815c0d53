"""Auto-reset of a batch: exactly the ended environments change, each to a start of its own."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytrack_env.auto_reset import Ended, reset_if_ended
from flytrack_env.fusion import SWITCH, one_kernel


def begin(seed, offset):
    """Return rows and state of a start."""
    value = seed.astype(jnp.float32) + offset
    return [value, 2.0 * value], {"scalar": value, "vector": jnp.tile(value, 3)}


def steps(size, share):
    """Return a batch of which about so many episodes end."""
    index = jnp.arange(size)
    done = jax.random.uniform(jax.random.key(1), (size,)) < share
    state = {"scalar": index * 1.0, "vector": jnp.ones((size, 3))}
    return Ended(done, ([index * 1.0, index * 3.0], state), (7 * index).astype(jnp.uint32))


def expected(batch, offset):
    """Return what the reset of each environment alone is."""
    found = []
    for i in range(len(batch.done)):
        step = jax.tree.map(lambda leaf, i=i: leaf[i], batch)
        found.append(begin(step.seed, offset) if step.done else step.shown)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)


@pytest.mark.parametrize("switch", ["1", "0"])
@pytest.mark.parametrize("size", [7, 300])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.4, 1.0])
def test_only_ended_environments_change(monkeypatch, switch, size, share):
    monkeypatch.setenv(SWITCH, switch)
    batch = steps(size, share)
    reset = partial(reset_if_ended, begin)
    found = jax.jit(jax.vmap(one_kernel(reset), in_axes=(0, None)))(batch, 1000.0)
    jax.tree.map(np.testing.assert_array_equal, found, expected(batch, 1000.0))


def test_a_batch_of_batches_and_parameters_of_each():
    batch, reset = steps(24, 0.3), partial(reset_if_ended, begin)
    nested = jax.tree.map(lambda leaf: leaf.reshape(4, 6, *leaf.shape[1:]), batch)
    found = jax.jit(jax.vmap(jax.vmap(reset, in_axes=(0, None)), in_axes=(0, None)))(nested, 5.0)
    flat = jax.tree.map(lambda leaf: leaf.reshape(24, *leaf.shape[2:]), found)
    jax.tree.map(np.testing.assert_array_equal, flat, expected(batch, 5.0))
    found = jax.jit(jax.vmap(reset))(batch, jnp.arange(24) * 1.0)
    fresh = np.asarray(batch.seed, np.float32) + np.arange(24)
    np.testing.assert_array_equal(found[0][0], np.where(batch.done, fresh, np.arange(24)))


def test_gradient_flows_through_what_did_not_end():
    def total(rows):
        batch = Ended(jnp.array([True, False, True]), ([rows], rows), jnp.zeros(3, jnp.uint32))
        reset = partial(reset_if_ended, lambda seed, _: ([seed * 1.0], seed * 1.0))
        (found,), _ = jax.vmap(one_kernel(reset), in_axes=(0, None))(batch, None)
        return (found**2).sum()

    np.testing.assert_allclose(jax.grad(total)(jnp.array([3.0, 4.0, 5.0])), [0.0, 8.0, 0.0])
