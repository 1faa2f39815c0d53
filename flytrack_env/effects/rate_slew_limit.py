"""Setpoints of the rate loop that change no faster than a limit on the angular acceleration."""

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
from flytrack_env.motion import Motion
from flytrack_env.quaternion import Scalar
from flytrack_env.state import Action, Drone

THROUGHOUT = 0.75 - 1e-5  # mean of a stick that moves all the step, less what float32 rounds


class RateSlewLimit(NamedTuple):
    """Least time from centre to full stick of each axis, s: 0 is no limit.

    The largest angular acceleration of the setpoint is ``max_rate`` over this.
    """

    roll_s: Scalar = 0.0
    pitch_s: Scalar = 0.0
    yaw_s: Scalar = 0.0


Setpoint = tuple[
    Scalar, Scalar, Scalar
]  # the rate sticks that the loop follows at the end of a step


def start(limit: RateSlewLimit, drone: Drone) -> Setpoint:
    """Return the memory of an episode that begins: the setpoint has arrived."""
    return drone.applied[:3]


def _command(
    limit: RateSlewLimit, setpoint: Setpoint, sticks: Action, context: CommandContext
) -> Action:
    """Return the limited sticks.

    For continuous motion they are the mean in the span, else those at the end of the step.
    """

    def limited(stick: Scalar, before: Scalar, full_s: Scalar) -> Scalar:
        change = stick - before
        arrives_s = full_s * jnp.abs(change)
        if context.motion is Motion.CONTINUOUS:
            begin, end = (share * context.dt for share in context.span)
        else:
            begin = end = context.dt
        is_late = arrives_s > begin
        # Guard inside the where: a division by 0 has no slope even where it is not selected.
        slope = jnp.sign(change) / jnp.where(is_late, full_s, 1.0)
        if begin is end:
            return jnp.where(is_late, before + slope * end, stick)
        until = jnp.minimum(end, arrives_s)
        moving = slope * 0.5 * (until * until - begin * begin) + change * (end - until)
        return jnp.where(is_late, before + moving / (end - begin), stick)

    roll, pitch, yaw = (limited(*axis) for axis in zip(sticks[:3], setpoint, limit, strict=True))
    return sticks._replace(roll=roll, pitch=pitch, yaw=yaw)


def remember(limit: RateSlewLimit, setpoint: Setpoint, context: StepContext) -> Setpoint:
    """Return the memory after a step; nothing changes the sticks behind this effect."""
    if context.motion is not Motion.CONTINUOUS:
        return context.acting[:3]
    roll, pitch, yaw = zip(context.acting[:3], setpoint, limit, strict=True)
    return _end_of(*roll, context.dt), _end_of(*pitch, context.dt), _end_of(*yaw, context.dt)


def _end_of(mean: Scalar, before: Scalar, full_s: Scalar, dt: Scalar) -> Scalar:
    """Return where a stick is that has had this mean in the second half of a step.

    In units of what a step can change, a stick that arrives at x after the middle had the mean
    2 x - x^2 - 1/4; one that moves throughout had 3/4, and one that rests 1/2 at most.
    """
    share = full_s * jnp.abs(mean - before) / dt
    is_late = share > 0.5
    arrival = 1.0 - jnp.sqrt(0.75 - jnp.minimum(share, THROUGHOUT))
    reached = jnp.where(share < THROUGHOUT, arrival, 1.0)
    slope = jnp.sign(mean - before) / jnp.where(is_late, full_s, 1.0)
    return jnp.where(is_late, before + slope * reached * dt, mean)


RATE_SLEW_LIMIT = Effect(
    name="rate_slew_limit",
    parameters=RateSlewLimit,
    ranges={axis: Range(0.0, 1.0, "s") for axis in RateSlewLimit._fields},
    notable={axis: 0.05 for axis in RateSlewLimit._fields},
    equation=r"|u_i(t + \Delta t) - u_i(t)| \le \frac{\Delta t}{T_i}",
    source="the acceleration limit of Betaflight (src/main/flight/pid.c), "
    "which the setpoint passes between the stick's curve and the controller",
    hooks={"command": _command},
    memory=Memory(start=start, remember=remember),
    search=Search(
        probes={
            "roll_s": (0.03, 0.1, 0.3),
            "pitch_s": (0.03, 0.1, 0.3),
            "yaw_s": (0.015, 0.05, 0.15),
        }
    ),
)
