"""Search for a law where no effect explains a log, by sparse regression over physical terms.

Every candidate is a term of ``flytrack_env.effects.grammar``: a product of shapes of quantities
times a free vector. The search scores all candidates beside the free parameters of the model, as
the diagnosis scores effects: whitened, robust, by blocks of a second. It refines the shape
parameters of the best candidates, and adds the one that gains most for its numbers, up to three
terms. A term has to gain on held-out rows, too.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import optimize, stats

from flytrack_env.dynamics import collective_thrust
from flytrack_env.effects.grammar import QUANTITIES, SHAPES, XYZ, Factor, Moment, Term
from flytrack_env.quaternion import Vec3
from flytrack_env.state import Action
from flytrack_sysid.diagnosis.unexplained import (
    BUMP_PLACES,
    BUMP_WIDTHS_M,
    SIDES,
    FlightVariables,
    SideFit,
    SideTest,
    build_flight_variables,
    fitted_on,
    linearized_residuals,
    whitened,
)
from flytrack_sysid.inference.chunks import CHUNK_S, of_row_before
from flytrack_sysid.inference.parameters import MAX_RATES, from_vector
from flytrack_sysid.inference.problem import Problem, robust_square, split_blocks
from flytrack_sysid.inference.search import FittedModel

FALSE_POSITIVE_RATE = 1e-7  # of a term if the residuals are noise
FURTHER_FALSE_POSITIVE_RATE = 1e-4  # of a second and third term
# Gain of chi2 that each coefficient and each shape parameter has to add.
PER_COEFFICIENT, PER_NUMBER = 4.0, 8.0
MAX_RETRIED_TERMS = 100  # terms that are tried beside the first one
MAX_REFINED, REFINEMENTS = 5, 60  # terms a round whose shapes are refined, and evaluations of each
MAX_TERMS = 3  # of one side
MAX_STARTS = 3  # first terms from which a law is searched
MIN_GAIN_FRACTION = 0.04  # smallest gain of one more term, relative to that of the earlier terms
# of a column's information: the part that the model's free parameters cannot explain
MIN_INDEPENDENT_FRACTION = 0.01
TINY = 1e-3  # lower limit of positive shape parameters
MIN_SIGMAS = 3.0  # of a coefficient that is kept
HELD_OUT_SHARE = 0.6  # of the gain that a law would have on held-out rows if it were right
MIN_EXPECTED_GAIN = 10.0  # of that gain: with less, held-out rows cannot confirm a law


def moment_of_flight(problem: Problem, vector: np.ndarray, flight: FlightVariables) -> Moment:
    """Return the quantities that a law may depend on, at the beginning of the step to each row.

    Returns:
        Quantities, (rows, chunks) each.
    """
    model, record = from_vector(vector, problem.like), problem.chunks.record
    wind = model.effect("wind")
    wind_w = np.array([float(wind.v_x), float(wind.v_y), float(wind.v_z)])
    rotation = flight.body_to_world
    airspeed_b = np.einsum("rlji,rlj->rli", rotation, flight.vel_w - wind_w)
    volts = of_row_before(record.battery_v)
    thrust = collective_thrust(flight.applied[..., 3], volts, model.thrust_coeffs)
    max_rates = np.radians(vector[problem.parameter_indices(MAX_RATES)])
    rates_b = flight.applied[..., :XYZ] * max_rates
    if "w" in problem.chunks.measured:
        rates_b = of_row_before(problem.chunks.measured["w"])

    def vec(values: np.ndarray) -> Vec3:
        return Vec3(*np.moveaxis(values, -1, 0))

    return Moment(
        pos_w=vec(flight.pos_w),
        rates_b=vec(rates_b),
        body_axes_w=(vec(rotation[..., 0]), vec(rotation[..., 1]), vec(rotation[..., 2])),
        airspeed_b=vec(airspeed_b),
        applied=Action(*np.moveaxis(flight.applied, -1, 0)),
        thrust_acc=np.asarray(thrust) / float(model.m),
        battery_v=volts,
        time_s=of_row_before(record.time_s),
    )


def list_directions(term: Term, moment: Moment, rotation: np.ndarray) -> np.ndarray:
    """Return a term's unit directions in the world frame, (coefficients, rows, chunks, 3)."""
    body = [
        np.stack(np.broadcast_arrays(*unit, moment.time_s)[:-1], axis=-1)
        for unit in term.basis(moment)
    ]
    return np.einsum("rlij,crlj->crli", rotation, np.stack(body))


