"""Continuing a training: the checkpoints in a folder, what a run is, and whether both fit."""

import dataclasses
import logging
import math
import os
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import (
    SUFFIX,
    Checkpoint,
    CheckpointError,
    as_json,
    as_named_arrays,
    check_kinds,
    check_no_differences,
    find_differences,
    from_named_arrays,
    load_checkpoint,
    observation_layout,
    save_checkpoint,
)
from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.ppo import Runner
from flytrack_env.model_file import model_as_json

FINAL = f"final{SUFFIX}"
SEED_FOLDER = re.compile(r"seed(\d+)")
STEP_FILE = re.compile(rf"step_(\d+)\{SUFFIX}")
REWARD = "reward."  # prefix of the reward's weights among the environment's parameters
MUST_FIT = ("env_id", "seed", "missed_gate", "config", "observation", "track_data", "model", "environment")

# What is used before a checkpoint is compared with the run.
FIELDS: dict[str, Any] = {
    **dict.fromkeys(("steps", "seed"), int),
    **dict.fromkeys(("seconds", "success", "best_lap_s"), (int, float, type(None))),
    **dict.fromkeys(("model", "environment"), dict),
}

logger = logging.getLogger(__name__)


class Start(NamedTuple):
    """A checkpoint to continue from, and its path."""

    path: Path
    checkpoint: Checkpoint

    @property
    def steps(self) -> int:
        """Environment steps of training so far."""
        return self.checkpoint.meta["steps"]


def step_file(steps: int) -> str:
    """Return the name of the checkpoint after a number of environment steps."""
    return f"step_{steps}{SUFFIX}"


def checkpoints_in(folder: Path) -> list[Path]:
    """Return the checkpoints in a folder, newest first: the final one, then by the steps in their names."""
    steps = {path: STEP_FILE.fullmatch(path.name) for path in folder.glob(f"step_*{SUFFIX}")}
    known = {path: int(match[1]) for path, match in steps.items() if match}
    if (folder / FINAL).exists():
        known[folder / FINAL] = sys.maxsize
    return sorted(known, key=lambda path: known[path], reverse=True)


def seeds_in(folder: Path) -> list[int]:
    """Return the seeds of which a folder holds checkpoints, in seed<N>."""
    matches = [(path, SEED_FOLDER.fullmatch(path.name)) for path in folder.glob("seed*")]
    return sorted(int(match[1]) for path, match in matches if match and checkpoints_in(path))


def check_free(folder: Path, start: Start | None = None) -> None:
    """Raise ValueError if a folder holds a run that is not the one to continue."""
    is_own = start is not None and start.path.parent.resolve() == folder.resolve()
    if not is_own and (checkpoints_in(folder) or seeds_in(folder)):
        raise ValueError(
            f"{folder} holds the checkpoints of a run; continue it (--resume {folder}), give another folder "
            "(--out), or remove it"
        )


def describe_run(
    env: Any, env_id: str, track: str, config: Config, seed: int, num_seeds: int = 1
) -> dict[str, Any]:
    """Return the description of a run, as JSON values, that its checkpoints hold.

    num_seeds: that train side by side. track: its name or path; gates and bounds are under ``track_data``.
    environment: the other parameters (rewards, starts, time step, wrappers) by their paths. machine: what
    decides the last bits of a result: XLA splits sums by the number of its threads, which are the cores that
    this process may use, or NPROC, its own setting.
    """
    params = env.default_params
    others = as_named_arrays(params.replace(model=None, course=None))
    machine = {
        "backend": jax.default_backend(),
        "devices": jax.device_count(),
        "threads": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "NPROC": os.environ.get("NPROC"),
        **({"seeds": num_seeds} if num_seeds > 1 else {}),
    }
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
            "machine": machine,
        }
    )


def check_same_run(path: Path, checkpoint: Checkpoint, description: dict[str, Any]) -> None:
    """Raise CheckpointError, field by field, unless a checkpoint is of the run described."""
    found = {**checkpoint.meta, "config": as_json(dataclasses.asdict(checkpoint.config))}
    lines = _differences(found, description, MUST_FIT)
    check_no_differences(path, [*lines, *_machine_differences(checkpoint, description)] if lines else [])


def warn_of_other_machine(path: Path, checkpoint: Checkpoint, description: dict[str, Any]) -> None:
    """Warn if software or machine differ from the checkpoint's: results may differ in the last bits."""
    lines = _machine_differences(checkpoint, description)
    if lines:
        logger.warning("%s: %s; continuing, perhaps not bit for bit", path, "; ".join(lines))


