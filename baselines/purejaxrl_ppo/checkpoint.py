"""Checkpoints: a policy, all that is needed to fly it and, in a run, the state of its training.

A checkpoint is a safetensors file: arrays named ``policy.*`` and ``training.*``, and in the header
a JSON description and a SHA-256 checksum of description and arrays. Nothing in it is executed.
"""

import dataclasses
import hashlib
import json
import logging
import os
import re
import sys
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import safetensors.numpy

import flytrack_env
from baselines.purejaxrl_ppo.config import Config, Width, read_config
from baselines.purejaxrl_ppo.networks import ActorCritic, Policy, make_network
from baselines.purejaxrl_ppo.ppo import Runner
from flytrack_env.effects import BY_NAME, takes_motors
from flytrack_env.files import read_at_most, write_atomically
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_env.model_file import model_as_json
from flytrack_env.motion import OLD_EULER, Motion
from flytrack_env.validation import convert

SUFFIX = ".safetensors"
FORMAT = "flytrack-ppo-3"
POLICY, TRAINING = "policy.", "training."  # prefixes of the arrays' names
MAX_BYTES = 3 * 2**27
MAX_HEADER_BYTES = 2**23  # the description of a track of ten thousand gates
MAX_DIFFERENCES = 12  # in one message

FINAL = f"final{SUFFIX}"
# Names of the shipped policies, which docs/results/champion.md and camera.md describe.
SHIPPED = {
    name: Path(__file__).parent / "champion" / f"{stem}{SUFFIX}"
    for name, stem in (("champion", "flytrack"), ("robust", "robust"), ("corners", "corners"))
}
STEP_FILE = re.compile(rf"step_(\d+)\{SUFFIX}")
REWARD = "reward."  # prefix of the reward's weights among the environment's parameters
# What a run that continues must have in common with its checkpoint, beside its configuration.
SAME_RUN = ("env_id", "seed", "missed_gate", "observation", "track_data", "model", "environment")
WORDING = (
    "name",
    "unit",
)  # fields of a row of an observation that are for people, and may be reworded

Arrays = dict[str, np.ndarray]
logger = logging.getLogger(__name__)


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; the message says what was found and what was expected."""


class _Description(msgspec.Struct):
    """What every checkpoint says."""

    format: str
    env_id: str
    track: str
    missed_gate: str
    observation_size: Width
    image_shape: tuple[Width, Width, Width] | None = None


class _Progress(msgspec.Struct):
    """Fields that the checkpoint of a run adds, used before it is compared with the run."""

    steps: Annotated[int, msgspec.Meta(ge=0)]
    seed: int
    seconds: float
    model: dict[str, Any]
    environment: dict[str, Any]


class Checkpoint(NamedTuple):
    """A trained policy and, in a run, the state of its training.

    Attributes:
        params: of the network.
        config: of the training.
        env_id: what it was trained on.
        track: what it was trained on, a name or the path of a file.
        observation_size: of the network's input.
        meta: the whole description as stored.
        training: named arrays of the rest of the training's state (optimizer, environments, random
            keys); None for a policy alone.
        path: of its file.
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
        return make_network(self.config, sees_image=self.meta.get("image_shape") is not None)

    @property
    def policy(self) -> Policy:
        """What flies."""
        return Policy(self.network, self.params)

    def check_fits(self, env: Any) -> None:
        """Raise CheckpointError unless the policy's input is the observation, row by row.

        What it commands, sticks or motors, must be what the environment's model takes, too.
        """
        shape = env.observation_space(env.default_params).shape
        if shape != tuple(self.meta.get("image_shape") or (self.observation_size,)):
            raise CheckpointError(
                f"checkpoint: trained on observations of size {self.observation_size} "
                f"({self.env_id}), but the environment's have shape {shape}"
            )
        if "observation" in self.meta:
            layouts = (self.meta["observation"], observation_layout(env))
            check_equal("checkpoint: observation", *map(_without_wording, layouts))
        if "model" in self.meta:  # by names alone, so that files of other versions still fly
            names = dict(self.meta["model"]).get("effects", {})
            commands_motors = any(BY_NAME[name].takes_motors for name in names if name in BY_NAME)
            takes = commands_motors, takes_motors(env.default_params.model.effects)
            trained, flown = ("motors" if of_motors else "sticks" for of_motors in takes)
            if trained != flown:
                raise CheckpointError(
                    f"checkpoint: found a policy that commands {trained} ({self.env_id}), expected "
                    f"one that commands {flown}, as the environment's model takes"
                )


