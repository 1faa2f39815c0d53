"""Recordings of rollout files: ``python -m flytrack_env.viz_rerun ROLLOUT ... --out RRD``."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from flytrack_env.references import ghost_rollout, shipped_references
from flytrack_env.rollout import load_named_rollouts
from flytrack_env.tracks import load_track
from flytrack_env.viz_rerun.recording import write_recording
from flytrack_env.viz_rerun.trajectory import Trajectory

DEMO_STEPS = 1200
NO_HINT = "(optional)"  # tyro would print "(default: None)"


@dataclass(frozen=True)
class Settings:
    """Write rollouts as one Rerun recording; without any, a time-optimal flight."""

    rollouts: tyro.conf.Positional[
        Annotated[tuple[Path, ...], tyro.conf.arg(metavar="[ROLLOUT ...]", help_behavior_hint=NO_HINT)]
    ] = ()
    """Rollout files (.npy)."""
    out: Path = Path("rollout.rrd")
    """Recording to write."""
    track: str = "flytrack"
    """Name of a shipped track, or a track file (.toml)."""
    allow_pickle: bool = False
    """Read pickled rollouts. Unpickling runs whatever code a file holds: allow it for files you trust."""
    ghost: Annotated[
        Literal["time_optimal"] | None, tyro.conf.arg(metavar="time_optimal", help_behavior_hint=NO_HINT)
    ] = None
    """Fly the time-optimal flight beside them."""
    ghost_model: Literal["nominal", "black_box"] = "nominal"
    """Drone for which the ghost is optimal."""


def write(settings: Settings) -> None:
    """Write the recording; raises ValueError for what cannot be read, shown or written."""
    out = settings.out
    if out.resolve() in {path.resolve() for path in [*settings.rollouts, Path(settings.track)]}:
        raise ValueError(f"--out: found {out}, which is read, expected another file")
    track = load_track(settings.track)
    rollouts = load_named_rollouts(settings.rollouts, settings.allow_pickle)
    flights = [Trajectory(name, *rollout) for name, rollout in rollouts.items()]
    num_steps = max((len(flight.states) for flight in flights), default=DEMO_STEPS)
    if settings.ghost or not flights:
        references = shipped_references(track, (settings.ghost_model,))
        flights.append(Trajectory("time-optimal", *ghost_rollout(references, num_steps)))
    write_recording(out, flights, track)
    print(f"{out}: {num_steps} steps, {out.stat().st_size} bytes")


def main(arguments: Sequence[str] | None = None) -> int:
    """Write a recording from the command line; return the exit status."""
    settings = tyro.cli(
        Settings,
        args=arguments,
        prog="python -m flytrack_env.viz_rerun",
        config=[tyro.conf.FlagCreatePairsOff],
    )
    try:
        write(settings)
    except ValueError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
