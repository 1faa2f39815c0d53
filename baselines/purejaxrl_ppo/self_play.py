"""PPO by self-play: ``python -m baselines.purejaxrl_ppo.self_play [--out FOLDER]``.

One network learns to race a pool of opponents: a trained policy that stays, and its own past
policies. The training is that of ``ppo.py`` on a race whose opponents are frozen
(``flytrack_env.multi_drone.Versus``). The pool is a part of the environment's parameters. After
every few updates the learner replaces the oldest of its past policies. At the end, the result races
the policy that stayed, and its wins are printed.
"""

import dataclasses
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import tyro

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import (
    SHIPPED,
    Checkpoint,
    load_checkpoint,
    observation_layout,
    rewards_of,
    save_checkpoint,
)
from baselines.purejaxrl_ppo.config import Config, Count
from baselines.purejaxrl_ppo.flights import start_pose_params
from baselines.purejaxrl_ppo.networks import ActorCritic
from baselines.purejaxrl_ppo.ppo import Metrics, Runner, make_ppo
from flytrack_env.model_file import model_from_json
from flytrack_env.multi_drone import MultiDroneRace, Opponent, Versus, VersusParams

FIRST_LAYER = "layers_0"
# Small steps, and nearly deterministic actions: the first policy races already, and noise would
# undo it.
CONFIG_CHANGES = {"learning_rate": 5e-5, "episode_steps": 400, "gamma": 0.998, "min_std": 0.01}
NUM_LAPS, NUM_RACE_STEPS = 3, 1500  # 15 s: the champions need 12


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of self-play, which are the flags of the command."""

    opponent: Path = SHIPPED["champion"]
    """Checkpoint of the policy that stays in the pool; the learner begins as a copy of it."""
    out: Path = Path("runs/self_play")
    """Folder of final.safetensors."""
    total_timesteps: Count = 5_000_000
    """Environment steps over all races."""
    seed: int = 0
    """Seed of the training and of the races that evaluate it."""
    num_past: int = 3
    """Past policies in the pool."""
    updates_per_phase: int = 25
    """Updates after which the learner replaces its oldest past policy."""
    lead: float = 1.0
    """Reward for each gate gained on the opponent."""
    std: float = 0.015
    """Standard deviation of the actions at the start."""
    course_fraction: float = 0.8
    """Share of the races that begin somewhere on the course, not at the start."""
    num_races: int = 256
    """Races of the evaluation, from each slot of the start grid."""


class RaceResults(NamedTuple):
    """Shares of races that the learner finishes, wins, or that have a collision before a finish."""

    finishes: float
    wins: float
    collisions: float


def widen_params(params: Any, observation_size: int) -> Any:
    """Return a network's parameters for longer observations; the added rows have no weight."""

    def widen(path: tuple[Any, ...], leaf: jax.Array) -> jax.Array:
        if FIRST_LAYER not in jax.tree_util.keystr(path) or leaf.ndim != 2:
            return leaf
        return jnp.pad(leaf, ((0, observation_size - leaf.shape[0]), (0, 0)))

    return jax.tree_util.tree_map_with_path(widen, params)


def set_std(params: Any, std: float) -> Any:
    """Return a network's parameters with another standard deviation of the actions."""
    own = params["params"]
    return {"params": {**own, "log_std": jnp.full_like(own["log_std"], jnp.log(std))}}


def make_pool_opponent(network: ActorCritic, pool: Any) -> Opponent:
    """Return a pool of policies as one opponent.

    Each member flies an equal share of a batch of races, the first member the first share.

    Args:
        network: of all members.
        pool: parameters, leaves (num_members, ...).
    """
    num_members = len(jax.tree.leaves(pool)[0])
    observation_size = pool["params"]["actor_tower"]["layers_0"]["kernel"].shape[1]

    def act(pool: Any, observations: jax.Array) -> jax.Array:
        shares = observations.reshape(num_members, -1, observation_size)
        actions = jax.vmap(lambda params, share: network.act(params, (), share)[1])(pool, shares)
        return actions.reshape(*observations.shape[:-1], -1)

    return Opponent(act, observation_size, pool)


def make_training_params(env: Versus, config: Config, settings: Settings) -> VersusParams:
    """Return parameters with short episodes, thicker drones and a reward for the lead."""
    params = env.default_params
    flight = params.race.flight
    flight = flight.replace(
        max_steps_in_episode=config.episode_steps,
        drone_radius=flight.drone_radius + config.gate_margin,
        reset=flight.reset._replace(course_fraction=settings.course_fraction),
    )
    rules = params.race.rules._replace(lead=settings.lead)
    return params._replace(race=params.race._replace(flight=flight, rules=rules))


