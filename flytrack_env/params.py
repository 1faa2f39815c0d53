"""The parameters of an environment."""

from dataclasses import field
from typing import TYPE_CHECKING, Any, Self

import chex
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import check_parameters
from flytrack_env.quaternion import Scalar
from flytrack_env.resets import ResetParams
from flytrack_env.rewards import RewardWeights
from flytrack_env.state import BATTERY_EMPTY_V, BATTERY_FULL_V
from flytrack_env.tracks import Course


@chex.dataclass(frozen=True, mappable_dataclass=False)
class EnvParams:
    """Everything that may be fitted, randomised or tuned: a pytree without static fields.

    model: the simulated drone. course: the track as arrays. reset: how episodes start. reward: weights.
    dt: s. drone_radius: m. max_steps_in_episode: the time limit, steps. wrappers: the parameters of each
    wrapper around the environment, by its name; a wrapper's class says what they are.
    """

    model: ModelParameters
    course: Course
    reset: ResetParams
    reward: RewardWeights
    dt: Scalar = 0.01
    drone_radius: Scalar = 0.15
    max_steps_in_episode: Scalar = 1000
    wrappers: dict[str, Any] = field(default_factory=dict)

    if TYPE_CHECKING:  # chex adds it, and tells no type checker

        def replace(self, **changes: Any) -> Self:
            """Return the parameters with some fields changed."""
            ...

    def check(self) -> None:
        """Raise ValueError, naming the field, for values that no episode can be flown with.

        For concrete values, before work begins: under ``jit`` nothing can be refused any more.
        """
        for name in ("start_battery_low_v", "course_battery_low_v"):
            value = getattr(self.reset, name)
            if not np.all((np.asarray(value) >= BATTERY_EMPTY_V) & (np.asarray(value) <= BATTERY_FULL_V)):
                raise ValueError(
                    f"reset.{name}: found {value}, expected {BATTERY_EMPTY_V:g} to {BATTERY_FULL_V:g} V"
                )
        for parameters in self.model.effects:
            check_parameters(parameters, self.dt)
        for name in ("dt", "drone_radius", "max_steps_in_episode"):
            value = getattr(self, name)
            if not np.all(np.asarray(value) > 0):
                raise ValueError(f"{name}: found {value}, expected > 0")
        if not np.all(np.asarray(self.course.gates.half_opening) > self.drone_radius):
            raise ValueError(
                f"drone_radius: found {self.drone_radius}, expected less than half of every gate's opening"
            )
