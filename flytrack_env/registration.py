"""The table of environment ids, and their registration with gymnax."""

from functools import partial
from typing import Any

import gymnax
from gymnax.registration import registered_envs

from flytrack_env.env import FlyTrack

# An id is a set of base arguments; variants with wrappers are rows of the same table.
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    "FlyTrack-v0": {},
}


def make(env_id: str, **overrides: Any) -> FlyTrack:
    """Return the environment of an id; ``overrides`` are arguments of ``FlyTrack``.

    Raises:
        ValueError: unknown id.
    """
    if env_id not in ENVIRONMENTS:
        raise ValueError(f"env_id: found {env_id!r}, expected one of {', '.join(ENVIRONMENTS)}")
    return FlyTrack(**{**ENVIRONMENTS[env_id], **overrides})


def register_all() -> None:
    """Register every id with gymnax; ids that are registered already are left alone."""
    for env_id in ENVIRONMENTS:
        if env_id not in registered_envs:
            gymnax.register(env_id, partial(make, env_id))
