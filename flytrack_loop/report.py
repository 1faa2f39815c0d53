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
    before, after = loop.before, loop.after

    def line(label: str, first: float | None, second: float | None, form: str) -> str:
        cells = (
            "-" if one is None or not np.isfinite(one) else format(one, form)
            for one in (first, second)
        )
        return f"{label:58}" + "".join(f"{cell:>12}" for cell in cells)

    lines = [f"{'':58}{'before':>12}{'after':>12}"]
    if before.errors is not None and after.errors is not None:
        for name, value in before.errors.one_step_nrmse.items():
            label = f"held-out flight, one step, {name}: NRMSE"
            lines.append(line(label, value, after.errors.one_step_nrmse.get(name), ".4f"))
        for horizon, value in before.errors.position_m.items():
            label = f"held-out flight, {horizon} s of free flight: position, m"
            lines.append(line(label, value, after.errors.position_m.get(horizon), ".4f"))
    for side in ("simulator", "plant"):
        first, second = getattr(before.gap, side), getattr(after.gap, side)
        lines.append(
            line(
                f"{side}: starts that finish {NUM_LAPS} laps", first.success, second.success, ".1%"
            )
        )
        for name in ("first_lap_s", "flying_lap_s"):
            label = f"{side}: {name.removesuffix('_s').replace('_', ' ')}, s"
            lines.append(line(label, getattr(first, name), getattr(second, name), ".3f"))
    lines.append(
        line(
            "lap gap, plant against simulator, %",
            before.gap.lap_percent,
            after.gap.lap_percent,
            "+.2f",
        )
    )
    return "\n".join(lines)


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
