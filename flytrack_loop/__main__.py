"""Close the loop on a black box: ``python -m flytrack_loop --black-box acro_step.bin [--out FOLDER]``.

Collects, fits the minimal model, trains, flies; diagnoses the log of that flight, extends the model, trains
again and flies again. Prints before and after; writes logs, models, diagnosis, policies, flights and
``loop.json``.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from baselines.purejaxrl_ppo import Config
from flytrack_env import blackbox
from flytrack_env.files import fresh_folder
from flytrack_loop.loop import Settings, close_loop
from flytrack_loop.report import describe, write_flights


@dataclass(frozen=True)
class Command:
    """Identify a black box, train, fly, diagnose the flight, extend the model, train and fly again."""

    black_box: Path
    """The plant (.bin)."""
    out: Path | None = None
    """Folder to write to (default: runs/loop_NAME, or the next free name)."""
    seed: int = 0
    """Seed of flights and trainings."""
    total_timesteps: float = Config.total_timesteps
    """Environment steps of each training."""
    settings: Settings = field(default_factory=Settings)


def _run(command: Command) -> None:
    """Close the loop and print before and after; raises OSError or ValueError for what cannot be used."""
    plant = blackbox.load(command.black_box)
    out = command.out or fresh_folder(Path("runs") / f"loop_{command.black_box.stem}")
    config = Config(total_timesteps=int(command.total_timesteps))
    loop = close_loop(plant, out, config, command.seed, command.settings)
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