class Side(NamedTuple):
    """One side of a problem and a model: its residuals, and the columns of its free parameters.

    Attributes:
        name: rate or force.
        problem: the rows that are fitted or tested.
        vector: parameters of the model, (num_parameters,).
        moment: quantities that a law may depend on.
        flight: the flight at the step to each row.
        test: score test beside the free parameters.
        acting: indices into ``vector`` of the parameters that the columns in ``test`` belong to.
    """

    name: str
    problem: Problem
    vector: np.ndarray
    moment: Moment
    flight: FlightVariables
    test: SideTest
    acting: tuple[int, ...]

    @classmethod
    def of(cls, name: str, problem: Problem, model: FittedModel) -> "Side":
        """Build a side ("rate" or "force") of a problem and a model."""
        white, slopes = linearized_residuals(problem, model)
        flight = build_flight_variables(problem, model)
        is_fitted = fitted_on(name, slopes)
        acting = tuple(index for index, fits in zip(model.indices, is_fitted, strict=True) if fits)
        moment = moment_of_flight(problem, model.vector, flight)
        test = SideTest.of(name, white, slopes)
        return cls(name, problem, model.vector, moment, flight, test, acting)

    def white(self, term: Term) -> np.ndarray:
        """Return a term's unit coefficients as innovations, (coefficients, rows, chunks, 3, 2)."""
        signal = np.broadcast_to(term.signal(self.moment), np.shape(self.moment.time_s))[..., None]
        directions = list_directions(term, self.moment, self.flight.body_to_world)
        return whitened(self.problem, directions * signal, self.name)

    def vector_beside(self, given: np.ndarray) -> np.ndarray:
        """Return the model's vector beside fitted terms.

        Args:
            given: the step of its acting parameters, which is subtracted.
        """
        vector = self.vector.copy()
        vector[list(self.acting)] -= given
        return self.problem.clipped(vector)

    def columns(self, term: Term) -> np.ndarray:
        """Return a term's unit coefficients, weighted, by blocks of a second."""
        return split_blocks(self.white(term) * self.test.root)

    def spread(self, quantity: str) -> np.ndarray:
        """Return the values of a quantity in the rows that are scored."""
        values = QUANTITIES[quantity].of(self.moment)
        return np.asarray(jnp.broadcast_to(values, self.flight.time_s.shape))[
            self.flight.is_counted
        ]


def power(quantity: str, exponent: float = 1.0) -> Factor:
    """Return a power of a quantity."""
    return Factor(quantity, "power", (exponent, 0.0))


def _local(side: Side, quantity: str, shapes: Sequence[str], count: int) -> Iterator[Factor]:
    """Yield bumps or steps of two widths, centred at values along a quantity's range."""
    low, high = np.quantile(side.spread(quantity), [0.02, 0.98])
    if high - low < 1e-9:
        return
    for centre in np.linspace(low, high, count + 2)[1:-1]:
        for shape in shapes:
            for relative_width in (0.5, 1.2):
                yield Factor(
                    quantity,
                    shape,
                    (float(centre), float(relative_width * (high - low) / (count + 1))),
                )


def _powers(quantity: str, exponents: Iterable[float]) -> Iterator[tuple[str, tuple[Factor, ...]]]:
    """Yield powers of a quantity, each with its frame."""
    for exponent in exponents:
        yield "body", (power(quantity, exponent),)


