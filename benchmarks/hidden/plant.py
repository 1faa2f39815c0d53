"""The plant: the handout's step in plain floats, with hooks for the hidden effects."""

import math
from typing import NamedTuple

import numpy as np

from benchmarks.hidden.effects import (
    AIR_VELOCITY,
    COMMAND_EFFECTS,
    FORCE_EFFECTS,
    RATE_EFFECTS,
    THRUST_EFFECTS,
    Sticks,
)
from benchmarks.hidden.outside import FirstOrderNoise, command_hook, vector_hook
from benchmarks.hidden.truth import DT_S, Truth
from benchmarks.hidden.vectors import (
    Quaternion,
    Vector,
    add,
    integrate_attitude,
    rotation,
    scale,
    to_body,
    to_world,
)

SECONDS_PER_MINUTE = 60.0


class Start(NamedTuple):
    """The start of a flight, at rest in the air: position, m; heading, rad; voltage without load, V."""

    pos_w: Vector
    heading: float
    open_v: float
    thrust_stick: float


class Plant:
    """A drone in flight; attributes are its state, updated by ``step``.

    pos_w, vel_w, acc_w: m, m/s, m/s^2. quat: body to world; rows: of its matrix, before the step.
    rates_b: rad/s. force_b: specific force in the attitude before the step, m/s^2. applied: lagged
    sticks. battery_v: V, under load. thrust_acc: thrust over mass, m/s^2. airspeed_b: m/s. time_s: s.
    """

    def __init__(
        self,
        truth: Truth,
        start: Start,
        rng: np.random.Generator,
        duration_s: float = 60.0,
        centre_w: Vector = (0.0, 0.0, 0.0),
    ):
        """duration_s, centre_w: of the flight, for effects outside the list."""
        self.truth, self.duration_s, self.centre_w = truth, duration_s, centre_w
        self.pos_w, self.vel_w, self.acc_w = start.pos_w, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        self.quat: Quaternion = (math.cos(0.5 * start.heading), 0.0, 0.0, math.sin(0.5 * start.heading))
        self.rates_b: Vector = (0.0, 0.0, 0.0)
        self.rows = rotation(self.quat)
        self.force_b, self.airspeed_b, self.thrust_acc = (0.0, 0.0, truth.gravity), (0.0, 0.0, 0.0), 0.0
        self.applied: Sticks = (0.0, 0.0, 0.0, start.thrust_stick)
        self.applied_before = self.applied
        self.full_rates = tuple(math.radians(rate) for rate in truth.max_rate)
        self._sag_v = truth.effects.get("voltage_sag", {}).get("at_full_v", 0.0)
        self._open_v, self.time_s = start.open_v, 0.0
        self.battery_v = self._loaded_v()
        self._air_w = tuple(truth.effects.get("wind", {}).get(name, 0.0) for name in AIR_VELOCITY)
        self._hooks(rng)

    def _hooks(self, rng: np.random.Generator) -> None:
        """Collect the hooks of each stage, in the order of its table."""
        effects, outside, gust = self.truth.effects, self.truth.outside, self.truth.gust

        def made(makers: dict) -> list:
            return [make(effects[name]) for name, make in makers.items() if name in effects]

        self._command_hooks, self._rate_hooks = made(COMMAND_EFFECTS), made(RATE_EFFECTS)
        self._thrust_hooks, self._force_hooks = made(THRUST_EFFECTS), made(FORCE_EFFECTS)
        self._turn_hooks = []
        if outside is not None and outside.kind == "command":
            self._command_hooks.append(command_hook(outside, self.truth))
        elif outside is not None:
            hooks = self._turn_hooks if outside.channel == "rate" else self._force_hooks
            hooks.append(vector_hook(outside, rng))
        if gust is not None:
            air, turns = (FirstOrderNoise(gust.time_constant, rng) for _ in range(2))
            self._force_hooks.append(
                lambda plant: to_body(plant.rows, scale(gust.std, air.step())),
            )
            if gust.rate_std:
                self._turn_hooks.append(lambda plant: scale(gust.rate_std, turns.step()))
        asymmetry = effects.get("thrust_lag_asymmetry", {}).get("ratio", 1.0)
        self._shares = tuple(-math.expm1(-DT_S / tau) for tau in self.truth.tau)
        self._falling_share = -math.expm1(-DT_S / (asymmetry * self.truth.tau[3]))

    def _loaded_v(self) -> float:
        return self._open_v - self._sag_v * (0.5 + 0.5 * self.applied[3]) ** 2

    def step(self, command: Sticks) -> None:
        """Fly 10 ms under a command in [-1, 1]."""
        for hook in self._command_hooks:
            command = hook(self, command)
        self._lag(command)
        self.rows = rotation(self.quat)
        self.airspeed_b = to_body(
            self.rows, tuple(v - w for v, w in zip(self.vel_w, self._air_w, strict=True))
        )
        thrust = self.truth.thrust(self.applied[3], self.battery_v)
        for hook in self._thrust_hooks:
            thrust = hook(self, thrust)
        self.thrust_acc = thrust / self.truth.mass
        rates = tuple(full * stick for full, stick in zip(self.full_rates, self.applied, strict=False))
        for hook in self._rate_hooks:
            rates = hook(self, rates)
        for hook in self._turn_hooks:
            rates = add(rates, hook(self))
        force = (0.0, 0.0, self.thrust_acc)
        for hook in self._force_hooks:
            force = add(force, hook(self))
        self._move(force, rates)

    def _lag(self, command: Sticks) -> None:
        self.applied_before = before = self.applied
        shares = self._shares
        last = self._falling_share if command[3] < before[3] else shares[3]
        self.applied = (
            before[0] + shares[0] * (command[0] - before[0]),
            before[1] + shares[1] * (command[1] - before[1]),
            before[2] + shares[2] * (command[2] - before[2]),
            before[3] + last * (command[3] - before[3]),
        )

    def _move(self, force_b: Vector, rates_b: Vector) -> None:
        """Integrate as the handout does: acceleration in the old attitude, rates after the step."""
        x, y, z = to_world(self.rows, force_b)
        acc = (x, y, z - self.truth.gravity)
        half = 0.5 * DT_S * DT_S
        self.pos_w = tuple(
            p + v * DT_S + a * half for p, v, a in zip(self.pos_w, self.vel_w, acc, strict=True)
        )
        self.vel_w = tuple(v + a * DT_S for v, a in zip(self.vel_w, acc, strict=True))
        self.quat = integrate_attitude(self.quat, rates_b, DT_S)
        self.acc_w, self.force_b, self.rates_b = acc, force_b, rates_b
        self._open_v -= self.truth.drain / SECONDS_PER_MINUTE * DT_S
        self.battery_v = self._loaded_v()
        self.time_s += DT_S
