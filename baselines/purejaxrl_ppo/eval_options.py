"""The command line of ``eval_agent.py``, and what it may write where."""

import argparse
import os
from pathlib import Path

from baselines.purejaxrl_ppo.recording import CANNOT_RECORD, can_record

DEFAULT_LAPS = 3
MAX_SEED = 2**31
MAX_STEPS = 1_000_000  # hours: the battery is empty after minutes
MAX_LAPS = 100  # their gate times are kept for every flight
MAX_FLIGHTS = 100_000  # so that the gate times of all of them fit into memory


def ghost_path(out: Path) -> Path:
    """Return where the ghost of a rollout lies."""
    return out.with_name(f"{out.stem}_ghost.npy")


def parse_arguments(parser: argparse.ArgumentParser, shipped: Path) -> argparse.Namespace:
    """Return the command line's arguments, checked as far as that goes without reading a file.

    shipped: the black box that is flown if none is named.
    """
    parser.add_argument("--checkpoint", type=Path, required=True, help="of train_ppo: final.msgpack")
    parser.add_argument("--steps", type=int, required=True, help="time limit; at 100 Hz, 2000 are 20 s")
    parser.add_argument("--episodes", type=int, default=1, help="noisy starts, on each plant (%(default)s)")
    parser.add_argument("--laps", type=int, help=f"to complete ({DEFAULT_LAPS}; one flight: no limit)")
    parser.add_argument(
        "--plants", type=int, metavar="K", help="fly K simulated plants, drawn around the checkpoint's model"
    )
    parser.add_argument("--black-box", type=Path, help=f"file ({shipped.name}, as shipped)")
    parser.add_argument("--track", metavar="NAME_OR_FILE", help="default: the checkpoint's")
    parser.add_argument("--seed", type=int, default=0, help="of the noisy starts and of the plants")
    parser.add_argument("--ghost", action="store_true", help="compare with the time-optimal flight, write it")
    parser.add_argument(
        "--out", type=Path, default=Path("rollout.npy"), help="rollout of the first flight (%(default)s)"
    )
    parser.add_argument(
        "--rrd", type=Path, metavar="FILE", help="write a Rerun recording of the first flight"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all that is printed")
    arguments = parser.parse_args()
    if arguments.plants is not None and arguments.black_box is not None:
        parser.error(f"--plants: found --black-box {arguments.black_box} beside it, expected one of the two")
    is_many = arguments.episodes != 1 or arguments.plants is not None
    if arguments.laps is None and is_many:
        arguments.laps = DEFAULT_LAPS
    limits = {"steps": (1, MAX_STEPS), "episodes": (1, MAX_FLIGHTS), "laps": (1, MAX_LAPS)}
    limits |= {"plants": (1, MAX_FLIGHTS // max(arguments.episodes, 1)), "seed": (0, MAX_SEED - 1)}
    for name, (low, high) in limits.items():
        value = getattr(arguments, name)
        if value is not None and not low <= value <= high:
            parser.error(f"--{name}: found {value}, expected {low} to {high}")
    check_files(parser, arguments)
    return arguments


def check_files(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """End the program, saying why, where a file could not be written, or would replace another one."""
    if arguments.rrd is not None and not can_record():
        parser.error(f"--rrd: {CANNOT_RECORD}")
    read = {path.resolve() for path in (arguments.checkpoint, arguments.black_box) if path is not None}
    taken: dict[Path, str] = {}
    for name, path in (("--out", arguments.out), ("--rrd", arguments.rrd), ("--json", arguments.json)):
        if path is None:
            continue
        if path.resolve() in read:
            parser.error(f"{name}: found {path}, which is read, expected another file")
        if path.absolute() in taken:
            parser.error(f"{name}: found {path}, which is {taken[path.absolute()]}, expected another file")
        if path.is_dir():
            parser.error(f"{name}: {path} is a folder, expected the path of a file")
        nearest = next(folder for folder in path.absolute().parents if folder.exists())
        if not nearest.is_dir():
            parser.error(f"{name}: {path}: found a file {nearest}, expected a folder")
        if not os.access(nearest, os.W_OK):
            parser.error(f"{name}: {path}: found no permission to write in {nearest}")
        taken[path.absolute()] = f"that of {name}"
        if name == "--out":
            taken[ghost_path(path).absolute()] = "the rollout of the ghost"
