"""The parameters of an environment."""

from collections.abc import Mapping
from dataclasses import field
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Self

import chex
import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import (
    DEFAULT_DELAY_STEPS,
    ROUNDING,
    Range,
    check_beside_motors,
    check_parameters,
)
from flytrack_env.quaternion import Scalar
from flytrack_env.resets import ResetParams
from flytrack_env.rewards import RewardWeights
from flytrack_env.tracks import Course
from flytrack_env.tracks.track import MAX_COORDINATE_M

# Within these, numbers stay finite, attitudes unit quaternions and observations in their space;
# wider than anything that flies. Effects and wrappers have ranges of their own.
RANGES: Mapping[str, Range] = {
    "dt": Range(5e-4, 1.0, "s"),
    "drone_radius": Range(1e-3, 1e3, "m"),
    "max_steps_in_episode": Range(1, 2e9, "steps"),
    "model.tau": Range(1e-6, 1e3, "s"),
    "model.thrust_coeffs": Range(-1e4, 1e4, "N"),
    "model.max_rate": Range(1e-3, 1e5, "deg/s"),
    "model.m": Range(1e-3, 1e3, "kg"),
    "model.g": Range(0.0, 1e3, "m/s^2"),
    "model.battery_drain_v_per_min": Range(-1e3, 1e3, "V/min"),
    "reset.course_fraction": Range(0.0, 1.0, "1"),
    "reset.start_position_noise": Range(0.0, MAX_COORDINATE_M, "m"),
    "reset.start_height_noise": Range(0.0, MAX_COORDINATE_M, "m"),
    "reset.start_yaw_noise_deg": Range(0.0, 180.0, "deg"),
    "reset.start_tilt_noise_deg": Range(0.0, 180.0, "deg"),
    "reset.start_charge_low": Range(0.0, 1.0, "1"),
    "reset.course_offset": Range(0.0, MAX_COORDINATE_M, "m"),
    "reset.course_speed": Range(0.0, 1e3, "m/s"),
    "reset.course_yaw_deg": Range(0.0, 180.0, "deg"),
    "reset.course_tilt_deg": Range(0.0, 180.0, "deg"),
    "reset.course_stick": Range(0.0, 1.0, "1"),
    "reset.course_thrust_low": Range(-1.0, 1.0, "1"),
    "reset.course_thrust_high": Range(-1.0, 1.0, "1"),
    "reset.course_charge_low": Range(0.0, 1.0, "1"),
    **{f"reward.{name}": Range(-1e6, 1e6, "1") for name in RewardWeights._fields},
}
MIN_GATES = 2
DT_S = 0.01  # step of an environment
UNIT_TOLERANCE = 1e-5  # of a norm


@chex.dataclass(frozen=True, mappable_dataclass=False)
class EnvParams:
    """Everything that may be fitted, randomised or tuned: a pytree without static fields.

    Attributes:
        model: the simulated drone.
        course: the track as arrays.
        reset: how episodes start.
        reward: weights.
        dt: s.
        drone_radius: m.
        max_steps_in_episode: the time limit, steps.
        wrappers: the parameters of each wrapper around the environment, by its name; documented by
            the wrapper's class.
    """

    model: ModelParameters
    course: Course
    reset: ResetParams
    reward: RewardWeights
    dt: Scalar = DT_S
    drone_radius: Scalar = 0.15
    max_steps_in_episode: Scalar = 1000
    wrappers: dict[str, Any] = field(default_factory=dict)

    if TYPE_CHECKING:  # chex adds it at run time

        def replace(self, **changes: Any) -> Self:
            """Return the parameters with some fields changed."""
            ...

    def check(self, delay_steps: int = DEFAULT_DELAY_STEPS) -> None:
        """Raise ValueError, naming the field, for values that no episode can be flown with.

        For concrete values, as nothing can be refused under ``jit``. Any may be batched, as for
        ``vmap``.

        Args:
            delay_steps: that the plant remembers (``flytrack_env.plants``).
        """
        for name, bounds in RANGES.items():
            value = attrgetter(name)(self)
            low = bounds.low - ROUNDING * abs(bounds.low)
            high = bounds.high + ROUNDING * abs(bounds.high)
            if not np.all((np.asarray(value) >= low) & (np.asarray(value) <= high)):
                expected = f"{bounds.low:g} to {bounds.high:g} {bounds.unit}"
                raise ValueError(f"{name}: found {value}, expected {expected}")
        self.model.battery.check()
        for parameters in self.model.effects:
            check_parameters(parameters, self.dt, delay_steps)
        check_beside_motors(self.model.effects)
        _check_course(self.course)
        if not np.all(
            np.asarray(self.course.gates.half_opening) > np.asarray(self.drone_radius)[..., None]
        ):
            raise ValueError(
                f"drone_radius: found {self.drone_radius}, "
                "expected less than half of every gate's opening"
            )


def _check_course(course: Course) -> None:
    """Raise ValueError for invalid numbers, or one gate alone, whose passes would count twice."""
    num_gates = np.shape(course.gates.half_opening)[-1]
    if num_gates < MIN_GATES:
        raise ValueError(f"course.gates: found {num_gates}, expected at least {MIN_GATES}")
    for path, leaf in jax.tree_util.tree_leaves_with_path(course):
        if not np.all(np.abs(leaf) <= MAX_COORDINATE_M):
            name = f"course{jax.tree_util.keystr(path)}"
            raise ValueError(
                f"{name}: found {leaf}, expected finite numbers within +-{MAX_COORDINATE_M:g}"
            )
    units = {
        "start_quat": course.start_quat,
        "gates.forward": course.gates.forward,
        "gates.up": course.gates.up,
    }
    for name, components in units.items():
        norm = np.sqrt(sum(np.square(np.asarray(component, float)) for component in components))
        if not np.all(np.abs(norm - 1.0) <= UNIT_TOLERANCE):
            raise ValueError(f"course.{name}: found norm {norm}, expected 1")
