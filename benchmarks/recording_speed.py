"""How long a minute of flight takes to record, and how large it is: ``python -m benchmarks.recording_speed``.

The time-optimal flight, alone and three times beside itself, as Rerun recordings in a temporary folder. The
first call compiles the race's rules, and a command that writes one recording pays for that.
"""

import argparse
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

from benchmarks.env_speed import cpu_name, pin_to_one_core, versions
from flytrack_env import load_track
from flytrack_env.files import write_atomically
from flytrack_env.references import ghost_rollout, shipped_references
from flytrack_env.viz_rerun import ShownFlight, write_recording

STEPS = 6000
AIM_S = 3.0
HEADER = "| what | wall s | file, MB |\n|---|---|---|\n"


def main() -> None:
    """Measure, print and write the table; exit 1 if the aim is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--page", type=Path, help="write the table here")
    arguments = parser.parse_args()
    pinned = pin_to_one_core()
    track = load_track("flytrack")
    states, actions = ghost_rollout(shipped_references(track, ("nominal",)), STEPS)
    flights = [ShownFlight(name, states, actions) for name in ("flight", "second", "third")]
    cases = {
        "one flight, first call": flights[:1],
        "one flight, later calls": flights[:1],
        "three flights": flights,
    }
    rows, slowest_s = [], 0.0
    with tempfile.TemporaryDirectory() as folder:
        for name, shown in cases.items():
            path = Path(folder) / "flight.rrd"
            started_s = time.perf_counter()
            write_recording(path, shown, track)
            seconds = time.perf_counter() - started_s
            rows.append(f"| {name} | {seconds:.2f} | {path.stat().st_size / 1e6:.1f} |\n")
            if len(shown) == 1:
                slowest_s = max(slowest_s, seconds)
    page = (
        "# Recording a flight\n\n"
        f"`python -m benchmarks.recording_speed`: {STEPS:,} steps, 60 s, of the time-optimal flight on the "
        f"FlyTrack course. Aim: one flight in at most {AIM_S:g} s, after the libraries were imported.\n\n"
        f"{HEADER}{''.join(rows)}\n"
        f"{cpu_name()}, {pinned}; jax {versions()['jax']}, rerun-sdk {version('rerun-sdk')}.\n"
    )
    print(page, end="")
    if arguments.page is not None:
        write_atomically(arguments.page, page.encode())
    if slowest_s > AIM_S:
        raise SystemExit(f"one flight took {slowest_s:.1f} s, expected at most {AIM_S:g} s")


if __name__ == "__main__":
    main()
