"""The step outside plain ``jit``: flights divided among devices, in a process of their own.

``python -m tests.support.stepping ENV_ID EXPECTED WAY ...``, with ``XLA_FLAGS``, flies an id in
some of the ``WAYS`` and compares with the flight on one device in the file ``EXPECTED``.
"""

import hashlib
import sys
from functools import partial

import chex
import gymnax
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

import flytrack_env  # noqa: F401, registers the ids
from tests.support.compiling import quick_jit

NUM_DEVICES, NUM_ENVS, NUM_STEPS = 4, 8, 5
# Of the process; each program runs once, so that optimising it does not pay.
XLA_FLAGS = (
    f"--xla_force_host_platform_device_count={NUM_DEVICES} --xla_backend_optimization_level=0"
)
MAX_STEPS = 3  # of an episode, so that episodes end
TOLERANCE = 1e-4  # rounding of a float32 step depends on how many environments are computed at once


def short_episodes(env):
    """Return the parameters of an environment or a race with a time limit of ``MAX_STEPS``."""
    params = env.default_params
    if hasattr(params, "max_steps_in_episode"):
        return params.replace(max_steps_in_episode=MAX_STEPS)
    flight = params.race.flight.replace(max_steps_in_episode=MAX_STEPS)
    return params._replace(race=params.race._replace(flight=flight))


def flight(env):
    """Return a function of keys (n,), actions (n, ...) and parameters: a reset, then steps.

    Episodes that end are reset. ``place`` puts what the reset returns on its devices.
    """

    def fly(keys, actions, params, place=lambda begun: begun):
        step = jax.vmap(env.step, in_axes=(0, 0, 0, None))

        def advance(begun, _):
            observation, state, reward, terminated, truncated, _ = step(
                keys, begun[1], actions, params
            )
            return (observation, state), (reward, terminated, truncated)

        begun = place(jax.vmap(env.reset, in_axes=(0, None))(keys, params))
        return jax.lax.scan(advance, begun, None, length=NUM_STEPS)

    return fly


def inputs(env):
    """Return keys, actions and parameters for ``flight``."""
    shape = (NUM_ENVS, *env.action_space(env.default_params).shape)
    actions = jax.random.uniform(jax.random.key(1), shape, jnp.float32, minval=-1.0)
    return jax.random.split(jax.random.key(0), NUM_ENVS), actions, short_episodes(env)


def fly(env_id):
    """Return the flight of an id."""
    env = gymnax.make(env_id)[0]
    return quick_jit(flight(env))(*inputs(env))


def digest(flown):
    """Return a digest of every bit of a flight."""
    leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(flown)]
    return hashlib.sha256(b"".join(leaves)).hexdigest()


def _by_named_sharding(fly, keys, actions, params, mesh):
    placed = jax.device_put((keys, actions), NamedSharding(mesh, PartitionSpec("batch")))
    program = jax.jit(fly).lower(*placed, params).compile()
    text = program.as_text()
    assert "xla_cpu_small_call" in text, "the fast path is off"
    # The rounds of a race's resets are outside of the kernel and gather the random words.
    assert hasattr(params, "race") or " all-gather(" not in text, "the batch is gathered"
    flown = program(*placed, params)
    assert not flown[0][0].sharding.is_fully_replicated
    return flown


def _by_explicit_axes(fly, keys, actions, params, mesh):
    mesh = jax.make_mesh(mesh.devices.shape, mesh.axis_names, axis_types=(AxisType.Explicit,))
    batch = NamedSharding(mesh, PartitionSpec("batch"))
    placed = jax.device_put((keys, actions), batch)
    # What a reset returns the same for every key is not divided, which vmap of a step asks for.
    fly = partial(fly, place=lambda begun: jax.sharding.reshard(begun, batch))
    with jax.set_mesh(mesh):
        return jax.jit(fly)(*placed, params)


def _by_shard_map(fly, keys, actions, params, mesh):
    batch, steps = PartitionSpec("batch"), PartitionSpec(None, "batch")
    specs = {"in_specs": (batch, batch, PartitionSpec()), "out_specs": (batch, steps)}
    return jax.jit(jax.shard_map(fly, mesh=mesh, **specs))(keys, actions, params)


def _by_pmap(fly, keys, actions, params, mesh):
    keys, actions = (leaf.reshape(NUM_DEVICES, -1, *leaf.shape[1:]) for leaf in (keys, actions))
    begun, steps = jax.pmap(fly, in_axes=(0, 0, None))(keys, actions, params)
    begun = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), begun)
    return begun, jax.tree.map(lambda leaf: jnp.concatenate(list(leaf), axis=1), steps)


WAYS = {
    "sharding": _by_named_sharding,
    "explicit": _by_explicit_axes,
    "shard_map": _by_shard_map,
    "pmap": _by_pmap,
}


def main(env_id, expected, *ways):
    """Fly an id in some ways; raise AssertionError if one differs from that on one device."""
    assert len(jax.devices()) == NUM_DEVICES
    mesh = Mesh(np.array(jax.devices()), ("batch",))
    env = gymnax.make(env_id)[0]
    with np.load(expected) as file:
        leaves = list(file.values())
    for way in ways:
        flown = jax.tree.leaves(WAYS[way](flight(env), *inputs(env), mesh))
        chex.assert_trees_all_close(flown, leaves, rtol=TOLERANCE, atol=TOLERANCE)


if __name__ == "__main__":
    main(*sys.argv[1:])
