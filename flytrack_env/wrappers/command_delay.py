"""A delay between policy and drone, for any plant: a black box as well as the simulator."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.effects import CommandDelay as Delay
from flytrack_env.effects import Flight, check_parameters, command_delay
from flytrack_env.episodes import EpisodicEnvironment, without_nan
from flytrack_env.params import EnvParams
from flytrack_env.state import Action, Drone
from flytrack_env.wrappers.action_history import ActionHistory
from flytrack_env.wrappers.base import Wrapper


class CommandDelayState(NamedTuple):
    """The inner state, and the commands that are still on their way."""

    inner: Any
    past: command_delay.PastCommands


class CommandDelay(Wrapper):
    """Delay every command by ``params.wrappers["command_delay"].delay_s``, the effect of that name.

    Where the simulator flies, the effect in its model does the same; this does it for other plants too.

    Raises:
        ValueError: a delay outside the effect's range.
        WrapperError: as ``Wrapper``, or a history of commands inside.
    """

    key = "command_delay"

    def __init__(self, env: EpisodicEnvironment, delay_s: float = 0.02):
        super().__init__(env)
        self._default = Delay(delay_s)
        check_parameters(self._default, float(env.default_params.dt))

    def refusal(self, inside: EpisodicEnvironment) -> str | None:
        """Return why not: a history of commands inside, or what every wrapper refuses."""
        if isinstance(inside, ActionHistory) and inside.kind == "commanded":
            return "the history would hold the delayed commands; put the history outside the delay"
        return super().refusal(inside)

    def own_defaults(self) -> Delay:
        """Return the delay that the wrapper was made with."""
        return self._default

    def check_params(self, params: EnvParams) -> None:
        """Raise ValueError for a delay outside the effect's range, and what the inner check refuses."""
        super().check_params(params)
        check_parameters(self.own_params(params), params.dt)

    def begin(self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0) -> CommandDelayState:
        """Return the state of an episode that begins, as if its applied action were commanded for long."""
        inner = self.env.begin(drone, gate_index, params, seed)
        return CommandDelayState(inner, command_delay.start(self.own_params(params), drone))

    def advance(
        self, state: CommandDelayState, command: Action, params: EnvParams
    ) -> tuple[CommandDelayState, jax.Array, jax.Array, dict[str, Any]]:
        """Return the outcome of the command that arrives during this step.

        An action that is not a number ends the episode at once, whatever the delay.
        """
        delay = self.own_params(params)
        is_nan = jnp.isnan(sum(command))
        flight = Flight(drone=self.env.drone(state.inner), command=without_nan(command), dt=params.dt)
        arriving = command_delay.delayed(delay, state.past, flight.command, flight)
        arriving = Action(*(jnp.where(is_nan, jnp.nan, value) for value in arriving))
        inner, reward, terminated, info = self.env.advance(state.inner, arriving, params)
        past = command_delay.remember(delay, state.past, flight)
        return CommandDelayState(inner, past), reward, terminated, info
