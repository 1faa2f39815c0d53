"""What a flight controller makes of the rate sticks: curves, their limit, a limit on their speed."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Hook, Range, StepContext
from flytrack_env.motion import Motion
from flytrack_env.quaternion import Scalar
from flytrack_env.state import Action, Drone

CENTRED = 1e-6  # of a stick: nothing saturates there, and nothing is divided by 0
AXES = ("roll", "pitch", "yaw")
THROUGHOUT = 0.75 - 1e-5  # mean of a stick that moves all the step, less what float32 rounds


def on_rate_sticks(curve: Callable[..., Scalar]) -> Hook:
    """Return the hook of a curve on each rate stick; parameters: its other arguments, of three axes each."""

    def command(parameters: Any, memory: None, sticks: Action, context: StepContext) -> Action:
        thirds = (parameters[start : start + 3] for start in range(0, len(parameters), 3))
        roll, pitch, yaw = map(curve, sticks[:3], *thirds)
        return sticks._replace(roll=roll, pitch=pitch, yaw=yaw)

    return command


class Curves(NamedTuple):
    """Two numbers of each stick's curve."""

    roll: Scalar = 0.0
    pitch: Scalar = 0.0
    yaw: Scalar = 0.0
    roll_expo: Scalar = 0.0
    pitch_expo: Scalar = 0.0
    yaw_expo: Scalar = 0.0


class ActualRates(Curves):
    """Share of the rate at full stick that the slope about the centre lacks, 1; how late it comes, 1."""


def _actual(stick: Scalar, bend: Scalar, expo: Scalar) -> Scalar:
    size = jnp.abs(stick)
    late = size * (expo * size**4 + 1.0 - expo)
    return stick * (1.0 - bend * (1.0 - late))


ACTUAL_RATES = Effect(
    parameters=ActualRates,
    about="Betaflight's Actual rates: a slope about the centre of each stick, and the rest of the "
    "rate later.",
    ranges={name: Range(0.0, 1.0, "1") for name in ActualRates._fields},
    notable=dict.fromkeys(ActualRates._fields[:3], 0.05),
    shapes=ActualRates._fields[3:],
    follows_sticks=True,
    is_setting=True,
    equation=r"u_i \leftarrow u_i \left( 1 - b_i + b_i |u_i| \left( e_i u_i^4 + 1 - e_i \right) \right)",
    source="applyActualRates in Betaflight 4.6, src/main/fc/rc.c, over the rate at full stick",
    command=on_rate_sticks(_actual),
)


class BetaflightRates(Curves):
    """Super rate of each stick, 1; its expo, 1."""


def _betaflight(stick: Scalar, super_rate: Scalar, expo: Scalar) -> Scalar:
    size = jnp.abs(stick)
    curved = 1.0 - expo + expo * size**3
    return stick * (curved * ((1.0 - super_rate) / (1.0 - super_rate * size)))


BETAFLIGHT_RATES = Effect(
    parameters=BetaflightRates,
    about="Betaflight's own rates: sticks that turn ever faster towards their ends, and an expo about "
    "the centre.",
    ranges={name: Range(0.0, 0.99, "1") for name in BetaflightRates._fields},
    notable=dict.fromkeys(BetaflightRates._fields, 0.05),
    follows_sticks=True,
    is_setting=True,
    equation=r"u_i \leftarrow u_i \left( 1 - e_i + e_i |u_i|^3 \right) \frac{1 - s_i}{1 - s_i |u_i|}",
    source="applyBetaflightRates in Betaflight 4.6, src/main/fc/rc.c, over the rate at full stick",
    command=on_rate_sticks(_betaflight),
)


class QuickRates(Curves):
    """Share of the rate at full stick that the slope about the centre lacks, 1; how late it comes, 1."""


def _quick(stick: Scalar, bend: Scalar, expo: Scalar) -> Scalar:
    size = jnp.abs(stick)
    late = expo * size**3 + (1.0 - expo) * size
    return stick * ((1.0 - bend) / (1.0 - bend * late))


QUICK_RATES = Effect(
    parameters=QuickRates,
    about="Betaflight's Quick rates: a slope about the centre of each stick that grows towards its end.",
    ranges={name: Range(0.0, 0.99, "1") for name in QuickRates._fields},
    notable=dict.fromkeys(QuickRates._fields[:3], 0.05),
    shapes=QuickRates._fields[3:],
    follows_sticks=True,
    is_setting=True,
    equation=r"u_i \leftarrow u_i \frac{1 - b_i}{1 - b_i \left( e_i |u_i|^3 + (1 - e_i) |u_i| \right)}",
    source="applyQuickRates in Betaflight 4.6, src/main/fc/rc.c, over the rate at full stick",
    command=on_rate_sticks(_quick),
)


class RateExpo(NamedTuple):
    """Cubic part of the stick curve of each axis, 1."""

    roll: Scalar = 0.0
    pitch: Scalar = 0.0
    yaw: Scalar = 0.0