def observation_layout(env: Any) -> dict[str, Any]:
    """Return the layout of an environment's observation as JSON values.

    Each row has its meaning, frame, unit, scale and limit.
    """
    rows = {f"row {i} ({e.key})": e._asdict() for i, e in enumerate(env.observation_table)}
    return dict(json.loads(json.dumps(rows)))


def _without_wording(layout: Any) -> dict[str, Any]:
    """Return the leaves of an observation's layout by their names, without those for people."""
    leaves = flatten(layout).items()
    return {name: value for name, value in leaves if name.rpartition(".")[2] not in WORDING}


def flatten(tree: Any) -> dict[str, Any]:
    """Return the leaves of JSON values or of another tree by their dotted paths."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def find_differences(found: Any, expected: Any) -> list[str]:
    """Return a line for each leaf of two trees that differs, the shallowest first."""
    found, expected, lines = flatten(found), flatten(expected), []
    for name in sorted({**expected, **found}, key=lambda name: name.count(".")):
        if found.get(name) != expected.get(name):
            values = (
                quote_value(tree[name]) if name in tree else "nothing" for tree in (found, expected)
            )
            lines.append("{}: found {}, expected {}".format(quote_name(name), *values))
    return lines


def check_equal(where: Any, found: Any, expected: Any) -> None:
    """Raise CheckpointError with the differences of two trees; ``where`` is the file."""
    lines = find_differences(found, expected)
    if len(lines) > MAX_DIFFERENCES:
        lines[MAX_DIFFERENCES:] = [f"and {len(lines) - MAX_DIFFERENCES} more"]
    if lines:
        raise CheckpointError(f"{where}: does not fit: " + "; ".join(lines))


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def as_named_arrays(tree: Any) -> Arrays:
    """Return a tree's leaves by dotted path, bit for bit; random keys become integers."""
    return {
        name: np.asarray(
            jax.random.key_data(leaf) if isinstance(leaf, jax.Array) and _is_key(leaf) else leaf
        )
        for name, leaf in flatten(tree).items()
    }


def from_named_arrays(where: Any, arrays: Arrays, target: Any) -> Any:
    """Return named arrays as a tree.

    Args:
        where: the file, for the message.
        arrays: as ``as_named_arrays`` returns them; random keys are of JAX's default
            implementation.
        target: the tree, of shapes and types.

    Raises:
        CheckpointError: leaves that are missing, superfluous, or of another shape or type.
    """
    leaves = flatten(target)

    def describe(array: Any) -> str:
        array = jax.eval_shape(jax.random.key_data, array) if _is_key(array) else array
        return f"{np.dtype(array.dtype)} of shape {array.shape}"

    found, expected = (
        {name: describe(leaf) for name, leaf in tree.items()} for tree in (arrays, leaves)
    )
    check_equal(where, found, expected)
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
    path: str | Path,
    params: Any,
    config: Config,
    description: dict[str, Any],
    training: Arrays | None = None,
) -> None:
    """Write a checkpoint atomically.

    Args:
        path: of the file.
        params: of the network.
        config: of the training.
        description: JSON values; needs env_id, track, missed_gate and observation_size, may hold
            more.
        training: named arrays of what else training needs to continue; None: the file is a policy
            alone.

    Raises:
        OSError: the file cannot be written.
    """
    meta = {"format": FORMAT, "package_version": flytrack_env.__version__, **description}
    text = json.dumps({**meta, "config": config.as_json()})
    arrays = {POLICY + name: array for name, array in as_named_arrays(params).items()}
    arrays |= {TRAINING + name: array for name, array in (training or {}).items()}
    arrays = {
        name: np.ascontiguousarray(array).reshape(array.shape) for name, array in arrays.items()
    }
    write_atomically(
        path, safetensors.numpy.save(arrays, {"meta": text, "sha256": checksum(text, arrays)})
    )


