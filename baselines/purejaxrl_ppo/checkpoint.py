"""Checkpoints: network parameters and all that is needed to fly them, in one file."""

import dataclasses
import json
from pathlib import Path
from typing import Any, NamedTuple

import flax.serialization
import jax
import jax.numpy as jnp
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.networks import ActorCritic, make_network
from flytrack_env.files import write_atomically

FORMAT = "flytrack-ppo-1"


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; the message says what was found and what was expected."""


class Checkpoint(NamedTuple):
    """A trained policy.

    params: of the network. config: of the training. env_id, track: what it was trained on.
    observation_size: of its input. meta: the whole description as stored.
    """

    params: Any
    config: Config
    env_id: str
    track: str
    observation_size: int
    meta: dict[str, Any]

    @property
    def network(self) -> ActorCritic:
        """The network that the parameters belong to."""
        return make_network(self.config)

    def check_fits(self, env: Any) -> None:
        """Raise CheckpointError unless the policy's input is this environment's observation."""
        found = env.observation_space(env.default_params).shape
        if found != (self.observation_size,):
            raise CheckpointError(
                f"checkpoint: trained on observations of size {self.observation_size} "
                f"({self.env_id}), but the environment's have shape {found}"
            )


def save_checkpoint(path: str | Path, params: Any, config: Config, description: dict[str, Any]) -> None:
    """Write a checkpoint atomically.

    description: JSON values; needs env_id, track, missed_gate and observation_size, may hold anything else.
    """
    meta = {
        "format": FORMAT,
        "package_version": flytrack_env.__version__,
        "config": dataclasses.asdict(config),
        **description,
    }
    content = {"meta": json.dumps(meta), "params": flax.serialization.to_state_dict(params)}
    write_atomically(path, flax.serialization.msgpack_serialize(content))


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Return the checkpoint in a file.

    Raises:
        CheckpointError: missing or damaged file, another format, or parameters that do not belong to the
            network that the file describes.
    """
    path = Path(path)
    try:
        content = flax.serialization.msgpack_restore(path.read_bytes())
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error}") from error
    except Exception as error:  # msgpack raises what it likes on damaged bytes
        raise CheckpointError(f"{path}: not a checkpoint, or damaged: {error}") from error
    try:
        meta = json.loads(content["meta"])
        found_format = meta["format"]
    except (KeyError, IndexError, TypeError, AttributeError, json.JSONDecodeError) as error:
        raise CheckpointError(f"{path}: not a checkpoint: no description in it") from error
    if found_format != FORMAT:
        raise CheckpointError(f"{path}: format: found {found_format!r}, expected {FORMAT!r}")
    try:
        config = _config_from(meta["config"])
        size = int(meta["observation_size"])
        network = make_network(config)
        expected = jax.eval_shape(network.init, jax.random.key(0), jnp.zeros((1, size)))
        params = flax.serialization.from_state_dict(expected, content["params"])
        _check_shapes(path, expected, params)
        for name in ("env_id", "track", "missed_gate"):
            if not isinstance(meta[name], str):
                raise CheckpointError(f"{path}: {name}: found {meta[name]!r}, expected a string")
        return Checkpoint(params, config, meta["env_id"], meta["track"], size, meta)
    except CheckpointError:
        raise
    except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
        raise CheckpointError(f"{path}: damaged description or parameters: {error}") from error


def _config_from(values: dict[str, Any]) -> Config:
    """Return the configuration of a JSON object; tuples come back from lists."""
    return Config(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


def _check_shapes(path: Path, expected: Any, params: Any) -> None:
    """Raise CheckpointError where an array is not of the network's shape or not finite."""
    found_leaves = jax.tree_util.tree_leaves_with_path(params)
    for (where, leaf), wanted in zip(found_leaves, jax.tree.leaves(expected), strict=True):
        name = jax.tree_util.keystr(where)
        if np.shape(leaf) != wanted.shape:
            raise CheckpointError(f"{path}: {name}: found shape {np.shape(leaf)}, expected {wanted.shape}")
        if not np.isfinite(leaf).all():
            raise CheckpointError(f"{path}: {name}: found values that are not finite")
