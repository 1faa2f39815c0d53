"""Auto-reset of a batch: exactly the ended environments change, each to a start of its own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytrack_env import FlyTrack
from flytrack_env.auto_reset import reset_ended
from flytrack_env.dynamics import advance
from flytrack_env.plants import Simulator


@pytest.mark.parametrize("size", [7, 300])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.4, 1.0])
def test_only_ended_environments_change(size, share):
    ended = jax.random.uniform(jax.random.key(1), (size,)) < share
    olds = {"scalar": jnp.arange(size) * 1.0, "vector": jnp.ones((size, 3))}

    def sample(places, offset):
        return {"scalar": places * 1.0 + offset, "vector": jnp.tile(places[:, None], (1, 3)) * 2.0}

    fresh = jax.jit(lambda: reset_ended(sample, ended, olds, 1000.0))()
    index = np.arange(size)
    np.testing.assert_array_equal(fresh["scalar"], np.where(ended, index + 1000.0, index))
    expected = np.where(np.asarray(ended)[:, None], 2.0 * index[:, None], 1.0)
    np.testing.assert_array_equal(fresh["vector"], np.broadcast_to(expected, (size, 3)))


def test_gradient_flows_through_what_did_not_end():
    ended = jnp.array([True, False, True])

    def total(olds):
        return (reset_ended(lambda places, _: places * 1.0, ended, olds, None) ** 2).sum()

    np.testing.assert_allclose(jax.grad(total)(jnp.array([3.0, 4.0, 5.0])), [0.0, 8.0, 0.0])


class Remembering(Simulator):
    """A plant whose state has an array beside the drone: the last three commanded thrusts."""

    def reset(self, drone, model):
        return drone, jnp.zeros(3)

    def step(self, state, command, dt, model):
        drone, memory = state
        memory = jnp.append(memory[1:], command.thrust)
        return advance(drone, (), command, dt, model)[0], memory

    def drone(self, state):
        return state[0]


@pytest.mark.slow
def test_a_plant_may_remember_arrays_and_forgets_at_the_end():
    env = FlyTrack(plant=Remembering())
    params = env.default_params.replace(max_steps_in_episode=2)
    keys = jax.random.split(jax.random.key(0), 4)
    _, states = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
    actions = jnp.full((4, 4), -0.25)
    for expected in ([0.0, 0.0, -0.25], [0.0, 0.0, 0.0]):
        _, states, *_ = env.step_batch(keys[0], states, actions, params)
        np.testing.assert_allclose(states.plant[1], np.tile(expected, (4, 1)))
