"""Return and length of the episode so far, in ``info``."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.params import EnvParams
from flytrack_env.state import Action, Drone
from flytrack_env.wrappers.base import Wrapper


class EpisodeStatisticsState(NamedTuple):
    """The inner state; the sum of rewards and the number of steps since the episode began."""

    inner: Any
    episode_return: jax.Array
    episode_length: jax.Array


class EpisodeStatistics(Wrapper):
    """Add ``episode_return`` and ``episode_length`` to info, this step included.

    Of a whole episode where it is ``terminated`` or ``truncated``; nothing is carried into the next
    one.
    """

    key = "episode_statistics"

    def begin(
        self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0
    ) -> EpisodeStatisticsState:
        """Return the state of an episode that begins, with nothing counted."""
        inner = self.env.begin(drone, gate_index, params, seed)
        return EpisodeStatisticsState(inner, jnp.float32(0.0), jnp.int32(0))

    def advance(
        self, state: EpisodeStatisticsState, command: Action, params: EnvParams
    ) -> tuple[EpisodeStatisticsState, jax.Array, jax.Array, dict[str, Any]]:
        """Return the outcome of the inner environment, counted."""
        inner, reward, terminated, info = self.env.advance(state.inner, command, params)
        counted = EpisodeStatisticsState(
            inner, state.episode_return + reward, state.episode_length + 1
        )
        statistics = {
            "episode_return": counted.episode_return,
            "episode_length": counted.episode_length,
        }
        return counted, reward, terminated, {**info, **statistics}
