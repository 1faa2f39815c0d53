"""Checkpoints: a policy, all that is needed to fly it and, in a run, all that training needs to continue.

What a run is, the checkpoints in its folder, and whether both fit, is here, too.

A checkpoint is a safetensors file: arrays named ``policy.*`` and ``training.*``, and in the header a JSON
description and a SHA-256 checksum of description and arrays. Nothing in it is executed.
"""

import dataclasses
import hashlib
import json
import logging
import math
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy

import flytrack_env
from baselines.purejaxrl_ppo.config import Config, read_settings
from baselines.purejaxrl_ppo.networks import ActorCritic, Policy, make_network
from baselines.purejaxrl_ppo.ppo import Runner
from flytrack_env.files import read_at_most, write_atomically
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_env.model_file import model_as_json

SUFFIX = ".safetensors"
FORMAT = "flytrack-ppo-3"
POLICY, TRAINING = "policy.", "training."  # prefixes of the arrays' names
LARGEST_BYTES = 3 * 2**27
LARGEST_HEADER_BYTES = 2**23  # the description of a track of ten thousand gates
WIDEST = 2**16  # layer of a network
MOST_DIFFERENCES = 12  # in one message

FINAL = f"final{SUFFIX}"
SEED_FOLDER = re.compile(r"seed(\d+)")
STEP_FILE = re.compile(rf"step_(\d+)\{SUFFIX}")
REWARD = "reward."  # prefix of the reward's weights among the environment's parameters
MUST_FIT = ("env_id", "seed", "missed_gate", "config", "observation", "track_data", "model", "environment")

WORDING = ("name", "unit")  # of a row of an observation

# What is used before a checkpoint is compared with the run.
FIELDS: dict[str, Any] = {
    **dict.fromkeys(("steps", "seed"), int),
    **dict.fromkeys(("seconds", "success", "best_lap_s"), (int, float, type(None))),
    **dict.fromkeys(("model", "environment"), dict),
}

Arrays = dict[str, np.ndarray]
logger = logging.getLogger(__name__)


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; the message says what was found and what was expected."""


class Checkpoint(NamedTuple):
    """A trained policy and, in a run, the state of its training.

    params: of the network. config: of the training. env_id, track: what it was trained on.
    observation_size: of its input. meta: the whole description as stored. training: named arrays of the
    rest of the training's state (optimiser, environments, random keys); None for a policy alone. path: of its
    file.
    """

    params: Any
    config: Config
    env_id: str
    track: str
    observation_size: int
    meta: dict[str, Any]
    training: Arrays | None = None
    path: Path = Path()

    @property
    def steps(self) -> int:
        """Environment steps of training so far."""
        return int(self.meta["steps"])

    @property
    def network(self) -> ActorCritic:
        """The network that the parameters belong to."""
        return make_network(self.config)

    @property
    def policy(self) -> Policy:
        """What flies."""
        return Policy(self.network, self.params)

    def check_fits(self, env: Any) -> None:
        """Raise CheckpointError unless the policy's input is this environment's observation, row by row."""
        found = env.observation_space(env.default_params).shape
        if found != (self.observation_size,):
            raise CheckpointError(
                f"checkpoint: trained on observations of size {self.observation_size} "
                f"({self.env_id}), but the environment's have shape {found}"
            )
        if "observation" in self.meta:
            lines = find_differences(
                *map(_without_wording, (self.meta["observation"], observation_layout(env)))
            )
            check_no_differences("checkpoint: observation", lines)


def observation_layout(env: Any) -> dict[str, Any]:
    """Return an environment's observation as JSON values: each row's meaning, frame, unit, scale, limit."""
    return as_json({f"row {i} ({e.key})": e._asdict() for i, e in enumerate(env.observation_table)})


def _without_wording(layout: Any) -> Any:
    """Return an observation's layout without names and units, which are for people and may be reworded."""
    if not isinstance(layout, dict):
        return layout
    return {
        row: {name: value for name, value in entry.items() if name not in WORDING}
        if isinstance(entry, dict)
        else entry
        for row, entry in layout.items()
    }


def as_json(value: Any) -> Any:
    """Return values as they come back from JSON: lists for tuples."""
    return json.loads(json.dumps(value))


def find_differences(found: Any, expected: Any, show: Any = quote_value) -> list[str]:
    """Return a line for each leaf of two trees, by its dotted name, that differs, the shallowest first."""
    lines, found, expected = [], by_dotted_name(found), by_dotted_name(expected)
    for name in sorted({**expected, **found}, key=lambda name: name.count(".")):
        pair = found.get(name), expected.get(name)
        if pair[0] != pair[1]:
            shown = ["nothing" if value is None else show(value) for value in pair]
            lines.append(f"{quote_name(name)}: found {shown[0]}, expected {shown[1]}")
    return lines


