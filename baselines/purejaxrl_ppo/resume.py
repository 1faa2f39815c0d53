"""Going on with a training that was cut off: what a run is, its newest intact checkpoint, its state."""

import dataclasses
import itertools
import logging
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import (
    Checkpoint,
    CheckpointError,
    as_json,
    check_none,
    find_differences,
    load_checkpoint,
    observation_layout,
    save_checkpoint,
)
from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.distributed import is_first
from baselines.purejaxrl_ppo.journal import forget
from baselines.purejaxrl_ppo.named_arrays import as_named_arrays, find_misfits, from_named_arrays
from baselines.purejaxrl_ppo.ppo import Runner
from baselines.purejaxrl_ppo.run_folder import FINAL, checkpoints_in, is_its_folder, seeds_in
from flytrack_env.files import write_together
from flytrack_env.messages import quote_value
from flytrack_env.model_file import model_as_json

REWARD = "reward."  # what paths of the reward's weights begin with
MUST_FIT = ("env_id", "seed", "missed_gate", "config", "observation", "track_data", "model", "environment")

logger = logging.getLogger(__name__)

Start = tuple[Path, Checkpoint]  # a checkpoint to go on from, and its path


def describe_run(
    env: Any, env_id: str, track: str, config: Config, seed: int, number: int = 1
) -> dict[str, Any]:
    """Return what a run is, as JSON values: what its checkpoints say of themselves.

    number: of seeds that train side by side.
    track: what finds it again, a name or a path; its gates and bounds stand under ``track_data``.
    environment: the other parameters (rewards, starts, time step, wrappers) by their paths.
    """
    params = env.default_params
    others = as_named_arrays(params.replace(model=None, course=None))
    return as_json(
        {
            "env_id": env_id,
            "track": track,
            "track_data": dataclasses.asdict(env.track),
            "missed_gate": env.missed_gate,
            "observation_size": int(env.observation_space().shape[0]),
            "observation": observation_layout(env),
            "seed": seed,
            "model": model_as_json(params.model),
            "environment": {name: values.tolist() for name, values in others.items()},
            "config": dataclasses.asdict(config),
            "software": {"jax": jax.__version__},
            "machine": describe_machine(number),
        }
    )


def describe_machine(number: int = 1) -> dict[str, Any]:
    """Return what of a machine decides the last bits: XLA splits sums by the number of its threads.

    threads: cores that this process may use. NPROC: XLA's own setting of that number, where there is one.
    seeds: that train side by side, where there are several, because their program is another.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "backend": jax.default_backend(),
        "devices": jax.device_count(),
        "threads": cores,
        "NPROC": os.environ.get("NPROC"),
        **({"seeds": number} if number > 1 else {}),
    }


def save_run(path: Path, runner: Runner, config: Config, description: dict[str, Any]) -> None:
    """Write a checkpoint that training can go on from, atomically."""
    state = runner.train_state
    rest = runner._replace(train_state=state.replace(params=None))
    save_checkpoint(path, state.params, config, description, as_named_arrays(rest))


def newest_intact(path: Path) -> tuple[Path, Checkpoint]:
    """Return the checkpoint in a file, or the newest one in a folder that is intact, and its path.

    Raises:
        CheckpointError: a file that cannot be used, a folder without an intact one, or a policy alone.
    """
    candidates = checkpoints_in(path) if path.is_dir() else [path]
    if not candidates and seeds_in(path):
        names = ", ".join(f"seed{seed}" for seed in seeds_in(path))
        raise CheckpointError(f"{path}: found the runs of several seeds, expected that of one: {names} in it")
    if not candidates:
        raise CheckpointError(f"{path}: found no checkpoint, expected {FINAL} or step_<N>.msgpack")
    *newer, oldest = candidates
    for candidate in newer:
        try:
            return candidate, _load_training(candidate)
        except CheckpointError as error:
            logger.warning("%s; the checkpoint before it is used", error)
    return oldest, _load_training(oldest)


def own_start(out: Path, start: Start) -> Path:
    """Return the path, in a run's folder, of the checkpoint that it goes on from."""
    path, checkpoint = start
    return path if is_its_folder(out, path) else out / f"step_{checkpoint.meta['steps']}.msgpack"


def take_over(starts: list[tuple[Path, Start]], beside: Iterable[tuple[Path, bytes]] = ()) -> None:
    """Have every run's start in its own folder: killed before its first checkpoint, it goes on from there.

    starts: a run's folder, which holds no other run, and where the run goes on. beside: files that are
    written with them; where one cannot be written, none is.
    """
    moves = [(start[0], own_start(out, start)) for out, start in starts]
    moves = [(source, path) for source, path in moves if source != path]
    if is_first():
        for _, path in moves:
            forget(path.parent)
        write_together(itertools.chain(beside, ((path, source.read_bytes()) for source, path in moves)))


def seeds_side_by_side(starts: list[Start | None]) -> int:
    """Return how many seeds trained side by side, as the first checkpoint says; all of them without one."""
    found = [start[1] for start in starts if start is not None]
    return _seeds_noted(found[0]) if found else len(starts)


