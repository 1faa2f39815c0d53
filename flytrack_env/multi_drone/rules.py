"""The rules of a race of several drones, and its parameters."""

from typing import NamedTuple

import numpy as np

from flytrack_env.params import EnvParams
from flytrack_env.quaternion import Scalar

MAX_DRONES = 8
DRAWN_SLOT = -1
BOTH_OUT, RAMMER_OUT = 0, 1


class RaceRules(NamedTuple):
    """How drones start and collide; all of it may be batched, as parameters may.

    Attributes:
        collision_radius: of the sphere around each drone, m.
        blame: 0, both drones of a collision are out; 1, the one that ran into the other is
            (``flytrack_env.multi_drone.collisions``).
        column_spacing, row_spacing: of the start grid, m.
        first_slot: slot on the grid of drone 0, the others following; -1: drawn.
        lead: reward for each gate gained on the best opponent.
    """

    collision_radius: Scalar = 0.15
    blame: Scalar = BOTH_OUT
    column_spacing: Scalar = 1.0
    row_spacing: Scalar = 0.5
    first_slot: Scalar = DRAWN_SLOT
    lead: Scalar = 0.0


class RaceParams(NamedTuple):
    """What each drone flies with, the same for all, and the rules of the race."""

    flight: EnvParams
    rules: RaceRules


def check_num_drones(num_drones: int) -> None:
    """Raise ValueError unless this number of drones can race."""
    if not isinstance(num_drones, int) or not 1 <= num_drones <= MAX_DRONES:
        raise ValueError(f"num_drones: found {num_drones!r}, expected 1 to {MAX_DRONES}")


def check_rules(rules: RaceRules, num_drones: int) -> None:
    """Raise ValueError, naming the field, for concrete rules that no race can be flown by."""
    diameter = 2.0 * np.asarray(rules.collision_radius, float)
    apart = "more than twice the collision_radius: drones would start inside each other"
    slots = f"a slot of 0 to {num_drones - 1}, or {DRAWN_SLOT} to draw it"
    requirements = {
        "collision_radius": (diameter > 0.0, "more than 0 m"),
        "blame": (np.isin(rules.blame, (BOTH_OUT, RAMMER_OUT)), f"{BOTH_OUT} or {RAMMER_OUT}"),
        "column_spacing": (np.asarray(rules.column_spacing) > diameter, apart),
        "row_spacing": (
            2.0 * np.asarray(rules.row_spacing) > diameter,
            apart.replace("twice ", ""),
        ),
        "first_slot": (np.isin(rules.first_slot, range(DRAWN_SLOT, num_drones)), slots),
        "lead": (np.isfinite(rules.lead), "a finite number"),
    }
    for name, (holds, expected) in requirements.items():
        if not np.all(holds):
            raise ValueError(f"rules.{name}: found {getattr(rules, name)}, expected {expected}")


def check_apart(positions_w: np.ndarray, rules: RaceRules) -> None:
    """Raise ValueError for drones, positions (num_drones, 3), that would start in a collision."""
    distances = np.linalg.norm(positions_w[:, None] - positions_w[None], axis=-1)
    for first, second in zip(*np.triu_indices(len(positions_w), 1), strict=True):
        if distances[first, second] < 2.0 * float(rules.collision_radius):
            raise ValueError(
                f"drones {first} and {second}: found starts "
                f"{distances[first, second]:.3g} m apart, expected "
                f"at least {2.0 * float(rules.collision_radius):.3g} m, twice the collision_radius"
            )