def list_factors(side: Side) -> Iterator[tuple[str, tuple[Factor, ...]]]:
    """Yield the frames and factors that are tried."""
    airspeeds = ("airspeed_x", "airspeed_y", "airspeed_z", "edgewise", "airspeed")
    for quantity in airspeeds:
        yield from _powers(quantity, (1.0, 2.0, 3.0))
        yield from (
            ("body", (power("thrust", exponent), power(quantity))) for exponent in (0.5, 1.0)
        )
        yield "body", (power("thrust"), power(quantity, 2.0))
    rates = ("rate_x", "rate_y", "rate_z")
    for quantity in rates:
        yield from _powers(quantity, (1.0, 2.0))
        yield from (("body", (power(quantity), power(airspeed))) for airspeed in airspeeds[:3])
    yield from (("body", tuple(map(power, pair))) for pair in combinations(rates, 2))
    for quantity in ("roll", "pitch", "yaw", "throttle"):
        yield from _powers(quantity, (2.0, 3.0))
        yield from (("body", (factor,)) for factor in _local(side, quantity, ("bump", "step"), 5))
    # The voltage alone is not tried: within one flight it falls with the time.
    yield "body", (power("thrust"), power("voltage"))
    for quantity in ("tilt", "height"):
        yield from _powers(quantity, (1.0, 2.0))
        yield from (("body", (factor,)) for factor in _local(side, quantity, ("bump",), 6))
        yield "body", (power("thrust"), power(quantity))
    span = float(np.ptp(side.spread("time")))
    saturations = [Factor("time", "saturation", (share * span,)) for share in (0.1, 0.3, 1.0)]
    for factor in (power("time"), *saturations, *_local(side, "time", ("bump", "step"), 8)):
        yield "body", (factor,)
        yield "body", (power("thrust"), factor)
    frames = ("body", "world") if side.name == "force" else ("body",)
    for order in (1.0, 2.0, 3.0, 4.0):
        for phase in np.linspace(0.0, math.pi, 4, endpoint=False):
            yield from (
                (frame, (Factor("heading", "wave", (order, float(phase))),)) for frame in frames
            )
    if side.name == "force":
        for factor in (
            power("airspeed", 2.0),
            power("airspeed", 3.0),
            *_local(side, "airspeed", ("bump",), 8),
        ):
            yield "air", (factor,)
        positions = side.flight.pos_w[side.flight.is_counted]
        for centre in positions[
            np.linspace(0, len(positions) - 1, 2 * BUMP_PLACES + 1).astype(int)[1::2]
        ].tolist():
            for width in BUMP_WIDTHS_M:
                yield "world", (Factor("position", "place", (*centre, width)),)


class Trial(NamedTuple):
    """A scored term.

    Attributes:
        term: the term without coefficients.
        merit: its gain less a price for its numbers.
        gain: that gain alone.
    """

    term: Term
    merit: float
    gain: float


def bare_term(side: Side, frame: str, factors: tuple[Factor, ...]) -> Term:
    """Return a term whose coefficients are not fitted yet."""
    return Term(side.name, frame, factors, (0.0,) * XYZ, (0.0,) * XYZ)


def num_shaped(term: Term) -> int:
    """Return the number of free shape parameters of a term."""
    return sum(len(factor.numbers) for factor in term.factors if factor.shape != "power")


def num_numbers(term: Term) -> int:
    """Return the number of free numbers of a term: coefficients and shape parameters."""
    return term.num_coefficients + num_shaped(term)


def term_price(term: Term) -> float:
    """Return the gain that a term needs to be preferred to no term."""
    return PER_COEFFICIENT * term.num_coefficients + PER_NUMBER * num_shaped(term)


def score_term(side: Side, test: SideTest, term: Term) -> Trial:
    """Return the gain of a term beside given columns; zero if it hardly differs from them."""
    columns = side.columns(term)
    if not np.isfinite(columns).all() or not np.abs(columns).max() > 0.0:
        return Trial(term, -np.inf, 0.0)
    gain = test.fit(columns, MIN_INDEPENDENT_FRACTION).gain
    return Trial(term, gain - term_price(term), gain)


