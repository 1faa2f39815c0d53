"""Beyond the list: where a diagnosis leaves something unexplained, a law for it.

Of each side (rate, force) that depends on something, a law is searched; it is proposed where it
explains nearly all that smooth functions of everything would. It has to predict held-out flights
better in all, and no worse at any horizon where these tell anything.
"""

import numpy as np

from flytrack_env.effects.grammar import Law
from flytrack_sysid.diagnosis.beyond import Learned
from flytrack_sysid.diagnosis.chunks import thinned
from flytrack_sysid.diagnosis.law_search import MIN_EXPECTED_GAIN, FittedLaw, Side, find_law
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.refinement import (
    LIKELY,
    LIKELY_WORSE,
    WORSE_ANYWHERE,
    FlightErrors,
    FlightTest,
    errors_at,
)
from flytrack_sysid.diagnosis.search import FittedModel
from flytrack_sysid.diagnosis.unexplained import (
    find_dependences,
    find_lines,
    stochastic_shares,
    waves_of,
)

MAX_ROWS = 12_000  # with their lead-ins: two minutes at 100 Hz
MIN_RMS_RATIO = 0.08  # of the sensor's noise, rms: less is not learnt
# of squared errors of held-out flights, over all horizons: what takes less off is nothing
MIN_ERROR_REDUCTION = 0.02
LAW_SHARE = 0.75  # of what smooth functions of everything explain: the least that a law explains


def find_learned(
    problem: Problem,
    test: Problem,
    model: FittedModel,
    base: np.ndarray,
    flight_test: FlightTest | None,
) -> tuple[Learned | None, np.ndarray]:
    """Return the law of what a model leaves, None without one, and the model's vector beside it.

    problem, test: of rows to learn from and of others. base: vector of the refitted model without
    effects. flight_test: of free flights on held-out rows; None without any.
    """
    problem, test = thinned_problem(problem), thinned_problem(test)
    waves = waves_of(problem, model, find_lines(problem, model))
    dependences = find_dependences(problem, model, base, waves)
    learned: Learned | None = None
    # What wanders may be a law whose variable smooth functions of everything do not have.
    wandering = [] if dependences else list(stochastic_shares(problem, model))
    for name in dict.fromkeys([*(one.side for one in dependences), *wandering]):
        on_side = [one for one in dependences if one.side == name]
        if on_side and max(one.share for one in on_side) < MIN_RMS_RATIO:
            continue
        law = find_law(Side.of(name, problem, model), Side.of(name, test, model))
        if law is None or law.gain < LAW_SHARE * sum(one.gain for one in on_side):
            continue
        more = _with_side(learned, name, law)
        acts_there = law.expected >= MIN_EXPECTED_GAIN
        if _predicts(problem, flight_test, (learned, model.vector), (more, law.vector), acts_there):
            learned, model = more, model._replace(vector=law.vector)
    return learned, model.vector


def _with_side(learned: Learned | None, name: str, law: FittedLaw) -> Learned:
    """Return what was learnt, with the law of one more side."""
    learned = learned or Learned(Law(()), {}, {}, {})
    return Learned(
        Law((*learned.law.terms, *law.terms)),
        {**learned.gains, name: law.gain},
        {**learned.held_out_gains, name: law.held_out_gain},
        {**learned.rivals, name: law.rivals},
    )


def thinned_problem(problem: Problem) -> Problem:
    """Return a problem of fewer chunks, evenly spread, where a log is long.

    Hundreds of terms are tried.
    """
    chunks = thinned(problem.chunks, max(MAX_ROWS // len(problem.chunks.row), 2))
    if chunks is problem.chunks or problem.late is not None:
        return problem
    return problem.with_chunks(chunks)


def _predicts(
    problem: Problem,
    flight_test: FlightTest | None,
    before: tuple[Learned | None, np.ndarray],
    after: tuple[Learned | None, np.ndarray],
    acts_there: bool,
) -> bool:
    """Return whether what was learnt predicts held-out flights no worse, and better overall.

    before, after: what was learnt, and the model's vector beside it. acts_there: whether it acts in
    them enough to be judged.
    """
    if flight_test is None:
        return True
    old, new = (_flight_errors(problem, flight_test, *each) for each in (before, after))
    ratio, lost = new.against(old)
    return improves_flights(ratio[flight_test.is_known], lost[flight_test.is_known], acts_there)


def _flight_errors(
    problem: Problem, flight_test: FlightTest, learned: Learned | None, vector: np.ndarray
) -> FlightErrors:
    """Return the errors of held-out flights with what was learnt, if anything."""
    if learned is None:
        return errors_at(problem, vector[None], flight_test.windows)
    return errors_at(
        problem.with_law(learned.effect), learned.beside(vector)[None], flight_test.windows
    )


def improves_flights(ratio: np.ndarray, lost: np.ndarray, acts_there: bool) -> bool:
    """Return whether flights are predicted no worse anywhere and, if it acts there, better overall.

    ratio: of errors with what was learnt over those without, by horizon and quantity. lost: by how
    many standard errors each is larger.
    """
    is_better = float(np.mean(ratio**2)) < 1.0 - MIN_ERROR_REDUCTION
    # What makes flights in all no better has to be as good at every horizon.
    worst = WORSE_ANYWHERE if is_better else LIKELY
    is_worse = (ratio > LIKELY_WORSE) & (lost > worst)
    return not is_worse.any() and (is_better or not acts_there)