def save_run(path: Path, runner: Runner, config: Config, description: dict[str, Any]) -> None:
    """Write a checkpoint that training can continue from, atomically."""
    state = runner.train_state
    rest = runner._replace(train_state=state.replace(params=None))
    save_checkpoint(path, state.params, config, description, as_named_arrays(rest))


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Return the checkpoint in a file, or a shipped one by its name, a key of ``SHIPPED``.

    A file of such a name comes first.

    Raises:
        CheckpointError: missing or damaged file, another format, or parameters that do not belong
            to the network that the file describes.
    """
    path = Path(path)
    if not path.is_file():
        path = SHIPPED.get(str(path), path)
    if path.is_dir():
        files = ", ".join(sorted(file.name for file in path.glob(f"*{SUFFIX}"))) or "there is none"
        raise CheckpointError(f"{path}: found a folder, expected a checkpoint file in it: {files}")
    try:
        content = read_at_most(path, MAX_BYTES)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error_text(error)}") from error
    try:
        return _decode(path, content)
    except CheckpointError:
        raise
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(
            f"{path}: not a checkpoint, or damaged: {error_text(error)}"
        ) from error


def _decode(path: Path, content: bytes) -> Checkpoint:
    """Return the checkpoint of a file's content, its parts checked against each other."""
    size = int.from_bytes(content[:8], "little")
    if size > MAX_HEADER_BYTES:
        raise ValueError(f"found a header of {size} bytes, expected at most {MAX_HEADER_BYTES}")
    arrays = safetensors.numpy.load(content)
    header = json.loads(content[8 : 8 + size])["__metadata__"]
    if checksum(header["meta"], arrays) != header["sha256"]:
        raise ValueError("the checksum does not match the content")
    meta = json.loads(header["meta"])
    description = convert("", meta, _Description)
    if description.format != FORMAT:
        raise ValueError(f"format: found {quote_value(description.format)}, expected {FORMAT!r}")
    config = read_config("config", meta["config"]).check()
    image = description.image_shape
    network = make_network(config, sees_image=image is not None)
    size = description.observation_size + network.num_state_rows
    observation = jax.ShapeDtypeStruct(
        (1, *(image or (size,))), jnp.uint8 if image else jnp.float32
    )
    # Of the precision it was trained in, whatever that of this process.
    is_double = any(array.dtype == np.float64 for array in arrays.values())
    with jax.enable_x64(is_double):
        target = jax.eval_shape(network.init, jax.random.key(0), observation)
    policy, training = (
        {
            name.removeprefix(prefix): array
            for name, array in arrays.items()
            if name.startswith(prefix)
        }
        for prefix in (POLICY, TRAINING)
    )
    for name, array in policy.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{quote_name(name)}: found values that are not finite")
    return Checkpoint(
        params=from_named_arrays(path, policy, target),
        config=config,
        env_id=description.env_id,
        track=description.track,
        observation_size=description.observation_size,
        meta=meta,
        training=training or None,
        path=path,
    )


def step_file(steps: int) -> str:
    """Return the name of the checkpoint after a number of environment steps."""
    return f"step_{steps}{SUFFIX}"


def checkpoints_in(folder: Path) -> list[Path]:
    """Return the checkpoints in a folder, newest first.

    The final one is the newest; the others are ordered by the steps in their names.
    """
    steps = {folder / FINAL: sys.maxsize} if (folder / FINAL).exists() else {}
    for path in folder.glob(f"step_*{SUFFIX}"):
        if match := STEP_FILE.fullmatch(path.name):
            steps[path] = int(match[1])
    return sorted(steps, key=lambda path: steps[path], reverse=True)


