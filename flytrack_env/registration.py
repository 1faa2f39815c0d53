"""The table of environment ids, and their registration with gymnax."""

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import gymnax
from gymnax.registration import registered_envs

from flytrack_env.env import FlyTrack
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.messages import check_keywords
from flytrack_env.wrappers import ActionHistory, DomainRandomization, ObservationNoise


class Variant(NamedTuple):
    """One id: what it is, the base arguments of ``FlyTrack``, and the wrappers, innermost first."""

    summary: str
    arguments: Mapping[str, Any] = {}
    wrappers: tuple[Callable[[EpisodicEnvironment], EpisodicEnvironment], ...] = ()


ARGUMENTS = tuple(inspect.signature(FlyTrack).parameters)  # of make, by name
HISTORY = partial(ActionHistory, length=3)

ENVIRONMENTS: dict[str, Variant] = {
    "FlyTrack-v0": Variant("The race with perfect sensors and one known drone."),
    "FlyTrackNoisy-v0": Variant("The race seen through noisy sensors.", wrappers=(ObservationNoise,)),
    "FlyTrackActionHistory-v0": Variant(
        "The race with the last three commands in the observation.", wrappers=(HISTORY,)
    ),
    "FlyTrackRandomized-v0": Variant(
        "The race with another drone, and other air, in every episode.", wrappers=(DomainRandomization,)
    ),
    "FlyTrackRobust-v0": Variant(
        "All of it: another drone in every episode, noisy sensors, the last three commands.",
        wrappers=(DomainRandomization, ObservationNoise, HISTORY),
    ),
}


def make(env_id: str, **overrides: Any) -> EpisodicEnvironment:
    """Return the environment of an id; ``overrides`` are arguments of ``FlyTrack``.

    With a plant that has its parameters baked in (a black box), ids that randomise the model fly that plant
    as it is, with the same observation: what was trained on the id can be flown on the plant.

    Raises:
        ValueError: unknown id.
        TypeError: unknown argument.
    """
    if env_id not in ENVIRONMENTS:
        raise ValueError(f"env_id: found {env_id!r}, expected one of {', '.join(ENVIRONMENTS)}")
    check_keywords(overrides, ARGUMENTS)
    variant = ENVIRONMENTS[env_id]
    env: EpisodicEnvironment = FlyTrack(**{**variant.arguments, **overrides})
    for wrapper in variant.wrappers:
        if wrapper is DomainRandomization and env.plant.dt is not None:
            continue
        env = wrapper(env)
    env.env_id = env_id
    return env


def register_all() -> None:
    """Register every id with gymnax; ids that are registered already are left alone."""
    for env_id in ENVIRONMENTS:
        if env_id not in registered_envs:
            gymnax.register(env_id, partial(make, env_id))
