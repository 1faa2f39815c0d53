"""Pictures of rollout files: ``python -m flytrack_env.pictures ROLLOUT ... --out FOLDER``."""

import argparse
import sys
from pathlib import Path

from flytrack_env.pictures import read_flights, write_pictures, write_video
from flytrack_env.tracks import load_track


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m flytrack_env.pictures", description="Draw rollouts as PNGs, and a lap of each as MP4."
    )
    parser.add_argument("rollouts", metavar="ROLLOUT", nargs="+", help="rollout files (.npy)")
    parser.add_argument(
        "--out", metavar="FOLDER", type=Path, required=True, help="where pictures are written"
    )
    parser.add_argument("--track", default="flytrack", help="track name or .toml (%(default)s)")
    parser.add_argument("--video", action="store_true", help="also write a lap of each as MP4")
    parser.add_argument(
        "--allow-pickle",
        action="store_true",
        help="read pickled rollouts; this runs whatever code they hold: only for files from those you trust",
    )
    return parser


def _check_folder(folder: Path) -> None:
    """Refuse a path that is a file or below one, before anything is drawn."""
    found = next(path for path in (folder, *folder.parents) if path.exists())
    if not found.is_dir():
        raise NotADirectoryError(f"--out {folder}: found a file, {found}, expected a folder or a new path")


def main(arguments: list[str] | None = None) -> int:
    """Draw rollout files from the command line; return the exit status."""
    options = _parser().parse_args(arguments)
    try:
        _check_folder(options.out)
        flights = read_flights(options.rollouts, load_track(options.track), options.allow_pickle)
        for path in write_pictures(flights, options.out):
            print(f"{path}: {path.stat().st_size} bytes")
        for flight in flights if options.video else ():
            path = write_video(flight, options.out, has_bar=True)
            print(f"{path}: {path.stat().st_size} bytes")
    except (ImportError, OSError, ValueError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
