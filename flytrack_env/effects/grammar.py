"""The grammar of laws that were learnt from a log: numbers and a fixed vocabulary, nothing is code.

A law is a sum of terms, up to three on force and three on rate. A term is a vector in a frame times
one or two factors; a factor is a shape of a quantity, ``bump(airspeed; 7, 1.2)``. Shapes and
quantities are the tables below. A law is a static part of a model: what is compiled computes its
terms only.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from msgspec import Meta

from flytrack_env.effects.base import ForceContext
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Action
from flytrack_env.validation import Fields, choose, convert

MIN_SPEED = 0.3  # m/s: slower flight has no direction
MAX_TERMS, MAX_FACTORS = 6, 2
MAX_NUMBER = 1e6  # of any number in a law
XYZ = 3


class Moment(NamedTuple):
    """The inputs of a law: scalars or arrays of one shape; units, frames as in ``ForceContext``.

    Attributes:
        time_s: since the start of the flight.
    """

    pos_w: Vec3
    rates_b: Vec3
    body_axes_w: tuple[Vec3, Vec3, Vec3]
    airspeed_b: Vec3
    applied: Action
    thrust_acc: Scalar
    battery_v: Scalar
    time_s: Scalar


class Flight(NamedTuple):
    """The memory of a law: the time since the flight began, s."""

    time_s: Scalar


def moment_of(context: ForceContext, flight: Flight | None) -> Moment:
    """Return what a law may look at, at the stages rates and force."""
    drone = context.drone
    return Moment(
        drone.pos_w,
        drone.rates_b,
        context.body_axes_w,
        context.airspeed_b,
        context.applied,
        context.thrust_acc,
        drone.battery_v,
        time_s=0.0 if flight is None else flight.time_s,
    )


class Quantity(NamedTuple):
    """A quantity of a moment: its unit, and the lowest and highest that a drone can have."""

    unit: str
    low: float
    high: float
    of: Callable[[Moment], Scalar]


def _tilt(moment: Moment) -> Scalar:
    # The chord of the angle: no inverse cosine, whose slope is infinite at level flight.
    upright = jnp.clip(moment.body_axes_w[2].z, -1.0, 1.0)
    return _root(2.0 * (1.0 - upright))


def _heading(moment: Moment) -> tuple[Scalar, Scalar]:
    """Return cosine and sine of the heading; 0 where the nose points straight up or down."""
    nose = moment.body_axes_w[0]
    flat = jnp.maximum(_root(nose.x * nose.x + nose.y * nose.y), 1e-6)
    return nose.x / flat, nose.y / flat


def _root(square: Scalar) -> Scalar:
    is_positive = square > 0.0
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, square, 1.0)), 0.0)


QUANTITIES: dict[str, Quantity] = {
    "airspeed": Quantity("m/s", 0.0, 60.0, lambda m: m.airspeed_b.norm()),
    "airspeed_x": Quantity("m/s", -60.0, 60.0, lambda m: m.airspeed_b.x),
    "airspeed_y": Quantity("m/s", -60.0, 60.0, lambda m: m.airspeed_b.y),
    "airspeed_z": Quantity("m/s", -60.0, 60.0, lambda m: m.airspeed_b.z),
    "edgewise": Quantity(
        "m/s",
        0.0,
        60.0,
        lambda m: _root(m.airspeed_b.x * m.airspeed_b.x + m.airspeed_b.y * m.airspeed_b.y),
    ),
    "thrust": Quantity("m/s^2", 0.0, 100.0, lambda m: jnp.maximum(m.thrust_acc, 0.0)),
    "rate_x": Quantity("rad/s", -40.0, 40.0, lambda m: m.rates_b.x),
    "rate_y": Quantity("rad/s", -40.0, 40.0, lambda m: m.rates_b.y),
    "rate_z": Quantity("rad/s", -40.0, 40.0, lambda m: m.rates_b.z),
    "roll": Quantity("1", -1.0, 1.0, lambda m: m.applied.roll),
    "pitch": Quantity("1", -1.0, 1.0, lambda m: m.applied.pitch),
    "yaw": Quantity("1", -1.0, 1.0, lambda m: m.applied.yaw),
    "throttle": Quantity("1", -1.0, 1.0, lambda m: m.applied.thrust),
    "tilt": Quantity("rad", 0.0, 2.0, _tilt),
    "height": Quantity("m", -1000.0, 1000.0, lambda m: m.pos_w.z),
    "voltage": Quantity("V", 0.0, 60.0, lambda m: m.battery_v),
    "time": Quantity("s", 0.0, 3600.0, lambda m: m.time_s),
}


def _bump(value: Scalar, middle: float, width: float) -> Scalar:
    off = (value - middle) * (1.0 / width)
    return jnp.exp(-0.5 * off * off)


def _power(value: Scalar, exponent: float, offset: float) -> Scalar:
    base = value + offset
    if exponent == 0.5:
        return _root(base)
    if exponent == 1.5:
        return base * _root(base)
    return base ** int(exponent) if exponent > 0 else 1.0 / base ** int(-exponent)


def _wave(moment: Moment, order: float, phase: float) -> Scalar:
    """Return cos(order * heading + phase), from the heading's cosine and sine."""
    cosine, sine = _heading(moment)
    real, imaginary = jnp.ones_like(cosine), jnp.zeros_like(cosine)
    for _ in range(int(order)):
        real, imaginary = real * cosine - imaginary * sine, imaginary * cosine + real * sine
    return math.cos(phase) * real - math.sin(phase) * imaginary


