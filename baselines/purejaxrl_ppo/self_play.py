"""PPO by self-play, for duels: against a pool of its own past policies and the one that it began with.

The learner and its opponents are one network. Training is that of ``ppo.py``, loss and all, on a race in
which every opponent is frozen (``flytrack_env.multi_drone.Versus``): the pool is a part of the environment's
parameters, and between some updates the learner replaces one of its members. Every member races in its own
share of the environments.
"""

from collections.abc import Iterator
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

    pool: policies in the pool, the first of them that which training began with; num_envs is a multiple of
    it. every: updates after which the learner replaces a member, the oldest first. lead: reward for each gate
    gained on the opponent. std: standard deviation of the actions at the start, small, so that what the
    first policy can already is not lost in noise.
    """

    pool: int = 4
    every: int = 50
    lead: float = 1.0
    std: float = 0.1


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


def make_duel(race: MultiDroneRace, config: Config, settings: Settings, start: Any) -> Versus:
    """Return the environment of the learner against a pool of which all members are the start.

    Raises:
        ValueError: a number of environments that the pool does not divide, or settings out of range.
    """
    if settings.pool < 1 or config.num_envs % settings.pool:
        expected = f"a divisor of num_envs, {config.num_envs}"
        raise ValueError(f"pool: found {settings.pool}, expected {expected}")
    if settings.every < 1:
        raise ValueError(f"every: found {settings.every}, expected at least 1")
    pool = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], settings.pool, axis=0), start)
    return Versus(race, [pool_opponent(config, race.observation_space().shape[0], pool)])


def training_params(duel: Versus, config: Config, settings: Settings) -> VersusParams:
    """Return the parameters to train with: short episodes, thicker drones, and a reward for the lead."""
    params = duel.default_params
    flight = params.race.flight
    flight = flight.replace(
        max_steps_in_episode=config.episode_steps, drone_radius=flight.drone_radius + config.gate_margin
    )
    rules = params.race.rules._replace(lead=settings.lead)
    return params._replace(race=params.race._replace(flight=flight, rules=rules))


def train(
    start: Checkpoint, race: MultiDroneRace, config: Config, settings: Settings, seed: int
) -> Iterator[tuple[int, Any, Metrics]]:
    """Yield (updates, parameters of the network, metrics) each time when the learner enters the pool.

    start: the policy that training begins with, of an environment for one drone. race: of two drones, over
    with the first.

    Raises:
        ValueError: settings that cannot be trained with.
    """
    first = with_std(widened(start.params, race.observation_space().shape[0]), settings.std)
    duel = make_duel(race, config, settings, first)
    params = training_params(duel, config, settings)

    def update(carry: tuple[Runner, VersusParams], _: None) -> tuple[tuple[Runner, VersusParams], Metrics]:
        runner, params = carry
        runner, metrics = make_ppo(duel, params, config).update(runner)
        return (runner, params), metrics

    @jax.jit
    def phase(runner: Runner, params: VersusParams) -> tuple[Runner, Metrics]:
        (runner, _), metrics = jax.lax.scan(update, (runner, params), None, settings.every)
        return runner, metrics

    runner = jax.jit(make_ppo(duel, params, config).start)(jax.random.key(seed))
    runner = runner._replace(train_state=runner.train_state.replace(params=first))
    for number in range(config.num_updates // settings.every):
        runner, metrics = phase(runner, params)
        member = 1 + number % max(settings.pool - 1, 1)
        if settings.pool > 1:
            params = params._replace(
                opponents=(replaced(params.opponents[0], member, runner.train_state.params),)
            )
        yield (number + 1) * settings.every, runner.train_state.params, metrics
