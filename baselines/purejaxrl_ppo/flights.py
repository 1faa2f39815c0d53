"""Flying a policy from noisy start poses: rollouts, their outcomes and their score.

``fly_episode`` and ``fly_many`` keep every step; ``race_many`` keeps the outcomes only, flies no
step beyond the last flight's end, and is for thousands of flights. Both are made of the same step.
Rerun is imported when a recording is written.
"""

from collections.abc import Callable, Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from baselines.purejaxrl_ppo.networks import Memory, Policy
from flytrack_env.dynamics import ModelParameters
from flytrack_env.env import EnvParams
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.references import References, ghost_restarts, ghost_rollout
from flytrack_env.rollout import save_rollout
from flytrack_env.state import POSITION, pack
from flytrack_env.terminations import Causes
from flytrack_env.tracks import Track, cross_gate

CANNOT_RECORD = (
    "found no rerun-sdk, or RERUN turned off; expected pip install 'flytrack[viz]', RERUN unset"
)
BATCH = 1024  # flights side by side: more exceed a core's cache, fewer leave its vector units idle


class Outcomes(NamedTuple):
    """Outcomes of flights; leaves (num_flights, ...), or without the first axis for one.

    Attributes:
        steps: number flown.
        gates_passed: number.
        laps: number completed.
        lap_times_s: (num_laps,), the first from standstill; NaN where not reached.
        gate_times_s: s since the reset, (num_laps * num_gates,); NaN where not reached.
        causes: of termination.
    """

    steps: Any
    gates_passed: Any
    laps: Any
    lap_times_s: Any
    gate_times_s: Any
    causes: Causes

    def is_complete(self) -> np.ndarray:
        """Return which flights completed their laps, (num_flights,)."""
        return np.asarray(self.laps) >= np.shape(self.lap_times_s)[-1]

    def first_laps_s(self) -> np.ndarray:
        """Return the times of completed first laps, from standstill, s, (number of these,)."""
        times = np.asarray(self.lap_times_s)[..., 0]
        return times[np.isfinite(times)]

    def flying_laps_s(self) -> np.ndarray:
        """Return the times of all later laps that were completed, s, (number of these,)."""
        times = np.asarray(self.lap_times_s)[..., 1:]
        return times[np.isfinite(times)]

    def ends(self) -> dict[str, np.ndarray]:
        """Return, by cause, masks (num_flights,) of the flights it ended before their last lap."""
        is_complete = self.is_complete()
        causes = {
            name: np.asarray(cause) & ~is_complete for name, cause in self.causes._asdict().items()
        }
        is_ended = np.any(list(causes.values()), axis=0)
        return {**causes, "time_limit": ~is_complete & ~is_ended}

    def end_reason(self) -> str:
        """Return the causes that ended one flight, or that laps or steps are complete."""
        causes = [name for name, happened in self.causes._asdict().items() if happened]
        if self.is_complete():
            return "laps complete"
        return ", ".join(causes) or "all steps flown"


class Rollout(NamedTuple):
    """One episode; leaves (num_steps, ...), or (num_episodes, num_steps, ...) for many.

    Attributes:
        states: before each step, (21,).
        actions: clipped as commanded, (4,).
        is_flying: whether the step was flown; what follows the end is padding.
        outcome: of the episode, without the axis of steps.
    """

    states: jax.Array
    actions: jax.Array
    is_flying: jax.Array
    outcome: Outcomes

    def positions(self) -> np.ndarray:
        """Return every position flown through, (num_samples, 3), world, m."""
        return self.flown()[0][:, POSITION]

    def flown(self) -> tuple[np.ndarray, np.ndarray]:
        """Return states and actions of the steps that were flown, (num_samples, ...)."""
        is_flying = np.asarray(self.is_flying)
        return np.asarray(self.states)[is_flying], np.asarray(self.actions)[is_flying]


class Score(NamedTuple):
    """Score of many episodes.

    Attributes:
        success: share that completed the laps.
        gates: mean number passed.
        first_lap_s: mean time of the first lap, from standstill; NaN where there was none.
        flying_lap_s: mean time of the later laps; NaN where there was none.
    """

    success: float
    gates: float
    first_lap_s: float
    flying_lap_s: float


def save_flight(path: Path, rollout: Rollout) -> None:
    """Write the steps of one rollout that were flown as a rollout file."""
    save_rollout(path, *rollout.flown())


