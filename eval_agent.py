"""Fly a checkpoint: ``python eval_agent.py --checkpoint PATH --steps N [--episodes E] [--plants K]``.

A black box moves the drone; the environment's own gate logic says what was passed, when, and why a flight
ended. With ``--plants``, drawn simulated plants move it instead. The first flight's rollout is written as a
plain numeric array (T, 25) = [x 21 | u 4]. What is printed and stored: docs/baseline.md.
"""

import argparse
import json
import os
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import Checkpoint, CheckpointError, load_checkpoint
from baselines.purejaxrl_ppo.evaluate import fly_episode, race_many, start_keys, start_pose_params
from baselines.purejaxrl_ppo.flights import Flight, Outcomes, outcomes_of, save_flown
from baselines.purejaxrl_ppo.perturbed import Plants, draw_plants, with_model_as_given
from baselines.purejaxrl_ppo.report import describe, describe_report, lap_times, reason_ended
from baselines.purejaxrl_ppo.summary import summarise
from benchmarks.optimal.compared import compare, time_lost
from flytrack_env import EnvParams, blackbox
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.files import write_atomically
from flytrack_env.model_file import model_from_json
from flytrack_env.references import (
    ReferenceFileError,
    References,
    ghost_rollout,
    is_model_of,
    shipped_references,
)
from flytrack_env.rollout import save_rollout

SHIPPED_BLACK_BOX = Path(__file__).parent / "blackbox" / "acro_step.bin"

SCHEMA = 1
DEFAULT_LAPS = 3
MAX_SEED = 2**31
MAX_STEPS = 1_000_000  # hours: the battery is empty after minutes
MAX_LAPS = 100  # their gate times are kept for every flight
MAX_FLIGHTS = 100_000  # so that the gate times of all of them fit into memory
BLACK_BOX_MODELS, NOMINAL_MODELS = ("black_box", "nominal"), ("nominal",)  # of references, the best first


def black_box_env(
    checkpoint: Checkpoint, black_box: Path, track: str | Path | None = None
) -> EpisodicEnvironment:
    """Return the checkpoint's environment with the black box in place of the simulator.

    track: name or file; the checkpoint's if None.

    Raises:
        BlackBoxError, CheckpointError, TrackError: a file that cannot be used.
    """
    return _checked_env(checkpoint, track, plant=blackbox.load(black_box))


def simulated_env(checkpoint: Checkpoint, track: str | Path | None = None) -> EpisodicEnvironment:
    """Return the checkpoint's environment with the simulator and the model that it was trained on.

    Raises:
        CheckpointError, TrackError: a file that cannot be used, a checkpoint that does not hold its model.
    """
    if "model" not in checkpoint.meta:
        raise CheckpointError("checkpoint: model: found none in it, expected the one it was trained on")
    return _checked_env(
        checkpoint, track, model=model_from_json(checkpoint.meta["model"], "checkpoint: model")
    )


def _checked_env(checkpoint: Checkpoint, track: str | Path | None, **arguments: Any) -> EpisodicEnvironment:
    env = flytrack_env.make(
        checkpoint.env_id,
        track=checkpoint.track if track is None else track,
        missed_gate=checkpoint.meta["missed_gate"],
        **arguments,
    )
    checkpoint.check_fits(env)
    env.check_params(env.default_params)
    return env


def fly_on_black_box(checkpoint: Checkpoint, black_box: Path, num_steps: int, seed: int) -> Flight:
    """Return one flight of the policy on a black box, from a noisy start pose, any number of laps."""
    env = black_box_env(checkpoint, black_box)
    return _fly_one(env, checkpoint, jax.random.key(seed), env.default_params, num_steps, num_steps)


def _fly_one(
    env: EpisodicEnvironment,
    checkpoint: Checkpoint,
    key: jax.Array,
    params: EnvParams,
    num_steps: int,
    num_laps: int,
) -> Flight:
    network, params = checkpoint.network, start_pose_params(params, num_steps)
    return fly_episode(env, network, checkpoint.params, key, params, num_steps, num_laps)


def ghost_path(out: Path) -> Path:
    """Return where the ghost of a rollout lies."""
    return out.with_name(f"{out.stem}_ghost.npy")


