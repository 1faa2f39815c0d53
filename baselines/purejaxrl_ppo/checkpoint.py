"""Checkpoints: network parameters, all that is needed to fly them, and all that training needs to go on."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import flax.serialization
import jax
import jax.numpy as jnp
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo.config import Config, config_from_json
from baselines.purejaxrl_ppo.named_arrays import as_named_arrays, find_misfits, from_named_arrays
from baselines.purejaxrl_ppo.networks import ActorCritic, make_network
from baselines.purejaxrl_ppo.unpack import LARGEST_BYTES, UnpackError, unpack
from flytrack_env.files import read_at_most, write_atomically
from flytrack_env.messages import error_text, quote_name, quote_value

FORMAT = "flytrack-ppo-2"
FORMAT_WITHOUT_TRAINING = "flytrack-ppo-1"  # of before there was a checksum and a state of the training
LONGEST_META = 2**22  # characters: a track of ten thousand gates
ROOM_BYTES = 2**10  # of the checksum and what is around the content
MOST_LAYERS, WIDEST = 64, 2**16  # of networks
MOST_DIFFERENCES = 12  # as many as can be read in a terminal


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; the message says what was found and what was expected."""


class Checkpoint(NamedTuple):
    """A trained policy, and perhaps its training.

    params: of the network. config: of the training. env_id, track: what it was trained on.
    observation_size: of its input. meta: the whole description as stored. training: named arrays of the
    rest of the training's state (optimiser, environments, random keys); None in a policy alone.
    """

    params: Any
    config: Config
    env_id: str
    track: str
    observation_size: int
    meta: dict[str, Any]
    training: dict[str, np.ndarray] | None = None

    @property
    def network(self) -> ActorCritic:
        """The network that the parameters belong to."""
        return make_network(self.config)

    def check_fits(self, env: Any) -> None:
        """Raise CheckpointError unless the policy's input is this environment's observation, row by row."""
        found = env.observation_space(env.default_params).shape
        if found != (self.observation_size,):
            raise CheckpointError(
                f"checkpoint: trained on observations of size {self.observation_size} "
                f"({self.env_id}), but the environment's have shape {found}"
            )
        if "observation" in self.meta:
            lines = find_differences(self.meta["observation"], observation_layout(env), "observation")
            check_none("checkpoint", lines)


def observation_layout(env: Any) -> dict[str, Any]:
    """Return an environment's observation as JSON values: each row's meaning, frame, unit, scale, limit."""
    return as_json({f"row {i} ({e.key})": e._asdict() for i, e in enumerate(env.observation_table)})


def as_json(value: Any) -> Any:
    """Return values as they come back from JSON: lists for tuples."""
    return json.loads(json.dumps(value))


def find_differences(found: Any, expected: Any, where: str) -> list[str]:
    """Return, field by field, where JSON values differ; ``where`` is their name."""
    if isinstance(found, dict) and isinstance(expected, dict):
        names = {**expected, **found}
        return [
            line
            for name in names
            for line in find_differences(found.get(name), expected.get(name), f"{where}.{quote_name(name)}")
        ]
    if isinstance(found, list) and isinstance(expected, list) and len(found) == len(expected):
        pairs = enumerate(zip(found, expected, strict=True))
        return [line for i, (one, other) in pairs for line in find_differences(one, other, f"{where}[{i}]")]
    if found == expected:
        return []
    return [f"{where}: found {_show(found)}, expected {_show(expected)}"]


def _show(value: Any) -> str:
    return "nothing" if value is None else quote_value(value)


def check_none(where: Any, lines: list[str]) -> None:
    """Raise CheckpointError with the differences, if there are any; ``where`` is the file."""
    if lines:
        more = [f"and {len(lines) - MOST_DIFFERENCES} more"] if len(lines) > MOST_DIFFERENCES else []
        raise CheckpointError(f"{where}: does not fit: " + "; ".join(lines[:MOST_DIFFERENCES] + more))