def _place(moment: Moment, x: float, y: float, z: float, radius: float) -> Scalar:
    off = moment.pos_w - Vec3(x, y, z)
    return jnp.exp(off.dot(off) * (-0.5 / radius**2))


class Shape(NamedTuple):
    """A shape of a factor: a function of a quantity.

    Attributes:
        numbers: names of its numbers.
        words: of its formula.
        quantities: that can have the shape.
        at: the function.
        positive: numbers that must be above 0.
        of_moment: it takes the moment in place of the quantity's value, since its quantity is a
            direction or a place.
    """

    numbers: tuple[str, ...]
    words: str
    quantities: tuple[str, ...]
    at: Callable[..., Scalar]
    positive: tuple[str, ...] = ()
    of_moment: bool = False


SCALARS = tuple(QUANTITIES)
ORDERS = (1.0, 2.0, 3.0, 4.0)  # of waves
EXPONENTS = (-2.0, -1.0, 0.5, 1.0, 1.5, 2.0, 3.0)
SHAPES: dict[str, Shape] = {
    "power": Shape(("exponent", "offset"), "({q} + {offset})^{exponent}", SCALARS, _power),
    "bump": Shape(("middle", "width"), "bump({q}; {middle}, {width})", SCALARS, _bump, ("width",)),
    "step": Shape(
        ("middle", "width"),
        "step({q}; {middle}, {width})",
        SCALARS,
        lambda value, middle, width: 0.5 + 0.5 * jnp.tanh((value - middle) * (1.0 / width)),
        ("width",),
    ),
    "saturation": Shape(
        ("scale",),
        "(1 - exp(-{q}/{scale}))",
        ("time",),
        lambda value, scale: 1.0 - jnp.exp(value * (-1.0 / scale)),
        ("scale",),
    ),
    "wave": Shape(
        ("order", "phase"),
        "cos({order} {q} + {phase})",
        ("heading",),
        _wave,
        ("order",),
        of_moment=True,
    ),
    "place": Shape(
        ("x", "y", "z", "radius"),
        "bump({q}; {x}, {y}, {z}; {radius})",
        ("position",),
        _place,
        ("radius",),
        of_moment=True,
    ),
}


@dataclass(frozen=True)
class Factor:
    """A shape of a quantity; numbers: those of the shape."""

    quantity: str
    shape: str
    numbers: tuple[float, ...]

    def at(self, moment: Moment) -> Scalar:
        """Return its value."""
        shape = SHAPES[self.shape]
        argument = moment if shape.of_moment else QUANTITIES[self.quantity].of(moment)
        return shape.at(argument, *self.numbers)

    def text(self) -> str:
        """Return its formula."""
        shape = SHAPES[self.shape]
        named = {
            name: f"{value:.4g}" for name, value in zip(shape.numbers, self.numbers, strict=True)
        }
        if self.shape == "power":
            base = (
                self.quantity
                if self.numbers[1] == 0.0
                else f"({self.quantity} + {named['offset']})"
            )
            return base if self.numbers[0] == 1.0 else f"{base}^{named['exponent']}"
        return shape.words.format(q=self.quantity, **named)


@dataclass(frozen=True)
class Term:
    """A vector times factors.

    Attributes:
        acts: "force", m/s^2 of specific force, or "rate", rad/s of body rates.
        frame: of the vector: body, world or air: only the first component is used, along the
            velocity through the air.
        coefficients, standard_errors: three each.
    """

    acts: str
    frame: str
    factors: tuple[Factor, ...]
    coefficients: tuple[float, ...]
    standard_errors: tuple[float, ...]

    @property
    def num_coefficients(self) -> int:
        """How many of the coefficients are its own."""
        return 1 if self.frame == "air" else XYZ

    def basis(self, moment: Moment) -> tuple[Vec3, ...]:
        """Return the unit vectors of the coefficients, body frame."""
        unit = tuple(Vec3(*row) for row in np.eye(XYZ).tolist())
        if self.frame == "body":
            return unit
        if self.frame == "world":
            return tuple(
                Vec3(*(axis.dot(direction) for axis in moment.body_axes_w)) for direction in unit
            )
        speed = jnp.maximum(moment.airspeed_b.norm(), MIN_SPEED)
        return (moment.airspeed_b.scale(1.0 / speed),)

    def signal(self, moment: Moment) -> Scalar:
        """Return the product of its factors."""
        return math.prod(
            (factor.at(moment) for factor in self.factors[1:]), start=self.factors[0].at(moment)
        )

    def at(self, moment: Moment, spread: Scalar) -> Vec3:
        """Return its vector, body frame.

        Args:
            spread: by how many standard errors each coefficient is larger.
        """
        signal, total = self.signal(moment), Vec3(0.0, 0.0, 0.0)
        for index, direction in enumerate(self.basis(moment)):
            if self.coefficients[index] or self.standard_errors[index]:
                size = self.coefficients[index] + spread * self.standard_errors[index]
                total = total + direction.scale(size * signal)
        return total

    def text(self) -> str:
        """Return its formula, with the standard errors of its coefficients."""
        values = ", ".join(f"{value:.3g}" for value in self.coefficients[: self.num_coefficients])
        factors = " ".join(factor.text() for factor in self.factors)
        return f"{self.acts} ({self.frame}) += ({values}) {factors}"


