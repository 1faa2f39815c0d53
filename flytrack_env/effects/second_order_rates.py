"""A rate loop with inertia: body rates that follow with a second order, sluggish or overshooting."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Range, StepContext
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Drone

SHORTEST_S = 1e-5  # a lag below this is none: nothing at 100 Hz shows it
CRITICAL = 1e-6  # of the squared damping about 1: the series is exact to rounding


class SecondOrderRates(NamedTuple):
    """Lag of a rate that changes evenly, s, and damping: below 1 it overshoots."""

    lag_s: Scalar = 0.0
    damping: Scalar = 0.7


class Turning(NamedTuple):
    """Body rates, rad/s, and their slopes, rad/s^2."""

    rates_b: Vec3
    slopes_b: Vec3


class _Response(NamedTuple):
    """What remains after a step of an offset from the input and of a slope, in offset and in slope."""

    offset: Scalar
    offset_of_slope: Scalar
    slope_of_offset: Scalar
    slope: Scalar


def start(loop: SecondOrderRates, drone: Drone) -> Turning:
    """Return the memory of an episode that begins: a rate that has been held."""
    return Turning(drone.rates_b, Vec3(*(jnp.zeros_like(rate) for rate in drone.rates_b)))


def _response(loop: SecondOrderRates, dt: Scalar) -> _Response:
    """Return the transition of a held input: the exponential of [[0, 1], [-wn^2, -2 zeta wn]] dt."""
    is_lag = loop.lag_s > SHORTEST_S
    frequency = 2.0 * loop.damping / jnp.where(is_lag, loop.lag_s, 1.0)
    decay = loop.damping * frequency
    spread = frequency * frequency * (loop.damping * loop.damping - 1.0)
    size = jnp.sqrt(jnp.maximum(jnp.abs(spread), CRITICAL * frequency * frequency))
    # exp(-decay t) cosh and sinh, apart so that neither overflows; cos and sin where it oscillates.
    slow, fast = jnp.exp(-(decay - size) * dt), jnp.exp(-(decay + size) * dt)
    fade = jnp.exp(-decay * dt)
    even = jnp.where(spread > 0.0, 0.5 * (slow + fast), fade * jnp.cos(size * dt))
    odd = jnp.where(spread > 0.0, 0.5 * (slow - fast), fade * jnp.sin(size * dt)) / size
    found = (even + decay * odd, odd, -frequency * frequency * odd, even - decay * odd)
    return _Response(*(jnp.where(is_lag, value, 0.0) for value in found))


def _rates(loop: SecondOrderRates, memory: Turning, rates_b: Vec3, context: StepContext) -> Vec3:
    left = _response(loop, context.dt)
    axes = zip(rates_b, memory.rates_b, memory.slopes_b, strict=True)
    return Vec3(*(new + left.offset * (old - new) + left.offset_of_slope * slope for new, old, slope in axes))


def remember(loop: SecondOrderRates, memory: Turning, context: StepContext) -> Turning:
    """Return the memory after a step; the input of the step is found back from the rates it led to."""
    left = _response(loop, context.dt)

    def slope_after(rate: Scalar, old: Scalar, slope: Scalar) -> Scalar:
        held = (rate - left.offset * old - left.offset_of_slope * slope) / (1.0 - left.offset)
        return left.slope_of_offset * (old - held) + left.slope * slope

    axes = zip(context.rates_b, memory.rates_b, memory.slopes_b, strict=True)
    return Turning(context.rates_b, Vec3(*(slope_after(*axis) for axis in axes)))


SECOND_ORDER_RATES = Effect(
    name="second_order_rates",
    parameters=SecondOrderRates,
    ranges={"lag_s": Range(0.0, 0.1, "s"), "damping": Range(0.2, 3.0, "1")},
    notable={"lag_s": 0.005},
    equation=r"\frac{\ddot{\omega}}{\omega_n^2} + \text{lag}\, \dot{\omega} + \omega = \omega_\text{stick}, "
    r"\quad \omega_n = \frac{2\, \text{damping}}{\text{lag}}",
    source="a second-order servo, exact for an input held over the step; assumption: the same on all axes",
    probes={"lag_s": (0.003, 0.01, 0.03)},
    shapes=("damping",),
    rates=_rates,
    start=start,
    remember=remember,
)
