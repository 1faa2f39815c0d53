"""A pure delay of all commands: radio, flight controller, motor driver."""

from itertools import pairwise
from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import (
    CommandContext,
    Effect,
    Memory,
    Range,
    Search,
    StepContext,
)
from flytrack_env.quaternion import Scalar
from flytrack_env.state import Action, Drone

DEFAULT_DELAY_STEPS, MAX_DELAY_STEPS = 4, 12  # commands remembered, by default and at most
MAX_DELAY_S, STEPS_PER_DELAY = (
    0.06,
    6,
)  # of each parameter: all of them fit into the longest memory together


class CommandDelay(NamedTuple):
    """Delay of all commands, and how much later yaw and thrust are than that, s.

    Delays need not be whole steps. A channel is never early: below 0 the sum is 0.
    """

    delay_s: Scalar = 0.0
    yaw_extra_s: Scalar = 0.0
    thrust_extra_s: Scalar = 0.0


PastCommands = tuple[Action, ...]  # those before the present one, the latest first


def start(delay: CommandDelay, drone: Drone, num_steps: int = DEFAULT_DELAY_STEPS) -> PastCommands:
    """Return the memory of a new episode, as if the applied action had always been commanded.

    Args:
        num_steps: how many commands it holds; longer delays are cut.
    """
    return (drone.applied,) * num_steps


def dead_times(delay: CommandDelay) -> Action:
    """Return the delay of each channel, s."""

    def later(extra_s: Scalar) -> Scalar:
        together = delay.delay_s + extra_s
        return jnp.where(together < 0.0, 0.0, together)

    return Action(
        delay.delay_s, delay.delay_s, later(delay.yaw_extra_s), later(delay.thrust_extra_s)
    )


def late(
    values: tuple[Scalar, ...], delay_s: Scalar, dt: Scalar, span: tuple[float, float] = (0.0, 1.0)
) -> Scalar:
    """Return the mean over a step of a value that is ``delay_s`` late and was held over each step.

    A delay of n + f steps is 1 - f parts of the value n steps before and f parts of the one before
    that; longer delays than values are cut. Differentiable, at 0 from above.

    Args:
        values: the present one, the one a step of ``dt`` s before, ...
        span: shares of the step that the mean is over, if not all of it.
    """
    steps = delay_s / dt
    mean = values[0]
    for age, (later, earlier) in enumerate(pairwise(values)):
        share = jnp.clip((steps - age - span[0]) / (span[1] - span[0]), 0.0, 1.0)
        mean = mean + share * (earlier - later)
    return mean


def delayed(
    delay: CommandDelay,
    past: PastCommands,
    command: Action,
    dt: Scalar,
    span: tuple[float, float] = (0.0, 1.0),
) -> Action:
    """Return the command that acts: the mean of what arrives during the span of a step."""
    by_channel = zip(*(command, *past), strict=True)
    return Action(
        *(
            late(values, delay_s, dt, span)
            for values, delay_s in zip(by_channel, dead_times(delay), strict=True)
        )
    )


def _command(
    delay: CommandDelay, past: PastCommands, command: Action, context: CommandContext
) -> Action:
    return delayed(delay, past, command, context.dt, context.span)


def _remember(delay: CommandDelay, past: PastCommands, context: StepContext) -> PastCommands:
    return (context.command, *past[:-1])


COMMAND_DELAY = Effect(
    name="command_delay",
    parameters=CommandDelay,
    ranges={
        "delay_s": Range(0.0, MAX_DELAY_S, "s"),
        "yaw_extra_s": Range(-MAX_DELAY_S, MAX_DELAY_S, "s"),
        "thrust_extra_s": Range(-MAX_DELAY_S, MAX_DELAY_S, "s"),
    },
    notable=dict.fromkeys(CommandDelay._fields, 0.005),
    equation=r"u_i(t) \leftarrow \frac{1}{\Delta t} "
    r"\int_t^{t + \Delta t} u_i(s - \text{delay}_i)\, ds, "
    r"\quad \text{delay}_i = \max(0, \text{delay} + \text{extra}_i)",
    source="assumption: constant within a flight; the link comes first, then what the flight "
    "controller makes of the sticks",
    max_steps=dict.fromkeys(CommandDelay._fields, STEPS_PER_DELAY),
    hooks={"command": _command},
    memory=Memory(start=start, remember=_remember),
    search=Search(
        probes={
            "delay_s": (0.005, 0.01, 0.02, 0.03, 0.05),
            "yaw_extra_s": (0.01, 0.01, 0.03, 0.03, 0.05),
            "thrust_extra_s": (0.01, 0.01, 0.03, 0.03, 0.03),
        },
        groups=(("delay_s",), CommandDelay._fields),
    ),
)
