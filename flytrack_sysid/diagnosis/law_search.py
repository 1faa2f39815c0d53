"""Search for a law where no effect explains a log, by sparse regression over physical terms.

Every candidate is a term of ``flytrack_env.effects.grammar``: a product of shapes of quantities
times a free vector. All are scored beside what the model may change (as the diagnosis scores
effects: whitened, robust, by blocks of a second), the best are refined in the numbers of their
shapes, and the one that gains most per number is added, up to three. A term has to gain on held-out
rows, too.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import optimize, stats

from flytrack_env.dynamics import collective_thrust
from flytrack_env.effects.grammar import QUANTITIES, SHAPES, XYZ, Factor, Moment, Term
from flytrack_env.quaternion import Vec3
from flytrack_env.state import Action
from flytrack_sysid.diagnosis.chunks import CHUNK_S
from flytrack_sysid.diagnosis.problem import Problem, blocks_of, robust_square
from flytrack_sysid.diagnosis.search import FittedModel
from flytrack_sysid.diagnosis.unexplained import (
    BUMP_PLACES,
    BUMP_WIDTHS_M,
    SIDES,
    FlightVariables,
    SideFit,
    SideTest,
    flight_of,
    linearized_residuals,
    whitened,
)
from flytrack_sysid.parameters import MAX_RATES, from_vector

FALSE_POSITIVE_RATE = 1e-7  # of a term where nothing is left
FURTHER_FALSE_POSITIVE_RATE = 1e-4  # of a second and third term
PER_COEFFICIENT, PER_NUMBER = 4.0, 8.0  # of chi2: what each has to gain to be preferred to fewer
MAX_RETRIED_TERMS = 100  # terms, beside the first one found
MAX_REFINED, REFINEMENTS = 5, 60  # terms a round whose shapes are refined, and evaluations of each
MAX_TERMS = 3  # of one side
MAX_STARTS = 3  # first terms from which a law is searched
MIN_GAIN_FRACTION = 0.04  # of what the terms before gain: the least of one more
# of a column's information: what is not within the reach of the model's free numbers
MIN_INDEPENDENT_FRACTION = 0.01
TINY = 1e-3  # of numbers that are positive
MIN_SIGMAS = 3.0  # of a coefficient that stays
HELD_OUT_SHARE = 0.6  # of the gain on held-out rows that a law would have there if it were right
MIN_EXPECTED_GAIN = 10.0  # of that gain: with less, held-out rows say nothing of a law


def moment_of_flight(problem: Problem, vector: np.ndarray, flight: FlightVariables) -> Moment:
    """Return the quantities a law may depend on, at the beginning of the step to each row.

    Arrays are (rows, chunks).
    """
    model, record = from_vector(vector, problem.like), problem.chunks.record
    wind = model.effect("wind")
    air_w = np.array([float(wind.v_x), float(wind.v_y), float(wind.v_z)])
    rotation = flight.body_to_world
    airspeed_b = np.einsum("rlji,rlj->rli", rotation, flight.vel_w - air_w)
    volts = np.concatenate([record.battery_v[:1], record.battery_v[:-1]])
    thrust = collective_thrust(flight.applied[..., 3], volts, model.thrust_coeffs)
    full = np.radians(vector[problem.indices_of(MAX_RATES)])
    rates_b = flight.applied[..., :XYZ] * full
    if "w" in problem.chunks.measured:
        gyro = problem.chunks.measured["w"]
        rates_b = np.concatenate([gyro[:1], gyro[:-1]])

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
        time_s=np.concatenate([record.time_s[:1], record.time_s[:-1]]),
    )


def directions_of(term: Term, moment: Moment, rotation: np.ndarray) -> np.ndarray:
    """Return a term's unit directions in the world frame, (coefficients, rows, chunks, 3)."""
    body = [
        np.stack(np.broadcast_arrays(*unit, moment.time_s)[:-1], axis=-1)
        for unit in term.basis(moment)
    ]
    return np.einsum("rlij,crlj->crli", rotation, np.stack(body))


