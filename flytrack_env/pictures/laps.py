"""A flight's fastest flying lap, beside the time-optimal one."""

import itertools

from flytrack_env.flown_race import STEP_S
from flytrack_env.pictures.flight import Flight
from flytrack_env.references import Reference
from flytrack_env.rendering.animation import Lap
from flytrack_env.scene import FLIGHT_COLOURS


def fastest_flying_lap(flight: Flight) -> tuple[int, int] | None:
    """Return the pass that begins the fastest flying lap and the one that ends it; None if there is none."""
    ends = [place for place, one in enumerate(flight.race.passes) if one.lap]
    laps = [(flight.race.passes[end].lap_time_s, start, end) for start, end in itertools.pairwise(ends)]
    return min(laps)[1:] if laps else None


def laps_to_compare(flight: Flight, reference: Reference) -> tuple[Lap, Lap]:
    """Return a flight's fastest flying lap and the time-optimal one, each from its start on.

    Raises:
        ValueError: a flight without a complete flying lap.
    """
    lap = fastest_flying_lap(flight)
    if lap is None:
        raise ValueError(f"{flight.name}: found no complete flying lap, expected one to animate")
    start, end = (flight.race.passes[place] for place in lap)
    first = round(start.time_s / STEP_S)  # the state nearest to the crossing
    own = flight.states[first : first + round(end.lap_time_s / STEP_S) + 1]
    return (
        Lap(flight.name, FLIGHT_COLOURS[0], own, end.lap_time_s),
        Lap("time-optimal", FLIGHT_COLOURS[2], reference.states, reference.time_s),
    )