def by_dotted_name(tree: Any) -> dict[str, Any]:
    """Return the leaves of JSON values or of another tree by their dotted paths."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def check_no_differences(where: Any, lines: list[str]) -> None:
    """Raise CheckpointError with the differences, if there are any; ``where`` is the file."""
    if lines:
        more = [f"and {len(lines) - MOST_DIFFERENCES} more"] if len(lines) > MOST_DIFFERENCES else []
        raise CheckpointError(f"{where}: does not fit: " + "; ".join(lines[:MOST_DIFFERENCES] + more))


def check_kinds(where: Any, meta: dict[str, Any], kinds: Mapping[str, Any]) -> None:
    """Raise CheckpointError unless the fields of a description are of these types; ``where`` is the file."""
    for name, kind in kinds.items():
        if not isinstance(meta.get(name), kind):
            raise CheckpointError(f"{where}: {name}: found {quote_value(meta.get(name))}")


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def as_named_arrays(tree: Any) -> Arrays:
    """Return the leaves of a tree by their dotted paths, bit for bit; random keys as their integers."""
    return {
        name: np.asarray(jax.random.key_data(leaf) if isinstance(leaf, jax.Array) and _is_key(leaf) else leaf)
        for name, leaf in by_dotted_name(tree).items()
    }


def from_named_arrays(where: Any, arrays: Arrays, target: Any) -> Any:
    """Return named arrays as the tree that ``target`` describes by its shapes and types.

    where: the file, for the message. Random keys are of JAX's default implementation.

    Raises:
        CheckpointError: leaves that are missing, superfluous, or of another shape or type.
    """

    def describe(array: Any) -> str:
        array = jax.eval_shape(jax.random.key_data, array) if _is_key(array) else array
        return f"{np.dtype(array.dtype)} of shape {array.shape}"

    leaves = by_dotted_name(target)
    found, expected = ({n: describe(leaf) for n, leaf in one.items()} for one in (arrays, leaves))
    check_no_differences(where, find_differences(found, expected, show=str))
    values = (jnp.asarray(arrays[name]) for name in leaves)
    restored = [
        jax.random.wrap_key_data(value) if _is_key(leaf) else value
        for value, leaf in zip(values, leaves.values(), strict=True)
    ]
    return jax.tree.unflatten(jax.tree.structure(target), restored)


def checksum(text: str, arrays: Arrays) -> str:
    """Return the SHA-256 of a description and named arrays, as hexadecimal digits."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype} {arrays[name].shape}".encode())
        digest.update(arrays[name].tobytes())
    return digest.hexdigest()


