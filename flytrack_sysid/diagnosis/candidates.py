"""What may be wrong: every effect of the list, in each way in which it can be looked for."""

from typing import NamedTuple

import numpy as np

from flytrack_env.effects import BY_NAME, EFFECTS, Effect
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.parameters import DRAIN, TAUS, THRUST_COEFFS

# Names of causes in the base, and the parameters of each.
BASE_CAUSES = {**{name: (name,) for name in TAUS}, "thrust_curve": THRUST_COEFFS, "battery_drain": (DRAIN,)}
BASE_FREE = (*TAUS, *THRUST_COEFFS, DRAIN)


class Candidate(NamedTuple):
    """An effect and one way to look for it.

    fields: ``effect.parameter`` names that are freed. probe: one of them and a value to start from, where
    there is no slope at neutral.
    """

    effect: str
    fields: tuple[str, ...]
    probe: tuple[str, float] | None = None

    @property
    def num_priced(self) -> int:
        """How many of its parameters count against it: not those that only shape what others do."""
        shapes = [f"{self.effect}.{field}" for field in BY_NAME[self.effect].shapes]
        return sum(field not in shapes for field in self.fields)

    @property
    def other_fields(self) -> tuple[str, ...]:
        """Its fields without that of the probe."""
        return tuple(field for field in self.fields if self.probe is None or field != self.probe[0])

    def placed_in(self, problem: Problem, vector: np.ndarray) -> np.ndarray:
        """Return the vector with the probe in place."""
        vector = vector.copy()
        if self.probe is not None:
            vector[problem.names.index(self.probe[0])] = self.probe[1]
        return vector


def candidates_of(effect: Effect) -> list[Candidate]:
    """Return the ways in which an effect is looked for."""
    found = []
    for group in effect.groups or (tuple(effect.ranges),):
        fields = tuple(f"{effect.name}.{field}" for field in group)
        probes: list[tuple[str, float] | None] = [
            (f"{effect.name}.{field}", value) for field in group for value in effect.probes.get(field, ())
        ]
        found += [Candidate(effect.name, fields, probe) for probe in probes or [None]]
    return found


CANDIDATES = [candidate for effect in EFFECTS for candidate in candidates_of(effect)]
PROBES = [candidate for candidate in CANDIDATES if candidate.probe is not None]
