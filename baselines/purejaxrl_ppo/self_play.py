"""PPO by self-play, for duels: against a pool of its own past policies and of some that stay.

The learner and its opponents are one network. Training is that of ``ppo.py``, loss and all, on a race in
which every opponent is frozen (``flytrack_env.multi_drone.Versus``): the pool is a part of the environment's
parameters, and between some updates the learner replaces one of its members. Every member races in its own
share of the environments.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from baselines.purejaxrl_ppo.checkpoint import Checkpoint
from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.networks import make_network
from baselines.purejaxrl_ppo.ppo import Metrics, Runner, make_ppo
from flytrack_env.multi_drone import MultiDroneRace, Opponent, Versus, VersusParams

FIRST_LAYER = "layers_0"


class Settings(NamedTuple):
    """What self-play adds to PPO.

    past: how many of its past policies are in the pool, beside those that stay. every: updates after which
    the learner replaces one, the oldest first. lead: reward for each gate gained on the opponent. std:
    standard deviation of the actions at the start, small, so that what the first policy can already is not
    lost in noise. course_fraction: share of the races that begin somewhere on the course.
    """

    past: int = 2
    every: int = 75
    lead: float = 1.0
    std: float = 0.03
    course_fraction: float = 0.3


def widened(params: Any, size: int) -> Any:
    """Return a network's parameters for observations of more rows, of which it takes no notice."""

    def widen(path: tuple[Any, ...], leaf: jax.Array) -> jax.Array:
        if FIRST_LAYER not in jax.tree_util.keystr(path) or leaf.ndim != 2:
            return leaf
        return jnp.pad(leaf, ((0, size - leaf.shape[0]), (0, 0)))

    return jax.tree_util.tree_map_with_path(widen, params)


def with_std(params: Any, std: float) -> Any:
    """Return a network's parameters with another standard deviation of the actions."""
    own = params["params"]
    return {"params": {**own, "log_std": jnp.full_like(own["log_std"], jnp.log(std))}}


def replaced(pool: Any, member: int, params: Any) -> Any:
    """Return a pool with other parameters in a member's place."""
    return jax.tree.map(lambda leaf, new: leaf.at[member].set(new), pool, params)


def pool_opponent(config: Config, size: int, pool: Any) -> Opponent:
    """Return the opponent that is a pool: parameters with its members as first axis of each leaf.

    The first share of a batch of observations (num_envs, size) is the first member's, and so on.
    """
    network = make_network(config)
    num_members = len(jax.tree.leaves(pool)[0])

    def act(pool: Any, observations: jax.Array) -> jax.Array:
        shares = observations.reshape(num_members, -1, size)
        actions = jax.vmap(lambda params, share: network.act(params, (), share)[1])(pool, shares)
        return actions.reshape(*observations.shape[:-1], -1)

    return Opponent(act, size, pool)


def training_params(duel: Versus, config: Config, settings: Settings) -> VersusParams:
    """Return the parameters to train with: short episodes, thicker drones, and a reward for the lead."""
    params = duel.default_params
    flight = params.race.flight
    flight = flight.replace(
        max_steps_in_episode=config.episode_steps,
        drone_radius=flight.drone_radius + config.gate_margin,
        reset=flight.reset._replace(course_fraction=settings.course_fraction),
    )
    rules = params.race.rules._replace(lead=settings.lead)
    return params._replace(race=params.race._replace(flight=flight, rules=rules))


def train(
    starts: Sequence[Checkpoint], race: MultiDroneRace, config: Config, settings: Settings, seed: int
) -> Iterator[tuple[int, Any, Metrics]]:
    """Yield (updates, parameters of the network, metrics) each time when the learner enters the pool.

    starts: policies of an environment for one drone that stay in the pool; training begins with the first.
    race: of two drones, over with the first.

    Raises:
        ValueError: settings that cannot be trained with, or a number of environments that the pool does not
            divide.
    """
    size, num_members = race.observation_space().shape[0], len(starts) + settings.past
    if settings.past < 1 or settings.every < 1 or config.num_envs % num_members:
        expected = f"at least 1 each, and a pool of {num_members} that divides num_envs, {config.num_envs}"
        raise ValueError(f"past, every: found {settings.past}, {settings.every}, expected {expected}")
    members = [widened(start.params, size) for start in starts]
    pool = jax.tree.map(lambda *leaves: jnp.stack(leaves), *members, *members[:1] * settings.past)
    duel = Versus(race, [pool_opponent(config, size, pool)])
    params = training_params(duel, config, settings)

    @jax.jit
    def phase(runner: Runner, params: VersusParams) -> tuple[Runner, Metrics]:
        ppo = make_ppo(duel, params, config)
        return jax.lax.scan(lambda runner, _: ppo.update(runner), runner, None, settings.every)

    runner = jax.jit(make_ppo(duel, params, config).start)(jax.random.key(seed))
    first = with_std(members[0], settings.std)
    runner = runner._replace(train_state=runner.train_state.replace(params=first))
    for number in range(config.num_updates // settings.every):
        runner, metrics = phase(runner, params)
        learnt = runner.train_state.params
        oldest = len(starts) + number % settings.past
        params = params._replace(opponents=(replaced(params.opponents[0], oldest, learnt),))
        yield (number + 1) * settings.every, learnt, metrics
