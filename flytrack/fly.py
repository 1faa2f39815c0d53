"""What ``flytrack fly`` does, and its flags."""

import sys
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain, count
from pathlib import Path

from flytrack.flags import OptionalPath
from flytrack_env import load_model, load_track
from flytrack_env.extras import check_installed
from flytrack_env.flown_race import STEP_S
from flytrack_env.rendering import open_window
from flytrack_env.rollout import save_rollout
from flytrack_fly.ghost import Kind, make_ghost
from flytrack_fly.session import Flight, Session
from flytrack_fly.sticks import Gamepad


@dataclass(frozen=True)
class Fly:
    """Flags of ``flytrack fly``."""

    track: str = "flytrack"
    """Name of a shipped track, or a track file (.toml)."""
    model: OptionalPath = None
    """Model file of the drone; default: the nominal drone, or the champion's own with its ghost."""
    ghost: Kind = "reference"
    """Fly against the time-optimal flight, against the shipped champion (extra train), or alone."""
    race: bool = False
    """Race it: it starts once, with you half a metre behind, does not wait at laps, and can be
    hit."""
    controls: Gamepad = field(default_factory=Gamepad)
    out: Path = Path("runs/flight.npy")
    """Rollout to write; a number is added to the name where the file exists."""


def run_fly(flags: Fly) -> None:
    """Fly until the pilot quits, write what was flown, and print a line about each flight.

    Raises:
        ImportError, OSError, ValueError: what cannot be flown, shown or written.
    """
    check_installed("fly", "flights by hand", "pygame", "PIL")
    flags.controls.check()
    folder = next(path for path in flags.out.absolute().parents if path.exists())
    if not folder.is_dir():
        raise NotADirectoryError(f"--out {flags.out}: found a file, {folder}, expected a folder")
    track = load_track(flags.track)
    model = None if flags.model is None else load_model(flags.model)
    window = open_window(STEP_S, must_be_seen=True)
    from flytrack_fly.play import Controls, play, tick_of_clock

    controls = Controls(flags.controls)
    print("compiling ...", file=sys.stderr)
    ghost, model = make_ghost(flags.ghost, track, model)
    session = Session(track, model, ghost, flags.race)
    try:
        with suppress(KeyboardInterrupt):  # quits, too
            play(session, controls, window.put, tick_of_clock())
    finally:  # whatever happened
        print("\n".join(save(session.flights, flags.out)))


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
