"""Recordings and pictures with the extra ``[viz]`` alone. Run by ``release.check_wheel``."""

import subprocess
import sys
from pathlib import Path

import numpy as np

from flytrack_env.references import ghost_rollout, shipped_references
from flytrack_env.rollout import save_rollout
from flytrack_env.tracks import load_track

NUM_STEPS = 400
RECORD = ("flight.npy", "--out", "flight.rrd", "--ghost", "time_optimal")
DRAW = ("flight.npy", "--out", "pictures")


def must_write(path: str, *arguments: str) -> None:
    """Run a module, which must end well and write a file."""
    ran = subprocess.run([sys.executable, "-I", "-m", *arguments], capture_output=True, text=True)
    assert ran.returncode == 0 and Path(path).stat().st_size > 0, f"{arguments}: {ran.stdout}{ran.stderr}"


def main() -> None:
    """Write the time-optimal flight as a rollout, a recording of it, and pictures."""
    flight = ghost_rollout(shipped_references(load_track("flytrack"), ("nominal",)), NUM_STEPS)
    save_rollout("flight.npy", *map(np.asarray, flight))
    must_write("flight.rrd", "flytrack_env.viz_rerun", *RECORD)
    must_write("pictures/flight_top.png", "flytrack_env.pictures", *DRAW)


if __name__ == "__main__":
    main()
