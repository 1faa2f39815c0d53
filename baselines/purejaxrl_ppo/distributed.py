"""Training on several devices, of one process or of many: environments in equal shards.

Every device steps its shard of the environments and computes gradients on its own minibatches. Gradients and
the statistics that normalise advantages are averaged over all devices, so that every device takes the same
gradient step.
"""

import hashlib
import json
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.extend.backend import clear_backends
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from baselines.purejaxrl_ppo.collectives import AXIS
from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.ppo import Algorithm, Metrics, Runner

REPLICATED, SHARDED = PartitionSpec(), PartitionSpec(AXIS)
LAYOUT = Runner(REPLICATED, SHARDED, SHARDED, SHARDED, REPLICATED)  # type: ignore[arg-type]
HEARTBEAT_TIMEOUT_S = 30  # a process that is silent for longer counts as lost


def join(coordinator: str | None, num_processes: int | None, process: int | None) -> None:
    """Connect to the other processes; a process without a job stays alone with its several devices.

    All arrays that exist become unusable: JAX computes once at import, and can be connected only before.

    coordinator: HOST:PORT of the first process. num_processes: their number. process: index of this one. All
    None: as SLURM or Open MPI say.

    Raises:
        ValueError: neither a job nor several devices, or other processes that cannot be reached.
    """
    job = (coordinator, num_processes, process)
    clear_backends()
    try:
        jax.distributed.initialize(
            *job, heartbeat_timeout_seconds=HEARTBEAT_TIMEOUT_S, shutdown_timeout_seconds=HEARTBEAT_TIMEOUT_S
        )
    except (ValueError, RuntimeError) as error:
        if any(part is not None for part in job) or jax.device_count() == 1:
            raise ValueError(
                f"--distributed: {error}; expected a job of SLURM or Open MPI, several devices, or all of "
                "--coordinator HOST:PORT, --num-processes, --process-index"
            ) from error


def all_devices() -> Mesh:
    """Return the mesh of all devices of all processes."""
    return Mesh(jax.devices(), (AXIS,))


def check_divides(config: Config, mesh: Mesh) -> None:
    """Raise ValueError where environments or minibatches cannot be split over the devices."""
    if config.num_envs % mesh.size:
        raise ValueError(f"num_envs: found {config.num_envs}, expected a multiple of {mesh.size} devices")
    per_shard = config.batch_size // mesh.size
    if per_shard % config.num_minibatches:
        raise ValueError(
            f"num_minibatches: found {config.num_minibatches}, expected a divisor of the {per_shard} steps "
            f"of an update on each of {mesh.size} devices"
        )


def on_devices(ppo: Algorithm, mesh: Mesh) -> Algorithm:
    """Return PPO on all environments from PPO on one shard (``make_ppo`` with a shard per device)."""

    def update_shard(runner: Runner) -> tuple[Runner, Metrics]:
        shard = jax.lax.axis_index(AXIS)
        done, metrics = ppo.update(runner._replace(key=jax.random.fold_in(runner.key, shard)))
        # The next key is the same on every device, and no shard has drawn from it.
        return done._replace(key=jax.random.fold_in(runner.key, mesh.size)), metrics

    def start(key: jax.Array) -> Runner:
        return jax.lax.with_sharding_constraint(ppo.start(key), shardings(mesh))

    # check_vma would sum gradients implicitly, and require annotations in every loop of the environment.
    out_specs = (LAYOUT, REPLICATED)
    update = jax.shard_map(update_shard, mesh=mesh, in_specs=(LAYOUT,), out_specs=out_specs, check_vma=False)
    return Algorithm(start, update)


def shardings(mesh: Mesh) -> Runner:
    """Return the sharding of every part of a training's state."""
    return Runner(*(NamedSharding(mesh, spec) for spec in LAYOUT))  # type: ignore[arg-type]


def spread(runner: Runner, mesh: Mesh) -> Runner:
    """Return a state that every process holds whole, spread over the devices."""
    return jax.jit(lambda whole: whole, out_shardings=shardings(mesh))(runner)


def whole(runner: Runner, mesh: Mesh) -> Runner:
    """Return a spread state so that every process can read it; all processes must call this."""
    return jax.jit(lambda spread: spread, out_shardings=NamedSharding(mesh, REPLICATED))(runner)


def check_agree(settings: Any) -> None:
    """Raise ValueError unless all processes have the same settings, JSON values; all must call this."""
    text = json.dumps(settings, sort_keys=True, default=str)
    try:
        multihost_utils.assert_equal(np.frombuffer(hashlib.sha256(text.encode()).digest(), np.uint8))
    except AssertionError as error:
        raise ValueError(f"settings: process {jax.process_index()} has others than process 0") from error


def is_first() -> bool:
    """Return whether this process writes files and logs: the first, or the only one."""
    return jax.process_index() == 0