@jax.tree_util.register_static
@dataclass(frozen=True)
class Law:
    """A sum of terms; a pytree without leaves, so that each law compiles its own program."""

    terms: tuple[Term, ...] = ()

    def uses(self, quantity: str) -> bool:
        """Return whether any term looks at a quantity."""
        return any(factor.quantity == quantity for term in self.terms for factor in term.factors)

    def text(self) -> str:
        """Return its formula, a line a term."""
        return "\n".join(term.text() for term in self.terms)

    def as_json(self) -> list[dict[str, Any]]:
        """Return the terms as JSON values."""
        return [
            {
                "acts": term.acts,
                "frame": term.frame,
                "coefficients": list(term.coefficients),
                "standard_errors": list(term.standard_errors),
                "factors": [
                    {
                        "quantity": factor.quantity,
                        "shape": factor.shape,
                        **dict(zip(SHAPES[factor.shape].numbers, factor.numbers, strict=True)),
                    }
                    for factor in term.factors
                ],
            }
            for term in self.terms
        ]


def law_from_json(values: Any) -> Law:
    """Return the law in JSON values of ``Law.as_json``.

    Raises:
        ValueError: what is not in the grammar, numbers that are not finite, a pole within the
            envelope; the message begins with the field.
    """
    kind = Annotated[tuple[_TermFields, ...], Meta(min_length=1, max_length=MAX_TERMS)]
    terms = convert("", values, kind, field="law")
    return Law(tuple(_term(f"law[{index}]", term) for index, term in enumerate(terms)))


Number = Annotated[float, Meta(ge=-MAX_NUMBER, le=MAX_NUMBER)]
StandardError = Annotated[float, Meta(ge=0.0, le=MAX_NUMBER)]


class _TermFields(Fields):
    acts: Literal["force", "rate"]
    frame: Literal["body", "world", "air"]
    coefficients: tuple[Number, Number, Number]
    standard_errors: tuple[StandardError, StandardError, StandardError]
    factors: Annotated[tuple[dict[str, Any], ...], Meta(min_length=1, max_length=MAX_FACTORS)]

    def __post_init__(self) -> None:
        if self.frame == "air" and any(self.coefficients[1:]):
            raise ValueError(
                f"coefficients: found {self.coefficients}, expected only the first in the frame air"
            )


def _term(where: str, term: _TermFields) -> Term:
    factors = (
        _factor(f"{where}.factors[{index}]", value) for index, value in enumerate(term.factors)
    )
    return Term(term.acts, term.frame, tuple(factors), term.coefficients, term.standard_errors)


def _factor(where: str, value: dict[str, Any]) -> Factor:
    name = choose(f"{where}.shape", value.get("shape"), SHAPES)
    shape = SHAPES[name]
    positive = Annotated[float, Meta(gt=0.0, le=MAX_NUMBER)]
    numbers = [
        (number, positive if number in shape.positive else Number) for number in shape.numbers
    ]
    kind = msgspec.defstruct(name, [("quantity", str), ("shape", str), *numbers], bases=(Fields,))
    fields = convert("", value, kind, field=where)
    quantity = choose(f"{where}.quantity", value["quantity"], shape.quantities)
    factor = Factor(quantity, name, tuple(getattr(fields, number) for number in shape.numbers))
    if name == "wave" and factor.numbers[0] not in ORDERS:
        raise ValueError(f"{where}.order: found {factor.numbers[0]:g}, expected 1, 2, 3 or 4")
    if name == "power":
        _check_power(where, quantity, *factor.numbers)
    return factor


def _check_power(where: str, quantity: str, exponent: float, offset: float) -> None:
    """Raise ValueError for an exponent beyond the list, or a pole where a drone can fly."""
    if exponent not in EXPONENTS:
        expected = ", ".join(f"{allowed:g}" for allowed in EXPONENTS)
        raise ValueError(f"{where}.exponent: found {exponent:g}, expected one of {expected}")
    low, high = QUANTITIES[quantity].low + offset, QUANTITIES[quantity].high + offset
    if exponent < 0.0 and low <= 0.0 <= high:
        raise ValueError(
            f"{where}.offset: found a pole at {quantity} = {0.0 - offset:g} "
            f"{QUANTITIES[quantity].unit}, expected none between "
            f"{QUANTITIES[quantity].low:g} and {QUANTITIES[quantity].high:g}"
        )