class Side(NamedTuple):
    """One side of a problem and a model: what is left, and what its free numbers may change there.

    acting: the indices of the model's vector that the columns in ``test`` belong to.
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
        """Return a side ("rate" or "force") of a problem and a model."""
        white, slopes = linearized_residuals(problem, model)
        flight = flight_of(problem, model)
        squared = np.square(slopes).sum(axis=(1, 2, 4))
        own = squared[:, SIDES[name]].sum(axis=1)
        # Where a number shows mostly on another side, that side has fitted it.
        is_own = (own > 0.0) & (own >= 0.5 * squared.sum(axis=1))
        acting = tuple(index for index, does in zip(model.indices, is_own, strict=True) if does)
        moment = moment_of_flight(problem, model.vector, flight)
        test = SideTest.of(name, white, slopes[is_own])
        return cls(name, problem, model.vector, moment, flight, test, acting)

    def white(self, term: Term) -> np.ndarray:
        """Return a term's unit coefficients as innovations, (coefficients, rows, chunks, 3, 2)."""
        signal = np.broadcast_to(term.signal(self.moment), np.shape(self.moment.time_s))[..., None]
        directions = directions_of(term, self.moment, self.flight.body_to_world)
        return whitened(self.problem, directions * signal, self.name)

    def vector_beside(self, given: np.ndarray) -> np.ndarray:
        """Return the model's vector beside fitted terms.

        given: the step of its acting parameters, which is subtracted.
        """
        vector = self.vector.copy()
        vector[list(self.acting)] -= given
        return self.problem.clipped(vector)

    def columns(self, term: Term) -> np.ndarray:
        """Return a term's unit coefficients, weighted, by blocks of a second."""
        return blocks_of(self.white(term) * self.test.root)

    def spread(self, quantity: str) -> np.ndarray:
        """Return the values of a quantity in the rows that count."""
        of = QUANTITIES[quantity].of(self.moment)
        return np.asarray(jnp.broadcast_to(of, self.flight.time_s.shape))[self.flight.is_counted]


def power(quantity: str, exponent: float = 1.0) -> Factor:
    """Return a power of a quantity."""
    return Factor(quantity, "power", (exponent, 0.0))


def _local(side: Side, quantity: str, shapes: Sequence[str], number: int) -> Iterator[Factor]:
    """Return bumps or steps of two widths at places along a quantity's range."""
    low, high = np.quantile(side.spread(quantity), [0.02, 0.98])
    if high - low < 1e-9:
        return
    for middle in np.linspace(low, high, number + 2)[1:-1]:
        for shape in shapes:
            for share in (0.5, 1.2):
                yield Factor(
                    quantity, shape, (float(middle), float(share * (high - low) / (number + 1)))
                )


def factors_of(side: Side) -> Iterator[tuple[str, tuple[Factor, ...]]]:
    """Return frames and factors that are tried."""
    airspeeds = ("airspeed_x", "airspeed_y", "airspeed_z", "edgewise", "airspeed")
    for quantity in airspeeds:
        yield from (("body", (power(quantity, exponent),)) for exponent in (1.0, 2.0, 3.0))
        yield from (("body", (power("thrust", one), power(quantity))) for one in (0.5, 1.0))
        yield "body", (power("thrust"), power(quantity, 2.0))
    for quantity in ("rate_x", "rate_y", "rate_z"):
        yield from (("body", (power(quantity, exponent),)) for exponent in (1.0, 2.0))
        yield from (("body", (power(quantity), power(other))) for other in airspeeds[:3])
    yield "body", (power("rate_x"), power("rate_y"))
    yield "body", (power("rate_x"), power("rate_z"))
    yield "body", (power("rate_y"), power("rate_z"))
    for quantity in ("roll", "pitch", "yaw", "throttle"):
        yield from (("body", (power(quantity, exponent),)) for exponent in (2.0, 3.0))
        yield from (("body", (one,)) for one in _local(side, quantity, ("bump", "step"), 5))
    # Not of the voltage by itself: within one flight it falls as time goes on.
    yield "body", (power("thrust"), power("voltage"))
    for quantity in ("tilt", "height"):
        yield from (("body", (power(quantity, exponent),)) for exponent in (1.0, 2.0))
        yield from (("body", (one,)) for one in _local(side, quantity, ("bump",), 6))
        yield "body", (power("thrust"), power(quantity))
    span = float(np.ptp(side.spread("time")))
    saturations = [Factor("time", "saturation", (share * span,)) for share in (0.1, 0.3, 1.0)]
    for one in (power("time"), *saturations, *_local(side, "time", ("bump", "step"), 8)):
        yield "body", (one,)
        yield "body", (power("thrust"), one)
    frames = ("body", "world") if side.name == "force" else ("body",)
    for order in (1.0, 2.0, 3.0, 4.0):
        for phase in np.linspace(0.0, math.pi, 4, endpoint=False):
            yield from (
                (frame, (Factor("heading", "wave", (order, float(phase))),)) for frame in frames
            )
    if side.name == "force":
        for one in (
            power("airspeed", 2.0),
            power("airspeed", 3.0),
            *_local(side, "airspeed", ("bump",), 8),
        ):
            yield "air", (one,)
        where = side.flight.pos_w[side.flight.is_counted]
        for index in where[
            np.linspace(0, len(where) - 1, 2 * BUMP_PLACES + 1).astype(int)[1::2]
        ].tolist():
            for width in BUMP_WIDTHS_M:
                yield "world", (Factor("position", "place", (*index, width)),)


