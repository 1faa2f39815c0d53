"""One training on several devices, of one process or of many, by JAX's own runtime.

The update is that of one device (``ppo.py``): environments are sharded over a mesh, and XLA divides
the program along them. Every minibatch is one device's, row by row, and each device computes the
gradient of its share of the rows; XLA sums the shares before the optimizer steps. Results differ
from those of one device by rounding.
"""

import json
import os
import re
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from baselines.purejaxrl_ppo.checkpoint import check_equal
from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.ppo import Algorithm, Runner

AXIS = "environments"
JOIN_TIMEOUT_S = 60  # how long processes wait for each other at the start
HEARTBEAT_TIMEOUT_S = 15  # a process silent for longer is lost; JAX notices within twice that
AUTOMATIC = "auto"
# What the errors say by which gloo, NCCL and JAX's coordination service report a lost process.
LOSS = re.compile("gloo|nccl|heartbeat|coordination.?service|connection (closed|reset)", re.I)

Tree = TypeVar("Tree")


class LostProcessError(OSError):
    """Another process of the training is gone; the message says how to continue."""


def join(coordinator: str, num_processes: int | None, process: int | None) -> None:
    """Connect to the other processes of a training; call it before JAX computes.

    Args:
        coordinator: HOST:PORT at which process 0 listens; "auto": all three as SLURM, Open MPI or
            Kubernetes say.
        num_processes: their number.
        process: index of this one.

    Raises:
        ValueError: no such job, or processes that cannot be reached.
    """
    if coordinator != AUTOMATIC and process:
        wait_for(coordinator)  # JAX would abort with a trace of its C++
    try:
        jax.distributed.initialize(
            None if coordinator == AUTOMATIC else coordinator,
            num_processes,
            process,
            initialization_timeout=JOIN_TIMEOUT_S,
            heartbeat_timeout_seconds=HEARTBEAT_TIMEOUT_S,
            shutdown_timeout_seconds=HEARTBEAT_TIMEOUT_S,
        )
    except (ValueError, RuntimeError) as error:
        text = str(error).splitlines()[0]
        raise ValueError(
            f"--coordinator {coordinator}: {text}; expected a job of SLURM, Open MPI or "
            "Kubernetes, or HOST:PORT of process 0 with --num-processes and --process"
        ) from error


def wait_for(coordinator: str) -> None:
    """Wait until something listens at HOST:PORT; raises ValueError after ``JOIN_TIMEOUT_S``."""
    host, _, port = coordinator.rpartition(":")
    if not host or not port.isdecimal():
        raise ValueError(f"--coordinator: found {coordinator!r}, expected HOST:PORT or auto")
    end_s = time.monotonic() + JOIN_TIMEOUT_S
    while True:
        try:
            socket.create_connection((host, int(port)), timeout=JOIN_TIMEOUT_S).close()
            return
        except (OSError, OverflowError) as error:
            if time.monotonic() > end_s:
                raise ValueError(
                    f"--coordinator {coordinator}: nobody listens there after {JOIN_TIMEOUT_S} s "
                    f"({error}), expected process 0"
                ) from error
            time.sleep(0.2)


def make_mesh(count: int | None) -> Mesh:
    """Return the mesh of the first ``count`` devices of every process; None: of all.

    Raises:
        ValueError: fewer devices than that.
    """
    local = jax.local_device_count()
    if count is not None and not 1 <= count <= local:
        raise ValueError(f"--devices: found {count}, expected 1 to {local}, which JAX has here")
    of_processes: dict[int, list[Any]] = {}
    for device in jax.devices():
        of_processes.setdefault(device.process_index, []).append(device)
    chosen = [device for devices in of_processes.values() for device in devices[:count]]
    return Mesh(np.array(chosen), (AXIS,))


