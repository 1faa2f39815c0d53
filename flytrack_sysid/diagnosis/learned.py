"""Beyond the list: learn a law where a diagnosis leaves something unexplained.

For each side (rate, force) whose residuals depend on something, the diagnosis searches a law. It
proposes the law if it explains nearly all that smooth functions of all variables would. The law has
to predict held-out flights better overall, and no worse at any horizon with evidence.
"""

import numpy as np

from flytrack_env.effects.grammar import Law
from flytrack_sysid.diagnosis.beyond import Learned
from flytrack_sysid.diagnosis.flight_errors import (
    LIKELY,
    LIKELY_WORSE,
    WORSE_ANYWHERE,
    FlightErrors,
    FlightTest,
)
from flytrack_sysid.diagnosis.law_search import MIN_EXPECTED_GAIN, FittedLaw, Side, find_law
from flytrack_sysid.diagnosis.unexplained import (
    build_waves,
    find_dependences,
    find_lines,
    stochastic_shares,
)
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.search import FittedModel

MAX_ROWS = 12_000  # with their lead-ins: two minutes at 100 Hz
MIN_RMS_RATIO = 0.08  # of the sensor's noise, RMS: no law is learnt for smaller residuals
# of squared errors of held-out flights, over all horizons: a smaller reduction counts as none
MIN_ERROR_REDUCTION = 0.02
LAW_SHARE = 0.75  # of the gain of smooth functions of all variables: a law has to gain as much


def find_learned(
    problem: Problem,
    test: Problem,
    model: FittedModel,
    base: np.ndarray,
    flight_test: FlightTest | None,
) -> tuple[Learned | None, np.ndarray]:
    """Return the law of a model's residuals, None without one, and the model's vector beside it.

    Args:
        problem: the training rows.
        test: the held-out rows.
        model: the extended model.
        base: vector of the refitted model without effects, (num_parameters,).
        flight_test: free flights on held-out rows; None without any.
    """
    # The search tries hundreds of terms.
    max_chunks = max(MAX_ROWS // len(problem.chunks.row), 2)
    problem, test = problem.thinned(max_chunks), test.thinned(max_chunks)
    waves = build_waves(problem, model, find_lines(problem, model))
    dependences = find_dependences(problem, model, base, waves)
    learned: Learned | None = None
    # A wandering disturbance may be a law of a variable that is not among the smooth functions.
    wandering = [] if dependences else list(stochastic_shares(problem, model))
    for name in dict.fromkeys([*(dependence.side for dependence in dependences), *wandering]):
        on_side = [dependence for dependence in dependences if dependence.side == name]
        if on_side and max(dependence.share for dependence in on_side) < MIN_RMS_RATIO:
            continue
        law = find_law(Side.of(name, problem, model), Side.of(name, test, model))
        if law is None or law.gain < LAW_SHARE * sum(dependence.gain for dependence in on_side):
            continue
        extended = _with_side(learned, name, law)
        acts_there = law.expected >= MIN_EXPECTED_GAIN
        if _predicts(
            problem, flight_test, (learned, model.vector), (extended, law.vector), acts_there
        ):
            learned, model = extended, model._replace(vector=law.vector)
    return learned, model.vector


def _with_side(learned: Learned | None, name: str, law: FittedLaw) -> Learned:
    """Add the law of a side to what was learnt."""
    learned = learned or Learned(Law(()), {}, {}, {})
    return Learned(
        Law((*learned.law.terms, *law.terms)),
        {**learned.gains, name: law.gain},
        {**learned.held_out_gains, name: law.held_out_gain},
        {**learned.rivals, name: law.rivals},
    )


def _predicts(
    problem: Problem,
    flight_test: FlightTest | None,
    before: tuple[Learned | None, np.ndarray],
    after: tuple[Learned | None, np.ndarray],
    acts_there: bool,
) -> bool:
    """Return whether what was learnt predicts held-out flights no worse, and better overall.

    Args:
        before: what was learnt before, and the model's vector beside it.
        after: what was learnt now, and the model's vector beside it.
        acts_there: whether the new law acts enough in held-out rows for a score.
    """
    if flight_test is None:
        return True
    old, new = (_flight_errors(problem, flight_test, *pair) for pair in (before, after))
    ratio, z_scores = new.against(old)
    return improves_flights(ratio[flight_test.is_known], z_scores[flight_test.is_known], acts_there)


def _flight_errors(
    problem: Problem, flight_test: FlightTest, learned: Learned | None, vector: np.ndarray
) -> FlightErrors:
    """Return the errors of held-out flights with what was learnt, if anything was."""
    if learned is None:
        return flight_test.flights.errors_at(problem, vector[None])
    return flight_test.flights.errors_at(
        problem.with_law(learned.effect), learned.beside(vector)[None]
    )


def improves_flights(ratio: np.ndarray, z_scores: np.ndarray, acts_there: bool) -> bool:
    """Return whether a law predicts flights nowhere worse and, if it acts there, better overall.

    Args:
        ratio: errors with the law over those without it, by horizon and quantity.
        z_scores: increase of each error in standard errors.
        acts_there: whether the law acts in the flights.
    """
    is_better = ratio.size > 0 and float(np.mean(ratio**2)) < 1.0 - MIN_ERROR_REDUCTION
    # A law that predicts flights no better overall has to be as good at every horizon.
    worst = WORSE_ANYWHERE if is_better else LIKELY
    is_worse = (ratio > LIKELY_WORSE) & (z_scores > worst)
    return not is_worse.any() and (is_better or not acts_there)