def _seeds_noted(checkpoint: Checkpoint) -> int:
    """Return beside how many seeds, itself one of them, a checkpoint says that its seed trained."""
    machine = checkpoint.meta.get("machine")
    number = machine.get("seeds") if isinstance(machine, dict) else None
    return number if isinstance(number, int) and number > 0 else 1


def at_common_step(starts: list[Start | None]) -> list[Start | None]:
    """Return where seeds go on that trained side by side: all at the last step that all have stored.

    A kill between their checkpoints leaves some ahead, and alone they would not go on bit for bit.
    Others, None for those that begin, stay as they are.
    """
    found = [start for start in starts if start is not None]
    steps = {checkpoint.meta["steps"] for _, checkpoint in found}
    are_together = all(_seeds_noted(checkpoint) == len(starts) == len(found) for _, checkpoint in found)
    if not are_together or len(steps) <= 1:
        return starts
    name = f"step_{min(steps)}.msgpack"
    try:
        return [
            start if start[1].meta["steps"] == min(steps) else newest_intact(start[0].with_name(name))
            for start in found
        ]
    except CheckpointError as error:
        logger.warning("%s; the seeds go on from where each of them was", error)
        return starts


def _load_training(path: Path) -> Checkpoint:
    checkpoint = load_checkpoint(path)
    if checkpoint.training is None:
        raise CheckpointError(f"{path}: found a policy alone, expected one with its training")
    _check_progress(path, checkpoint)
    return checkpoint


def _check_progress(path: Path, checkpoint: Checkpoint) -> None:
    """Raise CheckpointError where a description does not say how far the training is, and of what."""
    meta = checkpoint.meta
    for name, (is_right, expected) in PROGRESS.items():
        if not is_right(meta.get(name)):
            found = quote_value(meta.get(name))
            raise CheckpointError(f"{path}: {name}: found {found}, expected {expected}")
    batch_size = checkpoint.config.batch_size
    if meta["steps"] % batch_size:
        found = meta["steps"]
        raise CheckpointError(f"{path}: steps: found {found}, expected a multiple of {batch_size}, an update")
    total = checkpoint.config.num_updates * batch_size
    if meta["steps"] > total:
        raise CheckpointError(
            f"{path}: steps: found {meta['steps']}, expected at most {total}, the whole training"
        )


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**63


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < sys.float_info.max


def _is_object(value: Any) -> bool:
    return isinstance(value, dict)


# What is used before, or without, being compared with the run that goes on.
PROGRESS = {
    "steps": (_is_count, "a whole number"),
    "seed": (_is_count, "a whole number"),
    "seconds": (lambda value: value is None or _is_number(value), "a number"),
    "seen": (
        lambda value: (
            value is None
            or (_is_object(value) and all(one is None or _is_number(one) for one in value.values()))
        ),
        "an object of numbers",
    ),
    "model": (_is_object, "an object"),
    "environment": (
        lambda value: (
            _is_object(value)
            and all(_is_number(one) for name, one in value.items() if name.startswith(REWARD))
        ),
        "an object, with numbers for weights of the reward",
    ),
}


def check_same_run(path: Path, checkpoint: Checkpoint, description: dict[str, Any]) -> None:
    """Raise CheckpointError, field by field, where a checkpoint is not of the run described."""
    found = {**checkpoint.meta, "config": as_json(dataclasses.asdict(checkpoint.config))}
    lines = [
        line for name in MUST_FIT for line in find_differences(found.get(name), description.get(name), name)
    ]
    check_none(path, [*lines, *_other_bits(checkpoint, description)] if lines else [])


def warn_of_other_bits(path: Path, checkpoint: Checkpoint, description: dict[str, Any]) -> None:
    """Warn where software or machine are not what a checkpoint was written with: it may go on differently."""
    lines = _other_bits(checkpoint, description)
    if lines:
        logger.warning("%s: %s; going on, perhaps not bit for bit", path, "; ".join(lines))


def _other_bits(checkpoint: Checkpoint, description: dict[str, Any]) -> list[str]:
    expected = {**description, "package_version": flytrack_env.__version__}
    return [
        line
        for name in ("package_version", "software", "machine")
        for line in find_differences(checkpoint.meta.get(name), expected[name], name)
    ]


def restore_runner(path: Path, checkpoint: Checkpoint, target: Runner) -> Runner:
    """Return the state of the training in a checkpoint; ``target``: its shapes and types.

    Raises:
        CheckpointError: arrays that are not what the training expects, leaf by leaf.
    """
    rest = target._replace(train_state=target.train_state.replace(params=None))
    training = checkpoint.training or {}
    if not all(isinstance(array, np.ndarray) for array in training.values()):
        raise CheckpointError(f"{path}: training: found something else than arrays")
    check_none(path, find_misfits(training, rest))
    runner = from_named_arrays(training, rest)
    params = jax.tree.map(jax.numpy.asarray, checkpoint.params)
    return runner._replace(train_state=runner.train_state.replace(params=params))
