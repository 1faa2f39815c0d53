"""Flying a policy: whole episodes from noisy start poses, one or many side by side."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from baselines.purejaxrl_ppo.networks import ActorCritic
from flytrack_env.env import EnvParams, EnvState, FlyTrack
from flytrack_env.state import POSITION, pack
from flytrack_env.terminations import Causes


class Flight(NamedTuple):
    """One episode; leaves (num_steps, ...), or (num_episodes, num_steps, ...) for many.

    states: (21,) before the step. actions: (4,), clipped as commanded. is_flying: whether the step was
    flown; what follows the end is padding. gates_passed, laps, lap_completed, lap_time_s: after the
    step. causes: of termination, in the step that ended the episode.
    """

    states: jax.Array
    actions: jax.Array
    is_flying: jax.Array
    gates_passed: jax.Array
    laps: jax.Array
    lap_completed: jax.Array
    lap_time_s: jax.Array
    causes: Causes

    def positions(self) -> np.ndarray:
        """Return every position flown through, (num_samples, 3), world, m."""
        return np.asarray(self.states)[np.asarray(self.is_flying)][:, POSITION]


class Score(NamedTuple):
    """Result of many episodes.

    success: share that completed the laps. gates: mean number passed. first_lap_s, flying_lap_s: mean
    time of the first lap, from standstill, and of the later ones; NaN where there was none.
    """

    success: float
    gates: float
    first_lap_s: float
    flying_lap_s: float


def start_pose_params(params: EnvParams, num_steps: int) -> EnvParams:
    """Return parameters whose episodes begin at the noisy start pose and may last that many steps."""
    return params.replace(reset=params.reset._replace(course_fraction=0.0), max_steps_in_episode=num_steps)


@partial(jax.jit, static_argnames=("env", "network", "num_steps"))
def fly_episode(
    env: FlyTrack,
    network: ActorCritic,
    policy_params: Any,
    key: jax.Array,
    params: EnvParams,
    num_steps: int,
    num_laps: int,
) -> Flight:
    """Return one episode of the mean action, from a reset to its end or to ``num_laps`` laps."""

    def step(carry: tuple[jax.Array, EnvState, jax.Array], _: None) -> tuple:
        observation, state, is_flying = carry
        mean = network.apply(policy_params, observation, method="policy").mode()
        action = jnp.clip(mean, -1.0, 1.0)
        next_observation, next_state, _, terminated, info = env.step_env(None, state, action, params)
        flown = Flight(
            states=pack(env.drone(state)),
            actions=action,
            is_flying=is_flying,
            gates_passed=jnp.where(is_flying, info["gates_passed"], env.race(state).gates_passed),
            laps=jnp.where(is_flying, info["laps"], env.race(state).laps),
            lap_completed=info["lap_completed"] & is_flying,
            lap_time_s=info["lap_time_s"],
            causes=Causes(*(info[name] & is_flying for name in Causes._fields)),
        )
        keep = partial(jax.tree.map, partial(jnp.where, is_flying))
        observation, state = keep((next_observation, next_state), (observation, state))
        is_flying = is_flying & ~terminated & (info["laps"] < num_laps)
        return (observation, state, is_flying), flown

    observation, state = env.reset(key, params)
    start = (observation, state, jnp.asarray(True))
    return jax.lax.scan(step, start, None, num_steps)[1]


def fly_many(
    env: FlyTrack,
    network: ActorCritic,
    policy_params: Any,
    seed: int,
    num_episodes: int,
    num_steps: int,
    num_laps: int,
    params: EnvParams | None = None,
) -> Flight:
    """Return episodes from noisy start poses, leaves (num_episodes, num_steps, ...)."""
    params = env.default_params if params is None else params
    keys = jax.random.split(jax.random.key(seed), num_episodes)
    return jax.vmap(
        lambda key: fly_episode(
            env,
            network,
            policy_params,
            key,
            start_pose_params(params, num_steps),
            num_steps,
            num_laps,
        )
    )(keys)


def score(flight: Flight, num_laps: int) -> Score:
    """Return the score of many episodes, asked to complete ``num_laps`` laps."""
    laps, is_completed = np.asarray(flight.laps), np.asarray(flight.lap_completed)

    def mean_time(mask: np.ndarray) -> float:
        times = np.asarray(flight.lap_time_s)[mask]
        return float(times.mean()) if times.size else float("nan")

    return Score(
        success=float((laps.max(axis=1) >= num_laps).mean()),
        gates=float(np.asarray(flight.gates_passed).max(axis=1).mean()),
        first_lap_s=mean_time(is_completed & (laps == 1)),
        flying_lap_s=mean_time(is_completed & (laps > 1)),
    )