def _machine_differences(checkpoint: Checkpoint, description: dict[str, Any]) -> list[str]:
    expected = {**description, "package_version": flytrack_env.__version__}
    return _differences(checkpoint.meta, expected, ("package_version", "software", "machine"))


def _differences(found: dict[str, Any], expected: dict[str, Any], names: tuple[str, ...]) -> list[str]:
    pairs = (({name: one.get(name)} for one in (found, expected)) for name in names)
    return [line for pair in pairs for line in find_differences(*pair)]


def save_run(path: Path, runner: Runner, config: Config, description: dict[str, Any]) -> None:
    """Write a checkpoint that training can continue from, atomically."""
    state = runner.train_state
    rest = runner._replace(train_state=state.replace(params=None))
    save_checkpoint(path, state.params, config, description, as_named_arrays(rest))


def restore_runner(start: Start, target: Runner) -> Runner:
    """Return the state of the training in a checkpoint; ``target``: its shapes and types."""
    rest = target._replace(train_state=target.train_state.replace(params=None))
    runner = from_named_arrays(start.path, start.checkpoint.training or {}, rest)
    return runner._replace(train_state=runner.train_state.replace(params=start.checkpoint.params))


def newest_intact(path: Path) -> Start:
    """Return the checkpoint in a file, or the newest intact one in a folder.

    Raises:
        CheckpointError: a file that cannot be used, a folder without an intact one, or a policy alone.
    """
    candidates = checkpoints_in(path) if path.is_dir() else [path]
    if not candidates and seeds_in(path):
        names = ", ".join(f"seed{seed}" for seed in seeds_in(path))
        raise CheckpointError(f"{path}: found the runs of several seeds ({names}), expected that of one")
    if not candidates:
        raise CheckpointError(f"{path}: found no checkpoint, expected {FINAL} or step_<N>{SUFFIX}")
    *newer, oldest = candidates
    for candidate in newer:
        try:
            return load_start(candidate)
        except CheckpointError as error:
            logger.warning("%s; the checkpoint before it is used", error)
    return load_start(oldest)


def load_start(path: Path) -> Start:
    """Return a checkpoint that training can continue from.

    Raises:
        CheckpointError: a policy alone, or fields that are used before they are compared with the run.
    """
    start = Start(path, load_checkpoint(path))
    meta, config = start.checkpoint.meta, start.checkpoint.config
    if start.checkpoint.training is None:
        raise CheckpointError(f"{path}: found a policy alone, expected one with its training")
    check_kinds(path, meta, FIELDS)
    if meta["steps"] not in range(0, config.total_timesteps + 1, config.batch_size):
        raise CheckpointError(f"{path}: steps: found {meta['steps']}")
    rewards = rewards_of(start.checkpoint)
    check_kinds(f"{path}: environment", rewards, dict.fromkeys(rewards, float))
    return start


def rewards_of(checkpoint: Checkpoint) -> dict[str, float]:
    """Return the weights of the reward terms that a checkpoint was trained with."""
    values = checkpoint.meta["environment"].items()
    return {name.removeprefix(REWARD): value for name, value in values if name.startswith(REWARD)}


def seeds_side_by_side(checkpoint: Checkpoint) -> int:
    """Return how many seeds trained in one program when a checkpoint was written."""
    machine = checkpoint.meta.get("machine")
    number = machine.get("seeds") if isinstance(machine, dict) else None
    return number if isinstance(number, int) and number > 0 else 1


def at_common_step(starts: list[Start | None]) -> list[Start | None]:
    """Return where seeds continue that trained side by side: at the last step that all have stored.

    A kill between their checkpoints leaves some ahead, and trained alone they would end in other bits.
    Seeds that did not train side by side stay where they are.
    """
    found = [start for start in starts if start is not None]
    steps = min((start.steps for start in found), default=math.inf)
    are_together = all(seeds_side_by_side(start.checkpoint) == len(starts) == len(found) for start in found)
    if not are_together or all(start.steps == steps for start in found):
        return starts
    try:
        return [
            start if start.steps == steps else load_start(start.path.with_name(step_file(int(steps))))
            for start in found
        ]
    except CheckpointError as error:
        logger.warning("%s; every seed continues from its own newest checkpoint", error)
        return starts
