"""Pictures of rollout files: ``python -m flytrack_env.pictures ROLLOUT ... --out FOLDER``."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from flytrack_env.pictures import read_flights, write_animation, write_pictures
from flytrack_env.references import shipped_reference
from flytrack_env.tracks import load_track


@dataclass(frozen=True)
class Settings:
    """Draw rollouts as PNGs, and a lap of each as GIF."""

    rollouts: tyro.conf.Positional[
        Annotated[tuple[Path, ...], tyro.conf.arg(metavar="ROLLOUT ...", help_behavior_hint="(at least one)")]
    ]
    """Rollout files (.npy)."""
    out: Path
    """Folder to write to."""
    track: str = "flytrack"
    """Name of a shipped track, or a track file (.toml)."""
    allow_pickle: bool = False
    """Read pickled rollouts. Unpickling runs whatever code a file holds: allow it for files you trust."""
    animation: bool = False
    """Also write the fastest flying lap of each beside the time-optimal one as GIF."""
    ghost_model: Literal["nominal", "black_box"] = "nominal"
    """Drone for which the animation's other lap is optimal."""


def _draw(settings: Settings) -> None:
    """Draw the flights; raises ImportError, OSError or ValueError for what cannot be drawn."""
    if not settings.rollouts:
        raise ValueError("rollouts: found none, expected at least one file")
    folder = settings.out
    found = next(path for path in (folder, *folder.parents) if path.exists())
    if not found.is_dir():
        raise NotADirectoryError(f"--out {folder}: found a file, {found}, expected a folder or a new path")
    track = load_track(settings.track)
    flights = read_flights(settings.rollouts, track, settings.allow_pickle)
    paths = write_pictures(flights, folder)
    if settings.animation:
        reference = shipped_reference(track.name, "flying", settings.ghost_model)
        paths += [write_animation(flight, reference, folder) for flight in flights]
    for path in paths:
        print(f"{path}: {path.stat().st_size} bytes")


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw rollout files from the command line; return the exit status."""
    settings = tyro.cli(
        Settings,
        args=arguments,
        prog="python -m flytrack_env.pictures",
        config=[tyro.conf.FlagCreatePairsOff],
    )
    try:
        _draw(settings)
    except (ImportError, OSError, ValueError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
