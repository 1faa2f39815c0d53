"""Laws as tables: the same values as the laws of the grammar, and one program for all."""

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.effects import LearnedLaw
from flytrack_env.effects.grammar import (
    EXPONENTS,
    ORDERS,
    QUANTITIES,
    SHAPES,
    Factor,
    Law,
    Moment,
    Term,
)
from flytrack_env.quaternion import Vec3
from flytrack_env.state import Action
from flytrack_sysid.inference.law_table import FRAMES, SIDES, TERMS_OF_SIDE, tabulated

SHAPES_OF_ALL = [("power", (exponent, 70.0)) for exponent in EXPONENTS]  # no pole
SHAPES_OF_ALL += [("bump", (0.5, 2.0)), ("step", (0.1, 0.7))]
FACTORS = [Factor(quantity, *shape) for quantity in QUANTITIES for shape in SHAPES_OF_ALL]
FACTORS += [Factor("heading", "wave", (order, 0.4 * order)) for order in ORDERS]
FACTORS += [
    Factor("time", "saturation", (3.0,)),
    Factor("position", "place", (1.0, -2.0, 3.0, 4.0)),
]


def draw_moment(rng):
    """Return a moment of a drone in flight, in float64."""
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return Moment(
        pos_w=Vec3(*rng.normal(0.0, 3.0, 3)),
        rates_b=Vec3(*rng.normal(0.0, 2.0, 3)),
        body_axes_w=tuple(Vec3(*axis) for axis in axes),
        airspeed_b=Vec3(*rng.normal(0.0, 5.0, 3)),
        applied=Action(*rng.uniform(-1.0, 1.0, 4)),
        thrust_acc=rng.uniform(0.0, 30.0),
        battery_v=rng.uniform(18.0, 25.0),
        time_s=rng.uniform(0.0, 30.0),
    )


def draw_law(rng, factors):
    """Return a law with a term for each factor or pair of factors, at random in all else."""
    terms = []
    for number, factors_of_term in enumerate(factors):
        coefficients, errors = (tuple(rng.normal(size=3).tolist()) for _ in range(2))
        frame = FRAMES[rng.integers(len(FRAMES))]
        if frame == "air":
            coefficients, errors = (coefficients[0], 0.0, 0.0), (errors[0], 0.0, 0.0)
        acts = SIDES[number // TERMS_OF_SIDE]
        terms.append(Term(acts, frame, factors_of_term, coefficients, errors))
    return Law(tuple(terms))


def vectors_of(law, moment, spread):
    """Return the sum of a law's terms on each side."""
    return {
        acts: sum(
            (jnp.stack(term.at(moment, spread)) for term in law.terms if term.acts == acts),
            start=jnp.zeros(3),
        )
        for acts in SIDES
    }


def test_a_table_has_the_values_of_its_law_and_one_program_serves_all_laws():
    rng, of_table = np.random.default_rng(3), jax.jit(vectors_of)
    assert {factor.shape for factor in FACTORS} == {*SHAPES}
    assert all(factor.quantity in factor.text() for factor in FACTORS)
    with jax.enable_x64(True):
        for first in range(0, len(FACTORS), 2 * TERMS_OF_SIDE):
            part = FACTORS[first : first + 2 * TERMS_OF_SIDE]
            pairs = [(factor, FACTORS[rng.integers(len(FACTORS))]) for factor in part]
            law = draw_law(rng, [pair[: 1 + number % 2] for number, pair in enumerate(pairs)])
            moment, table = draw_moment(rng), tabulated(LearnedLaw(1.0, 0.0, law)).law
            result, expected = of_table(table, moment, 0.7), vectors_of(law, moment, 0.7)
            for acts in SIDES:
                np.testing.assert_allclose(result[acts], expected[acts], rtol=1e-9, atol=1e-12)
    assert of_table._cache_size() == 1
