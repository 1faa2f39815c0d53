"""The last actions beside the observation: what makes a delayed drone predictable."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.episodes import EpisodicEnvironment, without_nan
from flytrack_env.observations import Entry
from flytrack_env.params import EnvParams
from flytrack_env.state import ACTION_SIZE, Action, Drone
from flytrack_env.wrappers.base import Wrapper

KINDS = ("commanded", "applied")


class ActionHistoryState(NamedTuple):
    """The inner state, and the last actions, the latest first."""

    inner: Any
    actions: tuple[Action, ...]


class ActionHistory(Wrapper):
    """Append the last ``length`` actions to the observation, the latest first.

    Args:
        kind: "commanded" (clipped, as the policy gave them) or "applied" (lagged). When an episode
            begins, all of them are the applied action that the drone begins with.

    Raises:
        ValueError: a length below 1, another kind.
        WrapperError: as ``Wrapper``.
    """

    needs_rows = True

    def __init__(self, env: EpisodicEnvironment, length: int = 3, kind: str = "commanded"):
        if length < 1:
            raise ValueError(f"length: found {length}, expected at least 1")
        if kind not in KINDS:
            raise ValueError(f"kind: found {kind!r}, expected one of {KINDS}")
        self.length = length
        self.kind = kind
        self.key = f"{kind}_action_history"
        super().__init__(env)

    @property
    def observation_table(self) -> tuple[Entry, ...]:
        """The inner environment's, and a row per action remembered."""
        names = ["latest", *(f"{age} before the latest" for age in range(1, self.length))]
        rows = (
            Entry(
                key=f"{self.kind}_{age}",
                name=f"{self.kind} action, {name}: roll, pitch, yaw, thrust",
                size=ACTION_SIZE,
                frame="body",
                unit="1",
                scale=1.0,
                limit=1.0,
            )
            for age, name in enumerate(names)
        )
        return (*self.env.observation_table, *rows)

    def begin(
        self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0
    ) -> ActionHistoryState:
        """Return the state of a new episode, with the applied action for all of history."""
        inner = self.env.begin(drone, gate_index, params, seed)
        return ActionHistoryState(inner, (drone.applied,) * self.length)

    def advance(
        self, state: ActionHistoryState, command: Action, params: EnvParams
    ) -> tuple[ActionHistoryState, jax.Array, jax.Array, dict[str, Any]]:
        """Return the next state with this action in front, reward, terminated and info."""
        inner, reward, terminated, info = self.env.advance(state.inner, command, params)
        latest = without_nan(command) if self.kind == "commanded" else self.env.drone(inner).applied
        return ActionHistoryState(inner, (latest, *state.actions[:-1])), reward, terminated, info

    def observe_drone(
        self, drone: Drone, state: ActionHistoryState, params: EnvParams
    ) -> list[jax.Array]:
        """Return the inner observation with the actions behind it."""
        values = [jnp.asarray(value) for action in state.actions for value in action]
        return [*self.env.observe_drone(drone, state.inner, params), *values]
