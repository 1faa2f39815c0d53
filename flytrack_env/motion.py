"""How a model moves within a step: which simulator's, or nature's, integration it has."""

from enum import Enum

import jax

OLD_EULER = "handout"  # its name up to version 0.1


@jax.tree_util.register_static
class Motion(Enum):
    """How a model moves within a step, a static choice.

    A pytree without leaves, so that each motion compiles its own program.

    EULER: the exercise's step, the contract of the registered ids: rates after the step turn the
    drone over all of it, and the force has the attitude before it. SEMI_IMPLICIT: the same, but the
    force has the attitude after the step, as in many simulators. CONTINUOUS: as drones move; rates
    and force change within the step, of second order or better in its length. Files and flags of
    older versions call EULER ``handout``, which is still read.
    """

    EULER = "euler"
    SEMI_IMPLICIT = "semi_implicit"
    CONTINUOUS = "continuous"

    @classmethod
    def _missing_(cls, value: object) -> "Motion | None":
        return cls.EULER if value == OLD_EULER else None
