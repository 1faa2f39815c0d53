"""The environment that a checkpoint races in: its id and track, with any plant or its own model."""

from pathlib import Path
from typing import Any

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import Checkpoint, CheckpointError
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.model_file import model_from_json
from flytrack_env.params import EnvParams
from flytrack_env.plants import Plant
from flytrack_env.tracks import Track
from flytrack_env.wrappers import DomainRandomization, RandomizationParams

MODEL_AS_GIVEN = RandomizationParams(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, low=(), high=())  # all factors are 1


def plant_env(
    checkpoint: Checkpoint, plant: Plant, track: str | Path | Track | None = None
) -> EpisodicEnvironment:
    """Return the checkpoint's environment with a plant (a black box, say) in place of the simulator.

    track: name or file; the checkpoint's if None.

    Raises:
        CheckpointError, TrackError: a checkpoint that does not fit, a track that cannot be used.
    """
    return _checked_env(checkpoint, track, plant=plant)


def simulated_env(checkpoint: Checkpoint, track: str | Path | Track | None = None) -> EpisodicEnvironment:
    """Return the checkpoint's environment with the simulator and the model that it was trained on.

    Raises:
        CheckpointError, TrackError: a file that cannot be used, a checkpoint that does not hold its model.
    """
    if "model" not in checkpoint.meta:
        raise CheckpointError("checkpoint: model: found none, expected the one it was trained on")
    return _checked_env(
        checkpoint, track, model=model_from_json(checkpoint.meta["model"], "checkpoint: model")
    )


def _checked_env(
    checkpoint: Checkpoint, track: str | Path | Track | None, **arguments: Any
) -> EpisodicEnvironment:
    env = flytrack_env.make(
        checkpoint.env_id,
        track=checkpoint.track if track is None else track,
        missed_gate=checkpoint.meta["missed_gate"],
        **arguments,
    )
    checkpoint.check_fits(env)
    env.check_params(env.default_params)
    return env


def with_model_as_given(params: EnvParams) -> EnvParams:
    """Return parameters with which an id that randomises the model in every episode keeps the given one."""
    if DomainRandomization.key not in params.wrappers:
        return params
    return params.replace(wrappers={**params.wrappers, DomainRandomization.key: MODEL_AS_GIVEN})
