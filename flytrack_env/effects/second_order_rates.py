"""A rate loop with more than one lag: inertia, a filter, or overshoot."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Flight, Range
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Drone

SHORTEST_S = 1e-5  # a lag below this is none: nothing at 100 Hz shows it


class SecondOrderRates(NamedTuple):
    """A second lag of the body rates, s, and a lead, s: a lead larger than the lag overshoots."""

    lag_s: Scalar = 0.0
    lead_s: Scalar = 0.0


class Filtered(NamedTuple):
    """The rates behind the second lag, before the lead, rad/s."""

    rates_b: Vec3


def start(loop: SecondOrderRates, drone: Drone) -> Filtered:
    """Return the memory of an episode that begins: a rate that has been held."""
    return Filtered(drone.rates_b)


def _lagged(loop: SecondOrderRates, memory: Filtered, rates_b: Vec3, flight: Flight) -> Vec3:
    is_lag = loop.lag_s > SHORTEST_S
    # Guard inside the where: the slope of exp(-dt / 0) is not a number even where it is not selected.
    keep = jnp.where(is_lag, jnp.exp(-flight.dt / jnp.where(is_lag, loop.lag_s, 1.0)), 0.0)
    return Vec3(*(new + keep * (old - new) for new, old in zip(rates_b, memory.rates_b, strict=True)))


def _rates(loop: SecondOrderRates, memory: Filtered, rates_b: Vec3, flight: Flight) -> Vec3:
    lagged = _lagged(loop, memory, rates_b, flight)
    gain = loop.lead_s / flight.dt
    return Vec3(*(new + gain * (new - old) for new, old in zip(lagged, memory.rates_b, strict=True)))


def remember(loop: SecondOrderRates, memory: Filtered, flight: Flight) -> Filtered:
    """Return the memory after a step: what the lag made of the rates, found back from the lead."""
    gain = loop.lead_s / flight.dt
    back = 1.0 / (1.0 + gain)
    pairs = zip(flight.rates_b, memory.rates_b, strict=True)
    return Filtered(Vec3(*(back * (rate + gain * old) for rate, old in pairs)))


SECOND_ORDER_RATES = Effect(
    name="second_order_rates",
    parameters=SecondOrderRates,
    ranges={"lag_s": Range(0.0, 0.1, "s"), "lead_s": Range(0.0, 0.1, "s")},
    equation="omega = (1 + lead d/dt) y, y the rates behind a further lag lag_s",
    source="assumption: the same on all axes; a second real pole and a zero",
    probes={"lag_s": (0.003, 0.01, 0.03)},
    rates=_rates,
    start=start,
    remember=remember,
)
