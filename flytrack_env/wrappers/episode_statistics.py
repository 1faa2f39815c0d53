"""Return and length of the episode so far, in ``info``."""

from typing import Any

import jax
import jax.numpy as jnp

from flytrack_env.params import EnvParams
from flytrack_env.state import Action, Drone
from flytrack_env.wrappers.base import Wrapped, Wrapper


class EpisodeStatistics(Wrapper):
    """Add ``episode_return`` and ``episode_length`` to info, this step included.

    Of a whole episode where it is ``terminated`` or ``truncated``; nothing is carried into the next one.
    """

    key = "episode_statistics"

    def begin(self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0) -> Wrapped:
        """Return the state of an episode that begins, with nothing counted."""
        inner = self.env.begin(drone, gate_index, params, seed)
        return Wrapped(inner, {"episode_return": jnp.float32(0.0), "episode_length": jnp.int32(0)})

    def advance(
        self, state: Wrapped, command: Action, params: EnvParams
    ) -> tuple[Wrapped, jax.Array, jax.Array, dict[str, Any]]:
        """Return the outcome of the inner environment, counted."""
        inner, reward, terminated, info = self.env.advance(state.inner, command, params)
        steps = {"episode_return": reward, "episode_length": 1}
        counted = {name: state.own[name] + step for name, step in steps.items()}
        return Wrapped(inner, counted), reward, terminated, {**info, **counted}
