"""Pictures and the page of the shipped references: docs/results/time_optimal.md."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks import report
from benchmarks.optimal.replay import Replay
from flytrack_env.files import write_atomically
from flytrack_env.pictures.drawing import draw_gates, draw_path, label_from_above, png_of
from flytrack_env.references import Reference
from flytrack_env.state import POSITION, VELOCITY
from flytrack_env.tracks import Track

DPI = 100
PANEL_IN, BAR_IN, TITLE_IN = 5.6, 1.4, 0.7  # the longer side of a panel; room for the scale and a title
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
EXPLAINED = f"""A flying lap goes from the last gate's plane to itself and ends as it began, except for the
battery. A standing start goes from rest at the start pose, rotors still, through every gate once. Both are in
steps of 0.01 s with held commands: the simulator's own equations at its own rate, traced from its code. *Free
times*: with free segment times and gates at nodes; where that differs little, the grid costs little. *Starts
agree*: of the searches on coarse grids, those within {AGREE_SHARE:.1%} of the best. These are local optima:
nothing proves that no better one exists. The model `nominal` is the simulator's own; `black_box` is what the
README's commands `collect`, `fit` and `diagnose` made of the shipped black box
(`benchmarks/data/time_optimal/black_box.json`)."""
REPLAYED = """The stored commands, open loop, in the environment at 100 Hz (float32), which judges which gates
were passed and when. *Drift*: largest distance from the stored path. *Frames touched*: of all gates, not only
of the next. On the black box itself no feedback corrects the model's errors: the drift soon exceeds the
clearance of a gate."""


def write_pictures(page: Path, references: list[Reference], tracks: list[Track]) -> None:
    """Write beside the page a picture per track, of the first flight of each kind.

    tracks: those that references are of, by name; others are not drawn.
    """
    for track in tracks:
        seen = {found.kind: found for found in reversed(references) if found.track == track.name}
        if seen:
            path = page.with_name(f"{page.stem}_{track.name}.png")
            _draw(path, track, [seen[kind] for kind in sorted(seen)])


def _draw(path: Path, track: Track, references: list[Reference]) -> None:
    """Write a picture of flights of one track from above, coloured by speed."""
    speeds = [np.linalg.norm(found.states[:, VELOCITY], axis=1) for found in references]
    top = max(values.max() for values in speeds)
    extent = np.subtract(track.bounds_high, track.bounds_low)[:2]
    panel = PANEL_IN * extent / extent.max()
    is_wide = extent[0] > extent[1]  # panels one above the other
    rows, columns = (len(references), 1) if is_wide else (1, len(references))
    size = panel * (columns, rows) + (BAR_IN, TITLE_IN * rows)
    figure = Figure(figsize=tuple(size), layout="constrained")
    panels = np.atleast_1d(figure.subplots(rows, columns))
    for axes, reference, speed in zip(panels, references, speeds, strict=True):
        points = reference.states[:, POSITION][:, :2]
        lines = draw_path(axes, points, speed[1:], top, linewidth=2.5)
        draw_gates(axes, track, [0, 1])
        label_from_above(axes, track)
        if reference.kind == "standing":
            axes.plot(*points[0], "o", color="tab:blue")
        ends = np.stack([track.bounds_low, track.bounds_high], axis=1)
        axes.set(aspect="equal", xlim=ends[0], ylim=ends[1], xlabel="x (m)", ylabel="y (m)")
        axes.set_title(
            f"{track.name}, {reference.model_name}: {TITLES[reference.kind]} {reference.time_s:.3f} s"
        )
    figure.colorbar(lines, ax=list(panels), label="speed (m/s)", shrink=0.8)
    write_atomically(path, png_of(figure, DPI))


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


def write_page(path: Path, replays: list[tuple[Reference, str, Replay]]) -> None:
    """Write the tables of references and their replays, with a picture per track.

    replays: references, the plants that flew them, and the replays; a reference may occur several times.
    """
    references = list({id(found): found for found, _, _ in replays}.values())
    notes = [reference.found for reference in references]

    def each(line: str) -> str:
        """Return the line for each reference, without repetitions."""
        return "; ".join(sorted({line.format(**note) for note in notes}))

    commands = sorted({note["command"].strip("`") for note in notes})
    tracks = sorted({reference.track for reference in references})
    settings = (
        f"Found with {each('casadi {casadi}, jax {jax}')} on {each('{machine}')}, one core. Battery at the "
        f"start: {each('{battery_v:g} V')}. Gates are passed {each('{clearance_m:g} m')} inside what the "
        f"environment allows a drone of radius {each('{drone_radius_m:g} m')}. Squared changes of commands "
        f"cost {each('{smoothing_s:g} s')} each, so that commands do not chatter."
    )
    text = report.page(
        "Time-optimal flights",
        f"{report.command_line()} wrote this page. The flights were found by",
        "\n".join(f"- `{line}`" for line in commands),
        EXPLAINED,
        settings,
        report.table(HEADER, map(_optimum_row, references)),
        "## Replays",
        REPLAYED,
        report.table(REPLAY_HEADER, (_replay_row(*entry) for entry in replays)),
        *(f"![{name}]({path.stem}_{name}.png)" for name in tracks),
        report.provenance_line(report.provenance()),
    )
    report.write_page(path, text)
