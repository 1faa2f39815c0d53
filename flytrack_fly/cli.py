"""Fly the quadcopter by keyboard or gamepad, in real time, against a ghost (docs/fly.md)."""

import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain, count
from pathlib import Path
from typing import Annotated

import tyro

from flytrack_env import load_model, load_track
from flytrack_env.extras import check_installed
from flytrack_env.flown_race import STEP_S
from flytrack_env.rendering import open_window
from flytrack_env.rollout import save_rollout
from flytrack_fly.ghost import Kind, make_ghost
from flytrack_fly.session import Flight, Session
from flytrack_fly.sticks import Gamepad

PROG = "python -m flytrack_fly"


@dataclass(frozen=True)
class Settings:
    """Fly the quadcopter by keyboard or gamepad, in real time, against a ghost."""

    track: str = "flytrack"
    """Name of a shipped track, or a track file (.toml)."""
    model: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(optional)")] = None
    """Model file of the drone; by default the nominal drone, or the champion's own with its ghost."""
    ghost: Kind = "reference"
    """Fly against the time-optimal flight, against the shipped champion (extra [train]), or alone."""
    controls: Gamepad = field(default_factory=Gamepad)
    out: Path = Path("runs/flight.npy")
    """Rollout to write; a number is added to the name where the file exists."""


def _fly(settings: Settings) -> list[str]:
    """Fly, write what was flown, and return a line about each flight."""
    settings.controls.check()
    folder = next(path for path in settings.out.absolute().parents if path.exists())
    if not folder.is_dir():
        raise NotADirectoryError(f"--out {settings.out}: found a file, {folder}, expected a folder")
    track = load_track(settings.track)
    model = None if settings.model is None else load_model(settings.model)
    check_installed("fly", "flights by hand", "pygame", "PIL")
    window = open_window(STEP_S, must_be_seen=True)
    from flytrack_fly.play import Controls, play, tick_of_clock

    controls = Controls(settings.controls)
    print("compiling ...", file=sys.stderr)
    ghost, model = make_ghost(settings.ghost, track, model)
    session = Session(track, model, ghost)
    try:
        with suppress(KeyboardInterrupt):  # quits, too
            play(session, controls, window.put, tick_of_clock())
    finally:  # whatever happened
        lines = save(session.flights, settings.out)
    return lines


def save(flights: list[Flight], out: Path) -> list[str]:
    """Write the flights that passed a gate, or else the last one; return a line about each.

    No file is overwritten: where ``out`` exists, _2, _3 and so on is added to its name.

    Raises:
        OSError: a file that cannot be written.
    """
    flown, lines = [one for one in flights if one.commands], []
    for flight in [one for one in flown if one.num_gates] or flown[-1:]:
        names = (out.with_stem(f"{out.stem}_{number}") for number in count(2))
        path = next(path for path in chain([out], names) if not path.exists())
        save_rollout(path, *flight.rollout())
        laps = ", ".join(f"{time_s:.3f} s" for time_s in flight.lap_times_s) or "none"
        flown_s = f"{flight.log.time_s:.2f} s, {flight.num_gates} gates, laps: {laps}"
        lines.append(f"{path}: {flown_s}; ended: {flight.ended}")
    return lines or ["nothing was flown, nothing was written"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Fly as the command line says, and print what was flown and where it was written."""
    config = (tyro.conf.OmitArgPrefixes,)
    settings = tyro.cli(Settings, args=arguments, prog=PROG, description=__doc__, config=config)
    try:
        print("\n".join(_fly(settings)))
    except (ImportError, OSError, ValueError) as error:
        print(f"{PROG}: error: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(2) from error
