"""Gymnasium environments of the tests."""

from typing import Any

import gymnasium

BASE = "FlyTrack-v0"


def make_vector(env_id: str = BASE, num_envs: int = 3, **arguments: Any) -> Any:
    """Return the vector environment of an id."""
    return gymnasium.make_vec(env_id, num_envs=num_envs, vectorization_mode="vector_entry_point", **arguments)
