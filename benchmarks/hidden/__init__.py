"""Plants with hidden effects, for grading the diagnosis, in equations that share nothing with the package.

``draw_base``, ``draw_effect``, ``draw_truth``, ``draw_outside``, ``draw_gust``, ``draw_onset``, ``draw_late``
and ``draw_change`` draw a ``Truth``; its ``motion`` and ``step_s`` say how it moves and is logged; ``fly``
flies it; ``measure`` turns the clean log into what sensors would have logged.
"""

from benchmarks.hidden.draws import (
    CHANGES,
    EFFECTS,
    NAMES,
    draw_base,
    draw_change,
    draw_effect,
    draw_gust,
    draw_late,
    draw_onset,
    draw_truth,
    with_effects,
)
from benchmarks.hidden.flights import CrashError, fly
from benchmarks.hidden.noise import NOISE_KINDS, measure
from benchmarks.hidden.outside import KINDS as OUTSIDE_KINDS
from benchmarks.hidden.outside import draw_outside
from benchmarks.hidden.plans import FLIGHT_KINDS
from benchmarks.hidden.truth import MOTIONS, Gust, Outside, Truth
from benchmarks.hidden.visibility import signal_to_noise

__all__ = [
    "CHANGES",
    "EFFECTS",
    "FLIGHT_KINDS",
    "MOTIONS",
    "NAMES",
    "NOISE_KINDS",
    "OUTSIDE_KINDS",
    "CrashError",
    "Gust",
    "Outside",
    "Truth",
    "draw_base",
    "draw_change",
    "draw_effect",
    "draw_gust",
    "draw_late",
    "draw_onset",
    "draw_outside",
    "draw_truth",
    "fly",
    "measure",
    "signal_to_noise",
    "with_effects",
]
