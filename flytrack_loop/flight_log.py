"""The log of a policy's own flights on a plant."""

import numpy as np

from baselines.purejaxrl_ppo import Checkpoint
from baselines.purejaxrl_ppo.flights import Rollout, fly_many
from baselines.purejaxrl_ppo.race_env import plant_env
from flytrack_env import nominal_parameters
from flytrack_env.plants import Plant
from flytrack_sysid import FlightLog, log_of_states
from flytrack_sysid.sensors import measure

FEWEST_ROWS = 50  # of a flight that is kept: half a second
BATCH = 16  # flights that are flown at once


def fly_log(
    plant: Plant,
    checkpoint: Checkpoint,
    seed: int,
    seconds: float = 60.0,
    noise: float = 0.0,
    num_laps: int = 3,
    num_steps: int = 2500,
) -> FlightLog:
    """Return the log of a policy's flights on a plant, from noisy starts, a segment per flight.

    seconds: flights are added until the log is that long, or there were 16 of them. noise: 0 logs states as
    they are, 1 as common sensors would (``flytrack_sysid.sensors``). num_laps, num_steps: what ends a flight
    beside a crash.

    Raises:
        ValueError: no flight lasts half a second.
    """
    env = plant_env(checkpoint, plant)
    flights = fly_many(env, checkpoint.network, checkpoint.params, seed, BATCH, num_steps, num_laps)
    return log_of_flights(flights, float(env.default_params.dt), seed, seconds, noise)


def log_of_flights(flights: Rollout, dt: float, seed: int, seconds: float, noise: float) -> FlightLog:
    """Return flights, leaves (num_flights, num_steps, ...), as ``fly_log`` does; seed: of the noise."""
    is_flying = np.asarray(flights.is_flying)
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    for states, actions, flown in zip(flights.states, flights.actions, is_flying, strict=True):
        if sum(len(rows) for rows, _ in kept) * dt >= seconds:
            break
        if flown.sum() >= FEWEST_ROWS:
            kept.append((np.asarray(states)[flown], np.asarray(actions)[flown]))
    if not kept:
        raise ValueError(
            f"policy: found {len(is_flying)} flights of at most {is_flying.sum(axis=1).max()} steps, "
            f"expected one of {FEWEST_ROWS} or more"
        )
    log = log_of_states(kept, dt, f"{len(kept)} flights of the policy")
    if noise > 0.0:
        log = measure(log, noise, float(nominal_parameters().g), np.random.default_rng(seed))
    return log
