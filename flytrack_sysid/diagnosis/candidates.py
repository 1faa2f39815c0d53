"""What may be wrong: every effect of the list, in each way in which it can be looked for."""

from typing import NamedTuple

import numpy as np

from flytrack_env.effects import BY_NAME, EFFECTS, Effect
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.parameters import DRAIN, TAUS, THRUST_COEFFS

# What a base parameter that differs is called.
BASE_CAUSES = {**{name: (name,) for name in TAUS}, "thrust_curve": THRUST_COEFFS, "battery_drain": (DRAIN,)}
BASE_FREE = (*TAUS, *THRUST_COEFFS, DRAIN)


class Candidate(NamedTuple):
    """An effect and one way to begin with it.

    fields: ``effect.parameter`` names that are freed. probe: of one of them, its value to begin with, where
    there is no slope at neutral.
    """

    effect: str
    fields: tuple[str, ...]
    probe: tuple[str, float] | None = None

    @property
    def price(self) -> int:
        """Its parameters, without those that only shape what others do."""
        shapes = [f"{self.effect}.{field}" for field in BY_NAME[self.effect].shapes]
        return sum(field not in shapes for field in self.fields)


def candidates_of(effect: Effect) -> list[Candidate]:
    """Return the ways in which an effect is looked for."""
    found = []
    for group in effect.groups or (tuple(effect.ranges),):
        fields = tuple(f"{effect.name}.{field}" for field in group)
        probes = [
            (f"{effect.name}.{field}", value) for field in group for value in effect.probes.get(field, ())
        ]
        found += [Candidate(effect.name, fields, probe) for probe in probes or [None]]
    return found


CANDIDATES = [candidate for effect in EFFECTS for candidate in candidates_of(effect)]


def opened(problem: Problem, vector: np.ndarray, candidate: Candidate) -> np.ndarray:
    """Return the vector with the candidate's probe in place."""
    vector = vector.copy()
    if candidate.probe is not None:
        vector[problem.names.index(candidate.probe[0])] = candidate.probe[1]
    return vector


def base_places(problem: Problem) -> list[int]:
    """Return the places of the base parameters that are free."""
    return [problem.names.index(name) for name in BASE_FREE if name not in problem.held]
