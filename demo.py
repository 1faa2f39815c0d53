"""The main job on the shipped black box: collect, identify, train from scratch, fly (``make demo``)."""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.density import draw_position_density
from baselines.purejaxrl_ppo.evaluate import SHIPPED_BLACK_BOX, EvaluationSettings, evaluate
from baselines.purejaxrl_ppo.flights import fly_many, outcomes_of, score
from baselines.purejaxrl_ppo.recording import CANNOT_RECORD, can_record
from baselines.purejaxrl_ppo.resume import FINAL, checkpoints_in
from baselines.purejaxrl_ppo.training import train_policy
from flytrack_env import blackbox, save_model
from flytrack_env.files import fresh_folder, write_atomically
from flytrack_env.pictures import read_flights, write_pictures
from flytrack_sysid import Validation, collect, fit, held_out_rows, load_log, save_log, validate
from flytrack_sysid.validate import NAMES

DEFAULT_OUT = Path("runs/demo")
NUM_LAPS = 3
NUM_STEPS = 2500
NUM_EPISODES = 256


def identify(black_box: Path, out: Path, seed: int) -> dict[str, Validation]:
    """Fly the excitation on the black box, fit, write log and model to train on; return held-out errors.

    The minimal model leaves a force unexplained; linear drag, reported for the original drone, is then added.
    """
    save_log(out / "flight_log.npz", collect(blackbox.load(black_box), seed=seed))
    log = load_log(out / "flight_log.npz")
    fits = {"minimal": fit(log), "with_drag": fit(log, effects=("linear_drag",))}
    save_model(out / "model.json", fits["with_drag"].model, fits["with_drag"].provenance())
    rows = held_out_rows(log)
    return {name: validate(found.model, log, rows) for name, found in fits.items()}


def describe_identification(validations: dict[str, Validation]) -> None:
    """Print one-step errors on held-out data."""
    minimal, extended = validations["minimal"], validations["with_drag"]
    print("    one-step MSE on held-out data          minimal   with linear drag")
    for name, error in minimal.one_step.channels.items():
        print(f"      {NAMES[name]:36} {error.mse:9.3g} {extended.one_step.channels[name].mse:9.3g}")


def main() -> None:
    """Run the job, print lap times, write ``runs/demo``, or the next folder that is free."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--black-box", type=Path, default=SHIPPED_BLACK_BOX)
    parser.add_argument("--out", type=Path, help=f"folder (default: {DEFAULT_OUT}, or the next free one)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--total-timesteps", type=float, default=Config.total_timesteps)
    arguments = parser.parse_args()
    try:
        run(arguments)
    except (ValueError, OverflowError, OSError) as error:
        parser.error(str(error))


def run(arguments: argparse.Namespace) -> None:
    """Do the job; raises ValueError or OSError for what cannot be used, settings before any work."""
    started = time.perf_counter()
    config = Config(total_timesteps=int(arguments.total_timesteps))
    config.check()
    if not can_record():
        raise ValueError(f"the recording: {CANNOT_RECORD}")
    out, seed = arguments.out or fresh_folder(DEFAULT_OUT), arguments.seed
    if checkpoints_in(out):
        raise ValueError(f"--out: {out} holds the run of an earlier demo; remove it, or give another folder")
    out.mkdir(parents=True, exist_ok=True)

    print(f"1/4 collect and identify: {arguments.black_box}")
    validations = identify(arguments.black_box, out, seed)
    describe_identification(validations)

    print("2/4 train PPO from scratch on the identified model")
    checkpoint, _ = train_policy(out, config, seed, model=out / "model.json")

    print("3/4 fly the checkpoint on the black box")
    settings = EvaluationSettings(
        out / FINAL, NUM_STEPS, black_box=arguments.black_box, seed=seed, out=out / "rollout.npy"
    )
    report = evaluate(settings)
    report.write()
    print(report.text)
    env = report.scene.env
    flights = fly_many(env, checkpoint.network, checkpoint.params, seed, NUM_EPISODES, NUM_STEPS, NUM_LAPS)
    result = score(outcomes_of(flights, NUM_LAPS, len(env.track.gates)))

    summary: dict[str, Any] = {
        "seed": seed,
        "black_box": arguments.black_box.name,
        "validation": {name: errors.as_json() for name, errors in validations.items()},
        "training_steps": checkpoint.meta["steps"],
        "training_seconds": checkpoint.meta["seconds"],
        "rollout": report.numbers["first_flight"],
        "noisy_starts": {
            "episodes": NUM_EPISODES,
            "laps": NUM_LAPS,
            # JSON has no NaN: a time without a lap is null.
            **{name: None if np.isnan(v) else v for name, v in result._asdict().items()},
        },
        "seconds": round(time.perf_counter() - started, 1),
    }
    write_atomically(out / "summary.json", (json.dumps(summary, indent=2) + "\n").encode())
    print("4/4 draw")
    draw_position_density(out / "position_density.png", flights.positions(), env.track, NUM_EPISODES)
    write_pictures(read_flights([out / "rollout.npy"], env.track), out)
    report.record(out / "rollout.rrd", with_ghost=True)
    print(
        f"{result.success:.1%} of {NUM_EPISODES} noisy starts finish {NUM_LAPS} laps on the black "
        f"box; first lap {result.first_lap_s:.2f} s, flying lap {result.flying_lap_s:.2f} s"
    )
    print(f"written: {out}/ in {summary['seconds']} s")


if __name__ == "__main__":
    main()