def refine_shapes(side: Side, test: SideTest, start: Trial) -> Trial:
    """Optimise the shape parameters of a term for the largest gain."""
    if not num_shaped(start.term):
        return start
    numbers = np.concatenate([factor.numbers for factor in start.term.factors])
    is_free = np.array(
        [
            factor.shape != "power"
            and (factor.shape, index) != ("wave", 0)  # a wave's order, which is an integer
            for factor in start.term.factors
            for index in range(len(factor.numbers))
        ]
    )
    steps = np.maximum(0.2 * np.abs(numbers), 0.1)[is_free]
    best = start

    def cost(change: np.ndarray) -> float:
        nonlocal best
        values = numbers.copy()
        values[is_free] += change * steps
        term = _with_numbers(start.term, values)
        if term is None:
            return 0.0
        trial = score_term(side, test, term)
        best = max(best, trial, key=lambda candidate: candidate.merit)
        return -trial.merit

    simplex = np.concatenate([np.zeros((1, len(steps))), np.eye(len(steps))])
    options = {"maxfev": REFINEMENTS, "initial_simplex": simplex, "xatol": 0.02, "fatol": 0.5}
    optimize.minimize(cost, np.zeros(len(steps)), method="Nelder-Mead", options=options)
    return best


def refine_jointly(side: Side, terms: Sequence[Term], indices: Iterable[int]) -> list[Term]:
    """Refine the shapes of some terms, each beside all others.

    Args:
        terms: the terms of a law.
        indices: which of the terms are refined.
    """
    result = list(terms)
    for index in indices:
        term = terms[index]
        other_columns = [
            side.columns(fixed_term) for fixed_term in (*result[:index], *result[index + 1 :])
        ]
        test = side.test.given_also(*other_columns)
        result[index] = refine_shapes(side, test, score_term(side, test, term)).term
    return result


def _with_numbers(term: Term, values: np.ndarray) -> Term | None:
    """Return a term with other shape parameters; None if one would have no width."""
    factors, index = [], 0
    for factor in term.factors:
        numbers = tuple(values[index : index + len(factor.numbers)].tolist())
        index += len(factor.numbers)
        by_name = dict(zip(SHAPES[factor.shape].numbers, numbers, strict=True))
        if any(not by_name[name] > TINY for name in SHAPES[factor.shape].positive):
            return None
        factors.append(replace(factor, numbers=numbers))
    return replace(term, factors=tuple(factors))


class FittedLaw(NamedTuple):
    """A fitted law of one side, with its gains of minus twice the log likelihood.

    Attributes:
        terms: terms with coefficients.
        vector: parameters of the model, with the changes of its free parameters due to the law.
        gain: gain on the training rows.
        held_out_gain: gain on held-out rows.
        expected: gain on held-out rows if the law is right.
        rivals: other terms whose gain alone is within 10 of the best one's, as formulas.
    """

    terms: tuple[Term, ...]
    vector: np.ndarray
    gain: float
    held_out_gain: float
    expected: float
    rivals: tuple[str, ...] = ()


def fit_terms(side: Side, terms: Sequence[Term]) -> tuple[tuple[Term, ...], SideFit]:
    """Fit terms together, and keep the coefficients of at least MIN_SIGMAS standard errors."""
    columns = [side.columns(term) for term in terms]
    sizes = [term_columns.shape[1] for term_columns in columns]
    joined = np.concatenate(columns, axis=1)
    kept = np.ones(joined.shape[1], bool)
    while True:
        fit = side.test.fit(joined[:, kept], MIN_INDEPENDENT_FRACTION)
        sigmas = np.abs(fit.step) / np.maximum(fit.errors, 1e-300)
        if sigmas.min() >= MIN_SIGMAS or kept.sum() == 1:
            break
        kept[np.flatnonzero(kept)[int(np.argmin(sigmas))]] = False
    numbers = np.zeros((2, len(kept)))
    numbers[:, kept] = fit.step, fit.errors
    result = []
    for term, term_numbers in zip(
        terms, np.split(numbers, np.cumsum(sizes)[:-1], axis=1), strict=True
    ):
        coefficients, errors = np.pad(
            term_numbers, ((0, 0), (0, XYZ - term_numbers.shape[1]))
        ).tolist()
        if any(coefficients):
            result.append(
                replace(term, coefficients=tuple(coefficients), standard_errors=tuple(errors))
            )
    return tuple(result), fit


