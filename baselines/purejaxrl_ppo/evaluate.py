"""Flying a policy: whole episodes from noisy start poses, one or many side by side.

``fly_episode`` and ``fly_many`` keep every step; ``race_many`` keeps what came of a flight, flies no step
beyond the last flight's end, and is for thousands. Both are made of the same step.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from baselines.purejaxrl_ppo.flights import Flight, Outcomes
from baselines.purejaxrl_ppo.networks import ActorCritic
from flytrack_env.dynamics import ModelParameters
from flytrack_env.env import EnvParams
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.state import pack
from flytrack_env.terminations import Causes
from flytrack_env.tracks import cross_gate

BATCH = 1024  # flights side by side: more do not fit into a core's cache, fewer do not fill its vectors


def start_pose_params(params: EnvParams, num_steps: int) -> EnvParams:
    """Return parameters whose episodes begin at the noisy start pose and may last that many steps."""
    return params.replace(reset=params.reset._replace(course_fraction=0.0), max_steps_in_episode=num_steps)


Step = Callable[[jax.Array, Any, jax.Array], tuple[jax.Array, Any, jax.Array, Flight]]


def make_step(
    env: EpisodicEnvironment, network: ActorCritic, policy_params: Any, params: EnvParams, num_laps: Any
) -> Step:
    """Return ``step(observation, state, index)``: one step of the mean action.

    It returns the next observation and state, whether the flight is over, and the step as a ``Flight``
    without its axis of steps. index: of the step, from 0.
    """

    def step(observation: jax.Array, state: Any, index: jax.Array) -> tuple[Any, ...]:
        policy: Any = network.apply(policy_params, observation, method="policy")
        action = jnp.clip(policy.mode(), -1.0, 1.0)
        next_observation, next_state, _, terminated, info = env.step_env(None, state, action, params)
        before, race = env.drone(state), env.race(state)
        after = env.drone(next_state)
        fraction = cross_gate(race.gate, before.pos_w, after.pos_w, params.drone_radius).fraction
        is_pass = info["gates_passed"] > race.gates_passed
        flown = Flight(
            states=pack(before),
            actions=action,
            is_flying=jnp.asarray(True),
            gates_passed=info["gates_passed"],
            laps=info["laps"],
            lap_completed=info["lap_completed"],
            lap_time_s=info["lap_time_s"],
            gate_time_s=jnp.where(is_pass, (index + fraction) * params.dt, 0.0),
            causes=Causes(*(info[name] for name in Causes._fields)),
        )
        return next_observation, next_state, terminated | (info["laps"] >= num_laps), flown

    return step


@partial(jax.jit, static_argnames=("env", "network", "num_steps"))
def fly_episode(
    env: EpisodicEnvironment,
    network: ActorCritic,
    policy_params: Any,
    key: jax.Array,
    params: EnvParams,
    num_steps: int,
    num_laps: int,
) -> Flight:
    """Return one episode of the mean action, from a reset to its end or to ``num_laps`` laps."""
    step = make_step(env, network, policy_params, params, num_laps)

    def go_on(carry: tuple[jax.Array, Any, jax.Array], index: jax.Array) -> tuple[Any, ...]:
        observation, state, is_flying = carry
        next_observation, next_state, is_over, flown = step(observation, state, index)
        race = env.race(state)
        padded = flown._replace(
            is_flying=is_flying,
            gates_passed=jnp.where(is_flying, flown.gates_passed, race.gates_passed),
            laps=jnp.where(is_flying, flown.laps, race.laps),
            lap_completed=flown.lap_completed & is_flying,
            gate_time_s=jnp.where(is_flying, flown.gate_time_s, 0.0),
            causes=Causes(*(cause & is_flying for cause in flown.causes)),
        )
        keep = partial(jax.tree.map, partial(jnp.where, is_flying))
        observation, state = keep((next_observation, next_state), (observation, state))
        return (observation, state, is_flying & ~is_over), padded

    observation, state = env.reset(key, params)
    start = (observation, state, jnp.asarray(True))
    return jax.lax.scan(go_on, start, jnp.arange(num_steps))[1]


def fly_many(
    env: EpisodicEnvironment,
    network: ActorCritic,
    policy_params: Any,
    seed: int,
    num_episodes: int,
    num_steps: int,
    num_laps: int,
    params: EnvParams | None = None,
) -> Flight:
    """Return episodes from noisy start poses, leaves (num_episodes, num_steps, ...)."""
    params = start_pose_params(env.default_params if params is None else params, num_steps)
    fly = partial(fly_episode, env, network, policy_params)
    return jax.vmap(lambda key: fly(key, params, num_steps, num_laps))(start_keys(seed, num_episodes))


def start_keys(seed: int, num_episodes: int) -> jax.Array:
    """Return the keys of episodes, (num_episodes,): those of fewer are the first of these."""
    return jax.random.split(jax.random.key(seed), num_episodes)


def _note(outcome: Outcomes, flown: Flight) -> Outcomes:
    """Return the outcome of one flight after another step."""
    lap, gate = jnp.arange(outcome.lap_times_s.size), jnp.arange(outcome.gate_times_s.size)
    is_lap = flown.lap_completed & (lap == flown.laps - 1)
    is_pass = (gate >= outcome.gates_passed) & (gate < flown.gates_passed)
    return Outcomes(
        steps=outcome.steps + 1,
        gates_passed=flown.gates_passed,
        laps=flown.laps,
        lap_times_s=jnp.where(is_lap, flown.lap_time_s, outcome.lap_times_s),
        gate_times_s=jnp.where(is_pass, flown.gate_time_s, outcome.gate_times_s),
        causes=flown.causes,
    )


@partial(jax.jit, static_argnames=("env", "network", "num_laps"))
def _race_batch(
    env: EpisodicEnvironment,
    network: ActorCritic,
    policy_params: Any,
    keys: jax.Array,
    params: EnvParams,
    models: ModelParameters | None,
    num_steps: int,
    num_laps: int,
) -> Outcomes:
    """Return the outcomes of one batch; models: one for each key, or None for that of ``params``."""
    zero, never = jnp.int32(0), jnp.asarray(False)

    def race(key: jax.Array, model: ModelParameters | None) -> Outcomes:
        own = params if model is None else params.replace(model=model)
        step = make_step(env, network, policy_params, own, num_laps)

        def is_flying(carry: tuple[Any, ...]) -> jax.Array:
            *_, is_over, outcome = carry
            return ~is_over & (outcome.steps < num_steps)

        def go_on(carry: tuple[Any, ...]) -> tuple[Any, ...]:
            observation, state, _, outcome = carry
            observation, state, is_over, flown = step(observation, state, outcome.steps)
            return observation, state, is_over, _note(outcome, flown)

        nothing = Outcomes(
            steps=zero,
            gates_passed=zero,
            laps=zero,
            lap_times_s=jnp.full(num_laps, jnp.nan),
            gate_times_s=jnp.full(num_laps * params.course.num_gates, jnp.nan),
            causes=Causes(*(never for _ in Causes._fields)),
        )
        # Under vmap the loop runs until no flight is left, and flights that are over stay as they are.
        return jax.lax.while_loop(is_flying, go_on, (*env.reset(key, own), never, nothing))[-1]

    return jax.vmap(race)(keys, models)


def race_many(
    env: EpisodicEnvironment,
    network: ActorCritic,
    policy_params: Any,
    keys: jax.Array,
    num_steps: int,
    num_laps: int,
    params: EnvParams | None = None,
    models: ModelParameters | None = None,
) -> Outcomes:
    """Return what came of flights from noisy start poses, one per key, as NumPy arrays.

    num_steps: time limit of each. params: of the environment, its default if None. models: a simulated
    drone for each flight, leaves (num_flights, ...); None: that of the parameters, or a black box.
    """
    params = start_pose_params(env.default_params if params is None else params, num_steps)
    num_flights = len(keys)
    size = -(-num_flights // -(-num_flights // BATCH))  # equal batches: one compiled program serves them
    parts = []
    for first in range(0, num_flights, size):
        # The last batch is filled up with its last flight.
        rows = np.minimum(np.arange(first, first + size), num_flights - 1)
        own = jax.tree.map(lambda leaf, rows=rows: leaf[rows], models)
        batch = _race_batch(env, network, policy_params, keys[rows], params, own, num_steps, num_laps)
        parts.append(jax.tree.map(np.asarray, batch))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:num_flights], *parts)
