"""Gyro and accelerometer that are late: their filters, the bus, the estimator's queue."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import (
    AccelerometerContext,
    Effect,
    Memory,
    Range,
    Search,
    StepContext,
)
from flytrack_env.effects.command_delay import DEFAULT_DELAY_STEPS, late
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Drone


class ImuLatency(NamedTuple):
    """Delay of both sensors, s; need not be whole steps."""

    latency_s: Scalar = 0.0


class PastReadings(NamedTuple):
    """True body rates, rad/s, and specific forces, m/s^2, body frame; the present ones first.

    Attributes:
        rate_bends_b, force_bends_b: how far those in the middle of a continuous step are from the
            mean of its ends, of the same steps; the last one is not used.
        is_fresh: no step was made yet, and no force is known.
    """

    rates_b: tuple[Vec3, ...]
    forces_b: tuple[Vec3, ...]
    rate_bends_b: tuple[Vec3, ...]
    force_bends_b: tuple[Vec3, ...]
    is_fresh: Scalar


def start(latency: ImuLatency, drone: Drone, num_steps: int) -> PastReadings:
    """Return the memory of a new episode: rates that have always been held, and no forces."""
    zero = Vec3(*(jnp.zeros_like(rate) for rate in drone.rates_b))
    size = min(num_steps, DEFAULT_DELAY_STEPS) + 1
    none = (zero,) * size
    return PastReadings(
        (drone.rates_b,) * size, none, none, none, jnp.ones_like(drone.battery_v, bool)
    )


def _late(
    latency: ImuLatency,
    present: Vec3,
    past: Sequence[Vec3],
    bends: Sequence[Vec3],
    dt: Scalar,
) -> Vec3:
    """Return the reading of the delayed time: on the parabola of its step, a line in a simulator.

    Args:
        past: the readings with the present ones first, as they were without later effects.
    """
    by_axis = zip(*(present, *past[1:]), strict=True)
    line = Vec3(*(late(values, latency.latency_s, dt) for values in by_axis))
    steps = latency.latency_s / dt
    for age, bend in enumerate(bends[:-1]):
        share = jnp.clip(steps - age, 0.0, 1.0)
        line = line + bend.scale(4.0 * share * (1.0 - share))
    return line


def _gyro(latency: ImuLatency, past: PastReadings, rates_b: Vec3, dt: Scalar) -> Vec3:
    return _late(latency, rates_b, past.rates_b, past.rate_bends_b, dt)


def _accelerometer(
    latency: ImuLatency, past: PastReadings, force_b: Vec3, context: AccelerometerContext
) -> Vec3:
    return _late(latency, force_b, past.forces_b, past.force_bends_b, context.dt)


def remember(latency: ImuLatency, past: PastReadings, context: StepContext) -> PastReadings:
    """Return the memory after a step.

    Before the first step, the force is taken to have been that of the first step.
    """

    def or_first(force_b: Vec3) -> Vec3:
        pairs = zip(context.force_b, force_b, strict=True)
        return Vec3(*(jnp.where(past.is_fresh, first, known) for first, known in pairs))

    def bend(first: Vec3, middle: Vec3, last: Vec3) -> Vec3:
        return middle - (first + last).scale(0.5)

    forces_b = tuple(or_first(force_b) for force_b in past.forces_b[:-1])
    rate_bend_b = force_bend_b = Vec3(*(jnp.zeros_like(rate) for rate in context.rates_b))
    if context.middle_b is not None:
        middle_rates_b, middle_force_b = context.middle_b
        rate_bend_b = bend(past.rates_b[0], middle_rates_b, context.rates_b)
        force_bend_b = bend(forces_b[0], middle_force_b, context.force_b)
    return PastReadings(
        rates_b=(context.rates_b, *past.rates_b[:-1]),
        forces_b=(context.force_b, *forces_b),
        rate_bends_b=(rate_bend_b, *past.rate_bends_b[:-1]),
        force_bends_b=(force_bend_b, *past.force_bends_b[:-1]),
        is_fresh=jnp.zeros_like(past.is_fresh),
    )


IMU_LATENCY = Effect(
    name="imu_latency",
    parameters=ImuLatency,
    ranges={"latency_s": Range(0.0, 0.04, "s")},
    notable={"latency_s": 0.003},
    equation=r"\boldsymbol{\omega}_\text{measured}(t) = "
    r"\boldsymbol{\omega}(t - \text{latency}), \quad "
    r"\mathbf{f}_\text{measured}(t) = \mathbf{f}(t - \text{latency})",
    source="assumption: the same for both sensors; what imu_offset adds is not late",
    max_steps={"latency_s": DEFAULT_DELAY_STEPS},
    hooks={"gyro": _gyro, "accelerometer": _accelerometer},
    memory=Memory(start=start, remember=remember),
    search=Search(probes={"latency_s": (0.005, 0.01, 0.02, 0.03)}),
)
