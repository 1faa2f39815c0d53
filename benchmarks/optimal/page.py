"""Pictures and the page of the shipped references: docs/results/time_optimal.md."""

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import report
from benchmarks.optimal.replay import Replay
from flytrack_env.files import write_atomically
from flytrack_env.references import Reference
from flytrack_env.state import POSITION, VELOCITY
from flytrack_env.tracks import Track

TITLES = {"flying": "flying lap", "standing": "standing start"}
MILLI = 1e3
HEADER = (
    "track | model | flight | time (s) | free times (s) | starts agree | highest speed (m/s) | "
    "lowest height (m) | solver | iterations | CPU (s)"
)
REPLAY_HEADER = (
    "track | model | flight | flown by | gates | time (s) | off the optimum (ms) | drift (mm) | "
    "frames touched"
)
AGREE_SHARE = 1e-3  # of the time: starts this near the best found about the same flight


def write_pictures(page: Path, references: list[Reference], tracks: list[Track]) -> None:
    """Write a picture per track of its flying lap from above, coloured by speed, beside the page."""
    from flytrack_env.pictures import draw_flight, make_flight
    from flytrack_env.pictures.drawing import png_of  # matplotlib, needed only here

    for track in tracks:
        for found in references:
            if (found.track, found.kind) == (track.name, "flying"):
                name = f"{found.model_name} model, {TITLES[found.kind]}"
                commands = np.concatenate([found.commands, found.commands[-1:]])  # one per state
                flight = make_flight(name, found.states.astype(np.float32), commands, track)
                picture = png_of(draw_flight(flight)["top"])
                write_atomically(page.with_name(f"{page.stem}_{track.name}.png"), picture)
                break


def _optimum_row(reference: Reference) -> tuple[Any, ...]:
    found, states = reference.found, reference.states
    starts = [seconds for seconds in found["coarse_times_s"] if seconds is not None]
    agree = sum(seconds <= min(starts) * (1.0 + AGREE_SHARE) for seconds in starts)
    return (
        reference.track,
        reference.model_name,
        TITLES[reference.kind],
        f"{reference.time_s:.4f}",
        f"{found['free_time_s']:.4f}",
        f"{agree} of {len(found['coarse_times_s'])}",
        f"{np.linalg.norm(states[:, VELOCITY], axis=1).max():.1f}",
        f"{states[:, POSITION][:, 2].min():.2f}",
        found["status"],
        found["iterations"],
        f"{found['cpu_s']:.0f}",
    )


def _replay_row(reference: Reference, flown_by: str, flown: Replay) -> tuple[Any, ...]:
    late_ms = MILLI * (flown.time_s - reference.time_s)
    times = ("-", "-") if np.isnan(flown.time_s) else (f"{flown.time_s:.4f}", f"{late_ms:+.3f}")
    gates = ", ".join([f"{flown.gates_passed} of {len(reference.gate_times_s)}", *flown.ended_by])
    names = reference.track, reference.model_name, TITLES[reference.kind], flown_by
    return (*names, gates, *times, f"{MILLI * flown.drift_m:.2f}", flown.frames_touched)


def write_page(path: Path | None, replays: list[tuple[Reference, str, Replay]]) -> None:
    """Print, and write unless the path is None, the tables of references and their replays.

    replays: references, the plants that flew them, and the replays; a reference may occur several times.
    """
    references = list({id(found): found for found, _, _ in replays}.values())
    notes = [reference.found for reference in references]

    def each(line: str) -> str:
        """Return the line for each reference, without repetitions."""
        return "; ".join(sorted({line.format(**note) for note in notes}))

    commands = sorted({note["command"].strip("`") for note in notes})
    tracks = sorted({reference.track for reference in references})
    pictures = [f"![{name}]({path.stem}_{name}.png)\n\n" for name in tracks if path is not None]
    report.fill_page(
        path,
        "time_optimal",
        commands="\n".join(f"- `{line}`" for line in commands),
        agree=AGREE_SHARE,
        packages_found=each("casadi {casadi}, jax {jax}"),
        machine=each("{machine}"),
        battery=each("{battery_v:g} V"),
        clearance=each("{clearance_m:g} m"),
        radius=each("{drone_radius_m:g} m"),
        smoothing=each("{smoothing_s:g} s"),
        optima=report.table(HEADER, map(_optimum_row, references)),
        replays=report.table(REPLAY_HEADER, (_replay_row(*entry) for entry in replays)),
        pictures="".join(pictures),
    )
