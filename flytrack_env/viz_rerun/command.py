"""The command ``python -m flytrack_env.viz_rerun``."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from flytrack_env.references import ghost_rollout, shipped_references
from flytrack_env.rollout import load_rollout
from flytrack_env.tracks import Track, load_track
from flytrack_env.viz_rerun.flights import ShownFlight
from flytrack_env.viz_rerun.recording import write_recording
from flytrack_env.viz_rerun.serving import serve

GHOST = "time_optimal"
GHOST_MODELS = ("nominal", "black_box")
DEMO_STEPS = 1200
DEFAULT_PORT = 9090


def ghost_flight(track: Track, num_steps: int, model_name: str = GHOST_MODELS[0]) -> ShownFlight:
    """Return the time-optimal flight of a shipped track, a standing start and flying laps.

    model_name: of the drone that it is optimal for, "nominal" or "black_box" (the shipped one, identified).

    Raises:
        ReferenceFileError: none for this track and model.
    """
    states, actions = ghost_rollout(shipped_references(track, (model_name,)), num_steps)
    return ShownFlight("time-optimal", states, actions)


def rollout_flights(paths: Sequence[Path], allow_pickle: bool = False) -> list[ShownFlight]:
    """Return the flights of rollout files, named after their files, with their folders where those are alike.

    Raises:
        RolloutError: a file that is no rollout. ValueError: a file that is given twice.
    """
    stems = [path.stem for path in paths]
    names = stems if len(set(stems)) == len(stems) else [str(path.with_suffix("")) for path in paths]
    if len(set(names)) != len(names):
        raise ValueError(f"rollout: found {', '.join(map(str, paths))}, expected every file once")
    return [
        ShownFlight(name, *load_rollout(path, allow_pickle)) for name, path in zip(names, paths, strict=True)
    ]


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command."""
    parser = argparse.ArgumentParser(
        prog="python -m flytrack_env.viz_rerun",
        description="Write rollouts as one Rerun recording; without any, a time-optimal flight as a demo.",
    )
    parser.add_argument("rollouts", type=Path, nargs="*", metavar="ROLLOUT", help="rollout file (.npy)")
    parser.add_argument("--out", type=Path, default=Path("rollout.rrd"), help="recording (%(default)s)")
    parser.add_argument("--track", default="flytrack", help="track name or .toml (%(default)s)")
    parser.add_argument("--ghost", choices=(GHOST,), help="fly the time-optimal flight beside them")
    parser.add_argument("--ghost-model", choices=GHOST_MODELS, default=GHOST_MODELS[0], help="(%(default)s)")
    parser.add_argument(
        "--allow-pickle", action="store_true", help="read pickled rollouts, which runs the code in them"
    )
    parser.add_argument("--serve", type=Path, metavar="RRD", help="open a recording in the web viewer")
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help="of the web viewer (%(default)s)")
    parser.add_argument("--no-browser", action="store_true", help="serve, and open no browser")
    return parser


def run(options: argparse.Namespace) -> None:
    """Do what the command line asks for; raises ValueError for what cannot be used."""
    if options.serve is not None:
        if options.rollouts:
            raise ValueError(f"--serve: found {len(options.rollouts)} rollouts beside it, expected none")
        serve(options.serve, options.port, not options.no_browser)
        return
    track = load_track(options.track)
    flights = rollout_flights(options.rollouts, options.allow_pickle)
    num_steps = max((len(flight.states) for flight in flights), default=DEMO_STEPS)
    if options.ghost or not flights:
        flights.append(ghost_flight(track, num_steps, options.ghost_model))
    write_recording(options.out, flights, track)
    print(f"{options.out}: {num_steps} steps, {options.out.stat().st_size} bytes")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status, 1 with a line of text for what cannot be used."""
    try:
        run(make_parser().parse_args(arguments))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0
