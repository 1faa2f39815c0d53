"""What a log shows and no law explains: small networks of what the rest was found to depend on."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.effects.grammar import (
    ACTS,
    QUANTITIES,
    XYZ,
    Moment,
    Term,
    chosen,
    fields_of,
    learned_effect,
    listed,
    number,
)
from flytrack_env.quaternion import Scalar, Vec3

FRAMES = ("body", "world")
MOST_INPUTS, MOST_HIDDEN = 9, 64
TAPER = 0.1  # of half the range that was flown: so far beyond it, nothing is left


class Input(NamedTuple):
    """A quantity and the range of it that was flown."""

    quantity: str
    low: float
    high: float


@dataclass(frozen=True)
class Network:
    """A layer of hyperbolic tangents, and what it adds: the mean of an ensemble, and along its main spread.

    acts: "force", m/s^2, or "rate", rad/s. frame: of the outputs. hidden: a row a unit, weights of the
    inputs, -1 to 1 over their range, and a bias. outputs, deviations: three rows, weights of the units and a
    bias.
    half_width_90: half of the interval that holds 90 % of measured rows about the mean, three.
    """

    acts: str
    frame: str
    inputs: tuple[Input, ...]
    hidden: tuple[tuple[float, ...], ...]
    outputs: tuple[tuple[float, ...], ...]
    deviations: tuple[tuple[float, ...], ...]
    half_width_90: tuple[float, ...]

    def units(self, moment: Moment) -> list[Scalar]:
        """Return the hidden units and a constant, all 0 outside the range that was flown."""
        values: list[Scalar] = []
        inside: Scalar = 1.0
        for one in self.inputs:
            middle, half = 0.5 * (one.high + one.low), 0.5 * (one.high - one.low)
            value = (QUANTITIES[one.quantity].of(moment) - middle) * (1.0 / half)
            inside = inside * jnp.clip((1.0 + TAPER - jnp.abs(value)) * (1.0 / TAPER), 0.0, 1.0)
            values.append(jnp.clip(value, -1.0 - TAPER, 1.0 + TAPER))
        sums = (sum((w * x for w, x in zip(row, values, strict=False)), row[-1]) for row in self.hidden)
        return [*(jnp.tanh(one) * inside for one in sums), inside]

    def at(self, moment: Moment, spread: Scalar) -> Vec3:
        """Return what it adds, body frame; spread: along the ensemble's main spread, standard deviations."""
        units, total = self.units(moment), Vec3(0.0, 0.0, 0.0)
        unit_vectors = Term(self.acts, self.frame, (), (), ()).basis(moment)
        for mean, deviation, one in zip(self.outputs, self.deviations, unit_vectors, strict=True):
            pairs = zip(mean, deviation, units, strict=True)
            total = total + one.scale(sum((a + spread * b) * unit for a, b, unit in pairs))
        return total


@jax.tree_util.register_static
@dataclass(frozen=True)
class Networks:
    """Networks of force, of rate, or of both; a pytree without leaves."""

    networks: tuple[Network, ...] = ()

    @property
    def parts(self) -> tuple[Network, ...]:
        """What acts on force or rate, each by itself."""
        return self.networks

    def uses(self, quantity: str) -> bool:
        """Return whether any network looks at a quantity."""
        return any(one.quantity == quantity for network in self.networks for one in network.inputs)

    def text(self) -> str:
        """Return what depends on what, a line a network."""
        lines = []
        for one in self.networks:
            ranges = ", ".join(f"{each.quantity} {each.low:.3g} to {each.high:.3g}" for each in one.inputs)
            lines.append(f"{one.acts} ({one.frame}): a network of {ranges}; nothing outside")
        return "\n".join(lines)

    def as_json(self) -> list[dict[str, Any]]:
        """Return the networks as JSON values."""
        return [
            {
                "acts": one.acts,
                "frame": one.frame,
                "inputs": [each._asdict() for each in one.inputs],
                **{name: [list(row) for row in getattr(one, name)] for name in WEIGHTS},
                "half_width_90": list(one.half_width_90),
            }
            for one in self.networks
        ]


WEIGHTS = ("hidden", "outputs", "deviations")
FIELDS = ("acts", "frame", "inputs", *WEIGHTS, "half_width_90")


def networks_from_json(values: Any) -> Networks:
    """Return the networks in JSON values of ``Networks.as_json``.

    Raises:
        ValueError: unknown quantities, ranges without a width, weights of another shape or not finite; the
            message begins with the field.
    """
    every = listed("networks", values, len(ACTS))
    return Networks(tuple(_network(f"networks[{place}]", one) for place, one in enumerate(every)))


def _network(where: str, value: Any) -> Network:
    fields = fields_of(where, value, FIELDS)
    inputs = [
        _input(f"{where}.inputs[{place}]", one)
        for place, one in enumerate(listed(f"{where}.inputs", fields["inputs"], MOST_INPUTS))
    ]
    hidden = listed(f"{where}.hidden", fields["hidden"], MOST_HIDDEN)
    rows = {
        "hidden": (len(hidden), len(inputs) + 1),
        "outputs": (XYZ, len(hidden) + 1),
        "deviations": (XYZ, len(hidden) + 1),
    }
    weights = {name: _matrix(f"{where}.{name}", fields[name], *shape) for name, shape in rows.items()}
    widths = _matrix(f"{where}.half_width_90", [fields["half_width_90"]], 1, XYZ)[0]
    acts, frame = (
        chosen(f"{where}.acts", fields["acts"], ACTS),
        chosen(f"{where}.frame", fields["frame"], FRAMES),
    )
    return Network(acts, frame, tuple(inputs), half_width_90=widths, **weights)


def _input(where: str, value: Any) -> Input:
    fields = fields_of(where, value, Input._fields)
    low, high = (number(f"{where}.{end}", fields[end]) for end in ("low", "high"))
    if not low < high:
        raise ValueError(f"{where}: found a range from {low:g} to {high:g}, expected one with a width")
    return Input(chosen(f"{where}.quantity", fields["quantity"], QUANTITIES), low, high)


def _matrix(where: str, value: Any, rows: int, columns: int) -> tuple[tuple[float, ...], ...]:
    if not isinstance(value, list) or [len(one) if isinstance(one, list) else -1 for one in value] != (
        [columns] * rows
    ):
        raise ValueError(f"{where}: found another shape, expected {rows} rows of {columns} numbers")
    return tuple(tuple(number(where, one) for one in row) for row in value)


class LearnedResidual(NamedTuple):
    """Networks, their share that acts, 1 as learnt, and how far along the ensemble's main spread.

    networks: static. Draw ``spread`` from -1 to 1, say, to fly what the log cannot tell.
    """

    scale: Scalar = 0.0
    spread: Scalar = 0.0
    networks: Networks = Networks()


LEARNED_RESIDUAL = learned_effect(
    "networks",
    networks_from_json,
    name="learned_residual",
    parameters=LearnedResidual,
    equation=r"\mathbf{f}_b \leftarrow \mathbf{f}_b + s\, (W_2 \tanh(W_1 \mathbf{z} + \mathbf{b}_1) "
    r"+ \mathbf{b}_2)",
    source="the log that it was learnt from; a random hidden layer and linear outputs: G.-B. Huang et al., "
    '"Extreme learning machine", 2006',
)
