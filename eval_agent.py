"""Fly a checkpoint: ``python eval_agent.py --checkpoint PATH --steps N [--episodes E] [--plants K]``.

A black box moves the drone; the environment's own gate logic says what was passed, when, and why a flight
ended. With ``--plants``, drawn simulated plants move it instead. The first flight's rollout is written as a
plain numeric array (T, 25) = [x 21 | u 4]. What is printed and stored: docs/baseline.md.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import Checkpoint, load_checkpoint
from baselines.purejaxrl_ppo.eval_options import ghost_path, parse_arguments
from baselines.purejaxrl_ppo.evaluate import fly_episode, race_many, start_keys, start_pose_params
from baselines.purejaxrl_ppo.flights import Flight, Outcomes, outcomes_of, save_flown
from baselines.purejaxrl_ppo.flown_env import plant_env, simulated_env
from baselines.purejaxrl_ppo.perturbed import Plants, draw_plants, with_model_as_given
from baselines.purejaxrl_ppo.recording import record_flights
from baselines.purejaxrl_ppo.report import describe, describe_report, lap_times, reason_ended
from baselines.purejaxrl_ppo.summary import summarise
from benchmarks.optimal.compared import compare, time_lost
from flytrack_env import EnvParams, blackbox
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.files import write_atomically
from flytrack_env.references import (
    ReferenceFileError,
    References,
    ghost_rollout,
    is_model_of,
    shipped_references,
)
from flytrack_env.rollout import save_rollout
from flytrack_env.tracks import Track

SHIPPED_BLACK_BOX = Path(__file__).parent / "blackbox" / "acro_step.bin"

SCHEMA = 1
BLACK_BOX_MODELS, NOMINAL_MODELS = ("black_box", "nominal"), ("nominal",)  # of references, the best first


def black_box_env(
    checkpoint: Checkpoint, black_box: Path, track: str | Path | None = None
) -> EpisodicEnvironment:
    """Return the checkpoint's environment with the black box in place of the simulator.

    track: name or file; the checkpoint's if None.

    Raises:
        BlackBoxError, CheckpointError, TrackError: a file that cannot be used.
    """
    return plant_env(checkpoint, blackbox.load(black_box), track)


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


def reference_models(black_box: Path) -> tuple[str, ...]:
    """Return the names of the models whose time-optimal flights a black box is compared with, best first."""
    is_shipped = black_box.read_bytes() == SHIPPED_BLACK_BOX.read_bytes()
    return BLACK_BOX_MODELS if is_shipped else NOMINAL_MODELS


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
        models = reference_models(black_box)
    else:
        env = simulated_env(checkpoint, arguments.track)
        model = env.default_params.model
        plants = draw_plants(arguments.seed, arguments.plants, model)
        is_shipped = is_model_of(env.track.name, BLACK_BOX_MODELS[0], model)
        models = BLACK_BOX_MODELS if is_shipped else NOMINAL_MODELS
    try:
        references = shipped_references(env.track, models)
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
        num_laps = arguments.laps or steps
        flight = _fly_one(env, checkpoint, first_key(arguments), params, steps, num_laps)
        flights = jax.tree.map(lambda leaf: leaf[None], flight)
        return outcomes_of(flights, num_laps, len(env.track.gates)), flight
    keys = _start_keys(arguments)
    models = None if plants is None else plants.repeated(episodes)
    policy = (checkpoint.network, checkpoint.params)
    outcomes = race_many(env, *policy, keys, steps, arguments.laps, params, models)
    if plants is not None:
        params = params.replace(model=plants.model(0))
    return outcomes, _fly_one(env, checkpoint, keys[0], params, steps, arguments.laps)


def _start_keys(arguments: argparse.Namespace) -> jax.Array:
    return start_keys(arguments.seed, arguments.episodes * (arguments.plants or 1))


def first_key(arguments: argparse.Namespace) -> jax.Array:
    """Return the key that the first flight starts from."""
    is_many = arguments.episodes != 1 or arguments.plants is not None
    return _start_keys(arguments)[0] if is_many else jax.random.key(arguments.seed)


def fly_beside(checkpoint: Checkpoint, key: jax.Array, num_steps: int, num_laps: int, track: Track) -> Flight:
    """Return the flight from the same start in the simulator, with the model that the policy learnt on.

    Beside a flight on a plant it shows what that simulator gets wrong.

    Raises:
        CheckpointError: a checkpoint that does not hold its model.
    """
    env = simulated_env(checkpoint, track)
    return _fly_one(env, checkpoint, key, with_model_as_given(env.default_params), num_steps, num_laps)


def record(scene: Scene, checkpoint: Checkpoint, arguments: argparse.Namespace, flight: Flight) -> None:
    """Write the first flight as a Rerun recording, the simulator's beside it, and the ghost if asked for."""
    flights = {"black box" if scene.plants is None else "first plant": flight}
    if "model" in checkpoint.meta:
        num_laps = arguments.laps or arguments.steps
        flights["simulator"] = fly_beside(
            checkpoint, first_key(arguments), arguments.steps, num_laps, scene.env.track
        )
    references = scene.references if arguments.ghost else None
    record_flights(arguments.rrd, flights, scene.env.track, arguments.laps, references)
    names = ", ".join([*flights, *(["time-optimal"] if references is not None else [])])
    print(f"recording: {arguments.rrd}, {names}: {arguments.rrd.stat().st_size} bytes")


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
    written = {"first_flight": first_flight, "rollout": str(arguments.out), "ghost": None, "recording": None}
    if arguments.ghost:
        path = ghost_path(arguments.out)
        save_rollout(path, *ghost_rollout(scene.references, first_flight["steps"]))
        written["ghost"] = str(path)
        print(f"ghost: {path}")
    if arguments.rrd is not None:
        record(scene, checkpoint, arguments, flight)
        written["recording"] = str(arguments.rrd)
    if arguments.json is not None:
        content = json.dumps(report | written, indent=2, allow_nan=False) + "\n"
        write_atomically(arguments.json, content.encode())
        print(f"json: {arguments.json}")


def main() -> None:
    """Parse the command line, fly, print the result, write the files."""
    parser = argparse.ArgumentParser(description=__doc__)
    arguments = parse_arguments(parser, SHIPPED_BLACK_BOX)
    try:
        evaluate(arguments)
    except (ImportError, ValueError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
