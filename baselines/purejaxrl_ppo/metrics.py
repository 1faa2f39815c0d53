"""Metrics of an update: its episodes and, in a race, laps and distance to the gate."""

import jax
import jax.numpy as jnp
import numpy as np

# Counts are summed over updates; means are weighted by them.
EPISODE_COUNT, LAP_COUNT = "episodes_ended", "laps_completed"
NOT_PER_EPISODE = (
    "done",
    "last_return",
    "lap_time_s",
)  # a lap time is zero at the end of most episodes


def summarize_episodes(log: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Return how many episodes ended in an update, and means over them, 0 if none did.

    Args:
        log: (num_steps, num_envs) arrays: done, episode_return and the environment's info.
    """
    done = log["done"]
    num_ended = done.sum()
    summary = {EPISODE_COUNT: num_ended}
    for name, values in log.items():
        if name not in NOT_PER_EPISODE:
            name = name if name.startswith("episode_") else f"episode_{name}"
            summary[name] = jnp.where(done, values, 0).sum() / jnp.maximum(num_ended, 1)
    return summary


def summarize_race(log: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Return metrics of the race in an update; nothing for an environment without a race.

    Returns: ``laps_completed``: number. ``lap_time_s``: mean, 0 without a lap. ``gate_distance_m``:
        mean over all steps.
    """
    if "lap_completed" not in log:
        return {}
    num_completed = log["lap_completed"].sum()
    total_s = jnp.where(log["lap_completed"], log["lap_time_s"], 0.0).sum()
    return {
        LAP_COUNT: num_completed,
        "lap_time_s": total_s / jnp.maximum(num_completed, 1),
        "gate_distance_m": log["gate_distance_m"].mean(),
    }


def summarize_updates(metrics: dict[str, np.ndarray]) -> dict[str, float]:
    """Return one value per metric for several updates.

    Counts are summed; means per episode are weighted by episodes, and lap times by laps. Means over
    nothing are left out.

    Args:
        metrics: by name, (num_updates,) each.
    """
    summary = {}
    for name, values in metrics.items():
        if name in (EPISODE_COUNT, LAP_COUNT):
            summary[name] = float(values.sum())
            continue
        weights = np.ones(len(values))
        if name.startswith("episode_"):
            weights = metrics[EPISODE_COUNT].astype(float)
        elif name == "lap_time_s":
            weights = metrics[LAP_COUNT].astype(float)
        if weights.sum() > 0:
            summary[name] = float(np.average(values.astype(float), weights=weights))
    return summary
