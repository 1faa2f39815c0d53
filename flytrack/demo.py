"""What ``flytrack demo`` does: collect, identify, train from scratch, fly, adapt, fly again."""

import dataclasses
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from baselines.purejaxrl_ppo import Checkpoint, Config
from baselines.purejaxrl_ppo.checkpoint import FINAL, checkpoints_in, save_checkpoint
from baselines.purejaxrl_ppo.checkpoint_env import plant_env
from baselines.purejaxrl_ppo.evaluate import EvaluationSettings, Report, evaluate
from baselines.purejaxrl_ppo.flights import (
    CANNOT_RECORD,
    Rollout,
    Score,
    can_record,
    fly_many,
    score,
)
from baselines.purejaxrl_ppo.monitor import draw_position_density
from baselines.purejaxrl_ppo.training import train_policy
from flytrack.flags import Demo
from flytrack_env import blackbox, save_model
from flytrack_env.files import fresh_folder, write_atomically
from flytrack_env.pictures import read_flights, write_pictures
from flytrack_env.progress import ProgressBar
from flytrack_loop import fly_log
from flytrack_loop.adapt import adapt, describe_adapted
from flytrack_sysid import Validation, collect, fit, held_out_rows, load_log, save_log, validate
from flytrack_sysid.validate import NAMES

DEFAULT_OUT = Path("runs/demo")
NUM_LAPS = 3
LOG_SECONDS = 10.0  # of the policy's own flight, which it is adapted to


class Size(NamedTuple):
    """How much is flown: minutes to identify from, steps of a flight in the race, noisy starts."""

    minutes: float
    num_steps: int
    num_episodes: int


WHOLE, QUICK = Size(2.0, 2500, 256), Size(1.0, 200, 16)


def identify(black_box: Path, out: Path, seed: int, minutes: float) -> dict[str, Validation]:
    """Identify the black box, write the log and the model to train on; return held-out errors.

    The minimal model leaves a force unexplained; linear drag, reported for the original drone, is
    then added.
    """
    flown = collect(blackbox.load(black_box), minutes, seed, report=ProgressBar("flights"))
    save_log(out / "flight_log.npz", flown)
    log = load_log(out / "flight_log.npz")
    fits = {
        "minimal": fit(log, report=ProgressBar("rounds")),
        "with_drag": fit(log, effects=("linear_drag",), report=ProgressBar("rounds")),
    }
    save_model(out / "model.json", fits["with_drag"].model, fits["with_drag"].provenance())
    rows = held_out_rows(log)
    return {name: validate(found.model, log, rows) for name, found in fits.items()}


def describe_identification(validations: dict[str, Validation]) -> None:
    """Print one-step errors on held-out data."""
    minimal, extended = validations["minimal"], validations["with_drag"]
    print("    one-step MSE on held-out data          minimal   with linear drag")
    for name, error in minimal.one_step.channels.items():
        print(
            f"      {NAMES[name]:36} {error.mse:9.3g} {extended.one_step.channels[name].mse:9.3g}"
        )


