"""Policies: a checkpoint of the baseline, or a function or object of the user's own module."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import flytrack_env
from baselines.purejaxrl_ppo import Checkpoint, load_checkpoint
from baselines.purejaxrl_ppo.checkpoint_env import plant_env
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.extras import import_object
from flytrack_env.plants import Plant
from flytrack_env.state import ACTION_SIZE
from flytrack_env.tracks import Track

ENV_ID = "FlyTrack-v0"  # whose observation a function is given


class PolicyError(ValueError):
    """A policy that cannot be used; the message says what was found and what was expected."""


@dataclass(frozen=True)
class Function:
    """A policy without memory: a function of the observation, (29,), that returns sticks, (4,)."""

    function: Any

    def first_memory(self) -> tuple[()]:
        """Return what is remembered at the start of an episode: nothing."""
        return ()

    def act(self, params: Any, memory: Any, observation: jax.Array) -> tuple[Any, jax.Array]:
        """Return the memory after a step, and the action, in [-1, 1]."""
        return memory, jnp.clip(self.function(observation), -1.0, 1.0)


class Policy(NamedTuple):
    """What flies.

    Attributes:
        network: has ``first_memory()`` and ``act(params, memory, observation)``, which returns the
            next memory and sticks.
        checkpoint: where it comes from one.
        sha256: of its file; empty without one.
    """

    name: str
    network: Any
    params: Any
    checkpoint: Checkpoint | None
    sha256: str

    def env(self, plant: Plant, track: Track) -> EpisodicEnvironment:
        """Return the environment that it observes, with a plant on a track."""
        if self.checkpoint is not None:
            return plant_env(self.checkpoint, plant, track)
        return flytrack_env.make(ENV_ID, track=track, plant=plant)

    def training(self) -> dict[str, Any]:
        """Return the steps and the seconds of its training, where the checkpoint says them."""
        meta = {} if self.checkpoint is None else self.checkpoint.meta
        return {"steps": meta.get("steps"), "seconds": meta.get("seconds")}


def policy_of(checkpoint: Checkpoint, name: str, sha256: str = "") -> Policy:
    """Return the policy in a checkpoint."""
    return Policy(name, checkpoint.network, checkpoint.params, checkpoint, sha256)


def load_policy(where: str) -> Policy:
    """Return the policy that a checkpoint's path or name, or ``module:name``, names.

    The name is that of a function of the observation, or of an object as in ``Policy.network``.

    Raises: PolicyError: nothing of that name, or something that returns no four sticks.
            CheckpointError: a file that is no checkpoint.
    """
    if ":" not in where or Path(where).exists():
        checkpoint = load_checkpoint(where)
        digest = hashlib.sha256(checkpoint.path.read_bytes()).hexdigest()
        return policy_of(checkpoint, Path(where).name, digest)
    found = import_object(where, "policy", PolicyError)
    network = found if hasattr(found, "act") else Function(found)
    space = flytrack_env.FlyTrack().observation_space()
    try:
        action = jax.eval_shape(
            lambda observation: network.act(None, network.first_memory(), observation)[1],
            jax.ShapeDtypeStruct(space.shape, jnp.float32),
        )
    except Exception as error:  # whatever a user's function raises
        raise PolicyError(f"policy: {where}: {type(error).__name__}: {error}") from error
    if action.shape != (ACTION_SIZE,):
        raise PolicyError(
            f"policy: {where}: found an action of shape {action.shape}, expected (4,)"
        )
    return Policy(where, network, None, None, "")
