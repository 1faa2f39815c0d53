"""What is told of an update: its episodes, and where they are a race, laps and distance to the gate."""

import jax
import jax.numpy as jnp
import numpy as np

from baselines.purejaxrl_ppo.across import Across

# What a mean over updates is weighted by; counts are summed.
OF_EPISODES, OF_LAPS = "episodes_ended", "laps_completed"
NOT_OF_AN_EPISODE = ("done", "last_return", "lap_time_s")  # of a lap: zero at the end of most episodes


def summarise_episodes(log: dict[str, jax.Array], across: Across) -> dict[str, jax.Array]:
    """Return how many episodes ended in an update, and means over them; 0 where none did.

    ``log`` holds (num_steps, num_envs) arrays: done, episode_return and the environment's info.
    """
    done = log["done"]
    num_ended = across.sum(done)
    summary = {OF_EPISODES: num_ended}
    for name, values in log.items():
        if name not in NOT_OF_AN_EPISODE:
            name = name if name.startswith("episode_") else f"episode_{name}"
            summary[name] = across.sum(jnp.where(done, values, 0)) / jnp.maximum(num_ended, 1)
    return summary


def summarise_race(log: dict[str, jax.Array], across: Across) -> dict[str, jax.Array]:
    """Return what a racing environment's info says of all steps of an update; nothing for others.

    laps_completed: number of them. lap_time_s: their mean, 0 where there was none. gate_distance_m: mean.
    """
    if "lap_completed" not in log:
        return {}
    num_completed = across.sum(log["lap_completed"])
    total_s = across.sum(jnp.where(log["lap_completed"], log["lap_time_s"], 0.0))
    return {
        OF_LAPS: num_completed,
        "lap_time_s": total_s / jnp.maximum(num_completed, 1),
        "gate_distance_m": across.mean(log["gate_distance_m"]),
    }


def summarise_updates(metrics: dict[str, np.ndarray]) -> dict[str, float]:
    """Return one value per metric of some updates, (num_updates,) each, leaving out means over nothing.

    Means per episode are weighted by the episodes, times per lap by the laps; counts are summed.
    """
    summary = {}
    for name, values in metrics.items():
        if name in (OF_EPISODES, OF_LAPS):
            summary[name] = float(values.sum())
            continue
        weights = np.ones(len(values))
        if name.startswith("episode_"):
            weights = metrics[OF_EPISODES].astype(float)
        elif name == "lap_time_s":
            weights = metrics[OF_LAPS].astype(float)
        if weights.sum() > 0:
            summary[name] = float(np.average(values.astype(float), weights=weights))
    return summary