def run_demo(flags: Demo) -> None:
    """Do the job, print lap times, write ``runs/demo``, the next free folder, or the one asked for.

    Raises:
        ValueError, OSError: what cannot be used, settings before any work.
    """
    started = time.perf_counter()
    size, config = (
        (QUICK, Config(total_timesteps=Config().batch_size)) if flags.quick else (WHOLE, Config())
    )
    if flags.total_timesteps is not None:
        config = dataclasses.replace(config, total_timesteps=int(flags.total_timesteps))
    config.check()
    black_box, seed = flags.black_box or blackbox.SHIPPED, flags.seed
    blackbox.load(black_box)  # refuses before anything is written
    if flags.out and checkpoints_in(flags.out):
        raise ValueError(
            f"--out: {flags.out} holds the run of an earlier demo; remove it, "
            "or give another folder"
        )
    out = flags.out or fresh_folder(DEFAULT_OUT)
    out.mkdir(parents=True, exist_ok=True)

    print(f"1/5 collect and identify: {black_box}")
    validations = identify(black_box, out, seed, size.minutes)
    describe_identification(validations)

    print("2/5 train PPO from scratch on the identified model")
    checkpoint, _ = train_policy(out, config, seed, model=out / "model.json")

    print("3/5 fly the checkpoint on the black box")
    settings = EvaluationSettings(
        out / FINAL, size.num_steps, black_box=black_box, seed=seed, out=out / "rollout.npy"
    )
    report = evaluate(settings)
    report.write()
    print(report.text)
    flown = (seed, size.num_episodes, size.num_steps, NUM_LAPS)
    flights = fly_many(report.env, checkpoint.policy, *flown)
    result = score(flights.outcome)

    summary: dict[str, Any] = {
        "seed": seed,
        "black_box": black_box.name,
        "validation": {name: errors.as_json() for name, errors in validations.items()},
        "training_steps": checkpoint.meta["steps"],
        "training_seconds": checkpoint.meta["seconds"],
        "rollout": report.numbers["first_flight"],
        "noisy_starts": {"episodes": size.num_episodes, "laps": NUM_LAPS, **as_json(result)},
    }
    adapted = adapt_to_flight(out, checkpoint, black_box, flown)
    summary["adapted"] = adapted and as_json(adapted)
    summary["seconds"] = round(time.perf_counter() - started, 1)
    write_atomically(out / "summary.json", (json.dumps(summary, indent=2) + "\n").encode())
    print("5/5 draw")
    draw(out, report, flights, size.num_episodes)
    print(describe_race(result, size.num_episodes))
    if adapted is not None:
        print(f"adapted to its flight: {describe_race(adapted, size.num_episodes)}")
    print(f"written: {out}/ in {summary['seconds']} s")


def adapt_to_flight(
    out: Path, checkpoint: Checkpoint, black_box: Path, flown: tuple[int, int, int, int]
) -> Score | None:
    """Log some seconds of the policy's own flight, adapt it to them, and fly it again.

    Args:
        out: folder of the log and the new policy.
        checkpoint: the policy.
        black_box: file of the plant.
        flown: seed, noisy starts, steps and laps of the race.

    Returns:
        The race of the new policy; None where there is none.
    """
    print(f"4/5 log {LOG_SECONDS:g} s of its flight, see what differs, adapt the policy, fly again")
    plant = blackbox.load(black_box)
    try:
        log = fly_log(plant, checkpoint, flown[0], LOG_SECONDS, noise=1.0)
        save_log(out / "race_log.npz", log)
        adapted = adapt(log, checkpoint, flown[0], report=ProgressBar)
    except ValueError as error:  # a policy that learned nothing flies nothing to learn from
        print(f"not adapted: {error}")
        return None
    print(describe_adapted(adapted))
    if not adapted.is_new:
        return None
    new = adapted.checkpoint
    save_checkpoint(out / "adapted.safetensors", new.params, new.config, new.meta)
    return score(fly_many(plant_env(new, plant), new.policy, *flown).outcome)


def draw(out: Path, report: Report, flights: Rollout, num_episodes: int) -> None:
    """Write pictures of the flights and, where Rerun is installed, a recording of the first."""
    track = report.env.track
    draw_position_density(out / "position_density.png", flights.positions(), track, num_episodes)
    write_pictures(read_flights([out / "rollout.npy"], track), out)
    if can_record():
        report.record(out / "rollout.rrd", with_ghost=True)
    else:
        print(f"no recording: {CANNOT_RECORD}")


def as_json(result: Score) -> dict[str, float | None]:
    """Return a race as JSON values, which have no NaN: a time without a lap is null."""
    return {name: None if np.isnan(v) else v for name, v in result._asdict().items()}


def describe_race(result: Score, num_episodes: int) -> str:
    """Return a race in one line; times of laps that nobody completed are left out."""
    times = [("first lap", result.first_lap_s), ("flying lap", result.flying_lap_s)]
    laps = [f"{name} {seconds:.2f} s" for name, seconds in times if not np.isnan(seconds)]
    return (
        f"{result.success:.1%} of {num_episodes} noisy starts finish {NUM_LAPS} laps on the black "
        f"box; {', '.join(laps) or 'no lap was completed'}"
    )
