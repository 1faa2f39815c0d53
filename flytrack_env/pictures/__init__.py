"""Recorded flights as PNG and GIF files, without a viewer and without a display.

``flytrack show`` draws rollout files. Needs the extra ``flytrack[viz]``, and
``flytrack[render]`` for animations; importing this package does not.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flytrack_env.extras import check_installed
from flytrack_env.files import write_atomically
from flytrack_env.flown_camera import film
from flytrack_env.flown_race import STEP_S
from flytrack_env.pictures.flight import Flight, Meeting, make_flight, read_flights
from flytrack_env.references import Reference
from flytrack_env.scene import FLIGHT_COLOURS
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
    "write_camera_view",
    "write_pictures",
]


def draw_flight(flight: Flight) -> dict[str, "Figure"]:
    """Return a flight's figures by name: top, side, commands.

    Raises:
        ImportError: matplotlib is not installed.
    """
    check_installed("viz", "pictures of flights", "matplotlib")
    from flytrack_env.pictures import figures

    draw = {"top": figures.draw_top, "side": figures.draw_side, "commands": figures.draw_commands}
    return {name: draw_view(flight) for name, draw_view in draw.items()}


def write_pictures(flights: Sequence[Flight], folder: str | Path) -> list[Path]:
    """Write ``NAME_top.png``, ``NAME_side.png`` and ``NAME_commands.png`` of each flight.

    Return their paths. Of several flights also ``comparison_top.png``. All are drawn before the
    first is written.

    Raises:
        ImportError, OSError: matplotlib is not installed, or a file cannot be written.
        ValueError: several flights on several tracks.
    """
    check_installed("viz", "pictures of flights", "matplotlib")
    from flytrack_env.pictures.drawing import png_of
    from flytrack_env.pictures.figures import draw_comparison

    figures = {
        f"{flight.name}_{name}": figure
        for flight in flights
        for name, figure in draw_flight(flight).items()
    }
    if len(flights) > 1:
        figures["comparison_top"] = draw_comparison(flights)
    contents = {Path(folder) / f"{name}.png": png_of(figure) for name, figure in figures.items()}
    for path, content in contents.items():
        write_atomically(path, content)
    return list(contents)


def write_animation(flight: Flight, reference: Reference, folder: str | Path) -> Path:
    """Write ``NAME.gif``, the fastest flying lap beside the time-optimal one; return its path.

    Args:
        reference: a time-optimal flying lap of the same track.

    Raises:
        ImportError, OSError: Pillow is not installed, or the file cannot be written.
        ValueError: a flight without a complete flying lap.
    """
    check_installed("render", "animations of flights", "PIL")
    from flytrack_env.rendering.animation import Lap, make_gif

    if flight.fastest_flying_lap is None:
        raise ValueError(f"{flight.name}: found no complete flying lap, expected one to animate")
    start, end = flight.fastest_flying_lap
    first = round(start.time_s / STEP_S)  # the state nearest to the crossing
    states = flight.states[first : first + round(end.lap_time_s / STEP_S) + 1]
    laps = (
        Lap(flight.name, FLIGHT_COLOURS[0], states, end.lap_time_s),
        Lap("time-optimal", FLIGHT_COLOURS[2], reference.states, reference.time_s),
    )
    path = Path(folder) / f"{flight.name}.gif"
    gate_ids = [gate.id for gate in flight.track.gates]
    write_atomically(path, make_gif(build_course(flight.track), gate_ids, laps))
    return path


def write_camera_view(flight: Flight, folder: str | Path) -> Path:
    """Write ``NAME_camera.gif``, the flight from behind and by its own camera; return its path.

    Of a flight with a complete flying lap its fastest one, else all of it.

    Raises:
        ImportError, OSError: Pillow is not installed, or the file cannot be written.
    """
    check_installed("render", "animations of flights", "PIL")
    from flytrack_env.rendering.onboard import make_onboard_gif

    rows = slice(0, len(flight.states))
    if flight.fastest_flying_lap is not None:
        start, end = (round(gate_pass.time_s / STEP_S) for gate_pass in flight.fastest_flying_lap)
        rows = slice(start, end + 1)
    states, gates = flight.states[rows], flight.race.gate[rows]
    laps = np.zeros((len(states), 3))  # the views show neither laps nor their times
    scenes = np.concatenate([states, gates[:, None], laps], axis=1).astype(np.float32)
    path = Path(folder) / f"{flight.name}_camera.gif"
    shown = film(states, gates, flight.track)
    write_atomically(path, make_onboard_gif(build_course(flight.track), scenes, shown))
    return path
