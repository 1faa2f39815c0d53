"""Plants: what moves the drone. The simulator is one, a black box is another.

The environment, the evaluator and the identification tools fly anything with this contract.
A plant's state is a pytree of its own, because a plant may remember more than the drone shows (a
delay buffer, a gust); whoever holds a state asks for the drone in it.
"""

from typing import Any, Protocol

from flytrack_env.dynamics import ModelParameters, advance
from flytrack_env.quaternion import Scalar
from flytrack_env.state import Action, Drone


class Plant(Protocol):
    """Pure functions for one drone; all of them work under ``jit``, ``vmap`` and ``scan``.

    A plant that cannot be asked for any other step of time says so with an attribute ``dt``, s.
    """

    def reset(self, drone: Drone) -> Any:
        """Return the plant's state with the drone in that state and nothing remembered."""

    def step(self, state: Any, command: Action, dt: Scalar, model: ModelParameters) -> Any:
        """Return the plant's state ``dt`` seconds later under a held command in [-1, 1]."""

    def drone(self, state: Any) -> Drone:
        """Return the drone of a plant's state."""


class Simulator:
    """The differentiable model (``flytrack_env.dynamics``); its state is the drone itself."""

    def reset(self, drone: Drone) -> Drone:
        """Return the drone."""
        return drone

    def step(self, state: Drone, command: Action, dt: Scalar, model: ModelParameters) -> Drone:
        """Return the model's next drone."""
        return advance(state, command, dt, model)

    def drone(self, state: Drone) -> Drone:
        """Return the drone."""
        return state
