"""Plants: what moves the drone. The simulator is one, a black box is another.

The environment, the evaluator and the identification tools fly any subclass of ``Plant``. A plant's
state is a pytree of its own, because it may hold more than the drone (a delay buffer, say);
``Plant.drone`` returns the drone in it.
"""

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

from flytrack_env.battery import Battery
from flytrack_env.dynamics import ModelParameters, advance, sensed
from flytrack_env.effects import DEFAULT_DELAY_STEPS, start_memories
from flytrack_env.effects.base import Memories
from flytrack_env.quaternion import Scalar
from flytrack_env.state import Action, Drone


class Plant(ABC):
    """Pure functions for one drone; all of them work under ``jit``, ``vmap`` and ``scan``.

    Attributes:
        dt: the only time step that the plant can take, s; None if it takes any. A plant with a
            ``dt`` has its parameters baked in and ignores ``model`` as well.
        delay_steps: how many commands delays of the model's effects remember.
        battery: of a plant that has its own; None if it is the model's.
    """

    dt: float | None = None
    battery: Battery | None = None
    delay_steps: int = DEFAULT_DELAY_STEPS

    @abstractmethod
    def reset(self, drone: Drone, model: ModelParameters) -> Any:
        """Return the plant's state with the drone in that state and nothing remembered."""

    @abstractmethod
    def step(self, state: Any, command: Action, dt: Scalar, model: ModelParameters) -> Any:
        """Return the plant's state ``dt`` seconds later under a held command in [-1, 1]."""

    @abstractmethod
    def drone(self, state: Any) -> Drone:
        """Return the drone of a plant's state."""

    def sensed(self, state: Any, drone: Drone, dt: Scalar, model: ModelParameters) -> Drone:
        """Return a drone as gyro and motion capture report it: as it is by default."""
        return drone

    def check_alive(self) -> None:  # noqa: B027, most plants cannot fail
        """Raise ValueError if a step has failed, since when states are NaN; nothing by default.

        A compiled step cannot raise: who runs some asks this afterwards.
        """


class SimulatorState(NamedTuple):
    """The drone, and memories: what each effect of the model remembers, None for most."""

    drone: Drone
    memories: Memories


class Simulator(Plant):
    """The differentiable model: ``flytrack_env.dynamics`` with the model's effects."""

    def __init__(self, delay_steps: int = DEFAULT_DELAY_STEPS):
        self.delay_steps = delay_steps

    def reset(self, drone: Drone, model: ModelParameters) -> SimulatorState:
        """Return the drone with fresh memories."""
        return SimulatorState(drone, start_memories(model.effects, drone, self.delay_steps))

    def step(
        self, state: SimulatorState, command: Action, dt: Scalar, model: ModelParameters
    ) -> SimulatorState:
        """Return the model's next state."""
        return SimulatorState(*advance(*state, command, dt, model))

    def drone(self, state: SimulatorState) -> Drone:
        """Return the drone."""
        return state.drone

    def sensed(
        self, state: SimulatorState, drone: Drone, dt: Scalar, model: ModelParameters
    ) -> Drone:
        """Return a drone as gyro and motion capture report it, with the memories of the state."""
        return sensed(drone, state.memories, dt, model)
