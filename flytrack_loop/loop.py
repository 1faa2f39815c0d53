"""The loop: collect, fit, train, fly, diagnose the flight, extend the model, retrain, fly again."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from baselines.purejaxrl_ppo import Config
from flytrack_env import ModelParameters, nominal_parameters, save_model
from flytrack_env.files import write_atomically
from flytrack_env.plants import Plant
from flytrack_env.progress import ProgressBar
from flytrack_loop.stages import Stage, errors_of, fly_log, stage_as_json, train_stage
from flytrack_sysid import Diagnosis, FlightLog, collect, diagnose, fit, save_log
from flytrack_sysid.diagnosis import joined, motion_of, text_of, write_diagnosis
from flytrack_sysid.log import usual_step

SCHEMA = 1
# One stream of random numbers per use, all of one seed.
STREAMS = ("collect", "train", "race_log", "held_out_log", "evaluation")


@dataclass(frozen=True)
class Settings:
    """What the loop flies, and how noisy its logs are.

    The policy itself observes the plant's state.
    """

    minutes: float = 2.0
    """Minutes of excitation."""
    log_seconds: float = 60.0
    """Seconds of the policy's own flights in the log that is diagnosed."""
    noise: float = 1.0
    """Noise of the sensors in all logs: 0 none, 1 that of common sensors."""


class Loop(NamedTuple):
    """The results of the loop on a plant.

    Attributes:
        before, after: policies of the minimal and of the extended model, the same if nothing was
            named.
        diagnosis: of race_log, flights of the first policy, together with the excitation.
        held_out: more flights of it, used for testing only.
    """

    before: Stage
    diagnosis: Diagnosis
    after: Stage
    excitation: FlightLog
    race_log: FlightLog
    held_out: FlightLog


def seeds_of(seed: int) -> dict[str, int]:
    """Return a seed for each of the loop's uses of randomness."""
    words = np.random.SeedSequence(seed).generate_state(len(STREAMS))
    return {name: int(word >> 1) for name, word in zip(STREAMS, words, strict=True)}


def close_loop(
    plant: Plant,
    out: Path,
    config: Config = Config(),  # noqa: B008, a frozen dataclass
    seed: int = 0,
    settings: Settings = Settings(),
    start: ModelParameters | None = None,
) -> Loop:
    """Close the loop on a plant.

    Logs, models, diagnosis, trainings and ``loop.json`` are written into ``out``.

    Args:
        plant: a black box, or any ``flytrack_env.plants.Plant``.
        config: of both trainings.
        start: the model to fit from, and how it moves; the nominal one, moving as fits the log, if
            None.

    Raises:
        ValueError: a plant that does not fly, settings that cannot be used, ``out`` with another
            run in it.
    """
    config.check()
    out.mkdir(parents=True, exist_ok=True)
    seeds = seeds_of(seed)
    print("1/6 collect and fit the minimal model")
    excitation = collect(
        plant, settings.minutes, seeds["collect"], settings.noise, ProgressBar("flights")
    )
    save_log(out / "excitation.npz", excitation)
    motion = None if start is None else start.motion
    if start is None:
        start = nominal_parameters()
        start = start._replace(motion=motion_of(excitation, start))
    fitted = fit(excitation, start, report=ProgressBar("rounds"))
    save_model(out / "minimal.json", fitted.model, fitted.provenance())

    print("2/6 train on it")
    rest = (plant, out, config, seeds["train"], seeds["evaluation"])
    before = train_stage("before", fitted.model, *rest)
    print("3/6 fly, and log the flight")
    length, noise = settings.log_seconds, settings.noise
    race_log = fly_log(plant, before.checkpoint, seeds["race_log"], length, noise)
    held_out = fly_log(plant, before.checkpoint, seeds["held_out_log"], length, noise)
    save_log(out / "race.npz", race_log)
    save_log(out / "held_out.npz", held_out)
    before = before._replace(errors=errors_of(fitted.model, held_out))

    print("4/6 diagnose the flight, extend the model")
    logs = [race_log, excitation]
    found = diagnose(logs, fitted.model, report=ProgressBar("stages"), motion=motion)
    write_diagnosis(out / "diagnosis", found, joined(logs))
    print(text_of(found))
    if found.causes or found.beyond or found.learned is not None:
        print("5/6 train on the extended model")
        after = train_stage("after", found.extended, *rest, held_out)
    else:
        print("5/6 nothing was named: the policy stays")
        after = before._replace(name="after")
    loop = Loop(before, found, after, excitation, race_log, held_out)
    print("6/6 flown again")
    content = json.dumps(loop_as_json(loop, seed, config, settings), indent=2, allow_nan=False)
    write_atomically(out / "loop.json", f"{content}\n".encode())
    return loop


def loop_as_json(loop: Loop, seed: int, config: Config, settings: Settings) -> dict[str, Any]:
    """Return what was measured as JSON values."""
    return {
        "schema": SCHEMA,
        "seed": seed,
        "training_steps": config.num_updates * config.batch_size,
        "settings": asdict(settings),
        "verdict": loop.diagnosis.verdict,
        "causes": [cause.effect for cause in loop.diagnosis.causes],
        "race_log_s": round(float(usual_step(loop.race_log).sum()), 2),
        "stages": [stage_as_json(stage) for stage in (loop.before, loop.after)],
    }
