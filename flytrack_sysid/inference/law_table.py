"""Learnt laws as tables of numbers, so that all laws share one compiled program.

A ``Law`` is a static part of a model, and each law compiles its own program: that takes longer than
the rest of a diagnosis. A table selects each factor from all shapes of all quantities by number.
The environment compiles a law, and computes its terms only.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.effects import LearnedLaw
from flytrack_env.effects.grammar import (
    EXPONENTS,
    MAX_FACTORS,
    MAX_TERMS,
    MIN_SPEED,
    ORDERS,
    QUANTITIES,
    SHAPES,
    XYZ,
    Moment,
    Term,
)
from flytrack_env.quaternion import Scalar, Vec3

SIDES = ("force", "rate")
FRAMES = ("body", "world", "air")
TERMS_OF_SIDE = MAX_TERMS // len(SIDES)
MAX_NUMBERS = max(len(shape.numbers) for shape in SHAPES.values())
QUANTITY_NAMES, SHAPE_NAMES = tuple(QUANTITIES), tuple(SHAPES)
ABSENT = -1.0  # index of the shape of an absent factor, which is 1


class TableSide(NamedTuple):
    """The terms of a law on one side; absent terms have coefficients of 0.

    Attributes:
        acts: as of ``Term``.
        frame: index into ``FRAMES``, (terms,).
        quantity: index into ``QUANTITIES``, (terms, factors).
        shape: index into ``SHAPES`` or ``ABSENT``, (terms, factors).
        numbers: of the shapes, 1 where a shape has fewer, (terms, factors, MAX_NUMBERS).
        coefficients, standard_errors: as of ``Term``, (terms, 3).
    """

    acts: str
    frame: jax.Array
    quantity: jax.Array
    shape: jax.Array
    numbers: jax.Array
    coefficients: jax.Array
    standard_errors: jax.Array

    def at(self, moment: Moment, spread: Scalar) -> Vec3:
        """Return the sum of the terms, as ``Term.at`` does."""
        sizes = self.coefficients + spread * self.standard_errors
        terms = sizes * self._signals(moment)[:, None]
        of_frame = [
            Vec3(*jnp.where((self.frame == index)[:, None], terms, 0.0).sum(axis=0))
            for index in range(len(FRAMES))
        ]
        body, world, air = of_frame
        turned = Vec3(*(axis.dot(world) for axis in moment.body_axes_w))
        speed = jnp.maximum(moment.airspeed_b.norm(), MIN_SPEED)
        return body + turned + moment.airspeed_b.scale(air.x / speed)

    def _signals(self, moment: Moment) -> jax.Array:
        """Return the product of the factors of each term, (terms,)."""
        value = _chosen(self.quantity, [one.of(moment) for one in QUANTITIES.values()])
        first, second, third, fourth = jnp.moveaxis(self.numbers, -1, 0)
        shapes = {
            "power": _power(value, first, second),
            "bump": SHAPES["bump"].at(value, first, second),
            "step": SHAPES["step"].at(value, first, second),
            "saturation": SHAPES["saturation"].at(value, first),
            "wave": _wave(moment, first, second),
            "place": SHAPES["place"].at(moment, first, second, third, fourth),
        }
        by_shape = [shapes[name] for name in SHAPE_NAMES]
        factors = jnp.where(self.shape == ABSENT, 1.0, _chosen(self.shape, by_shape))
        return factors.prod(axis=-1)


class LawTable(NamedTuple):
    """A law as numbers, in place of ``Law``; a row of ``_row_of`` each term, force first."""

    rows: np.ndarray | jax.Array

    @property
    def terms(self) -> tuple[TableSide, ...]:
        """The terms by side."""
        sides = []
        for number, acts in enumerate(SIDES):
            rows = self.rows[number * TERMS_OF_SIDE : (number + 1) * TERMS_OF_SIDE]
            sizes = (1, MAX_FACTORS, MAX_FACTORS, MAX_FACTORS * MAX_NUMBERS, XYZ)
            frame, quantity, shape, numbers, coefficients, errors = jnp.split(
                rows, np.cumsum(sizes), axis=1
            )
            numbers = numbers.reshape(-1, MAX_FACTORS, MAX_NUMBERS)
            sides.append(
                TableSide(acts, frame[:, 0], quantity, shape, numbers, coefficients, errors)
            )
        return tuple(sides)

    def uses(self, quantity: str) -> bool:
        """Return whether a law may look at a quantity: any may."""
        return quantity in QUANTITIES


def tabulated(learned: LearnedLaw) -> LearnedLaw:
    """Return a learnt law with its terms as numbers."""
    rows = []
    for acts in SIDES:
        own = [_row_of(term) for term in learned.law.terms if term.acts == acts]
        rows += [*own, *[_row_of(None)] * (TERMS_OF_SIDE - len(own))]
    table: Any = LawTable(np.array(rows))  # whatever reads a law can read it
    return learned._replace(law=table)


def _row_of(term: Term | None) -> list[float]:
    """Return the numbers of a term: frame, quantities, shapes, their numbers, coefficients."""
    factors = () if term is None else term.factors
    quantities, shapes = [0.0] * MAX_FACTORS, [ABSENT] * MAX_FACTORS
    numbers = [1.0] * (MAX_FACTORS * MAX_NUMBERS)
    for index, factor in enumerate(factors):
        if factor.quantity in QUANTITIES:
            quantities[index] = float(QUANTITY_NAMES.index(factor.quantity))
        shapes[index] = float(SHAPE_NAMES.index(factor.shape))
        begin = index * MAX_NUMBERS
        numbers[begin : begin + len(factor.numbers)] = factor.numbers
    frame = 0.0 if term is None else float(FRAMES.index(term.frame))
    sizes = [0.0] * (2 * XYZ) if term is None else [*term.coefficients, *term.standard_errors]
    return [frame, *quantities, *shapes, *numbers, *sizes]


def _chosen(index: jax.Array, values: list[Scalar]) -> jax.Array:
    """Return the value with each index, of scalars or arrays like the index."""
    result = jnp.zeros(index.shape)
    for number, value in enumerate(values):
        result = jnp.where(index == number, value, result)
    return result


def _power(value: jax.Array, exponent: jax.Array, offset: jax.Array) -> jax.Array:
    """Return the power for each exponent of the grammar; 0 for any other exponent."""
    result = jnp.zeros(value.shape)
    for number in EXPONENTS:
        result = jnp.where(exponent == number, SHAPES["power"].at(value, number, offset), result)
    return result


def _wave(moment: Moment, order: jax.Array, phase: jax.Array) -> jax.Array:
    """Return the wave for each order of the grammar; 0 for any other order."""
    at = SHAPES["wave"].at
    quarter = 0.5 * np.pi
    result = jnp.zeros(order.shape)
    for number in ORDERS:
        # The cosine of a sum: the grammar takes phases as numbers.
        turned = jnp.cos(phase) * at(moment, number, 0.0) + jnp.sin(phase) * at(
            moment, number, quarter
        )
        result = jnp.where(order == number, turned, result)
    return result
