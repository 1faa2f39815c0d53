"""Recorded flights as PNG and GIF files, without a viewer and without a display.

``flytrack show`` draws rollout files. Needs the extra ``flytrack[viz]``, and
``flytrack[render]`` for animations; importing this package does not.
"""

import importlib
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from flytrack_env.extras import check_installed
from flytrack_env.files import write_atomically
from flytrack_env.pictures.flight import Flight, Meeting, make_flight, read_flights
from flytrack_env.references import Reference
from flytrack_env.tracks import build_course

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Flight",
    "Meeting",
    "draw_flight",
    "make_flight",
    "read_flights",
    "write_animation",
    "write_pictures",
]

VIEWS = ("top", "side", "commands")


def _load(name: str, extra: str, library: str) -> ModuleType:
    check_installed(extra, "pictures of flights" if extra == "viz" else "animations of flights", library)
    return importlib.import_module(f"flytrack_env.{name}")


def draw_flight(flight: Flight) -> dict[str, "Figure"]:
    """Return a flight's figures by name: top, side, commands.

    Raises:
        ImportError: matplotlib is not installed.
    """
    figures = _load("pictures.figures", "viz", "matplotlib")
    return {name: getattr(figures, f"draw_{name}")(flight) for name in VIEWS}


def write_pictures(flights: Sequence[Flight], folder: str | Path) -> list[Path]:
    """Write ``NAME_top.png``, ``NAME_side.png``, ``NAME_commands.png`` of each flight; return their paths.

    Of several flights also ``comparison_top.png``. All are drawn before the first is written.

    Raises:
        ImportError, OSError: matplotlib is not installed, or a file cannot be written.
        ValueError: several flights on several tracks.
    """
    figures = {
        f"{flight.name}_{name}": figure for flight in flights for name, figure in draw_flight(flight).items()
    }
    if len(flights) > 1:
        figures["comparison_top"] = _load("pictures.figures", "viz", "matplotlib").draw_comparison(flights)
    png_of = _load("pictures.drawing", "viz", "matplotlib").png_of
    contents = {Path(folder) / f"{name}.png": png_of(figure) for name, figure in figures.items()}
    for path, content in contents.items():
        write_atomically(path, content)
    return list(contents)


def write_animation(flight: Flight, reference: Reference, folder: str | Path) -> Path:
    """Write ``NAME.gif``, the fastest flying lap beside the time-optimal one; return its path.

    reference: a time-optimal flying lap of the same track.

    Raises:
        ImportError, OSError: Pillow is not installed, or the file cannot be written.
        ValueError: a flight without a complete flying lap.
    """
    make_gif = _load("rendering.animation", "render", "PIL").make_gif
    laps = _load("pictures.laps", "render", "PIL").laps_to_compare(flight, reference)
    path = Path(folder) / f"{flight.name}.gif"
    gate_ids = [gate.id for gate in flight.track.gates]
    write_atomically(path, make_gif(build_course(flight.track), gate_ids, laps))
    return path
