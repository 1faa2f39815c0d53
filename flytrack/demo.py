"""What ``flytrack demo`` does: collect, identify, train from scratch, fly."""

import dataclasses
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.checkpoint import FINAL, checkpoints_in
from baselines.purejaxrl_ppo.evaluate import EvaluationSettings, evaluate
from baselines.purejaxrl_ppo.flights import CANNOT_RECORD, can_record, fly_many, score
from baselines.purejaxrl_ppo.monitor import draw_position_density
from baselines.purejaxrl_ppo.training import train_policy
from flytrack.flags import Demo
from flytrack_env import blackbox, save_model
from flytrack_env.files import fresh_folder, write_atomically
from flytrack_env.pictures import read_flights, write_pictures
from flytrack_env.progress import ProgressBar
from flytrack_sysid import Validation, collect, fit, held_out_rows, load_log, save_log, validate
from flytrack_sysid.validate import NAMES

DEFAULT_OUT = Path("runs/demo")
NUM_LAPS = 3


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

    print(f"1/4 collect and identify: {black_box}")
    validations = identify(black_box, out, seed, size.minutes)
    describe_identification(validations)

    print("2/4 train PPO from scratch on the identified model")
    checkpoint, _ = train_policy(out, config, seed, model=out / "model.json")

    print("3/4 fly the checkpoint on the black box")
    settings = EvaluationSettings(
        out / FINAL, size.num_steps, black_box=black_box, seed=seed, out=out / "rollout.npy"
    )
    report = evaluate(settings)
    report.write()
    print(report.text)
    env = report.env
    flown = (seed, size.num_episodes, size.num_steps, NUM_LAPS)
    flights = fly_many(env, checkpoint.policy, *flown)
    result = score(flights.outcome)

    summary: dict[str, Any] = {
        "seed": seed,
        "black_box": black_box.name,
        "validation": {name: errors.as_json() for name, errors in validations.items()},
        "training_steps": checkpoint.meta["steps"],
        "training_seconds": checkpoint.meta["seconds"],
        "rollout": report.numbers["first_flight"],
        "noisy_starts": {
            "episodes": size.num_episodes,
            "laps": NUM_LAPS,
            # JSON has no NaN: a time without a lap is null.
            **{name: None if np.isnan(v) else v for name, v in result._asdict().items()},
        },
        "seconds": round(time.perf_counter() - started, 1),
    }
    write_atomically(out / "summary.json", (json.dumps(summary, indent=2) + "\n").encode())
    print("4/4 draw")
    draw_position_density(
        out / "position_density.png", flights.positions(), env.track, size.num_episodes
    )
    write_pictures(read_flights([out / "rollout.npy"], env.track), out)
    if can_record():
        report.record(out / "rollout.rrd", with_ghost=True)
    else:
        print(f"no recording: {CANNOT_RECORD}")
    print(
        f"{result.success:.1%} of {size.num_episodes} noisy starts finish {NUM_LAPS} laps "
        f"on the black box; first lap {result.first_lap_s:.2f} s, "
        f"flying lap {result.flying_lap_s:.2f} s"
    )
    print(f"written: {out}/ in {summary['seconds']} s")
