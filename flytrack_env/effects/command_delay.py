"""A pure delay of all commands: radio, flight controller, motor driver."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Range, StepContext
from flytrack_env.quaternion import Scalar
from flytrack_env.state import Action, Drone

# Commands remembered: at 100 Hz, delays up to 0.04 s.
BUFFER_STEPS = 4


class CommandDelay(NamedTuple):
    """Delay, s; need not be whole steps."""

    delay_s: Scalar = 0.0


class PastCommands(NamedTuple):
    """The commands before the present one, the latest first."""

    commands: tuple[Action, ...]


def start(delay: CommandDelay, drone: Drone) -> PastCommands:
    """Return the memory of an episode that begins: as if the applied action had been commanded all along."""
    return PastCommands((drone.applied,) * BUFFER_STEPS)


def age_weights(delay_s: Scalar, dt: Scalar) -> list[jax.Array]:
    """Return the share of the present value, of the one a step before, ... in one that is ``delay_s`` late.

    BUFFER_STEPS + 1 shares that sum to 1. A delay of n + f steps, dt s each, is 1 - f parts of the value n
    steps before and f parts of the one before that. Differentiable, at 0 from above.
    """
    steps = jnp.minimum(delay_s / dt, float(BUFFER_STEPS))
    whole = jnp.floor(steps)
    part = steps - whole

    def weight(age: int) -> jax.Array:
        return jnp.where(whole == age, 1.0 - part, jnp.where(whole == age - 1, part, 0.0))

    return [weight(age) for age in range(BUFFER_STEPS + 1)]


def delayed(delay: CommandDelay, past: PastCommands, command: Action, context: StepContext) -> Action:
    """Return the command that acts: the mean of what arrives during the step.

    A command is held over its step, so that ``age_weights`` are the shares of the step that each acts.
    """
    weights = age_weights(delay.delay_s, context.dt)
    by_channel = zip(*(command, *past.commands), strict=True)
    return Action(
        *(sum(w * value for w, value in zip(weights, values, strict=True)) for values in by_channel)
    )


def remember(delay: CommandDelay, past: PastCommands, context: StepContext) -> PastCommands:
    """Return the memory after a step."""
    return PastCommands((context.command, *past.commands[:-1]))


COMMAND_DELAY = Effect(
    name="command_delay",
    parameters=CommandDelay,
    ranges={"delay_s": Range(0.0, 0.04, "s")},
    notable={"delay_s": 0.005},
    equation=r"\mathbf{u}(t) \leftarrow \frac{1}{\Delta t} \int_t^{t + \Delta t} \mathbf{u}(s - "
    r"\text{delay})\, ds",
    most_steps={"delay_s": BUFFER_STEPS},
    probes={"delay_s": (0.005, 0.01, 0.02, 0.03)},
    source="assumption: the same for all four commands, constant within a flight",
    command=delayed,
    start=start,
    remember=remember,
)
