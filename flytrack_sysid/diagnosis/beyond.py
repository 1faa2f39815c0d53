"""Laws that were learnt beyond the list of effects, as words and JSON."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import LearnedLaw
from flytrack_env.effects.grammar import Law, Term
from flytrack_env.toml_file import parse_toml, read_text

# Possible physical causes of a law, and the regressor that a quantity is drawn over.
_WORDS = parse_toml(read_text(Path(__file__).with_suffix(".toml")))
MAY_BE, DRAWN_AS = _WORDS["may_be"], _WORDS["drawn_as"]
LAST = ("thrust", "throttle", "airspeed")  # the least informative quantities of a product


@dataclass(frozen=True)
class Learned:
    """A law that was learnt beyond the list.

    Attributes:
        law: the terms of all sides.
        gains: decrease of minus twice the log likelihood on the training rows, by side.
        held_out_gains: the same on the held-out rows, by side.
        rivals: alternatives to the law's terms, by side.
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
        """Extend a vector for ``Problem.with_law(self.effect)``, with the law on or off."""
        return np.append(vector, [float(is_on), self.effect.spread])

    def drawn(self) -> list[tuple[str, str]]:
        """Return pairs of the residual and regressor to draw, with names as in ``traces``."""
        result = []
        for term in self.law.terms:
            axis = "xyz"[
                max(range(len(term.coefficients)), key=lambda index: abs(term.coefficients[index]))
            ]
            result.append(
                (
                    _column(term.acts, term.frame, axis),
                    _least(factor.quantity for factor in term.factors),
                )
            )
        return list(dict.fromkeys((column, DRAWN_AS.get(name, "time")) for column, name in result))

    def text(self) -> str:
        """Return the formulas of the terms and their possible causes, a line each."""
        return "\n".join(f"{term.text()}: may be {may_be(term)}" for term in self.law.terms)

    def as_json(self) -> dict[str, Any]:
        """Return the law as JSON values."""
        return {
            "law": [
                {"formula": term.text(), "may_be": may_be(term), **values}
                for term, values in zip(self.law.terms, self.law.as_json(), strict=True)
            ],
            "chi2_gain": dict(self.gains),
            "heldout_gain": dict(self.held_out_gains),
            "rivals": {name: list(values) for name, values in self.rivals.items()},
        }


def may_be(term: Term) -> str:
    """Return possible physical causes of a term."""
    return MAY_BE[_least(factor.quantity for factor in term.factors)]


def _least(quantities: Iterable[str]) -> str:
    """Return the most informative quantity."""
    return min(quantities, key=lambda quantity: 1 + LAST.index(quantity) if quantity in LAST else 0)


def _column(acts: str, frame: str, axis: str) -> str:
    if frame == "air":
        return "force_along"
    return f"{'rates' if acts == 'rate' else 'force'}_{'world_' if frame == 'world' else ''}{axis}"


def with_learned(model: ModelParameters, learned: Learned | None) -> ModelParameters:
    """Return a model with the learnt law, if any."""
    return model if learned is None else model.with_effects(learned.effect)


def with_and_without(
    learned: Learned, vectors: Mapping[str, np.ndarray], change: np.ndarray
) -> dict[str, np.ndarray]:
    """Return each model's vector for ``Problem.with_law``, and the extended one without the law.

    Args:
        learned: the law.
        vectors: parameters by model, (num_parameters,) each.
        change: change of the extended model's other parameters, fitted beside the law.
    """
    without = {**vectors, "without_learned": vectors["extended"]}
    result = {name: learned.beside(vector, is_on=False) for name, vector in without.items()}
    return {**result, "extended": learned.beside(vectors["extended"] + change)}