def can_record() -> bool:
    """Return whether Rerun is installed, and not turned off by its environment variable."""
    if find_spec("rerun") is None:
        return False
    import rerun

    return rerun.is_enabled(rerun.RecordingStream("flytrack_probe"))


def record_flights(
    path: Path,
    flights: Mapping[str, Rollout],
    track: Track,
    references: References | None = None,
) -> None:
    """Write flights by name on one timeline as a Rerun recording; the first is in the foreground.

    Args:
        path: of the recording.
        flights: by name.
        track: that is shown.
        references: the time-optimal flights of the track, shown as ghost.

    Raises:
        ImportError: Rerun is not installed; the message says how to install it.
        ValueError: a path that cannot be written.
    """
    from flytrack_env.viz_rerun import Trajectory, write_recording

    shown = []
    for name, flight in flights.items():
        ended = flight.outcome.end_reason().replace("_", " ")
        shown.append(Trajectory(name, *flight.flown(), ended=ended))
    if references is not None:
        longest = max(len(flight.states) for flight in shown)
        restarts = ghost_restarts(references, longest)
        ghost = ghost_rollout(references, longest)
        shown.append(Trajectory("time-optimal", *ghost, restarts=restarts))
    write_recording(path, shown, track)


def score(outcomes: Outcomes) -> Score:
    """Return the score of many flights."""

    def mean(times_s: np.ndarray) -> float:
        return float(times_s.mean()) if times_s.size else float("nan")

    return Score(
        success=float(outcomes.is_complete().mean()),
        gates=float(outcomes.gates_passed.mean()),
        first_lap_s=mean(outcomes.first_laps_s()),
        flying_lap_s=mean(outcomes.flying_laps_s()),
    )


def start_pose_params(params: EnvParams, num_steps: int) -> EnvParams:
    """Return parameters for episodes of at most ``num_steps`` from the noisy start pose."""
    return params.replace(
        reset=params.reset._replace(course_fraction=0.0), max_steps_in_episode=num_steps
    )


Carry = tuple[Memory, jax.Array, Any, jax.Array, Outcomes]


def begin_flight(
    env: EpisodicEnvironment, policy: Policy, key: jax.Array, params: EnvParams, num_laps: int
) -> Carry:
    """Return what ``advance_flight`` takes, before its first step."""
    outcome = Outcomes(
        steps=jnp.int32(0),
        gates_passed=jnp.int32(0),
        laps=jnp.int32(0),
        lap_times_s=jnp.full(num_laps, jnp.nan),
        gate_times_s=jnp.full(num_laps * params.course.num_gates, jnp.nan),
        causes=Causes(*(jnp.asarray(False) for _ in Causes._fields)),
    )
    return policy.network.first_memory(), *env.reset(key, params), jnp.asarray(False), outcome


def advance_flight(
    env: EpisodicEnvironment, policy: Policy, params: EnvParams, carry: Carry
) -> tuple[Carry, jax.Array]:
    """Return a flight after a step of the mean action, and the action.

    Args:
        carry: memory, observation, state, whether the flight is over, and its outcome so far.
    """
    memory, observation, state, _, outcome = carry
    memory, action = policy.network.act(policy.params, memory, observation)
    observation, after, _, terminated, info = env.step_env(None, state, action, params)
    ends_w, race = (env.drone(state).pos_w, env.drone(after).pos_w), env.race(state)
    fraction = cross_gate(race.gate, *ends_w, params.drone_radius).fraction
    lap, gate = jnp.arange(outcome.lap_times_s.size), jnp.arange(outcome.gate_times_s.size)
    is_lap = info["lap_completed"] & (lap == info["laps"] - 1)
    # Two gates can be passed in one step; both have the time of the first.
    is_pass = (gate >= outcome.gates_passed) & (gate < info["gates_passed"])
    outcome = Outcomes(
        steps=outcome.steps + 1,
        gates_passed=info["gates_passed"],
        laps=info["laps"],
        lap_times_s=jnp.where(is_lap, info["lap_time_s"], outcome.lap_times_s),
        gate_times_s=jnp.where(
            is_pass, (outcome.steps + fraction) * params.dt, outcome.gate_times_s
        ),
        causes=Causes(*(info[name] for name in Causes._fields)),
    )
    is_over = terminated | (info["laps"] >= lap.size)
    return (memory, observation, after, is_over, outcome), action


