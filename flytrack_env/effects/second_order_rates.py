"""A rate loop with inertia: body rates follow with second order, sluggish or overshooting."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Memory, Range, RatesContext, Search, StepContext
from flytrack_env.motion import Motion
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Drone

AXES = ("roll", "pitch", "yaw")
MIN_LAG_S = 1e-5  # a lag below this is none: nothing at 100 Hz shows it
MIN_STEP_S = 1e-12  # at the beginning of a step nothing has changed yet
OBSERVED_SLOPE = 0.6  # of what a step's offset says of the slope; the gyro's noise is in it
CRITICAL = 1e-6  # of the squared damping about 1: the series is exact to rounding


class SecondOrderRates(NamedTuple):
    """Of each axis: lag of a rate that changes evenly, s, and damping: below 1 it overshoots."""

    roll_s: Scalar = 0.0
    pitch_s: Scalar = 0.0
    yaw_s: Scalar = 0.0
    roll_damping: Scalar = 0.7
    pitch_damping: Scalar = 0.7
    yaw_damping: Scalar = 0.7


class Turning(NamedTuple):
    """Body rates, rad/s, and their slopes, rad/s^2."""

    rates_b: Vec3
    slopes_b: Vec3


class _Response(NamedTuple):
    """The transition matrix of a step, of a rate's offset from the input and of its slope."""

    offset: Scalar
    offset_of_slope: Scalar
    slope_of_offset: Scalar
    slope: Scalar


def start(loop: SecondOrderRates, drone: Drone) -> Turning:
    """Return the memory of an episode that begins: a rate that has been held."""
    zero = Vec3(*(jnp.zeros_like(rate) for rate in drone.rates_b))
    return Turning(drone.rates_b, zero)


def _response(lag_s: Scalar, damping: Scalar, dt: Scalar) -> _Response:
    """Return the exponential of [[0, 1], [-wn^2, -2 zeta wn]] dt."""
    is_lag = lag_s > MIN_LAG_S
    frequency = 2.0 * damping / jnp.where(is_lag, lag_s, 1.0)
    decay = damping * frequency
    spread = frequency * frequency * (damping * damping - 1.0)
    size = jnp.sqrt(jnp.maximum(jnp.abs(spread), CRITICAL * frequency * frequency))
    # exp(-decay t) cosh and sinh, apart so that neither overflows; cos and sin where it oscillates.
    slow, fast = jnp.exp(-(decay - size) * dt), jnp.exp(-(decay + size) * dt)
    fade = jnp.exp(-decay * dt)
    even = jnp.where(spread > 0.0, 0.5 * (slow + fast), fade * jnp.cos(size * dt))
    odd = jnp.where(spread > 0.0, 0.5 * (slow - fast), fade * jnp.sin(size * dt)) / size
    elements = (even + decay * odd, odd, -frequency * frequency * odd, even - decay * odd)
    return _Response(*(jnp.where(is_lag, value, 0.0) for value in elements))


class _Input(NamedTuple):
    """An axis's input over a step: its steady response at both ends, and its slope."""

    first: Scalar
    last: Scalar
    slope: Scalar


def _input(lag_s: Scalar, before: Scalar, now: Scalar, dt: Scalar, motion: Motion) -> _Input:
    """Return the input that a step sees: held over a simulator's step, else changing evenly.

    The response to one that changes evenly follows ``lag_s`` behind it.
    """
    if motion is not Motion.CONTINUOUS:
        return _Input(now, now, 0.0)
    slope = (now - before) / jnp.maximum(dt, MIN_STEP_S)
    return _Input(before - lag_s * slope, now - lag_s * slope, slope)


def _turned(
    loop: SecondOrderRates,
    memory: Turning,
    inputs_b: tuple[Vec3, Vec3],
    dt: Scalar,
    motion: Motion,
) -> Turning:
    """Return rates and slopes ``dt`` after the beginning of a step, of the inputs at both times."""

    def follow(
        lag_s: Scalar, damping: Scalar, first: Scalar, new: Scalar, old: Scalar, slope: Scalar
    ) -> tuple[Scalar, Scalar]:
        response, drive = _response(lag_s, damping, dt), _input(lag_s, first, new, dt, motion)
        offset, change, is_lag = old - drive.first, slope - drive.slope, lag_s > MIN_LAG_S
        after = drive.last + response.offset * offset + response.offset_of_slope * change
        slope_after = drive.slope + response.slope_of_offset * offset + response.slope * change
        # Without a lag, nothing may change.
        return jnp.where(is_lag, after, new), jnp.where(is_lag, slope_after, 0.0)

    axes = zip(loop[:3], loop[3:], *inputs_b, *memory, strict=True)
    rates_b, slopes_b = zip(*(follow(*axis) for axis in axes), strict=True)
    return Turning(Vec3(*rates_b), Vec3(*slopes_b))


def _rates(loop: SecondOrderRates, memory: Turning, rates_b: Vec3, context: RatesContext) -> Vec3:
    inputs_b = context.first_input_b, rates_b
    return _turned(loop, memory, inputs_b, context.dt, context.motion).rates_b


def remember(loop: SecondOrderRates, memory: Turning, context: StepContext) -> Turning:
    """Return the memory after a step."""
    turned = _turned(loop, memory, context.rate_inputs_b, context.dt, context.motion)
    return Turning(context.rates_b, turned.slopes_b)


def observe(
    loop: SecondOrderRates, memory: Turning, offset_b: Vec3, dt: Scalar
) -> tuple[Turning, Vec3]:
    """Correct the memory by measured rates (an alpha-beta filter).

    Rates become the measured ones, and slopes come nearer to theirs. Axes without a lag hold none
    of the offset.
    """
    held = [
        jnp.where(lag_s > MIN_LAG_S, offset, 0.0)
        for lag_s, offset in zip(loop, offset_b, strict=False)
    ]
    held_b = Vec3(*held)
    corrected = Turning(
        memory.rates_b + held_b, memory.slopes_b + held_b.scale(OBSERVED_SLOPE / dt)
    )
    return corrected, offset_b - held_b


SECOND_ORDER_RATES = Effect(
    name="second_order_rates",
    parameters=SecondOrderRates,
    ranges={
        **{f"{axis}_s": Range(0.0, 0.1, "s") for axis in AXES},
        **{f"{axis}_damping": Range(0.1, 3.0, "1") for axis in AXES},
    },
    notable={f"{axis}_s": 0.005 for axis in AXES},
    equation=r"\frac{\ddot{\omega}_i}{\omega_{n,i}^2} + \text{lag}_i\, \dot{\omega}_i + \omega_i = "
    r"\omega_{i,\text{lagged stick}}, \quad "
    r"\omega_{n,i} = \frac{2\, \text{damping}_i}{\text{lag}_i}",
    source="a second-order servo, as a rate loop with a PID controller is near its bandwidth; "
    "exact for an input that is held over the step or changes evenly in it",
    hooks={"rates": _rates},
    memory=Memory(start=start, remember=remember, observe=observe),
    search=Search(
        probes={f"{axis}_s": (0.003, 0.01, 0.03) for axis in AXES},
        shapes=tuple(f"{axis}_damping" for axis in AXES),
    ),
)