class Scene(NamedTuple):
    """What is flown: environment, its parameters, drawn plants (None: a black box), references if any."""

    env: EpisodicEnvironment
    params: EnvParams
    plants: Plants | None
    references: References | None


def set_scene(checkpoint: Checkpoint, arguments: argparse.Namespace) -> Scene:
    """Return what the command line asks to fly; raises ValueError or OSError for what cannot be used."""
    if arguments.plants is None:
        black_box = arguments.black_box or SHIPPED_BLACK_BOX
        env, plants = black_box_env(checkpoint, black_box, arguments.track), None
        is_shipped = black_box.read_bytes() == SHIPPED_BLACK_BOX.read_bytes()
    else:
        env = simulated_env(checkpoint, arguments.track)
        model = env.default_params.model
        plants = draw_plants(arguments.seed, arguments.plants, model)
        is_shipped = is_model_of(env.track.name, BLACK_BOX_MODELS[0], model)
    try:
        references = shipped_references(env.track, BLACK_BOX_MODELS if is_shipped else NOMINAL_MODELS)
    except ReferenceFileError:
        if arguments.ghost:
            raise
        references = None
    return Scene(env, with_model_as_given(env.default_params), plants, references)


def fly_scene(scene: Scene, checkpoint: Checkpoint, arguments: argparse.Namespace) -> tuple[Outcomes, Flight]:
    """Return what came of all flights, and the first flight step by step."""
    env, params, plants, _ = scene
    steps, episodes = arguments.steps, arguments.episodes
    if plants is None and episodes == 1:
        key, num_laps = jax.random.key(arguments.seed), arguments.laps or steps
        flight = _fly_one(env, checkpoint, key, params, steps, num_laps)
        flights = jax.tree.map(lambda leaf: leaf[None], flight)
        return outcomes_of(flights, num_laps, len(env.track.gates)), flight
    keys = start_keys(arguments.seed, episodes * (arguments.plants or 1))
    models = None if plants is None else plants.repeated(episodes)
    policy = (checkpoint.network, checkpoint.params)
    outcomes = race_many(env, *policy, keys, steps, arguments.laps, params, models)
    if plants is not None:
        params = params.replace(model=plants.model(0))
    return outcomes, _fly_one(env, checkpoint, keys[0], params, steps, arguments.laps)


def make_report(
    scene: Scene, checkpoint: Checkpoint, arguments: argparse.Namespace, outcomes: Outcomes
) -> dict[str, Any]:
    """Return all that is told of an evaluation, as JSON values: docs/baseline.md says what each is."""
    plants, references = scene.plants, scene.references
    report: dict[str, Any] = {
        "schema": SCHEMA,
        "package_version": flytrack_env.__version__,
        "checkpoint": str(arguments.checkpoint),
        "env_id": checkpoint.env_id,
        "track": scene.env.track.name,
        "gates_per_lap": len(scene.env.track.gates),
        "black_box": None if plants is not None else str(arguments.black_box or SHIPPED_BLACK_BOX),
        "seed": arguments.seed,
        "steps_limit": arguments.steps,
        "laps": arguments.laps,
        "episodes": arguments.episodes,
        **summarise(outcomes, is_limited=arguments.laps is not None),
        "plants": None,
        "optimal": None,
        "time_lost_s": None,
    }
    if plants is not None:
        is_complete = outcomes.is_complete().reshape(arguments.plants, arguments.episodes)
        report["success"] |= {} if arguments.episodes == 1 else {"low": None, "high": None}
        report["plants"] = plants.summarise(is_complete)
    if references is not None:
        report["optimal"] = compare(report, references)
        if arguments.ghost:
            report["time_lost_s"] = time_lost(outcomes, references)
    return report


