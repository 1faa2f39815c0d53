"""Where the parts of a flight lie in a recording."""

from typing import NamedTuple

import rerun as rr


class Entities(NamedTuple):
    """Entity paths of one flight: what is in the world, the folder of its plots, its events."""

    drone: str
    chase: str
    trajectory: str
    passes: str
    laps: str
    residual: str
    plots: str
    events: str


def entities_of(name: str, is_first: bool) -> Entities:
    """Return the paths of a flight; the first one has those of the handout."""
    part = "" if is_first else f"/flights/{rr.escape_entity_path_part(name)}"
    world = f"world{part}"
    return Entities(
        drone=f"{world}/drone",
        chase=f"{world}/chase",
        trajectory=f"{world}/trajectory",
        passes=f"{world}/passes",
        laps=f"{world}/laps",
        residual=f"{world}/residual",
        plots=f"plots{part}",
        events=f"events{part}",
    )