class Trial(NamedTuple):
    """A term without coefficients, its gain less a price for its numbers, and that gain alone."""

    term: Term
    merit: float
    gain: float


def bare_term(side: Side, frame: str, factors: tuple[Factor, ...]) -> Term:
    """Return a term whose coefficients are not known yet."""
    return Term(side.name, frame, factors, (0.0,) * XYZ, (0.0,) * XYZ)


def num_shaped(term: Term) -> int:
    """Return how many numbers of its shapes a term may choose."""
    return sum(len(one.numbers) for one in term.factors if one.shape != "power")


def num_numbers(term: Term) -> int:
    """Return how many numbers a term may choose: coefficients, and those of its shapes."""
    return term.num_coefficients + num_shaped(term)


def price_of(term: Term) -> float:
    """Return what a term has to gain to be preferred to nothing."""
    return PER_COEFFICIENT * term.num_coefficients + PER_NUMBER * num_shaped(term)


def score_term(side: Side, test: SideTest, term: Term) -> Trial:
    """Return the gain of a term beside what is given; nothing where it hardly differs from that."""
    columns = side.columns(term)
    if not np.isfinite(columns).all() or not np.abs(columns).max() > 0.0:
        return Trial(term, -np.inf, 0.0)
    gain = test.fit(columns, MIN_INDEPENDENT_FRACTION).gain
    return Trial(term, gain - price_of(term), gain)


