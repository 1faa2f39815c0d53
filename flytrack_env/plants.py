"""Plants: what moves the drone. The simulator is one, a black box is another.

The environment, the evaluator and the identification tools fly anything with this contract.
A plant's state is a pytree of its own, because a plant may remember more than the drone shows (a
delay buffer, say); whoever holds a state asks for the drone in it.
"""

from typing import Any, NamedTuple, Protocol

from flytrack_env.dynamics import ModelParameters, advance, read_gyro
from flytrack_env.effects import start_memories
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Action, Drone


class Plant(Protocol):
    """Pure functions for one drone; all of them work under ``jit``, ``vmap`` and ``scan``.

    A plant with everything baked in says so with an attribute ``dt``, its only step of time, s: it does
    not look at ``model`` either. A plant whose gyro can say something else than the drone's rates has a
    ``read_gyro`` as the simulator's.
    """

    def reset(self, drone: Drone, model: ModelParameters) -> Any:
        """Return the plant's state with the drone in that state and nothing remembered."""

    def step(self, state: Any, command: Action, dt: Scalar, model: ModelParameters) -> Any:
        """Return the plant's state ``dt`` seconds later under a held command in [-1, 1]."""

    def drone(self, state: Any) -> Drone:
        """Return the drone of a plant's state."""


class SimulatorState(NamedTuple):
    """The drone, and memories: what each effect of the model remembers, None for most."""

    drone: Drone
    memories: tuple[Any, ...]


class Simulator:
    """The differentiable model: ``flytrack_env.dynamics`` with the model's effects."""

    def reset(self, drone: Drone, model: ModelParameters) -> SimulatorState:
        """Return the drone with fresh memories."""
        return SimulatorState(drone, start_memories(model.effects, drone))

    def step(
        self, state: SimulatorState, command: Action, dt: Scalar, model: ModelParameters
    ) -> SimulatorState:
        """Return the model's next state."""
        return SimulatorState(*advance(*state, command, dt, model))

    def drone(self, state: SimulatorState) -> Drone:
        """Return the drone."""
        return state.drone

    def read_gyro(self, state: SimulatorState, drone: Drone, dt: Scalar, model: ModelParameters) -> Vec3:
        """Return what the gyro says of a drone's body rates, rad/s; what it remembers is the state's."""
        return read_gyro(drone, state.memories, dt, model)