def _expo(stick: Scalar, expo: Scalar) -> Scalar:
    return stick * (1.0 - expo + expo * (stick * stick))


RATE_EXPO = Effect(
    parameters=RateExpo,
    about="A cubic stick curve that the model does not know: gentle about the centre, the same at "
    "full stick.",
    ranges={axis: Range(-0.9, 0.9, "1") for axis in RateExpo._fields},
    notable={axis: 0.05 for axis in RateExpo._fields},
    follows_sticks=True,
    equation=r"u_i \leftarrow (1 - \text{expo}_i)\, u_i + \text{expo}_i\, u_i^3",
    source='the "expo" of radio transmitters, and of KISS and RaceFlight rates in Betaflight '
    "(src/main/fc/rc.c): the curve makes the setpoint of the rate loop, before any lag",
    command=on_rate_sticks(_expo),
)


class RateSaturation(NamedTuple):
    """Share of each full stick, at its end, that turns no faster, 1; how gradually, 0 (a corner) to 1."""

    roll: Scalar = 0.0
    pitch: Scalar = 0.0
    yaw: Scalar = 0.0
    softness: Scalar = 0.5


def _saturated(limit: RateSaturation, memory: None, sticks: Action, context: StepContext) -> Action:
    def limited(stick: Scalar, lost: Scalar) -> Scalar:
        reachable = 1.0 - lost
        bend = 1.0 / (reachable * reachable) - 1.0
        size = jnp.maximum(jnp.abs(stick), CENTRED)
        corner = jnp.where(size > reachable, reachable / size, 1.0)
        gradual = 1.0 / jnp.sqrt(1.0 + bend * size * size)
        share = corner + limit.softness * (gradual - corner)
        return jnp.where(lost > 0.0, stick * share, stick)  # sticks beyond full ones stay, too

    roll, pitch, yaw = (limited(stick, lost) for stick, lost in zip(sticks[:3], limit[:3], strict=True))
    return sticks._replace(roll=roll, pitch=pitch, yaw=yaw)


RATE_SATURATION = Effect(
    parameters=RateSaturation,
    about="Body rates that end below what full stick asks for: the flight controller limits its setpoint.",
    ranges={**{axis: Range(0.0, 0.9, "1") for axis in AXES}, "softness": Range(0.0, 1.0, "1")},
    notable={axis: 0.05 for axis in AXES},
    follows_sticks=True,
    equation=r"u_i \leftarrow (1 - s) \operatorname{clip}(u_i, -L_i, L_i) + \frac{s\, u_i}"
    r"{\sqrt{1 + (L_i^{-2} - 1)\, u_i^2}}, \quad L_i = 1 - \text{lost}_i, \quad s = \text{softness}",
    source="a corner: the rate limits of Betaflight (src/main/fc/rc.c), which clip the setpoint that the "
    "stick's curve makes; assumption: gradual limits give full stick as much as the corner does",
    shapes=("softness",),
    probes={axis: (0.03, 0.1, 0.3) for axis in AXES},
    command=_saturated,
)


class RateSlewLimit(NamedTuple):
    """Least time from centre to full stick of each axis, s: 0 is no limit.

    The largest angular acceleration that is asked for is ``max_rate`` over this.
    """

    roll_s: Scalar = 0.0
    pitch_s: Scalar = 0.0
    yaw_s: Scalar = 0.0


Setpoint = tuple[Scalar, Scalar, Scalar]  # the rate sticks that the loop follows at the end of a step


def _arrived(limit: RateSlewLimit, drone: Drone) -> Setpoint:
    """Return the memory of an episode that begins: the setpoint has arrived."""
    return drone.applied[:3]


def _slewed(limit: RateSlewLimit, setpoint: Setpoint, sticks: Action, context: StepContext) -> Action:
    """Return the sticks that a simulator's step ends with; of continuous motion their mean in the span."""

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


def _followed(limit: RateSlewLimit, setpoint: Setpoint, context: StepContext) -> Setpoint:
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
    parameters=RateSlewLimit,
    about="Setpoints of the rate loop that change no faster than a limit on the angular acceleration.",
    ranges={axis: Range(0.0, 1.0, "s") for axis in RateSlewLimit._fields},
    notable={axis: 0.05 for axis in RateSlewLimit._fields},
    equation=r"|u_i(t + \Delta t) - u_i(t)| \le \frac{\Delta t}{T_i}",
    source="the acceleration limit of Betaflight (src/main/flight/pid.c), which the setpoint passes between "
    "the stick's curve and the controller",
    # A limit on the acceleration of all axes is a shorter time on the axis with the lower rates.
    probes={"roll_s": (0.03, 0.1, 0.3), "pitch_s": (0.03, 0.1, 0.3), "yaw_s": (0.015, 0.05, 0.15)},
    command=_slewed,
    start=_arrived,
    remember=_followed,
)
