"""A race of two as the flight of one drone, which ``polish`` makes faster and takes around its opponent."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from baselines.purejaxrl_ppo.networks import Policy
from flytrack_env.multi_drone import EntrantState, MultiDroneRace, RaceParams
from flytrack_env.params import EnvParams
from flytrack_env.race import Race
from flytrack_env.state import Action, Drone

NEAR_M = 0.5  # spheres touch at 0.3
ALONG = 0.4  # behind, a metre along the opponent's velocity counts as so many across
UNTOUCHED_M = 1e-3  # collision radius: whoever is hit flies on, and the gradient with it
SMALL = 0.01  # m, m/s: where a norm has no gradient


class DuelState(NamedTuple):
    """The state of both drones, their observations (2, size), and the opponent's place in the pool."""

    entrants: EntrantState
    observations: jax.Array
    opponent: jax.Array


class DuelFlight:
    """A race of two, as what ``polish`` asks of an environment of drone 0.

    Opponent and slot on the grid are drawn for each flight. An opponent may see the learner, but has no
    gradient: the learner does not learn to scare it away. No collision puts anyone out; ``nearness`` is what
    it costs.

    Args:
        race: of two drones.
        pool: policies of one network, parameters with the members as first axis of each leaf.

    Raises:
        ValueError: a race of another number of drones.
    """

    def __init__(self, race: MultiDroneRace, pool: Policy) -> None:
        if race.num_drones != 2:
            raise ValueError(f"race: found {race.num_drones} drones, expected 2")
        self._race, self._pool = race, pool
        self._num_members = len(jax.tree.leaves(pool.params)[0])

    @property
    def default_params(self) -> EnvParams:
        """The parameters of each drone's flight."""
        return self._race.default_params.flight

    def _race_params(self, params: EnvParams) -> RaceParams:
        rules = self._race.default_params.rules
        return RaceParams(params, rules._replace(collision_radius=UNTOUCHED_M))

    def reset_env(self, key: jax.Array, params: EnvParams) -> tuple[jax.Array, DuelState]:
        """Return the learner's observation and the state of a race that begins."""
        of_start, of_slot, of_opponent = jax.random.split(key, 3)
        race = self._race_params(params)
        rules = race.rules._replace(first_slot=jax.random.randint(of_slot, (), 0, 2))
        observations, entrants = self._race.reset(of_start, race._replace(rules=rules))
        opponent = jax.random.randint(of_opponent, (), 0, self._num_members)
        return observations[0], DuelState(entrants, observations, opponent)

    def _learner(self, state: DuelState) -> EntrantState:
        return jax.tree.map(lambda leaf: leaf[0], state.entrants)

    def race(self, state: DuelState) -> Race:
        """Return where the learner stands on the course."""
        return self._race.race(self._learner(state))

    def drone(self, state: DuelState) -> Drone:
        """Return the learner's drone."""
        return self._race.drone(self._learner(state))

    def advance(
        self, state: DuelState, command: Action, params: EnvParams
    ) -> tuple[DuelState, jax.Array, jax.Array, dict[str, jax.Array]]:
        """Return the next state, the learner's reward, whether it is out, and info."""
        member = jax.tree.map(lambda leaf: leaf[state.opponent], self._pool.params)
        theirs = self._pool.network.act(member, (), state.observations[1])[1]
        actions = jnp.stack([jnp.stack(command), jax.lax.stop_gradient(theirs)])
        step = self._race.step_env(state.entrants, actions, self._race_params(params))
        observations, entrants, reward, terminated, _, info = step
        return DuelState(entrants, observations, state.opponent), reward[0], terminated[0], info

    def observe_drone(self, drone: Drone, state: DuelState, params: EnvParams) -> list[jax.Array]:
        """Return the learner's observation, row by row."""
        return list(state.observations[0])

    def nearness(self, state: DuelState) -> jax.Array:
        """Return how near the learner is to its opponent: 0 from ``NEAR_M`` on, and 1 inside it.

        Behind it, who has to look out, distance along the opponent's velocity counts less. That has no
        gradient: the way out is to the side, and straight back would only slow the learner down.
        """
        drones = self._race.drone(state.entrants)
        own_w, other_w = jnp.stack(drones.pos_w, axis=-1)
        apart_w = own_w - jax.lax.stop_gradient(other_w)
        velocity_w = jax.lax.stop_gradient(jnp.stack(drones.vel_w, axis=-1)[1])
        ahead_w = velocity_w / (jnp.linalg.norm(velocity_w) + SMALL)
        along = apart_w @ ahead_w
        across_w = apart_w - along * ahead_w
        along = jax.lax.stop_gradient(along) * jnp.where(along < 0.0, ALONG, 1.0)
        distance = jnp.sqrt(across_w @ across_w + along * along + SMALL * SMALL)
        return jnp.where(state.entrants.is_out[1], 0.0, jnp.maximum(0.0, 1.0 - distance / NEAR_M) ** 2)
