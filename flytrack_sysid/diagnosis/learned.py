"""Beyond the list: where a diagnosis leaves something unexplained, a law for it, or else a residual.

Of each side (rate, force) that depends on something, a law is searched; it is proposed where it explains
nearly all that smooth functions of everything would. Else networks of what the side depends on are
fitted. Either has to predict held-out flights better in all, and no worse at any horizon where these tell
anything.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flytrack_env.effects.grammar import Law, Term
from flytrack_env.effects.learned_residual import Network, Networks
from flytrack_sysid.diagnosis.beyond import Learned
from flytrack_sysid.diagnosis.law_search import LEAST_EXPECTED, Found, Side, find_law
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.refinement import (
    LIKELY,
    LIKELY_WORSE,
    WORSE_ANYWHERE,
    Judge,
    errors_at,
    sureness,
)
from flytrack_sysid.diagnosis.residual_fit import Residual, fit_residual
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
    terms: list[Term] = []
    networks: list[Network] = []
    found: dict[str, Found | Residual] = {}
    # What wanders may be a law whose variable smooth functions of everything do not have.
    wandering = [] if dependences else list(stochastic_shares(problem, model))
    for name in dict.fromkeys([*(one.side for one in dependences), *wandering]):
        own = [one for one in dependences if one.side == name]
        if own and max(one.share for one in own) < LEAST_SHARE:
            continue
        one = _learnt(Side.of(name, problem, model), Side.of(name, test, model), own)
        if one is None:
            continue
        added = (one.terms, ()) if isinstance(one, Found) else ((), (one.network,))
        acts_there = one.expected >= LEAST_EXPECTED
        if not _predicts(problem, judge, model.vector, one.vector, (terms, networks), added, acts_there):
            continue
        terms, networks = [*terms, *added[0]], [*networks, *added[1]]
        found[name], model = one, model._replace(vector=one.vector)
    if not found:
        return None, model.vector
    learned = Learned(
        Law(tuple(terms)),
        Networks(tuple(networks)),
        {name: one.gain for name, one in found.items()},
        {name: one.held_out_gain for name, one in found.items()},
        {name: one.rivals for name, one in found.items() if isinstance(one, Found)},
    )
    return learned, model.vector


def thinned_problem(problem: Problem) -> Problem:
    """Return a problem of fewer lanes, evenly spread, where a log is long: hundreds of terms are tried."""
    rows, number = problem.lanes.row.shape
    most = max(MOST_ROWS // rows, 2)
    if number <= most or problem.late is not None or problem.noise is None:
        return problem
    lanes = problem.lanes.selected(np.linspace(0, number - 1, most).round().astype(int))
    return replace(problem, lanes=lanes).with_noise(problem.noise)


def _learnt(side: Side, held: Side, dependences: Sequence[Dependence]) -> Found | Residual | None:
    """Return a law that explains nearly all of what is left on a side, or else a residual."""
    law = find_law(side, held)
    flexible = sum(one.gain for one in dependences)
    if law is not None and law.gain >= LAW_SHARE * flexible:
        return law
    if not dependences or max(one.share for one in dependences) < LEAST_RESIDUAL_SHARE:
        return None
    return fit_residual(side, held, [one.name for one in dependences])


def _of_parts(terms: Sequence[Term], networks: Sequence[Network]) -> Learned:
    return Learned(Law(tuple(terms)), Networks(tuple(networks)), {}, {}, {})


def _predicts(
    problem: Problem,
    judge: Judge | None,
    before: np.ndarray,
    after: np.ndarray,
    had: tuple[Sequence[Term], Sequence[Network]],
    added: tuple[Sequence[Term], Sequence[Network]],
    acts_there: bool,
) -> bool:
    """Return whether held-out flights are predicted no worse with what was learnt, and better in all.

    acts_there: whether it acts in them enough to be judged.
    """
    if judge is None:
        return True
    old, both = _of_parts(*had), _of_parts([*had[0], *added[0]], [*had[1], *added[1]])
    tested = [
        errors_at(problem.with_learned(one.effects), one.beside(vector)[None], judge.windows)
        for vector, one in ((before, old), (after, both))
    ]
    scale = np.maximum(np.nan_to_num(tested[0].rms()[0], nan=1.0), 1e-9)
    ratio = tested[1].rms()[0] / scale
    lost = sureness(tested[1].by_block(scale)[0] - tested[0].by_block(scale)[0])
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