def save_checkpoint(
    path: str | Path, params: Any, config: Config, description: dict[str, Any], training: Arrays | None = None
) -> None:
    """Write a checkpoint atomically.

    description: JSON values; needs env_id, track, missed_gate and observation_size, may hold anything else.
    training: named arrays of what else training needs to continue; without, the file is a policy alone.

    Raises:
        OSError: the file cannot be written.
    """
    meta = {
        "format": FORMAT,
        "package_version": flytrack_env.__version__,
        "config": dataclasses.asdict(config),
        **description,
    }
    arrays = {POLICY + name: array for name, array in as_named_arrays(params).items()}
    arrays |= {TRAINING + name: array for name, array in (training or {}).items()}
    arrays = {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in arrays.items()}
    text = json.dumps(meta)
    write_atomically(path, safetensors.numpy.save(arrays, {"meta": text, "sha256": checksum(text, arrays)}))


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Return the checkpoint in a file.

    Raises:
        CheckpointError: missing or damaged file, another format, or parameters that do not belong to the
            network that the file describes.
    """
    path = Path(path)
    if path.is_dir():
        files = ", ".join(sorted(file.name for file in path.glob(f"*{SUFFIX}"))) or "there is none"
        raise CheckpointError(f"{path}: found a folder, expected a checkpoint file in it: {files}")
    try:
        return _build(path, *_read_file(path))
    except CheckpointError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: damaged description or parameters: {error_text(error)}") from error


def _read_file(path: Path) -> tuple[dict[str, Any], Arrays]:
    """Return the description and the arrays in a file, with the checksum verified."""
    if path.suffix == ".msgpack":
        raise CheckpointError(f"{path}: found the format of an earlier FlyTrack, expected .safetensors")
    try:
        content = read_at_most(path, LARGEST_BYTES)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error_text(error)}") from error
    try:
        size = int.from_bytes(content[:8], "little")
        if size > LARGEST_HEADER_BYTES:
            raise ValueError(f"found a header of {size} bytes, expected at most {LARGEST_HEADER_BYTES}")
        arrays = safetensors.numpy.load(content)
        header = json.loads(content[8 : 8 + size])["__metadata__"]
        if checksum(header["meta"], arrays) != header["sha256"]:
            raise ValueError("the checksum does not match the content")
        meta = json.loads(header["meta"])
        if not isinstance(meta, dict) or "format" not in meta:
            raise ValueError("found no description")
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: not a checkpoint, or damaged: {error_text(error)}") from error
    return meta, arrays


def _build(path: Path, meta: dict[str, Any], arrays: Arrays) -> Checkpoint:
    """Return the checkpoint of a file's description and arrays, checked against each other."""
    if meta["format"] != FORMAT:
        raise CheckpointError(f"{path}: format: found {quote_value(meta['format'])}, expected {FORMAT!r}")
    config = Config(**read_settings("config", meta["config"]))
    config.check()
    size = meta["observation_size"]
    if not all(type(width) is int and 1 <= width <= WIDEST for width in (size, *config.hidden_sizes)):
        raise CheckpointError(f"{path}: found a network of widths {quote_value((size, config.hidden_sizes))}")
    check_kinds(path, meta, dict.fromkeys(("env_id", "track", "missed_gate"), str))
    observation = jax.ShapeDtypeStruct((1, size), jnp.float32)
    target = jax.eval_shape(make_network(config).init, jax.random.key(0), observation)
    policy, training = (
        {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
        for prefix in (POLICY, TRAINING)
    )
    for name, array in policy.items():
        if not np.isfinite(array).all():
            raise CheckpointError(f"{path}: {quote_name(name)}: found values that are not finite")
    params = from_named_arrays(path, policy, target)
    return Checkpoint(params, config, meta["env_id"], meta["track"], size, meta, training or None, path)


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


def check_free(folder: Path, start: Checkpoint | None = None) -> None:
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


def check_same_run(checkpoint: Checkpoint, description: dict[str, Any]) -> None:
    """Raise CheckpointError, field by field, unless a checkpoint is of the run described."""
    found = {**checkpoint.meta, "config": as_json(dataclasses.asdict(checkpoint.config))}
    lines = _differences(found, description, MUST_FIT)
    more = _machine_differences(checkpoint, description) if lines else []
    check_no_differences(checkpoint.path, [*lines, *more])


def warn_of_other_machine(checkpoint: Checkpoint, description: dict[str, Any]) -> None:
    """Warn if software or machine differ from the checkpoint's: results may differ in the last bits."""
    lines = _machine_differences(checkpoint, description)
    if lines:
        logger.warning("%s: %s; continuing, perhaps not bit for bit", checkpoint.path, "; ".join(lines))


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


def restore_runner(start: Checkpoint, target: Runner) -> Runner:
    """Return the state of the training in a checkpoint; ``target``: its shapes and types."""
    rest = target._replace(train_state=target.train_state.replace(params=None))
    runner = from_named_arrays(start.path, start.training or {}, rest)
    return runner._replace(train_state=runner.train_state.replace(params=start.params))


def newest_intact(path: Path) -> Checkpoint:
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


def load_start(path: Path) -> Checkpoint:
    """Return a checkpoint that training can continue from.

    Raises:
        CheckpointError: a policy alone, or fields that are used before they are compared with the run.
    """
    start = load_checkpoint(path)
    if start.training is None:
        raise CheckpointError(f"{path}: found a policy alone, expected one with its training")
    check_kinds(path, start.meta, FIELDS)
    if start.steps not in range(0, start.config.total_timesteps + 1, start.config.batch_size):
        raise CheckpointError(f"{path}: steps: found {start.steps}")
    rewards = rewards_of(start)
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


def at_common_step(starts: list[Checkpoint | None]) -> list[Checkpoint | None]:
    """Return where seeds continue that trained side by side: at the last step that all have stored.

    A kill between their checkpoints leaves some ahead, and trained alone they would end in other bits.
    Seeds that did not train side by side stay where they are.
    """
    found = [start for start in starts if start is not None]
    steps = min((start.steps for start in found), default=math.inf)
    are_together = all(seeds_side_by_side(start) == len(starts) == len(found) for start in found)
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
