"""A stage of the loop: a model, its policy, their results on the plant, and logs of flights."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from baselines.purejaxrl_ppo import Checkpoint, Config
from baselines.purejaxrl_ppo.checkpoint_env import plant_env, simulated_env, with_model_as_given
from baselines.purejaxrl_ppo.flights import Rollout, Score, fly_many, race_many, score, start_keys
from baselines.purejaxrl_ppo.training import train_policy
from flytrack_env import nominal_parameters
from flytrack_env.dynamics import ModelParameters
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.plants import Plant
from flytrack_sysid import FlightLog, log_of_states, validate
from flytrack_sysid.sensors import measure

NUM_EPISODES, NUM_LAPS, NUM_STEPS = 256, 3, 2500
MIN_ROWS = 50  # of a flight that is kept: half a second
BATCH = 16  # flights that are flown at once


class Errors(NamedTuple):
    """What a model gets wrong on flights that it has not seen.

    Both numbers lack what the log cannot tell: flights end where the drone crashes.

    Attributes:
        one_step_nrmse: by channel; 1 is as bad as "nothing changes" or the mean.
        position_m: median error of free flight, by seconds.
    """

    one_step_nrmse: dict[str, float]
    position_m: dict[str, float]


class Gap(NamedTuple):
    """The same policy in its simulator and on the plant, from the same noisy starts.

    Attributes:
        simulator, plant: the race there.
    """

    simulator: Score
    plant: Score

    @property
    def lap_percent(self) -> float:
        """How much longer a flying lap takes on the plant than simulated, %; NaN without laps."""
        return 100.0 * (self.plant.flying_lap_s / self.simulator.flying_lap_s - 1.0)


class Stage(NamedTuple):
    """A model and the policy that was trained on it.

    Attributes:
        name: of the stage, and of the training's folder.
        checkpoint: of the policy.
        gap: its race.
        errors: of the model, None where there was no log to judge it by.
    """

    name: str
    model: ModelParameters
    checkpoint: Checkpoint
    gap: Gap
    errors: Errors | None


def errors_of(model: ModelParameters, log: FlightLog) -> Errors:
    """Return what a model gets wrong on a log, all of which is judged."""
    found = validate(model, log)
    one_step = {
        name: one.nrmse for name, one in found.one_step.channels.items() if one.nrmse is not None
    }
    position = {
        f"{rollout.horizon_s:g}": rollout.errors["position"].median
        for rollout in found.rollouts
        if "position" in rollout.errors
    }
    return Errors(one_step, position)


def race(
    checkpoint: Checkpoint, env: EpisodicEnvironment, seed: int, episodes: int = NUM_EPISODES
) -> Score:
    """Return a policy's results from perturbed starts: share that finishes 3 laps, lap times."""
    keys, params = start_keys(seed, episodes), with_model_as_given(env.default_params)
    return score(race_many(env, checkpoint.policy, keys, NUM_STEPS, NUM_LAPS, params))


def measure_gap(
    checkpoint: Checkpoint, plant: Plant, seed: int, episodes: int = NUM_EPISODES
) -> Gap:
    """Return the race in the simulator and on the plant."""
    return Gap(
        race(checkpoint, simulated_env(checkpoint), seed, episodes),
        race(checkpoint, plant_env(checkpoint, plant), seed, episodes),
    )


def fly_log(
    plant: Plant, checkpoint: Checkpoint, seed: int, seconds: float = 60.0, noise: float = 0.0
) -> FlightLog:
    """Return the log of a policy's flights on a plant, from noisy starts, a segment per flight.

    Three laps end a flight, or 25 s, or a crash.

    Args:
        seconds: flights are added until the log is that long, or there were 16 of them.
        noise: 0 logs states as they are, 1 as common sensors would (``flytrack_sysid.sensors``).

    Raises:
        ValueError: no flight lasts half a second.
    """
    env = plant_env(checkpoint, plant)
    flights = fly_many(env, checkpoint.policy, seed, BATCH, NUM_STEPS, NUM_LAPS)
    return log_of_flights(flights, float(env.default_params.dt), seed, seconds, noise)


def log_of_flights(
    flights: Rollout, dt: float, seed: int, seconds: float, noise: float
) -> FlightLog:
    """Return flights, leaves (num_flights, num_steps, ...), as a log; seed: of the noise."""
    is_flying = np.asarray(flights.is_flying)
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    for states, actions, flown in zip(flights.states, flights.actions, is_flying, strict=True):
        if sum(len(rows) for rows, _ in kept) * dt >= seconds:
            break
        if flown.sum() >= MIN_ROWS:
            kept.append((np.asarray(states)[flown], np.asarray(actions)[flown]))
    if not kept:
        raise ValueError(
            f"policy: found {len(is_flying)} flights of at most "
            f"{is_flying.sum(axis=1).max()} steps, expected one of {MIN_ROWS} or more"
        )
    log = log_of_states(kept, dt, f"{len(kept)} flights of the policy")
    if noise > 0.0:
        log = measure(log, noise, float(nominal_parameters().g), np.random.default_rng(seed))
    return log


def train_stage(
    name: str,
    model: ModelParameters,
    plant: Plant,
    out: Path,
    config: Config,
    seed: int,
    evaluation_seed: int,
    held_out: FlightLog | None = None,
    env_id: str = "FlyTrack-v0",
) -> Stage:
    """Train a policy on a model, from scratch, and race it; ``out``/NAME holds the training.

    Args:
        evaluation_seed: of the noisy starts.
        held_out: a log to judge the model by, if there is one.
    """
    checkpoint, _ = train_policy(out / name, config, seed, env_id, model=model)
    return judge(name, model, checkpoint, plant, evaluation_seed, held_out)


def judge(
    name: str,
    model: ModelParameters,
    checkpoint: Checkpoint,
    plant: Plant,
    evaluation_seed: int,
    held_out: FlightLog | None = None,
) -> Stage:
    """Return the stage of a policy that is trained already."""
    gap = measure_gap(checkpoint, plant, evaluation_seed)
    return Stage(
        name, model, checkpoint, gap, None if held_out is None else errors_of(model, held_out)
    )


def rounded(value: float) -> float | None:
    """Return a number as JSON has it, null where there is none."""
    return round(float(value), 6) if np.isfinite(value) else None


def stage_as_json(stage: Stage) -> dict[str, Any]:
    """Return what was measured of a stage as JSON values; null where there is no number."""
    content = {side: one._asdict() for side, one in stage.gap._asdict().items()}
    content["lap_gap_percent"] = stage.gap.lap_percent
    content["errors"] = stage.errors and stage.errors._asdict()
    return {"name": stage.name, **jax.tree.map(rounded, content)}
