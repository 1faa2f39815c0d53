"""Past actions: the last ones beside the observation, and a delay between policy and drone."""

from typing import Any

import jax
import jax.numpy as jnp

from flytrack_env.effects import CommandDelay, StepContext, check_parameters, command_delay
from flytrack_env.episodes import EpisodicEnvironment, without_nan
from flytrack_env.observations import Entry
from flytrack_env.params import EnvParams
from flytrack_env.state import ACTION_SIZE, Action, Drone
from flytrack_env.wrappers.base import Wrapped, Wrapper

KINDS = ("commanded", "applied")


class ActionHistory(Wrapper):
    """Append the last ``length`` actions to the observation, the latest first.

    kind: "commanded" (clipped, as the policy gave them) or "applied" (lagged). When an episode begins,
    all that it remembers is the applied action that the drone begins with.

    Raises:
        ValueError: a length below 1, another kind.
        WrapperError: as ``Wrapper``.
    """

    def __init__(self, env: EpisodicEnvironment, length: int = 3, kind: str = "commanded"):
        if length < 1:
            raise ValueError(f"length: found {length}, expected at least 1")
        if kind not in KINDS:
            raise ValueError(f"kind: found {kind!r}, expected one of {KINDS}")
        self.length = length
        self.kind = kind
        self.key = f"{kind}_action_history"
        super().__init__(env)

    @property
    def observation_table(self) -> tuple[Entry, ...]:
        """The inner environment's, and a row per action remembered."""
        names = ["latest", *(f"{age} before the latest" for age in range(1, self.length))]
        rows = (
            Entry(
                key=f"{self.kind}_{age}",
                name=f"{self.kind} action, {name}: roll, pitch, yaw, thrust",
                size=ACTION_SIZE,
                frame="body",
                unit="1",
                scale=1.0,
                limit=1.0,
            )
            for age, name in enumerate(names)
        )
        return (*self.env.observation_table, *rows)

    def begin(self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0) -> Wrapped:
        """Return the state of an episode that begins, the drone's applied action for all of history."""
        inner = self.env.begin(drone, gate_index, params, seed)
        return Wrapped(inner, (drone.applied,) * self.length)

    def advance(
        self, state: Wrapped, command: Action, params: EnvParams
    ) -> tuple[Wrapped, jax.Array, jax.Array, dict[str, Any]]:
        """Return the next state with this action in front, reward, terminated and info."""
        inner, reward, terminated, info = self.env.advance(state.inner, command, params)
        latest = without_nan(command) if self.kind == "commanded" else self.env.drone(inner).applied
        return Wrapped(inner, (latest, *state.own[:-1])), reward, terminated, info

    def observe_drone(self, drone: Drone, state: Wrapped, params: EnvParams) -> list[jax.Array]:
        """Return the inner observation with the actions behind it."""
        values = [jnp.asarray(value) for action in state.own for value in action]
        return [*self.env.observe_drone(drone, state.inner, params), *values]


class ActionDelay(Wrapper):
    """Delay every action by ``params.wrappers["action_delay"].delay_s``.

    The parameters are those of the effect ``command_delay``, which does the same inside the simulator's
    model; this wrapper does it for any plant. It remembers the commands that are still on their way.

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
        """Raise ValueError for a delay outside the effect's range, and what the inner check refuses."""
        super().check_params(params)
        check_parameters(self.own_params(params), params.dt)

    def begin(self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0) -> Wrapped:
        """Return the state of an episode that begins, its applied action taken for all past commands."""
        inner = self.env.begin(drone, gate_index, params, seed)
        return Wrapped(inner, command_delay.start(self.own_params(params), drone))

    def advance(
        self, state: Wrapped, command: Action, params: EnvParams
    ) -> tuple[Wrapped, jax.Array, jax.Array, dict[str, Any]]:
        """Return the outcome of the command that arrives during this step.

        An action that is not a number ends the episode at once, whatever the delay.
        """
        delay = self.own_params(params)
        is_nan = jnp.isnan(sum(command))
        context = StepContext(drone=self.env.drone(state.inner), command=without_nan(command), dt=params.dt)
        arriving = command_delay.delayed(delay, state.own, context.command, context)
        arriving = Action(*(jnp.where(is_nan, jnp.nan, value) for value in arriving))
        inner, reward, terminated, info = self.env.advance(state.inner, arriving, params)
        past = command_delay.remember(delay, state.own, context)
        return Wrapped(inner, past), reward, terminated, info
