"""The loop's results: a table, rollouts, pictures, and a recording of flights before and after."""

from pathlib import Path

import jax
import numpy as np

from baselines.purejaxrl_ppo.checkpoint_env import plant_env, simulated_env, with_model_as_given
from baselines.purejaxrl_ppo.flights import (
    Rollout,
    can_record,
    fly_episode,
    record_flights,
    save_flight,
    start_pose_params,
)
from flytrack_env import load_track
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.pictures import read_flights, write_pictures
from flytrack_env.plants import Plant
from flytrack_loop.loop import Loop, seeds_of
from flytrack_loop.stages import NUM_LAPS, NUM_STEPS, Stage


def describe(loop: Loop) -> str:
    """Return before and after as lines of text: errors on held-out flight, the race, the gap."""
    columns = [_figures(stage) for stage in (loop.before, loop.after)]
    lines = [f"{'':58}{'before':>12}{'after':>12}"]
    for label in columns[0]:
        cells = "".join(f"{column.get(label, '-'):>12}" for column in columns)
        lines.append(f"{label:58}{cells}")
    return "\n".join(lines)


def _figures(stage: Stage) -> dict[str, str]:
    """Return what was measured of a stage as text, by what it is."""
    values: dict[str, tuple[float, str]] = {}
    if stage.errors is not None:
        for name, error in stage.errors.one_step_nrmse.items():
            values[f"held-out flight, one step, {name}: NRMSE"] = error, ".4f"
        for horizon, error in stage.errors.position_m.items():
            values[f"held-out flight, {horizon} s of free flight: position, m"] = error, ".4f"
    for side, score in stage.gap._asdict().items():
        values[f"{side}: starts that finish {NUM_LAPS} laps"] = score.success, ".1%"
        values[f"{side}: first lap, s"] = score.first_lap_s, ".3f"
        values[f"{side}: flying lap, s"] = score.flying_lap_s, ".3f"
    values["lap gap, plant against simulator, %"] = stage.gap.lap_percent, "+.2f"
    return {
        label: format(value, digits) if np.isfinite(value) else "-"
        for label, (value, digits) in values.items()
    }


def fly_one(stage: Stage, env: EpisodicEnvironment, seed: int) -> Rollout:
    """Return one flight of a stage's policy from a noisy start."""
    params = start_pose_params(with_model_as_given(env.default_params), NUM_STEPS)
    return fly_episode(
        env, stage.checkpoint.policy, jax.random.key(seed), params, NUM_STEPS, NUM_LAPS
    )


def write_flights(out: Path, loop: Loop, plant: Plant, seed: int) -> list[Path]:
    """Write a flight of each policy on the plant and in its simulator; return the files.

    All flights begin at the same start. The files are rollouts, pictures of them, and where Rerun
    is installed a recording of all.
    """
    start, track = seeds_of(seed)["evaluation"], load_track(loop.before.checkpoint.track)
    flights = {
        f"{stage.name}_{side}": fly_one(stage, env, start)
        for stage in (loop.before, loop.after)
        for side, env in (
            ("plant", plant_env(stage.checkpoint, plant)),
            ("simulator", simulated_env(stage.checkpoint)),
        )
    }
    files = []
    for name, flight in flights.items():
        files.append(out / f"{name}.npy")
        save_flight(files[-1], flight)
    files += write_pictures(read_flights(list(files), track), out)
    if can_record():
        record_flights(out / "flights.rrd", flights, track)
        files.append(out / "flights.rrd")
    return files
