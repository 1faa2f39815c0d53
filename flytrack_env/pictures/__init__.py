"""Recorded flights as PNGs and MP4s, without a viewer and without a display.

``python -m flytrack_env.pictures`` draws rollout files. Needs the extra ``flytrack[viz]``, and
``flytrack[render]`` for videos; importing this package does not.
"""

import importlib
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from flytrack_env.extras import check_installed
from flytrack_env.files import write_atomically
from flytrack_env.pictures.flight import COMPARISON, Flight, Meeting, make_flight, read_flights

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Flight",
    "Meeting",
    "draw_comparison",
    "draw_flight",
    "make_flight",
    "read_flights",
    "write_pictures",
    "write_video",
]

EXTRAS = {"matplotlib": "viz", "moviepy": "render"}
VIEWS = ("top", "side", "commands")


def _module(name: str, needs: str) -> ModuleType:
    """Return one of this package's modules that need a library.

    Raises:
        ImportError: that library is not installed; the message says how to install it.
    """
    what = "videos" if needs == "moviepy" else "pictures"
    check_installed(EXTRAS[needs], f"{what} of flights", needs)
    return importlib.import_module(f"{__name__}.{name}")


def draw_flight(flight: Flight) -> dict[str, "Figure"]:
    """Return a flight's figures by name: top, side, commands.

    Raises:
        ImportError: matplotlib is not installed.
    """
    return {name: getattr(_module(name, "matplotlib"), f"draw_{name}")(flight) for name in VIEWS}


def draw_comparison(flights: Sequence[Flight]) -> "Figure":
    """Return flights on one track from above, each in a colour of its own.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: no flights, or flights on several tracks.
    """
    tracks = sorted({flight.track.name for flight in flights})
    if len(tracks) != 1:
        raise ValueError(f"flights: found tracks {tracks}, expected flights on one")
    return _module("top", "matplotlib").draw_comparison(flights)


def write_pictures(flights: Sequence[Flight], folder: str | Path) -> list[Path]:
    """Write ``NAME_top.png``, ``NAME_side.png``, ``NAME_commands.png`` of each flight; return their paths.

    Of several flights also ``comparison_top.png``. All are drawn before the first is written.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: several flights on several tracks.
        OSError: a file cannot be written; nothing half-written is left.
    """
    figures = {
        f"{flight.name}_{name}": figure for flight in flights for name, figure in draw_flight(flight).items()
    }
    if len(flights) > 1:
        figures[f"{COMPARISON}_top"] = draw_comparison(flights)
    png_of = _module("style", "matplotlib").png_of
    contents = {Path(folder) / f"{name}.png": png_of(figure) for name, figure in figures.items()}
    for path, content in contents.items():
        write_atomically(path, content)
    return list(contents)


def write_video(flight: Flight, folder: str | Path, has_bar: bool = False) -> Path:
    """Write ``NAME.mp4``, the fastest flying lap at the speed at which it was flown; return its path.

    Else the first lap; without a complete lap the flight, up to 20 s. has_bar: show a progress bar.

    Raises:
        ImportError: moviepy or Pillow is not installed.
        OSError: the file cannot be written; nothing half-written is left.
    """
    path = Path(folder) / f"{flight.name}.mp4"
    _module("video", "moviepy").write_video(flight, path, has_bar)
    return path
