"""A race for PettingZoo: its parallel API, a dictionary by agent for everything."""

from typing import Any, ClassVar

import jax
import numpy as np
from gymnax.environments.spaces import gymnax_space_to_gym_space

from flytrack_env.extras import check_installed
from flytrack_env.multi_drone.race_env import MultiDroneRace
from flytrack_env.multi_drone.rules import RaceParams

check_installed("multi", "races for PettingZoo", "pettingzoo")

from pettingzoo import ParallelEnv

Observations = dict[str, np.ndarray]
SEEDS = 2**31


class ParallelRace(ParallelEnv[str, np.ndarray, np.ndarray]):
    """A race as a ``pettingzoo.ParallelEnv``.

    Agents are "drone_0" and so on, and leave once they are out.

    Args:
        params: the race's default ones if None.
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "FlyTrackRace-v0", "render_modes": []}

    def __init__(self, race: MultiDroneRace, params: RaceParams | None = None) -> None:
        self.race, self.params = race, race.default_params if params is None else params
        self.render_mode = None
        self.possible_agents = [f"drone_{index}" for index in range(race.num_drones)]
        self.agents: list[str] = []
        observation_space, action_space = race.observation_space(), race.action_space()
        self.observation_spaces = {
            agent: gymnax_space_to_gym_space(observation_space) for agent in self.possible_agents
        }
        self.action_spaces = {
            agent: gymnax_space_to_gym_space(action_space) for agent in self.possible_agents
        }
        self._rng = np.random.default_rng()
        self._states: Any = None

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, dict[str, Any]]]:
        """Return observations and infos of a race that begins; options are unused."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        key = jax.random.key(int(self._rng.integers(SEEDS)))
        observations, self._states = self.race.reset(key, self.params)
        self.agents = list(self.possible_agents)
        return self._by_agent(np.asarray(observations)), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, np.ndarray]) -> tuple[Any, ...]:
        """Step the race.

        Return observations, rewards, terminations, truncations and infos of the agents that were
        racing.

        Raises:
            ValueError: actions of other agents than those that race, or of another shape.
            RuntimeError: no race was begun.
        """
        if self._states is None:
            raise RuntimeError("step: found no race, expected reset() before it")
        if set(actions) != set(self.agents):
            raise ValueError(f"actions: found {sorted(actions)}, expected {self.agents}")
        sticks = np.zeros((self.race.num_drones, self.race.env.num_actions), np.float32)
        for index, agent in self._racing():
            sticks[index] = _as_sticks(agent, actions[agent], sticks.shape[1:])
        outcome = jax.device_get(self.race.step_env(self._states, sticks, self.params))
        observations, self._states, *outcomes, info = outcome
        del info["final_observation"]
        infos = {
            agent: {name: value[index] for name, value in info.items()}
            for index, agent in self._racing()
        }
        rewards, terminated, truncated = (
            {agent: values[index].item() for index, agent in self._racing()} for values in outcomes
        )
        observations = self._by_agent(observations)
        self.agents = [
            agent for agent in self.agents if not (terminated[agent] or truncated[agent])
        ]
        return observations, rewards, terminated, truncated, infos

    def observation_space(self, agent: str) -> Any:
        """Return the space of an agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """Return the space of an agent's actions."""
        return self.action_spaces[agent]

    def render(self) -> None:
        """Draw nothing: there are pictures and recordings of races (docs/multi_drone.md)."""

    def close(self) -> None:
        """Do nothing; there is nothing to be closed."""

    def _racing(self) -> list[tuple[int, str]]:
        return [
            (index, agent)
            for index, agent in enumerate(self.possible_agents)
            if agent in self.agents
        ]

    def _by_agent(self, values: np.ndarray) -> dict[str, np.ndarray]:
        return {agent: values[index] for index, agent in self._racing()}


def _as_sticks(agent: str, action: Any, shape: tuple[int, ...]) -> np.ndarray:
    sticks = np.asarray(action, np.float32)
    if sticks.shape != shape:
        raise ValueError(f"actions[{agent!r}]: found shape {sticks.shape}, expected {shape}")
    return sticks
