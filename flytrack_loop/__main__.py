"""Close the loop on a plant: ``python -m flytrack_loop --black-box acro_step.bin [--out FOLDER]``.

``--plant betaflight`` is real firmware on a simulated body instead (docs/firmware.md).

Collects, fits the minimal model, trains, flies; diagnoses the log of that flight, extends the model, trains
again and flies again. Prints before and after; writes logs, models, diagnosis, policies, flights and
``loop.json``.
"""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from baselines.purejaxrl_ppo import Config
from flytrack_env import ModelParameters, blackbox
from flytrack_env.files import fresh_folder
from flytrack_env.plants import Plant
from flytrack_loop.loop import Settings, close_loop
from flytrack_loop.report import describe, write_flights


@dataclass(frozen=True)
class Command:
    """Identify a plant, train, fly, diagnose the flight, extend the model, train and fly again."""

    black_box: Path | None = None
    """The plant (.bin)."""
    plant: Literal["betaflight"] | None = None
    """Instead of a black box: Betaflight's firmware on a simulated body, of a clone."""
    dump: Path | None = None
    """Of the firmware's settings: the text of a pilot's dump or diff all."""
    skip: tuple[str, ...] = ()
    """Patterns of settings in the dump that are left out."""
    body: Path | None = None
    """Of the firmware's body: a JSON object of fields of firmware.Body."""
    out: Path | None = None
    """Folder to write to (default: runs/loop_NAME, or the next free name)."""
    seed: int = 0
    """Seed of flights and trainings."""
    total_timesteps: float = Config.total_timesteps
    """Environment steps of each training."""
    settings: Settings = field(default_factory=Settings)


@contextmanager
def _opened(command: Command) -> Iterator[tuple[Plant, ModelParameters | None]]:
    """Give the plant, and the model to fit from if it has one of its own; nothing is left running."""
    if (command.black_box is None) == (command.plant is None):
        raise ValueError("plant: expected one of --black-box FILE and --plant betaflight")
    if command.black_box is not None:
        if command.dump or command.body or command.skip:
            raise ValueError("--dump, --skip and --body: expected with --plant betaflight only")
        yield blackbox.load(command.black_box), None
        return
    try:
        from firmware import Betaflight, Body, read_body
    except ModuleNotFoundError as error:
        raise ValueError("--plant betaflight: found no folder firmware/, expected a clone") from error
    dump = None if command.dump is None else command.dump.read_text(encoding="utf-8")
    body = Body() if command.body is None else read_body(command.body)
    with Betaflight({} if dump is None else dump, body, command.skip) as plant:
        yield plant, plant.nominal_model()


def _run(command: Command) -> None:
    """Close the loop and print before and after; raises OSError or ValueError for what cannot be used."""
    name = command.plant or (command.black_box and command.black_box.stem)
    config = Config(total_timesteps=int(command.total_timesteps))
    with _opened(command) as (plant, start):
        out = command.out or fresh_folder(Path("runs") / f"loop_{name}")
        loop = close_loop(plant, out, config, command.seed, command.settings, start=start)
        files = write_flights(out, loop, plant, command.seed)
    print(describe(loop))
    print(f"written: {out}/ with loop.json, diagnosis/report.html, {', '.join(one.name for one in files)}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Close the loop from the command line; return the exit status."""
    command = tyro.cli(
        Command, args=arguments, prog="python -m flytrack_loop", config=[tyro.conf.OmitArgPrefixes]
    )
    try:
        _run(command)
    except (OSError, OverflowError, ValueError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
