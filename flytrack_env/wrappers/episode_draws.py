"""What wrappers share that draw parameters of what is inside anew in every episode."""

from typing import Any, NamedTuple

import jax

from flytrack_env.params import EnvParams
from flytrack_env.randomness import Draws
from flytrack_env.state import Action, Drone
from flytrack_env.wrappers.base import Wrapper


class DrawnState(NamedTuple):
    """The inner state, and the word that the episode's parameters are drawn from."""

    inner: Any
    word: jax.Array


class EpisodeDraws(Wrapper):
    """Gives everything inside the parameters that ``drawn`` returns for the episode's word."""

    def drawn(self, word: jax.Array, params: EnvParams) -> EnvParams:
        """Return the parameters of an episode; the same word gives the same ones."""
        raise NotImplementedError

    def word(self, seed: Any) -> jax.Array:
        """Return the uint32 word of an episode that begins with a seed."""
        return Draws(seed).word(self.key)

    def begin(self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0) -> DrawnState:
        """Return the state of an episode that begins, its parameters decided by the seed."""
        word = self.word(seed)
        return DrawnState(self.env.begin(drone, gate_index, self.drawn(word, params), seed), word)

    def advance(
        self, state: DrawnState, command: Action, params: EnvParams
    ) -> tuple[DrawnState, jax.Array, jax.Array, dict[str, Any]]:
        """Return the outcome of the inner environment with this episode's parameters."""
        inner, reward, terminated, info = self.env.advance(
            state.inner, command, self.drawn(state.word, params)
        )
        return DrawnState(inner, state.word), reward, terminated, info

    def observe_drone(self, drone: Drone, state: DrawnState, params: EnvParams) -> list[jax.Array]:
        """Return the inner environment's observation with this episode's parameters."""
        return self.env.observe_drone(drone, state.inner, self.drawn(state.word, params))
