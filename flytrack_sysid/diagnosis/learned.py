"""Beyond the list: where a diagnosis leaves something unexplained, a law for it, or else a residual.

Of each side (rate, force) that depends on something, a law is searched; it is proposed where it explains
nearly all that smooth functions of everything would. Else networks of what the side depends on are
fitted. Either has to predict held-out flights better in all, and no worse at any horizon where these tell
anything.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flytrack_env.effects.grammar import Law
from flytrack_env.effects.learned_residual import Networks
from flytrack_sysid.diagnosis.beyond import Learned
from flytrack_sysid.diagnosis.lanes import thinned
from flytrack_sysid.diagnosis.law_search import LEAST_EXPECTED, Found, Side, find_law
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.refinement import LIKELY, LIKELY_WORSE, WORSE_ANYWHERE, Judge, errors_at
from flytrack_sysid.diagnosis.residual_fit import fit_residual
from flytrack_sysid.diagnosis.search import FittedModel
from flytrack_sysid.diagnosis.unexplained import (
    Dependence,
    find_dependences,
    find_lines,
    stochastic_shares,
    waves_of,
)

MOST_ROWS = 12_000  # with their lead-ins: two minutes at 100 Hz
LEAST_SHARE, LEAST_RESIDUAL_SHARE = 0.08, 0.15  # of the sensor's noise, rms: less is not learnt
LEAST_OFF = 0.02  # of squared errors of held-out flights, over all horizons: what takes less off is nothing
LAW_SHARE = 0.75  # of what smooth functions of everything explain: the least that a law explains


def find_learned(
    problem: Problem, test: Problem, model: FittedModel, base: np.ndarray, judge: Judge | None
) -> tuple[Learned | None, np.ndarray]:
    """Return what can be learnt of what a model leaves, None if nothing, and the model's vector beside it.

    problem, test: of rows to learn from and of others. base: vector of the refitted model without effects.
    judge: of free flights on held-out rows; None without any.
    """
    problem, test = thinned_problem(problem), thinned_problem(test)
    waves = waves_of(problem, model, find_lines(problem, model))
    dependences = find_dependences(problem, model, base, waves)
    learned = Learned(Law(()), Networks(()), {}, {}, {})
    # What wanders may be a law whose variable smooth functions of everything do not have.
    wandering = [] if dependences else list(stochastic_shares(problem, model))
    for name in dict.fromkeys([*(one.side for one in dependences), *wandering]):
        own = [one for one in dependences if one.side == name]
        if own and max(one.share for one in own) < LEAST_SHARE:
            continue
        found = _learnt(Side.of(name, problem, model), Side.of(name, test, model), own)
        if found is None:
            continue
        more = _with_side(learned, name, found)
        acts_there = found.expected >= LEAST_EXPECTED
        if _predicts(problem, judge, (learned, model.vector), (more, found.vector), acts_there):
            learned, model = more, model._replace(vector=found.vector)
    return learned if learned.gains else None, model.vector


def _with_side(learned: Learned, name: str, found: Found) -> Learned:
    """Return what was learnt, with what was found on one more side."""
    return Learned(
        Law((*learned.law.terms, *found.terms)),
        Networks((*learned.networks.networks, *found.networks)),
        {**learned.gains, name: found.gain},
        {**learned.held_out_gains, name: found.held_out_gain},
        {**learned.rivals, **({name: found.rivals} if found.terms else {})},
    )


def thinned_problem(problem: Problem) -> Problem:
    """Return a problem of fewer lanes, evenly spread, where a log is long: hundreds of terms are tried."""
    lanes = thinned(problem.lanes, max(MOST_ROWS // len(problem.lanes.row), 2))
    if lanes is problem.lanes or problem.late is not None or problem.noise is None:
        return problem
    return replace(problem, lanes=lanes).with_noise(problem.noise)


def _learnt(side: Side, held: Side, dependences: Sequence[Dependence]) -> Found | None:
    """Return a law that explains nearly all of what is left on a side, or else a residual."""
    law = find_law(side, held)
    flexible = sum(one.gain for one in dependences)
    if law is not None and law.gain >= LAW_SHARE * flexible:
        return law
    if not dependences or max(one.share for one in dependences) < LEAST_RESIDUAL_SHARE:
        return None
    return fit_residual(side, held, [one.name for one in dependences])


def _predicts(
    problem: Problem,
    judge: Judge | None,
    before: tuple[Learned, np.ndarray],
    after: tuple[Learned, np.ndarray],
    acts_there: bool,
) -> bool:
    """Return whether held-out flights are predicted no worse with what was learnt, and better in all.

    before, after: what was learnt, and the model's vector beside it. acts_there: whether it acts in them
    enough to be judged.
    """
    if judge is None:
        return True
    old, new = (
        errors_at(problem.with_learned(learned.effects), learned.beside(vector)[None], judge.windows)
        for learned, vector in (before, after)
    )
    ratio, lost = new.against(old)
    return improves_flights(ratio[judge.is_known], lost[judge.is_known], acts_there)


def improves_flights(ratio: np.ndarray, lost: np.ndarray, acts_there: bool) -> bool:
    """Return whether flights are predicted no worse anywhere and, if it acts in them, better in all.

    ratio: of errors with what was learnt over those without, by horizon and quantity. lost: by how many
    standard errors each is larger.
    """
    is_better = float(np.mean(ratio**2)) < 1.0 - LEAST_OFF
    # What makes flights in all no better has to be as good at every horizon.
    worst = WORSE_ANYWHERE if is_better else LIKELY
    is_worse = (ratio > LIKELY_WORSE) & (lost > worst)
    return not is_worse.any() and (is_better or not acts_there)