@partial(jax.jit, static_argnames=("env", "num_steps", "num_laps"))
def fly_episode(
    env: EpisodicEnvironment,
    policy: Policy,
    key: jax.Array,
    params: EnvParams,
    num_steps: int,
    num_laps: int,
) -> Rollout:
    """Return one episode of the mean action, from a reset to its end or to ``num_laps`` laps."""

    def advance(carry: Carry, _: None) -> tuple[Carry, tuple[jax.Array, ...]]:
        state, is_over = carry[2:4]
        later, action = advance_flight(env, policy, params, carry)
        kept = jax.tree.map(partial(jnp.where, is_over), carry, later)
        return kept, (pack(env.drone(state)), action, ~is_over)

    start = begin_flight(env, policy, key, params, num_laps)
    last, (states, actions, is_flying) = jax.lax.scan(advance, start, None, num_steps)
    return Rollout(states, actions, is_flying, outcome=last[-1])


def fly_many(
    env: EpisodicEnvironment,
    policy: Policy,
    seed: int,
    num_episodes: int,
    num_steps: int,
    num_laps: int,
) -> Rollout:
    """Return episodes from noisy start poses, leaves (num_episodes, num_steps, ...)."""
    params = start_pose_params(env.default_params, num_steps)
    fly = partial(fly_episode, env, policy)
    flights = jax.vmap(lambda key: fly(key, params, num_steps, num_laps))(
        start_keys(seed, num_episodes)
    )
    jax.block_until_ready(flights)
    env.plant.check_alive()
    return flights


def start_keys(seed: int, num_episodes: int) -> jax.Array:
    """Return keys of episodes, (num_episodes,); fewer episodes get the first of the same keys."""
    return jax.random.split(jax.random.key(seed), num_episodes)


@partial(jax.jit, static_argnames=("env", "num_laps"))
def _race_batch(
    env: EpisodicEnvironment,
    policy: Policy,
    keys: jax.Array,
    params: EnvParams,
    models: ModelParameters | None,
    num_steps: int,
    num_laps: int,
) -> Outcomes:
    """Return the outcomes of one batch of flights.

    Args:
        models: one for each key, or None for that of ``params``.
    """

    def race(key: jax.Array, model: ModelParameters | None) -> Outcomes:
        own = params if model is None else params.replace(model=model)

        def is_flying(carry: Carry) -> jax.Array:
            *_, is_over, outcome = carry
            return ~is_over & (outcome.steps < num_steps)

        def advance(carry: Carry) -> Carry:
            return advance_flight(env, policy, own, carry)[0]

        # Under vmap the loop runs until no flight is left, and flights that are over stay as they
        # are.
        start = begin_flight(env, policy, key, own, num_laps)
        return jax.lax.while_loop(is_flying, advance, start)[-1]

    return jax.vmap(race)(keys, models)


def race_many(
    env: EpisodicEnvironment,
    policy: Policy,
    keys: jax.Array,
    num_steps: int,
    num_laps: int,
    params: EnvParams | None = None,
    models: ModelParameters | None = None,
    report: Callable[[int, int], None] | None = None,
) -> Outcomes:
    """Return the outcomes of flights from noisy start poses, one per key, as NumPy arrays.

    Args:
        env: that is flown in.
        policy: whose mean action flies.
        keys: of the flights, (num_flights,).
        num_steps: time limit of a flight.
        num_laps: laps to complete.
        params: of the environment, its default if None.
        models: a simulated drone for each flight, leaves (num_flights, ...); None: that of the
            parameters, or a black box.
        report: called with the number of flights flown and of all.
    """
    params = start_pose_params(env.default_params if params is None else params, num_steps)
    num_flights = len(keys)
    size = -(
        -num_flights // -(-num_flights // BATCH)
    )  # equal batches: one compiled program serves them
    parts = []
    for first in range(0, num_flights, size):
        # The last batch is filled up with its last flight.
        rows = np.minimum(np.arange(first, first + size), num_flights - 1)
        own = jax.tree.map(lambda leaf, rows=rows: leaf[rows], models)
        batch = _race_batch(env, policy, keys[rows], params, own, num_steps, num_laps)
        parts.append(jax.tree.map(np.asarray, batch))
        env.plant.check_alive()
        if report is not None:
            report(min(first + size, num_flights), num_flights)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:num_flights], *parts)