def refine_shapes(side: Side, test: SideTest, start: Trial) -> Trial:
    """Return a term with the numbers of its shapes where it gains most."""
    if not num_shaped(start.term):
        return start
    numbers = np.concatenate([one.numbers for one in start.term.factors])
    is_free = np.array(
        [
            one.shape != "power"
            and (one.shape, index) != ("wave", 0)  # a wave's order, which is whole
            for one in start.term.factors
            for index in range(len(one.numbers))
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
        found = score_term(side, test, term)
        best = max(best, found, key=lambda one: one.merit)
        return -found.merit

    simplex = np.concatenate([np.zeros((1, len(steps))), np.eye(len(steps))])
    options = {"maxfev": REFINEMENTS, "initial_simplex": simplex, "xatol": 0.02, "fatol": 0.5}
    optimize.minimize(cost, np.zeros(len(steps)), method="Nelder-Mead", options=options)
    return best


def refine_jointly(side: Side, terms: Sequence[Term], indices: Iterable[int]) -> list[Term]:
    """Refine the shapes of some terms, each beside all others; ``indices`` says which."""
    result = list(terms)
    for index in indices:
        term = terms[index]
        others = [side.columns(one) for one in (*result[:index], *result[index + 1 :])]
        test = side.test.given_also(*others)
        result[index] = refine_shapes(side, test, score_term(side, test, term)).term
    return result


def _with_numbers(term: Term, values: np.ndarray) -> Term | None:
    """Return a term with other numbers; None where one would have no width."""
    factors, index = [], 0
    for one in term.factors:
        numbers = tuple(values[index : index + len(one.numbers)].tolist())
        index += len(one.numbers)
        by_name = dict(zip(SHAPES[one.shape].numbers, numbers, strict=True))
        if any(not by_name[name] > TINY for name in SHAPES[one.shape].positive):
            return None
        factors.append(replace(one, numbers=numbers))
    return replace(term, factors=tuple(factors))


class FittedLaw(NamedTuple):
    """A law of one side, and what it is worth.

    vector: of the model with what the law changes in its free numbers. gain: on rows that were
    learnt from, held_out_gain on others, of minus twice the log likelihood; expected: there, if it
    were right. rivals: other terms that alone gain within 10 of the best one, as formulas.
    """

    terms: tuple[Term, ...]
    vector: np.ndarray
    gain: float
    held_out_gain: float
    expected: float
    rivals: tuple[str, ...] = ()


def fit_terms(side: Side, terms: Sequence[Term]) -> tuple[tuple[Term, ...], SideFit]:
    """Return terms with the coefficients that are clear, fitted together."""
    columns = [side.columns(term) for term in terms]
    sizes = [one.shape[1] for one in columns]
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
    for term, own in zip(terms, np.split(numbers, np.cumsum(sizes)[:-1], axis=1), strict=True):
        coefficients, errors = np.pad(own, ((0, 0), (0, XYZ - own.shape[1]))).tolist()
        if any(coefficients):
            result.append(
                replace(term, coefficients=tuple(coefficients), standard_errors=tuple(errors))
            )
    return tuple(result), fit


def held_out(side: Side, held: Side, learnt: np.ndarray, vector: np.ndarray) -> tuple[float, float]:
    """Return what something learnt gains on held-out rows, and what it would gain if it were right.

    learnt: what it adds there, whitened. vector: of the model beside it.
    """
    axes = SIDES[side.name]
    less, moved = held.problem.whitened_residuals(side.vector, vector)
    full = moved[..., axes, :] - learnt
    gain = robust_square(less[..., axes, :]) - robust_square(full)
    return gain, float(np.sum((less[..., axes, :] - full) ** 2))


def cross_validate(side: Side, terms: Sequence[Term]) -> tuple[float, float]:
    """Return the cross-validated gain of a law's terms, and the gain expected if they are right.

    Coefficients fitted to each half of the blocks are tested on the other half.

    For a law that does not act in held-out rows, such as a thermal that they do not pass.
    """
    columns = np.concatenate([side.columns(term) for term in terms], axis=1)
    half = np.indices((CHUNK_S, len(columns) // CHUNK_S)).sum(axis=0).ravel() % 2
    gain = expected = 0.0
    for one in range(2):
        step = (
            side.test.of_blocks(half == one)
            .fit(columns[half == one], MIN_INDEPENDENT_FRACTION)
            .step
        )
        _, information, score, _ = side.test.of_blocks(half != one).projected(columns[half != one])
        expected += float(step @ information @ step)
        gain += float(2.0 * step @ score - step @ information @ step)
    return gain, expected


def judge_law(side: Side, held: Side, terms: tuple[Term, ...], fit: SideFit) -> FittedLaw:
    """Return terms that were fitted as a law, with what it gains on held-out rows."""
    vector, white = side.vector_beside(fit.given), [held.white(term) for term in terms]
    coefficients = [
        np.array(term.coefficients[: len(own)]) for term, own in zip(terms, white, strict=True)
    ]
    learnt = np.tensordot(np.concatenate(coefficients), np.concatenate(white), axes=1)
    return FittedLaw(terms, vector, fit.chi2, *held_out(side, held, learnt, vector))


def is_confirmed(side: Side, law: FittedLaw) -> bool:
    """Return whether held-out rows confirm a law.

    Where the law hardly acts in them, cross-validation on the other rows decides.
    """
    gain, expected = law.held_out_gain, law.expected
    if expected < MIN_EXPECTED_GAIN:
        gain, expected = cross_validate(side, law.terms)
    return gain >= HELD_OUT_SHARE * expected


def drop_weak_terms(side: Side, held: Side, law: FittedLaw, number: int) -> FittedLaw | None:
    """Drop terms that gain too little beside all others; return the rest, the best first.

    A first term may only have stood in for later ones. None where held-out rows do not confirm the
    rest. number: of terms among which they were chosen.
    """
    terms = law.terms
    while True:
        others = [[one for one in terms if one is not term] for term in terms]
        total = fit_terms(side, terms)[1].chi2
        losses = [total - fit_terms(side, rest)[1].chi2 if rest else total for rest in others]
        least = stats.chi2.isf(
            FURTHER_FALSE_POSITIVE_RATE / number, [num_numbers(term) for term in terms]
        )
        weakest = int(np.argmin(losses - least))
        if len(terms) == 1 or losses[weakest] >= least[weakest]:
            break
        terms = tuple(refine_jointly(side, others[weakest], range(len(others[weakest]))))
    order = np.argsort(losses)[::-1]
    if len(terms) == len(law.terms):
        return law._replace(terms=tuple(terms[index] for index in order))
    found = judge_law(side, held, *fit_terms(side, [terms[index] for index in order]))
    return found if is_confirmed(side, found) else None


def find_law(side: Side, held: Side) -> FittedLaw | None:
    """Return the law of a side that rows learnt from and held-out rows agree on; None without one.

    The search starts from the best terms of several quantities: each wave of a sum may gain less
    than a bump.
    """
    pool = [bare_term(side, *one) for one in factors_of(side)]
    firsts, ranked = best_of(side, side.test, pool)
    limit = stats.chi2.isf(
        FALSE_POSITIVE_RATE / len(pool), [num_numbers(one.term) for one in firsts]
    )
    clear = [one for one, least in zip(firsts, limit, strict=True) if one.gain >= least]
    rivals = tuple(_kind(one.term) for one in firsts[1:] if one.merit > firsts[0].merit - 10.0)
    by_quantity: dict[str, Trial] = {}
    for one in clear:
        by_quantity.setdefault(one.term.factors[-1].quantity, one)
    starts = list(by_quantity.values())[:MAX_STARTS]
    grown = [grow_law(side, held, one, ranked, len(pool)) for one in starts]
    laws = [drop_weak_terms(side, held, one, len(pool)) for one in grown if one is not None]
    found = [one._replace(rivals=rivals) for one in laws if one is not None]
    return max(
        found, key=lambda one: one.gain - sum(price_of(term) for term in one.terms), default=None
    )


def best_of(side: Side, test: SideTest, pool: Sequence[Term]) -> tuple[list[Trial], list[Term]]:
    """Return the best terms of different kinds, refined, and the whole pool, each best first."""
    trials = sorted((score_term(side, test, term) for term in pool), key=lambda one: -one.merit)
    best = [refine_shapes(side, test, one) for one in _of_different_kinds(trials)[:MAX_REFINED]]
    return sorted(best, key=lambda one: -one.merit), [one.term for one in trials]


def grow_law(
    side: Side, held: Side, first: Trial, pool: Sequence[Term], number: int
) -> FittedLaw | None:
    """Return the law that begins with a term, to which others of a pool are added while they gain.

    number: of terms among which they are chosen.
    """
    terms: list[Term] = []
    best: FittedLaw | None = None

    def uses_time(term: Term) -> bool:
        return any(one.quantity == "time" for one in term.factors)

    # What happens once would pass for the remainder of another law: all terms look at the time, or
    # none.
    pool = [term for term in pool if uses_time(term) == uses_time(first.term)][:MAX_RETRIED_TERMS]
    while True:
        now, fit = fit_terms(side, refine_jointly(side, [*terms, first.term], range(len(terms))))
        if len(now) <= len(terms) or (
            best is not None and fit.chi2 < (1.0 + MIN_GAIN_FRACTION) * best.gain
        ):
            break
        one = judge_law(side, held, now, fit)
        if best is not None and one.held_out_gain < best.held_out_gain:
            break
        # One wave of a sum of two may fail on held-out rows where both do not.
        if is_confirmed(side, one):
            best = one
        terms = list(now)
        if len(terms) == MAX_TERMS:
            break
        test = side.test.given_also(*(side.columns(term) for term in terms))
        (first, *_), _ = best_of(side, test, pool)
        if first.gain < stats.chi2.isf(
            FURTHER_FALSE_POSITIVE_RATE / number, num_numbers(first.term)
        ):
            break
    return best


def _kind(term: Term) -> str:
    return f"{term.frame}: " + " ".join(f"{one.shape} of {one.quantity}" for one in term.factors)


def _of_different_kinds(trials: Sequence[Trial]) -> list[Trial]:
    """Return the best trial of each frame, quantities and shapes."""
    found: dict[tuple[str, tuple[tuple[str, ...], ...]], Trial] = {}
    for one in trials:
        exponents = tuple(
            (
                each.quantity,
                each.shape,
                str(each.numbers[0]) if each.shape in ("power", "wave") else "",
            )
            for each in one.term.factors
        )
        found.setdefault((one.term.frame, exponents), one)
    return list(found.values())
