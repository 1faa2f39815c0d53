"""A race of two as the flight of one drone, which ``polish`` makes faster and takes around its opponent."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from baselines.purejaxrl_ppo.networks import Policy
from flytrack_env.multi_drone import EntrantState, MultiDroneRace, RaceParams
from flytrack_env.params import EnvParams
from flytrack_env.race import Race
from flytrack_env.state import Action, Drone

BESIDE_M, ABOVE_M = 2.0, 0.5  # from where on an opponent is not in the way; spheres touch at 0.3
UNTOUCHED_M = 1e-3  # collision radius: whoever is hit flies on, and the gradient with it


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
        behind: share of flights that start behind the opponent.

    Raises:
        ValueError: a race of another number of drones.
    """

    def __init__(self, race: MultiDroneRace, pool: Policy, behind: float = 0.5) -> None:
        if race.num_drones != 2:
            raise ValueError(f"race: found {race.num_drones} drones, expected 2")
        self._race, self._pool, self._behind = race, pool, behind
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
        slot = jax.random.bernoulli(of_slot, self._behind).astype(jnp.int32)
        rules = race.rules._replace(first_slot=slot)
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
        """Return how much the opponent is in the way: 0 far beside or above it, 1 where it is, more below.

        It falls with horizontal distance too, but only height has a gradient, so that the way past is always
        above. A gradient to the side would change its sign with the side that the learner happens to be on
        and average out over flights, and one that points back would only slow it down.
        """
        drones = self._race.drone(state.entrants)
        own_w, other_w = jnp.stack(drones.pos_w, axis=-1)
        *flat, above = own_w - jax.lax.stop_gradient(other_w)
        beside = jax.lax.stop_gradient(jnp.hypot(*flat))
        nearness = jnp.maximum(0.0, 1.0 - beside / BESIDE_M) ** 2 * jnp.maximum(0.0, 1.0 - above / ABOVE_M)
        return jnp.where(state.entrants.is_out[1], 0.0, nearness)