def save_checkpoint(
    path: str | Path,
    params: Any,
    config: Config,
    description: dict[str, Any],
    training: dict[str, np.ndarray] | None = None,
) -> None:
    """Write a checkpoint atomically, with a checksum of its content.

    description: JSON values; needs env_id, track, missed_gate and observation_size, may hold anything else.
    training: named arrays of what else training needs to go on; without, the file is a policy alone.

    Raises:
        CheckpointError: a network that is larger than ``load_checkpoint`` takes.
        OSError: what the system says.
    """
    _check_size(Path(path), config, description["observation_size"])
    meta = {
        "format": FORMAT,
        "package_version": flytrack_env.__version__,
        "config": dataclasses.asdict(config),
        **description,
    }
    parts = {"meta": json.dumps(meta), "params": flax.serialization.to_state_dict(params)}
    if training is not None:
        parts["training"] = training
    content = flax.serialization.msgpack_serialize(parts)
    if len(content) > LARGEST_BYTES - ROOM_BYTES:
        raise CheckpointError(
            f"{path}: found {len(content)} bytes to write, expected at most {LARGEST_BYTES}"
        )
    whole = {"checksum": hashlib.sha256(content).hexdigest(), "content": content}
    write_atomically(path, flax.serialization.msgpack_serialize(whole))


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Return the checkpoint in a file.

    Raises:
        CheckpointError: missing or damaged file, another format, or parameters that do not belong to the
            network that the file describes.
    """
    path = Path(path)
    content = _read_content(path)
    meta = _read_meta(path, content)
    if meta["format"] not in (FORMAT, FORMAT_WITHOUT_TRAINING):
        raise CheckpointError(f"{path}: format: found {quote_value(meta['format'])}, expected {FORMAT!r}")
    try:
        return _read_parts(path, meta, content)
    except CheckpointError:
        raise
    except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
        raise CheckpointError(f"{path}: damaged description or parameters: {error_text(error)}") from error


def _read_content(path: Path) -> Any:
    """Return what is in a file, its checksum compared."""
    try:
        whole = unpack(read_at_most(path, LARGEST_BYTES))
        if not isinstance(whole, dict) or "checksum" not in whole:
            return whole
        content = whole.get("content")
        if not isinstance(content, bytes):
            raise UnpackError("found a checksum of nothing")
        found = hashlib.sha256(content).hexdigest()
        if found.encode() != whole["checksum"]:
            expected = quote_value(_as_text(whole["checksum"]))
            raise CheckpointError(
                f"{path}: damaged: found content with checksum {found}, expected {expected}"
            )
        return unpack(content)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error_text(error)}") from error
    except UnpackError as error:
        raise CheckpointError(f"{path}: not a checkpoint, or damaged: {error_text(error)}") from error


def _as_text(value: Any) -> Any:
    return value.decode(errors="replace") if isinstance(value, bytes) else value


def _read_meta(path: Path, content: Any) -> dict[str, Any]:
    """Return the description in a file's content, which says what format it is of."""
    text = content.get("meta") if isinstance(content, dict) else None
    try:
        meta = json.loads(text.decode()) if isinstance(text, bytes) and len(text) <= LONGEST_META else None
    except (ValueError, RecursionError) as error:
        raise CheckpointError(
            f"{path}: not a checkpoint: no description in it: {error_text(error)}"
        ) from error
    if not isinstance(meta, dict) or "format" not in meta:
        raise CheckpointError(f"{path}: not a checkpoint: no description in it")
    return meta


def _check_size(path: Path, config: Config, size: Any) -> None:
    """Raise CheckpointError for a network that is none, or larger than any of ours: it is traced below."""
    widths = (size, len(config.initial_action), *config.hidden_sizes)
    if not all(type(width) is int and 1 <= width <= WIDEST for width in widths) or len(widths) > MOST_LAYERS:
        found = f"observation_size {quote_value(size)} and hidden_sizes {quote_value(config.hidden_sizes)}"
        raise CheckpointError(
            f"{path}: found {found}, expected at most {MOST_LAYERS} layers, 1 to {WIDEST} wide"
        )


def _read_parts(path: Path, meta: dict[str, Any], content: dict[str, Any]) -> Checkpoint:
    """Return the checkpoint of a file's description and arrays, checked against each other."""
    config = config_from_json(meta["config"])
    config.check()
    size = meta["observation_size"]
    _check_size(path, config, size)
    for name in ("env_id", "track", "missed_gate"):
        if not isinstance(meta[name], str):
            raise CheckpointError(f"{path}: {name}: found {quote_value(meta[name])}, expected a string")
    observation = jax.ShapeDtypeStruct((1, size), jnp.float32)
    expected = jax.eval_shape(make_network(config).init, jax.random.key(0), observation)
    arrays = as_named_arrays(content["params"])
    check_none(path, find_misfits(arrays, expected))
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise CheckpointError(f"{path}: {name}: found values that are not finite")
    training = content.get("training")
    is_tree = isinstance(training, dict) and all(isinstance(one, np.ndarray) for one in training.values())
    if not (training is None or is_tree):
        raise CheckpointError(f"{path}: training: found something else than arrays")
    params = from_named_arrays(arrays, expected)
    return Checkpoint(params, config, meta["env_id"], meta["track"], size, meta, training)
