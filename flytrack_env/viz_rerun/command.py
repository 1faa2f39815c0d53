"""The command ``python -m flytrack_env.viz_rerun``."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from flytrack_env.references import ghost_rollout, shipped_references
from flytrack_env.rollout import load_named_rollouts
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


def _check_together(options: argparse.Namespace) -> None:
    """Raise ValueError for options that have nothing to do with each other."""
    writing = {"rollouts": options.rollouts, "ghost": options.ghost, "allow-pickle": options.allow_pickle}
    serving = {"port": options.port != DEFAULT_PORT, "no-browser": options.no_browser}
    beside, what = (writing, "--serve") if options.serve is not None else (serving, "no --serve")
    found = [name for name, given in beside.items() if given]
    if found:
        raise ValueError(f"{', '.join(found)}: found beside {what}, expected without")


def run(options: argparse.Namespace) -> None:
    """Do what the command line asks for; raises ValueError for what cannot be used."""
    _check_together(options)
    if options.serve is not None:
        serve(options.serve, options.port, not options.no_browser)
        return
    read = [*options.rollouts, Path(options.track)]
    if options.out.resolve() in {path.resolve() for path in read}:
        raise ValueError(f"--out: found {options.out}, which is read, expected another file")
    track = load_track(options.track)
    rollouts = load_named_rollouts(options.rollouts, options.allow_pickle)
    flights = [ShownFlight(name, *rollout) for name, rollout in rollouts.items()]
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
