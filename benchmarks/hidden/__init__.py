"""Flights of hidden drones, for grading the diagnosis.

``draw_base``, ``draw_effect``, ``draw_truth``, ``draw_outside``, ``draw_gust``, ``draw_onset`` and
``draw_late`` draw a ``Truth``; its ``motion`` and ``step_s`` say how it moves and is logged;
``fly`` flies it; ``measure`` turns the clean log into what sensors would have logged.
"""

from flytrack_bench.hidden import MOTIONS, Gust, Outside, Truth
from flytrack_bench.hidden.draws import (
    EFFECTS,
    NAMES,
    draw_base,
    draw_effect,
    draw_gust,
    draw_late,
    draw_onset,
    draw_truth,
    log_uniform,
    with_effects,
)
from flytrack_bench.hidden.flights import fly
from flytrack_bench.hidden.noise import measure
from flytrack_bench.hidden.outside import draw_outside