def evaluate(arguments: argparse.Namespace) -> None:
    """Fly, print, write; raises ValueError or OSError for what cannot be used, before anything is flown."""
    checkpoint = load_checkpoint(arguments.checkpoint)
    scene = set_scene(checkpoint, arguments)
    outcomes, flight = fly_scene(scene, checkpoint, arguments)
    report = make_report(scene, checkpoint, arguments, outcomes)
    if arguments.episodes == 1 and arguments.plants is None:
        print(describe(flight, float(scene.params.dt), arguments.laps))
    if arguments.laps is not None or arguments.ghost:
        print(describe_report(report), end="")
    save_flown(arguments.out, flight)
    print(f"rollout: {arguments.out}")
    first_flight = {
        "steps": int(np.sum(flight.is_flying)),
        "gates": int(np.max(flight.gates_passed)),
        "lap_times_s": lap_times(flight).tolist(),
        "ended": reason_ended(flight, arguments.laps),
    }
    written = {"first_flight": first_flight, "rollout": str(arguments.out), "ghost": None}
    if arguments.ghost:
        path = ghost_path(arguments.out)
        save_rollout(path, *ghost_rollout(scene.references, first_flight["steps"]))
        written["ghost"] = str(path)
        print(f"ghost: {path}")
    if arguments.json is not None:
        content = json.dumps(report | written, indent=2, allow_nan=False) + "\n"
        write_atomically(arguments.json, content.encode())
        print(f"json: {arguments.json}")


def parse_arguments(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Return the command line's arguments, checked as far as that goes without reading a file."""
    parser.add_argument("--checkpoint", type=Path, required=True, help="of train_ppo: final.msgpack")
    parser.add_argument("--steps", type=int, required=True, help="time limit; at 100 Hz, 2000 are 20 s")
    parser.add_argument("--episodes", type=int, default=1, help="noisy starts, on each plant (%(default)s)")
    parser.add_argument("--laps", type=int, help=f"to complete ({DEFAULT_LAPS}; one flight: no limit)")
    parser.add_argument(
        "--plants", type=int, metavar="K", help="fly K simulated plants, drawn around the checkpoint's model"
    )
    parser.add_argument("--black-box", type=Path, help=f"file ({SHIPPED_BLACK_BOX.name}, as shipped)")
    parser.add_argument("--track", metavar="NAME_OR_FILE", help="default: the checkpoint's")
    parser.add_argument("--seed", type=int, default=0, help="of the noisy starts and of the plants")
    parser.add_argument("--ghost", action="store_true", help="compare with the time-optimal flight, write it")
    parser.add_argument(
        "--out", type=Path, default=Path("rollout.npy"), help="rollout of the first flight (%(default)s)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all that is printed")
    arguments = parser.parse_args()
    if arguments.plants is not None and arguments.black_box is not None:
        parser.error(f"--plants: found --black-box {arguments.black_box} beside it, expected one of the two")
    is_many = arguments.episodes != 1 or arguments.plants is not None
    if arguments.laps is None and is_many:
        arguments.laps = DEFAULT_LAPS
    limits = {"steps": (1, MAX_STEPS), "episodes": (1, MAX_FLIGHTS), "laps": (1, MAX_LAPS)}
    limits |= {"plants": (1, MAX_FLIGHTS // max(arguments.episodes, 1)), "seed": (0, MAX_SEED - 1)}
    for name, (low, high) in limits.items():
        value = getattr(arguments, name)
        if value is not None and not low <= value <= high:
            parser.error(f"--{name}: found {value}, expected {low} to {high}")
    check_files(parser, arguments)
    return arguments


def check_files(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """End the program, saying why, where a file could not be written, or would replace one that is read."""
    out, json_file = arguments.out, arguments.json
    read = {path.resolve() for path in (arguments.checkpoint, arguments.black_box) if path is not None}
    for name, path in (("--out", out), ("--json", json_file)):
        if path is None:
            continue
        if path.resolve() in read:
            parser.error(f"{name}: found {path}, which is read, expected another file")
        if path.is_dir():
            parser.error(f"{name}: {path} is a folder, expected the path of a file")
        nearest = next(folder for folder in path.absolute().parents if folder.exists())
        if not nearest.is_dir():
            parser.error(f"{name}: {path}: found a file {nearest}, expected a folder")
        if not os.access(nearest, os.W_OK):
            parser.error(f"{name}: {path}: found no permission to write in {nearest}")
    if json_file is not None and json_file.absolute() in (out.absolute(), ghost_path(out).absolute()):
        parser.error(f"--json: found {json_file}, expected another file than the rollouts")


def main() -> None:
    """Parse the command line, fly, print the result, write the files."""
    parser = argparse.ArgumentParser(description=__doc__)
    arguments = parse_arguments(parser)
    try:
        evaluate(arguments)
    except (ValueError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