def held_out(side: Side, held: Side, learnt: np.ndarray, vector: np.ndarray) -> tuple[float, float]:
    """Return the gain of something learnt on held-out rows, and the gain expected if it is right.

    Args:
        side: the training rows.
        held: the held-out rows.
        learnt: its contribution on the held-out rows, whitened.
        vector: parameters of the model beside it, (num_parameters,).
    """
    axes = SIDES[side.name]
    base, refitted = held.problem.whitened_residuals(side.vector, vector)
    full = refitted[..., axes, :] - learnt
    gain = robust_square(base[..., axes, :]) - robust_square(full)
    return gain, float(np.sum((base[..., axes, :] - full) ** 2))


def cross_validate(side: Side, terms: Sequence[Term]) -> tuple[float, float]:
    """Return the cross-validated gain of a law's terms, and the gain expected if they are right.

    Coefficients fitted to each half of the blocks are tested on the other half. This serves laws
    that do not act in held-out rows, such as a thermal that the drone does not pass there.
    """
    columns = np.concatenate([side.columns(term) for term in terms], axis=1)
    folds = np.indices((CHUNK_S, len(columns) // CHUNK_S)).sum(axis=0).ravel() % 2
    gain = expected = 0.0
    for fold in range(2):
        step = (
            side.test.of_blocks(folds == fold)
            .fit(columns[folds == fold], MIN_INDEPENDENT_FRACTION)
            .step
        )
        _, information, score, _ = side.test.of_blocks(folds != fold).projected(
            columns[folds != fold]
        )
        expected += float(step @ information @ step)
        gain += float(2.0 * step @ score - step @ information @ step)
    return gain, expected


def judge_law(side: Side, held: Side, terms: tuple[Term, ...], fit: SideFit) -> FittedLaw:
    """Return fitted terms as a law, with its gain on held-out rows."""
    vector, white = side.vector_beside(fit.given), [held.white(term) for term in terms]
    coefficients = [
        np.array(term.coefficients[: len(columns)])
        for term, columns in zip(terms, white, strict=True)
    ]
    learnt = np.tensordot(np.concatenate(coefficients), np.concatenate(white), axes=1)
    return FittedLaw(terms, vector, fit.chi2, *held_out(side, held, learnt, vector))


def is_confirmed(side: Side, law: FittedLaw) -> bool:
    """Return whether held-out rows confirm a law.

    If the law hardly acts in them, cross-validation on the training rows decides.
    """
    gain, expected = law.held_out_gain, law.expected
    if expected < MIN_EXPECTED_GAIN:
        gain, expected = cross_validate(side, law.terms)
    return gain >= HELD_OUT_SHARE * expected


def drop_weak_terms(side: Side, held: Side, law: FittedLaw, num_tried: int) -> FittedLaw | None:
    """Drop terms that gain too little beside all others; a first term may stand in for later ones.

    Args:
        side: the training rows.
        held: the held-out rows.
        law: the law with all terms.
        num_tried: number of terms among which they were chosen.

    Returns:
        The law with the other terms, the best first; None if held-out rows do not confirm it.
    """
    terms = law.terms
    while True:
        subsets = [[kept for kept in terms if kept is not term] for term in terms]
        total = fit_terms(side, terms)[1].chi2
        losses = [
            total - fit_terms(side, subset)[1].chi2 if subset else total for subset in subsets
        ]
        limits = stats.chi2.isf(
            FURTHER_FALSE_POSITIVE_RATE / num_tried, [num_numbers(term) for term in terms]
        )
        weakest = int(np.argmin(losses - limits))
        if len(terms) == 1 or losses[weakest] >= limits[weakest]:
            break
        terms = tuple(refine_jointly(side, subsets[weakest], range(len(subsets[weakest]))))
    order = np.argsort(losses)[::-1]
    if len(terms) == len(law.terms):
        return law._replace(terms=tuple(terms[index] for index in order))
    reduced_law = judge_law(side, held, *fit_terms(side, [terms[index] for index in order]))
    return reduced_law if is_confirmed(side, reduced_law) else None


def find_law(side: Side, held: Side) -> FittedLaw | None:
    """Return the law of a side that training and held-out rows agree on; None without one.

    The search starts from the best terms of several quantities, since each wave of a sum may gain
    less than a bump.
    """
    pool = [bare_term(side, *frame_and_factors) for frame_and_factors in list_factors(side)]
    firsts, ranked = rank_terms(side, side.test, pool)
    limits = stats.chi2.isf(
        FALSE_POSITIVE_RATE / len(pool), [num_numbers(trial.term) for trial in firsts]
    )
    clear = [trial for trial, limit in zip(firsts, limits, strict=True) if trial.gain >= limit]
    rivals = tuple(
        _kind(trial.term) for trial in firsts[1:] if trial.merit > firsts[0].merit - 10.0
    )
    by_quantity: dict[str, Trial] = {}
    for trial in clear:
        by_quantity.setdefault(trial.term.factors[-1].quantity, trial)
    starts = list(by_quantity.values())[:MAX_STARTS]
    grown = [grow_law(side, held, trial, ranked, len(pool)) for trial in starts]
    laws = [drop_weak_terms(side, held, law, len(pool)) for law in grown if law is not None]
    confirmed = [law._replace(rivals=rivals) for law in laws if law is not None]
    return max(
        confirmed,
        key=lambda law: law.gain - sum(term_price(term) for term in law.terms),
        default=None,
    )


def rank_terms(side: Side, test: SideTest, pool: Sequence[Term]) -> tuple[list[Trial], list[Term]]:
    """Return the best terms of each kind, refined, and the whole pool; both sorted by merit."""
    trials = sorted((score_term(side, test, term) for term in pool), key=lambda trial: -trial.merit)
    best = [refine_shapes(side, test, trial) for trial in _of_different_kinds(trials)[:MAX_REFINED]]
    return sorted(best, key=lambda trial: -trial.merit), [trial.term for trial in trials]


def grow_law(
    side: Side, held: Side, first: Trial, pool: Sequence[Term], num_tried: int
) -> FittedLaw | None:
    """Build a law by forward selection: start with a term, add terms of a pool while they gain.

    Args:
        side: the training rows.
        held: the held-out rows.
        first: the term to start with.
        pool: terms that may be added, the best first.
        num_tried: number of terms among which they are chosen.
    """
    terms: list[Term] = []
    best: FittedLaw | None = None

    def uses_time(term: Term) -> bool:
        return any(factor.quantity == "time" for factor in term.factors)

    # A single event would pass for the remainder of another law, so either all terms depend on the
    # time, or none.
    pool = [term for term in pool if uses_time(term) == uses_time(first.term)][:MAX_RETRIED_TERMS]
    while True:
        fitted, fit = fit_terms(side, refine_jointly(side, [*terms, first.term], range(len(terms))))
        if len(fitted) <= len(terms) or (
            best is not None and fit.chi2 < (1.0 + MIN_GAIN_FRACTION) * best.gain
        ):
            break
        law = judge_law(side, held, fitted, fit)
        if best is not None and law.held_out_gain < best.held_out_gain:
            break
        # One wave of a sum of two may fail on held-out rows although the sum does not.
        if is_confirmed(side, law):
            best = law
        terms = list(fitted)
        if len(terms) == MAX_TERMS:
            break
        test = side.test.given_also(*(side.columns(term) for term in terms))
        (first, *_), _ = rank_terms(side, test, pool)
        if first.gain < stats.chi2.isf(
            FURTHER_FALSE_POSITIVE_RATE / num_tried, num_numbers(first.term)
        ):
            break
    return best


def _kind(term: Term) -> str:
    return f"{term.frame}: " + " ".join(
        f"{factor.shape} of {factor.quantity}" for factor in term.factors
    )


def _of_different_kinds(trials: Sequence[Trial]) -> list[Trial]:
    """Return the best trial of each frame, quantities and shapes."""
    best: dict[tuple[str, tuple[tuple[str, ...], ...]], Trial] = {}
    for trial in trials:
        exponents = tuple(
            (
                factor.quantity,
                factor.shape,
                str(factor.numbers[0]) if factor.shape in ("power", "wave") else "",
            )
            for factor in trial.term.factors
        )
        best.setdefault((trial.term.frame, exponents), trial)
    return list(best.values())
