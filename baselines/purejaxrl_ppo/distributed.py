"""Training on several devices, of one process or of many on several machines: environments in equal shards.

Every device steps its shard of the environments and computes gradients on its own minibatches; gradients,
and the statistics that advantages are normalised with, are averaged over all devices, so that every device
takes the same gradient step. The processes meet in
``baselines.joining``.
"""

import hashlib
import json
from typing import Any

import jax
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from baselines.purejaxrl_ppo.across import AXIS
from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.ppo import Algorithm, Metrics, Runner

EVERYWHERE, IN_SHARDS = PartitionSpec(), PartitionSpec(AXIS)
LAYOUT = Runner(EVERYWHERE, IN_SHARDS, IN_SHARDS, IN_SHARDS, EVERYWHERE)  # type: ignore[arg-type]


def all_devices() -> Mesh:
    """Return the mesh of all devices of all processes."""
    return Mesh(jax.devices(), (AXIS,))


def check_divides(config: Config, mesh: Mesh) -> None:
    """Raise ValueError where environments or minibatches cannot be split over the devices."""
    if config.num_envs % mesh.size:
        raise ValueError(f"num_envs: found {config.num_envs}, expected a multiple of {mesh.size} devices")
    of_shard = config.batch_size // mesh.size
    if of_shard % config.num_minibatches:
        raise ValueError(
            f"num_minibatches: found {config.num_minibatches}, expected a divisor of the {of_shard} steps of "
            f"an update on each of {mesh.size} devices"
        )


def on_devices(ppo: Algorithm, mesh: Mesh) -> Algorithm:
    """Return PPO on all environments, of PPO on a shard (``make_ppo`` with as many shards as devices)."""

    def update_shard(runner: Runner) -> tuple[Runner, Metrics]:
        shard = jax.lax.axis_index(AXIS)
        done, metrics = ppo.update(runner._replace(key=jax.random.fold_in(runner.key, shard)))
        # The next key is the same everywhere, and none that a shard drew from.
        return done._replace(key=jax.random.fold_in(runner.key, mesh.size)), metrics

    def start(key: jax.Array) -> Runner:
        return jax.lax.with_sharding_constraint(ppo.start(key), shardings(mesh))

    # check_vma would have gradients summed by themselves, and every loop in the environment annotated.
    out_specs = (LAYOUT, EVERYWHERE)
    update = jax.shard_map(update_shard, mesh=mesh, in_specs=(LAYOUT,), out_specs=out_specs, check_vma=False)
    return Algorithm(start, update)


def shardings(mesh: Mesh) -> Runner:
    """Return where the parts of a training's state lie."""
    return Runner(*(NamedSharding(mesh, spec) for spec in LAYOUT))  # type: ignore[arg-type]


def spread(runner: Runner, mesh: Mesh) -> Runner:
    """Return the state that every process has whole, spread over the devices."""
    return jax.jit(lambda whole: whole, out_shardings=shardings(mesh))(runner)


def whole(runner: Runner, mesh: Mesh) -> Runner:
    """Return the spread state as every process can read it; all of them have to ask."""
    return jax.jit(lambda spread: spread, out_shardings=NamedSharding(mesh, EVERYWHERE))(runner)


def check_agree(what: str, value: Any) -> None:
    """Raise ValueError where the processes do not have the same; all of them have to ask."""
    try:
        multihost_utils.assert_equal(value)
    except AssertionError as error:
        raise ValueError(f"{what}: process {jax.process_index()} found another than process 0") from error


def digest(values: Any) -> int:
    """Return a number, of an int32, that two processes share where they have the same JSON values."""
    text = json.dumps(values, sort_keys=True, default=str)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4]) >> 1


def wait_for_all(where: str) -> None:
    """Return when all processes are here."""
    multihost_utils.sync_global_devices(where)


def is_first() -> bool:
    """Return whether this process writes, draws and tells: the first, or the only one."""
    return jax.process_index() == 0
