"""What was learnt beyond the list of effects: a law, its words and JSON."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import LearnedLaw
from flytrack_env.effects.grammar import Law, Term
from flytrack_env.toml_file import parse_toml, read_text

# What a law may be, and what to draw a quantity as.
_WORDS = parse_toml(read_text(Path(__file__).with_suffix(".toml")))
MAY_BE, DRAWN_AS = _WORDS["may_be"], _WORDS["drawn_as"]
LAST = ("thrust", "throttle", "airspeed")  # say least of a product


@dataclass(frozen=True)
class Learned:
    """A law that was learnt beyond the list.

    gains, held_out_gains: of minus twice the log likelihood, by side. rivals: of the law's terms,
    by side.
    """

    law: Law
    gains: Mapping[str, float]
    held_out_gains: Mapping[str, float]
    rivals: Mapping[str, tuple[str, ...]]

    @property
    def effect(self) -> LearnedLaw:
        """The law as an effect of a model."""
        return LearnedLaw(1.0, 0.0, self.law)

    def beside(self, vector: np.ndarray, is_on: bool = True) -> np.ndarray:
        """Return a vector of ``Problem.with_law(self.effect)``, with the law or without it."""
        return np.append(vector, [float(is_on), self.effect.spread])

    def drawn(self) -> list[tuple[str, str]]:
        """Return which residual to draw over which regressor, names as in ``traces``."""
        found = []
        for term in self.law.terms:
            axis = "xyz"[
                max(range(len(term.coefficients)), key=lambda index: abs(term.coefficients[index]))
            ]
            found.append(
                (_column(term.acts, term.frame, axis), _least(one.quantity for one in term.factors))
            )
        return list(dict.fromkeys((column, DRAWN_AS.get(name, "time")) for column, name in found))

    def text(self) -> str:
        """Return the formulas of the terms, and what each may be, a line each."""
        return "\n".join(f"{term.text()}: may be {may_be(term)}" for term in self.law.terms)

    def as_json(self) -> dict[str, Any]:
        """Return JSON values."""
        return {
            "law": [
                {"formula": term.text(), "may_be": may_be(term), **one}
                for term, one in zip(self.law.terms, self.law.as_json(), strict=True)
            ],
            "chi2_gain": dict(self.gains),
            "heldout_gain": dict(self.held_out_gains),
            "rivals": {name: list(one) for name, one in self.rivals.items()},
        }


def may_be(term: Term) -> str:
    """Return what a term may be, physically."""
    return MAY_BE[_least(one.quantity for one in term.factors)]


def _least(quantities: Iterable[str]) -> str:
    """Return the quantity that says most."""
    return min(quantities, key=lambda one: 1 + LAST.index(one) if one in LAST else 0)


def _column(acts: str, frame: str, axis: str) -> str:
    if frame == "air":
        return "force_along"
    return f"{'rates' if acts == 'rate' else 'force'}_{'world_' if frame == 'world' else ''}{axis}"


def with_learned(model: ModelParameters, learned: Learned | None) -> ModelParameters:
    """Return a model with what was learnt."""
    return model if learned is None else model.with_effects(learned.effect)


def with_and_without(
    learned: Learned, vectors: Mapping[str, np.ndarray], change: np.ndarray
) -> dict[str, np.ndarray]:
    """Return each model's vector for ``Problem.with_law``, and the extended one without the law.

    change: of the extended model's other parameters, fitted beside what was learnt.
    """
    without = {**vectors, "without_learned": vectors["extended"]}
    found = {name: learned.beside(vector, is_on=False) for name, vector in without.items()}
    return {**found, "extended": learned.beside(vectors["extended"] + change)}
