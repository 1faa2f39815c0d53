"""A race as an environment for one learner, drone 0, against opponents with frozen policies."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from gymnax.environments import environment, spaces

from flytrack_env.episodes import Step
from flytrack_env.multi_drone.race_env import EntrantState, MultiDroneRace
from flytrack_env.multi_drone.rules import RaceParams


class Opponent(NamedTuple):
    """A policy that does not learn.

    Attributes:
        act: (params, observations (..., observation_size)) -> actions (..., 4).
        observation_size: that of the race, or that of its environment for one drone, for a policy
            that does not see others.
        params: a pytree.
    """

    act: Callable[[Any, jax.Array], jax.Array]
    observation_size: int
    params: Any = ()


def idle(race: MultiDroneRace) -> Opponent:
    """Return an opponent that leaves its sticks alone, for the place of a ghost."""
    act = partial(_leave_sticks_alone, race.env.num_actions)
    return Opponent(act, race.env.observation_space().shape[0])


def _leave_sticks_alone(num_actions: int, params: Any, observations: jax.Array) -> jax.Array:
    """Return actions of zero; a function of the module, so that an environment can be pickled."""
    return jnp.zeros((*observations.shape[:-1], num_actions))


class VersusParams(NamedTuple):
    """The race's parameters, and those of each opponent's policy."""

    race: RaceParams
    opponents: tuple[Any, ...]


class VersusState(NamedTuple):
    """The states of all drones, and the opponents' observations (num_opponents, size)."""

    entrants: EntrantState
    observations: jax.Array


class Versus(environment.Environment[VersusState, VersusParams]):  # type: ignore[type-var]
    """gymnax's view of a race for drone 0; the race is over, and reset, once it is out.

    Args:
        race: with ``over="first"``.
        opponents: the policy of each other drone, in their order.

    Raises:
        ValueError: another number of opponents, one that observes something of another size, or a
            race that goes on without drone 0.
    """

    def __init__(self, race: MultiDroneRace, opponents: Sequence[Opponent]) -> None:
        super().__init__()
        if race.over != "first":
            raise ValueError(f"race: found over={race.over!r}, expected 'first'")
        if len(opponents) != race.num_drones - 1:
            expected = f"{race.num_drones - 1}, one for each drone but the learner's"
            raise ValueError(f"opponents: found {len(opponents)}, expected {expected}")
        sizes = {env.observation_space().shape[0] for env in (race, race.env)}
        for number, opponent in enumerate(opponents):
            if opponent.observation_size not in sizes:
                expected = " or ".join(map(str, sorted(sizes)))
                raise ValueError(
                    f"opponents[{number}].observation_size: found {opponent.observation_size}, "
                    f"expected {expected}"
                )
        self.race, self.opponents = race, tuple(opponents)

    @property
    def name(self) -> str:
        """What it is."""
        return repr(self)

    def __repr__(self) -> str:
        return f"<Versus: {self.race!r}>"

    @property
    def default_params(self) -> VersusParams:  # type: ignore[override]  # as in EpisodicEnvironment
        """The race's parameters, and the opponents' own."""
        return VersusParams(
            self.race.default_params, tuple(opponent.params for opponent in self.opponents)
        )

    @property
    def num_actions(self) -> int:
        """Number of components of an action."""
        return self.race.env.num_actions

    def action_space(self, params: VersusParams | None = None) -> spaces.Box:
        """Return the box of the learner's action."""
        return self.race.action_space()

    def observation_space(self, params: VersusParams | None = None) -> spaces.Box:
        """Return the box of the learner's observation."""
        return self.race.observation_space()

    def reset(  # type: ignore[override]
        self, key: jax.Array, params: VersusParams | None = None
    ) -> tuple[jax.Array, VersusState]:
        """Return the learner's observation, (size,) float32, and the state of a new race."""
        params = self.default_params if params is None else params
        observations, entrants = self.race.reset(key, params.race)
        return observations[0], VersusState(entrants, observations[1:])

    @partial(jax.jit, static_argnames=("self",))
    def step(
        self,
        key: jax.Array,
        state: VersusState,
        action: jax.Array,
        params: VersusParams | None = None,
    ) -> Step:
        """Step with auto-reset; return the learner's observation, state, reward, flags and info."""
        params = self.default_params if params is None else params
        actions = self._all_actions(state.observations, action, params)
        return self._of_learner(self.race.step(key, state.entrants, actions, params.race))

    @partial(jax.jit, static_argnames=("self",))
    def step_batch(
        self, key: jax.Array, states: VersusState, actions: jax.Array, params: VersusParams
    ) -> Step:
        """Step a batch of races with one key, faster than ``vmap(step)``.

        Args:
            actions: (num_races, 4).
        """
        actions = self._all_actions(states.observations, actions, params)
        return self._of_learner(self.race.step_batch(key, states.entrants, actions, params.race))

    def _all_actions(
        self, observations: jax.Array, action: jax.Array, params: VersusParams
    ) -> jax.Array:
        """Return the actions of all drones, (..., num_drones, 4)."""
        actions = [action]
        for index, (opponent, policy_params) in enumerate(
            zip(self.opponents, params.opponents, strict=True)
        ):
            actions.append(
                opponent.act(policy_params, observations[..., index, : opponent.observation_size])
            )
        return jnp.stack(actions, axis=-2)

    def _of_learner(self, step: Step) -> Step:
        """Return what a step of the race, leaves (..., num_drones, ...), comes to for drone 0."""
        observations, entrants, *outcomes, info = step
        axis = outcomes[0].ndim - 1
        take = partial(jax.lax.index_in_dim, index=0, axis=axis, keepdims=False)
        reward, terminated, truncated = map(take, outcomes)
        others = jax.lax.slice_in_dim(observations, 1, self.race.num_drones, axis=axis)
        state = VersusState(entrants, others)
        return take(observations), state, reward, terminated, truncated, jax.tree.map(take, info)