def check_divides(config: Config, mesh: Mesh) -> None:
    """Raise ValueError where environments or minibatches cannot be shared out equally."""
    rows = config.num_envs if config.memory_size else config.batch_size
    shares = {"num_envs": config.num_envs, "rows of a minibatch": rows // config.num_minibatches}
    for name, count in shares.items():
        if count % mesh.size:
            raise ValueError(f"{name}: found {count}, expected a multiple of {mesh.size} devices")


def layout(mesh: Mesh) -> Runner:
    """Return where the parts of a training's state are: by environment, or on every device."""
    everywhere, shared = (NamedSharding(mesh, PartitionSpec(*axes)) for axes in ((), (AXIS,)))
    parts: Any = (everywhere, shared, shared, shared, shared, everywhere)
    return Runner(*parts)


def divide_minibatches(mesh: Mesh, minibatches: Tree) -> Tree:
    """Share out the rows of minibatches, (num_minibatches, rows, ...), among the devices."""
    by_row = NamedSharding(mesh, PartitionSpec(None, AXIS))
    return jax.lax.with_sharding_constraint(minibatches, by_row)


def compile_on(mesh: Mesh | None, ppo: Algorithm) -> Algorithm:
    """Return both functions of PPO as programs of a mesh; None: of the default device."""
    if mesh is None:
        return Algorithm(jax.jit(ppo.start), jax.jit(ppo.update))
    state, everywhere = layout(mesh), NamedSharding(mesh, PartitionSpec())
    return Algorithm(
        jax.jit(ppo.start, out_shardings=state),
        jax.jit(ppo.update, in_shardings=(state,), out_shardings=(state, everywhere)),
    )


def spread(runner: Runner, mesh: Mesh | None) -> Runner:
    """Return a state that every process holds whole, divided among the devices."""
    if mesh is None:
        return runner
    divided: Runner = jax.jit(lambda whole: whole, out_shardings=layout(mesh))(runner)
    return divided


def gather(tree: Tree, mesh: Mesh | None) -> Tree:
    """Return a tree on this process' device; every process must call this."""
    if mesh is None:
        return tree
    everywhere = NamedSharding(mesh, PartitionSpec())
    whole: Tree = jax.jit(lambda divided: divided, out_shardings=everywhere)(tree)
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), whole)


def is_first() -> bool:
    """Return whether this process writes files: the first, or the only one."""
    return jax.process_index() == 0


def any_process(flag: bool) -> bool:
    """Return whether a flag is set in any process; every process must call this."""
    if jax.process_count() == 1:
        return flag
    return bool(multihost_utils.process_allgather(np.asarray(flag)).any())


def check_agree(out: Path, description: dict[str, Any]) -> None:
    """Check before a training that all processes are about to do the same; every one must call it.

    Args:
        out: folder that process 0 writes, made here.
        description: of the run, JSON values; what it says of the machine may differ.

    Raises:
        CheckpointError: this process' description differs from that of process 0.
        ValueError: this process does not see the folder.
    """
    if jax.process_count() == 1:
        return
    name = f"process {jax.process_index()}"
    if is_first():
        out.mkdir(parents=True, exist_ok=True)
    own = {**description, "machine": None}
    text = np.frombuffer(json.dumps(own).encode(), np.uint8)
    size = int(multihost_utils.broadcast_one_to_all(np.asarray(len(text))))
    sent = multihost_utils.broadcast_one_to_all(np.resize(text, size))
    check_equal(name, own, json.loads(np.asarray(sent).tobytes()))
    if not out.is_dir():
        raise ValueError(
            f"{out}: {name} does not see the folder that process 0 made, expected one on a file "
            "system that all processes share"
        )


@contextmanager
def noticing_loss(resume: str) -> Iterator[None]:
    """Raise LostProcessError where a computation fails as another process is gone.

    Args:
        resume: flags that continue the training, for the message.
    """
    try:
        yield
    except (jax.errors.JaxRuntimeError, ValueError) as error:
        # JAX raises a plain ValueError where a failed result is read.
        is_of_jax = type(error) in (jax.errors.JaxRuntimeError, ValueError)
        if jax.process_count() == 1 or not (is_of_jax and LOSS.search(str(error))):
            raise
        raise LostProcessError(
            f"process {jax.process_index()} of {jax.process_count()} has lost another; continue "
            f"with {resume}, on any number of devices"
        ) from error


def leave_alone(status: int) -> None:
    """End this process at once where another is lost: JAX would wait for that one at exit."""
    if jax.process_count() > 1:
        os._exit(status)
