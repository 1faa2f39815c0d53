"""Flights of ``benchmarks.seams``, each made once."""

from functools import cache

from benchmarks.seams.flight import make_flight

LENGTH_S = 20.0  # logged at 100 Hz


@cache
def seam_flight(kind):
    """Return the flight of a kind, which no test may change in place."""
    return make_flight(0, LENGTH_S, kind)