def train(
    start: Checkpoint, race: MultiDroneRace, config: Config, settings: Settings
) -> Iterator[tuple[int, Any, Metrics]]:
    """Train, and yield whenever the learner enters the pool.

    Args:
        start: policy that stays in the pool, and that the learner begins as.
        race: of two drones, which is over when the first one is out.
        config: of PPO.
        settings: of self-play.

    Yields: Updates so far, the learner's parameters, and the metrics of the updates since the last
        time.

    Raises:
        ValueError: settings that cannot be trained with.
    """
    num_members = 1 + settings.num_past
    for name in ("num_past", "updates_per_phase"):
        if getattr(settings, name) < 1:
            raise ValueError(f"{name}: found {getattr(settings, name)}, expected at least 1")
    if config.num_envs % num_members:
        raise ValueError(
            f"num_past: found {settings.num_past}, expected a pool, of one more, that divides "
            f"num_envs, {config.num_envs}"
        )
    first = widen_params(start.params, race.observation_space().shape[0])
    pool = jax.tree.map(lambda leaf: jnp.stack([leaf] * num_members), first)
    env = Versus(race, [make_pool_opponent(start.network, pool)])
    params = make_training_params(env, config, settings)

    @jax.jit
    def train_phase(runner: Runner, params: VersusParams) -> tuple[Runner, Metrics]:
        ppo = make_ppo(env, params, config)
        return jax.lax.scan(
            lambda runner, _: ppo.update(runner), runner, None, settings.updates_per_phase
        )

    runner = jax.jit(make_ppo(env, params, config).start)(jax.random.key(settings.seed))
    learner = set_std(first, settings.std)
    runner = runner._replace(train_state=runner.train_state.replace(params=learner))
    for phase in range(config.num_updates // settings.updates_per_phase):
        runner, metrics = train_phase(runner, params)
        learner = runner.train_state.params
        oldest = 1 + phase % settings.num_past
        pool = jax.tree.map(
            lambda rows, new, row=oldest: rows.at[row].set(new), params.opponents[0], learner
        )
        params = params._replace(opponents=(pool,))
        yield (phase + 1) * settings.updates_per_phase, learner, metrics


@partial(jax.jit, static_argnames=("race", "network"))
def fly_races(
    race: MultiDroneRace,
    network: ActorCritic,
    learner: Any,
    opponent: Any,
    slot: int,
    keys: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Race the learner against an opponent from the start grid, both with their mean actions.

    Args:
        race: of two drones.
        network: of both.
        learner: parameters.
        opponent: parameters.
        slot: of the learner on the grid, 0 in front.
        keys: of the races, (num_races,).

    Returns: When each drone finishes (num_races, 2), s, infinity if never; whether drones collide
        before anyone finishes (num_races,).
    """
    flight, rules = race.default_params
    flight = start_pose_params(flight, NUM_RACE_STEPS)
    params = race.default_params._replace(flight=flight, rules=rules._replace(first_slot=slot))

    def act(params: Any, observations: jax.Array) -> jax.Array:
        return network.act(params, (), observations)[1]

    def step(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], None]:
        observations, states, time_s, finish_s, has_collided = carry
        actions = jnp.stack(
            [act(learner, observations[:, 0]), act(opponent, observations[:, 1])], axis=1
        )
        step_env = jax.vmap(race.step_env, (0, 0, None))
        observations, states, *_, info = step_env(states, actions, params)
        is_racing = jnp.isinf(finish_s).all(axis=1)
        has_collided = has_collided | (info["collision"].any(axis=1) & is_racing)
        time_s = time_s + jnp.where(info["lap_completed"], info["lap_time_s"], 0.0)
        finish_s = jnp.where(info["lap_completed"] & (info["laps"] == NUM_LAPS), time_s, finish_s)
        return (observations, states, time_s, finish_s, has_collided), None

    nobody = jnp.zeros(len(keys), bool)
    time_s = jnp.zeros((len(keys), 2))
    start = (*jax.vmap(race.reset, (0, None))(keys, params), time_s, time_s + jnp.inf, nobody)
    *_, finish_s, has_collided = jax.lax.scan(step, start, None, NUM_RACE_STEPS)[0]
    return finish_s, has_collided


def summarize(finish_s: jax.Array, has_collided: jax.Array) -> RaceResults:
    """Return the learner's results of races, as ``fly_races`` returns them."""
    own_s, other_s = finish_s.T
    return RaceResults(
        float(jnp.isfinite(own_s).mean()),
        float((own_s < other_s).mean()),
        float(has_collided.mean()),
    )


def main(settings: Settings) -> None:
    """Train, write the checkpoint, and print how the result races the policy that stayed."""
    begun_s = time.perf_counter()
    start = load_checkpoint(settings.opponent)
    model = model_from_json(start.meta["model"], f"{settings.opponent}: model")
    env = flytrack_env.make(start.env_id, track=start.track, model=model, reward=rewards_of(start))
    race = MultiDroneRace(env, 2, over="first")
    changes: dict[str, Any] = {**CONFIG_CHANGES, "total_timesteps": settings.total_timesteps}
    config = dataclasses.replace(start.config, **changes)
    learner = None
    for updates, params, metrics in train(start, race, config, settings):
        learner = params
        print(
            f"{updates * config.batch_size} steps: mean return {metrics['episode_return'][-1]:.1f}"
        )
    if learner is None:
        least = settings.updates_per_phase * config.batch_size
        raise SystemExit(
            f"total_timesteps: found {settings.total_timesteps}, expected at least {least}"
        )
    path = settings.out / "final.safetensors"
    description = {
        **start.meta,
        "env_id": "FlyTrackDuel-v0",
        "observation_size": race.observation_space().shape[0],
        "observation": observation_layout(race),
        "seed": settings.seed,
        "steps": updates * config.batch_size,
        "seconds": time.perf_counter() - begun_s,
    }
    save_checkpoint(path, learner, config, description)
    print(f"checkpoint: {path}")
    opponent = widen_params(start.params, race.observation_space().shape[0])
    keys = jax.random.split(jax.random.key(settings.seed), settings.num_races)
    for slot, place in enumerate(("in front of", "behind")):
        results = summarize(*fly_races(race, start.network, learner, opponent, slot, keys))
        print(
            f"{settings.num_races} races from {place} {settings.opponent.stem}: "
            f"finishes {results.finishes:.1%}, wins {results.wins:.1%}, "
            f"collisions {results.collisions:.1%}"
        )


if __name__ == "__main__":
    main(
        tyro.cli(Settings, prog="python -m baselines.purejaxrl_ppo.self_play", description=__doc__)
    )
