"""A race for JaxMARL: a ``MultiAgentEnv``, with a dictionary by agent for everything."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from flytrack_env.extras import check_installed
from flytrack_env.multi_drone.race_env import EntrantState, MultiDroneRace
from flytrack_env.multi_drone.rules import RaceParams

check_installed("multi", "races for JaxMARL", "jaxmarl")

from jaxmarl.environments import MultiAgentEnv, spaces

Observations = dict[str, jax.Array]


class JaxMarlRace(MultiAgentEnv):
    """A race as a ``jaxmarl.environments.MultiAgentEnv``; agents are "drone_0" and so on.

    Auto-reset is JaxMARL's own: once the race is over, ``dones["__all__"]``. An agent that is out
    stays done, with a reward of 0.

    Args:
        params: the race's default ones if None.
    """

    def __init__(self, race: MultiDroneRace, params: RaceParams | None = None) -> None:
        super().__init__(num_agents=race.num_drones)
        self.race, self.params = race, race.default_params if params is None else params
        self.agents = [f"drone_{index}" for index in range(race.num_drones)]
        observation_space, action_space = race.observation_space(), race.action_space()
        self.observation_spaces = {
            agent: spaces.Box(
                observation_space.low, observation_space.high, observation_space.shape
            )
            for agent in self.agents
        }
        self.action_spaces = {
            agent: spaces.Box(-1.0, 1.0, action_space.shape) for agent in self.agents
        }

    @property
    def name(self) -> str:
        """What it is."""
        return repr(self.race)

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """One class: all drones have the same spaces."""
        return {"drones": list(self.agents)}

    @partial(jax.jit, static_argnums=(0,))
    def reset(self, key: jax.Array) -> tuple[Observations, EntrantState]:
        """Return observations and state of a race that begins."""
        observations, states = self.race.reset(key, self.params)
        return self._by_agent(observations), states

    def step_env(  # type: ignore[override]  # our states are not of JaxMARL's class, which no code needs
        self, key: jax.Array, state: EntrantState, actions: dict[str, jax.Array]
    ) -> tuple[Any, ...]:
        """Return observations, state, rewards, dones and infos; the key is unused.

        dones["__all__"]: the race is over. infos: leaves (num_drones,).
        """
        del key
        sticks = jnp.stack([actions[agent] for agent in self.agents])
        observations, states, rewards, terminated, truncated, info = self.race.step_env(
            state, sticks, self.params
        )
        del info["final_observation"]
        dones = {**self._by_agent(terminated | truncated), "__all__": info["race_over"][0]}
        return self._by_agent(observations), states, self._by_agent(rewards), dones, info

    def get_obs(self, state: EntrantState) -> Observations:  # type: ignore[override]
        """Return the observations of a state."""
        return self._by_agent(self.race.observe(state, self.params))

    @partial(jax.jit, static_argnums=(0,))
    def get_avail_actions(self, state: EntrantState) -> Observations:
        """Return that all sticks may be moved, by agent, (4,)."""
        del state
        return {agent: jnp.ones(self.action_spaces[agent].shape, bool) for agent in self.agents}

    def _by_agent(self, values: jax.Array) -> dict[str, jax.Array]:
        return {agent: values[index] for index, agent in enumerate(self.agents)}
