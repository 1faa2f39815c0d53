"""A delay between policy and drone, for any plant: a black box as well as the simulator."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.effects import CommandDelay, check_parameters, command_delay
from flytrack_env.episodes import EpisodicEnvironment, without_nan
from flytrack_env.params import EnvParams
from flytrack_env.state import Action, Drone
from flytrack_env.wrappers.action_history import ActionHistory
from flytrack_env.wrappers.base import Wrapper


class ActionDelayState(NamedTuple):
    """The inner state, and the commands that are still on their way."""

    inner: Any
    past: command_delay.PastCommands


class ActionDelay(Wrapper):
    """Delay every action by ``params.wrappers["action_delay"].delay_s``.

    The parameters are those of the effect ``command_delay``, which does the same inside the
    simulator's model; this wrapper does it for any plant.

    Raises:
        ValueError: a delay outside the effect's range.
        WrapperError: as ``Wrapper``, or a history of commands inside.
    """

    key = "action_delay"

    def __init__(self, env: EpisodicEnvironment, delay_s: float = 0.02):
        super().__init__(env)
        self._default = CommandDelay(delay_s)
        check_parameters(self._default, float(env.default_params.dt))

    def refusal(self, inside: EpisodicEnvironment) -> str | None:
        """Return why not: a history of commands inside, or what every wrapper refuses."""
        if isinstance(inside, ActionHistory) and inside.kind == "commanded":
            return "the history would hold the delayed commands; put the history outside the delay"
        return super().refusal(inside)

    def own_defaults(self) -> CommandDelay:
        """Return the delay that the wrapper was made with."""
        return self._default

    def check_params(self, params: EnvParams) -> None:
        """Raise ValueError for a delay out of the effect's range, and as the inner check does."""
        super().check_params(params)
        check_parameters(self.own_params(params), params.dt)

    def begin(
        self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0
    ) -> ActionDelayState:
        """Return the state of a new episode; all past commands are its applied action."""
        inner = self.env.begin(drone, gate_index, params, seed)
        return ActionDelayState(inner, command_delay.start(self.own_params(params), drone))

    def advance(
        self, state: ActionDelayState, command: Action, params: EnvParams
    ) -> tuple[ActionDelayState, jax.Array, jax.Array, dict[str, Any]]:
        """Return the outcome of the command that arrives during this step.

        An action that is not a number ends the episode at once, whatever the delay.
        """
        delay = self.own_params(params)
        is_nan = jnp.isnan(sum(command))
        command = without_nan(command)
        arriving = command_delay.delayed(delay, state.past, command, params.dt)
        arriving = Action(*(jnp.where(is_nan, jnp.nan, value) for value in arriving))
        inner, reward, terminated, info = self.env.advance(state.inner, arriving, params)
        past = (command, *state.past[:-1])
        return ActionDelayState(inner, past), reward, terminated, info