def describe_run(env: Any, env_id: str, track: str, config: Config, seed: int) -> dict[str, Any]:
    """Return the description of a run, as JSON values, that its checkpoints hold.

    Args:
        env: that is trained on.
        env_id: its id.
        track: name or path; gates and bounds are under ``track_data``.
        config: of the training.
        seed: of the training.

    Returns: ``environment`` holds rewards, starts, time step and wrappers by their paths.
        ``machine`` holds what decides the last bits of a result: XLA splits sums by the number of
        its threads.
    """
    params = env.default_params
    others = as_named_arrays(params.replace(model=None, course=None))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    description = {
        "env_id": env_id,
        "track": track,
        "track_data": dataclasses.asdict(env.track),
        "missed_gate": env.missed_gate,
        "observation_size": int(env.observation_space().shape[0]),
        "image_shape": env.image_shape,
        "observation": observation_layout(env),
        "seed": seed,
        "model": model_as_json(params.model),
        "environment": {name: values.tolist() for name, values in others.items()},
        "config": config.as_json(),
        "software": {"jax": jax.__version__},
        "machine": {
            "backend": jax.default_backend(),
            "devices": jax.device_count(),
            "threads": cores,
            "NPROC": os.environ.get("NPROC"),
        },
    }
    return dict(json.loads(json.dumps(description)))  # lists for tuples


def check_same_run(start: Checkpoint, description: dict[str, Any]) -> None:
    """Check that a run can continue from a checkpoint; warn where that is not bit for bit.

    The length may differ: a longer ``total_timesteps`` extends the run.

    Raises:
        CheckpointError: it is of another run, field by field.
    """
    config = {**start.config.as_json(), "total_timesteps": description["config"]["total_timesteps"]}
    found = {"config": config, **{name: start.meta.get(name) for name in SAME_RUN}}
    if isinstance(found["model"], dict) and found["model"].get("motion") == OLD_EULER:
        found["model"] = {**found["model"], "motion": Motion.EULER.value}
    check_equal(start.path, found, {name: description[name] for name in found})
    names = ("software", "machine")
    lines = find_differences(
        *({name: tree.get(name) for name in names} for tree in (start.meta, description))
    )
    if lines:
        logger.warning("%s: %s; continuing, perhaps not bit for bit", start.path, "; ".join(lines))


def restore_runner(start: Checkpoint, target: Runner) -> Runner:
    """Return the state of the training in a checkpoint; ``target``: its shapes and types."""
    rest = target._replace(train_state=target.train_state.replace(params=None))
    runner = from_named_arrays(start.path, start.training or {}, rest)
    return runner._replace(train_state=runner.train_state.replace(params=start.params))


def newest_intact(path: Path) -> Checkpoint:
    """Return the checkpoint in a file, or the newest intact one in a folder, to continue from.

    Raises: CheckpointError: a file that cannot be used, a folder without an intact one, or a policy
        alone.
    """
    candidates = checkpoints_in(path) if path.is_dir() else [path]
    if not candidates:
        raise CheckpointError(f"{path}: found no checkpoint, expected {FINAL} or step_<N>{SUFFIX}")
    *newer, oldest = candidates
    for candidate in newer:
        try:
            return _load_start(candidate)
        except CheckpointError as error:
            logger.warning("%s; the checkpoint before it is used", error)
    return _load_start(oldest)


def _load_start(path: Path) -> Checkpoint:
    """Return a checkpoint that training can continue from.

    Raises: CheckpointError: a policy alone, or fields that are used before they are compared with
        the run.
    """
    start = load_checkpoint(path)
    if start.training is None:
        raise CheckpointError(f"{path}: found a policy alone, expected one with its training")
    try:
        convert(str(path), start.meta, _Progress)
        for name, weight in rewards_of(start).items():
            convert(f"{path}: environment: {name}", weight, float)
    except ValueError as error:
        raise CheckpointError(str(error)) from error
    if start.steps % start.config.batch_size:
        raise CheckpointError(f"{path}: steps: found {start.steps}, expected whole updates")
    return start


def rewards_of(checkpoint: Checkpoint) -> dict[str, float]:
    """Return the weights of the reward terms that a checkpoint was trained with."""
    values = checkpoint.meta["environment"].items()
    return {name.removeprefix(REWARD): value for name, value in values if name.startswith(REWARD)}
