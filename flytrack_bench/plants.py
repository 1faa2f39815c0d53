"""Hidden plants: quadcopters whose equations share nothing with the simulator but the layout of the state."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.dynamics import ModelParameters
from flytrack_env.plants import Plant
from flytrack_env.quaternion import Scalar
from flytrack_env.state import APPLIED_ACTION, POSITION, QUATERNION, VELOCITY, Action, Drone, pack, unpack

DT_S, SECONDS_PER_MINUTE = 0.01, 60.0
LIFT_SPEED = 8.0  # m/s, airspeed at which translational lift has 1 - 1/e of its gain
MOST_STEPS = 8  # commands that a delay remembers


@dataclass(frozen=True)
class Craft:
    """Parameters of a plant.

    tau: s. coeffs: N, of 1, u, u^2, u^3, V, u V. max_rate: deg/s. drain: V/min. mass: kg. gravity: m/s^2.
    effects: name -> parameter -> value: command_delay, thrust_lag_asymmetry, rate_scale, thrust_scale,
    translational_lift, linear_drag, quadratic_drag, rotor_drag, thrust_tilt, voltage_sag.
    """

    tau: tuple[float, ...]
    coeffs: tuple[float, ...]
    max_rate: tuple[float, ...]
    drain: float
    mass: float
    gravity: float
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


class HiddenState(NamedTuple):
    """A plant in flight: the handout's state (21,), the battery without load (), V, and past commands.

    past: (MOST_STEPS, 4), newest first. num_past: how many of them are valid.
    """

    x: jax.Array
    open_v: jax.Array
    past: jax.Array
    num_past: jax.Array


class HiddenPlant(Plant):
    """A plant that flies a craft; its state is a ``HiddenState``."""

    dt = DT_S

    def __init__(self, craft: Craft):
        self.craft = craft

    def __repr__(self) -> str:
        return f"HiddenPlant({self.craft})"

    def _of(self, name: str) -> Mapping[str, float]:
        return self.craft.effects.get(name, {})

    def _sag_v(self, thrust_stick: Scalar) -> Scalar:
        return self._of("voltage_sag").get("at_full_v", 0.0) * (0.5 + 0.5 * thrust_stick) ** 2

    def reset(self, drone: Drone, model: ModelParameters) -> HiddenState:
        """Return the plant with a drone in it, nothing remembered; ``model`` is not used."""
        x = pack(jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), drone))
        open_v = jnp.asarray(drone.battery_v + self._sag_v(drone.applied.thrust), jnp.float32)
        return HiddenState(x, open_v, jnp.zeros((MOST_STEPS, 4), jnp.float32), jnp.int32(0))

    def drone(self, state: HiddenState) -> Drone:
        """Return the drone."""
        return unpack(state.x)

    def step(self, state: HiddenState, command: Action, dt: Scalar, model: ModelParameters) -> HiddenState:
        """Return the plant 0.01 s later under a held command in [-1, 1]; ``dt``, ``model`` are not used."""
        newest = jnp.clip(jnp.stack([jnp.asarray(stick, jnp.float32) for stick in command]), -1.0, 1.0)
        past = jnp.concatenate([newest[None], state.past[:-1]])
        num_past = jnp.minimum(state.num_past + 1, MOST_STEPS)
        x = state.x
        applied = self._lagged(x[APPLIED_ACTION], self._delayed(past, num_past))
        to_world = _rotation(x[QUATERNION])
        airspeed_b = x[VELOCITY] @ to_world
        thrust_acc = self._thrust_acc(applied[3], x[20], airspeed_b)
        gravity_w = jnp.array([0.0, 0.0, self.craft.gravity], jnp.float32)
        force_b, rates_b = self._force_b(airspeed_b, thrust_acc), self._rates_b(applied)
        force, rates = self.push(x[POSITION], to_world, airspeed_b)
        force_b, rates_b = force_b + force, rates_b + rates
        acc_w = to_world @ force_b - gravity_w
        open_v = state.open_v - self.craft.drain * DT_S / SECONDS_PER_MINUTE
        after = [
            x[POSITION] + x[VELOCITY] * DT_S + acc_w * (0.5 * DT_S * DT_S),
            x[VELOCITY] + acc_w * DT_S,
            acc_w,
            _turned(x[QUATERNION], rates_b),
            rates_b,
            applied,
            (open_v - self._sag_v(applied[3]))[None],
        ]
        return HiddenState(jnp.concatenate(after), open_v, past, num_past)

    def push(
        self, pos_w: jax.Array, to_world: jax.Array, airspeed_b: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return what else adds to specific force, (3,) m/s^2, and body rates, (3,) rad/s: nothing."""
        return jnp.zeros(3, jnp.float32), jnp.zeros(3, jnp.float32)

    def _delayed(self, past: jax.Array, num_past: jax.Array) -> jax.Array:
        """Return the delayed command, (4,): u(t - delay_s), averaged over the step."""
        part, whole = math.modf(self._of("command_delay").get("delay_s", 0.0) / DT_S)
        newer, older = (past[jnp.minimum(int(whole) + more, num_past - 1)] for more in (0, 1))
        return (1.0 - part) * newer + part * older

    def _lagged(self, applied: jax.Array, command: jax.Array) -> jax.Array:
        """Return the applied action (4,); thrust falls with a time constant of its own."""
        shares = jnp.array([-math.expm1(-DT_S / tau) for tau in self.craft.tau], jnp.float32)
        ratio = self._of("thrust_lag_asymmetry").get("ratio", 1.0)
        falling = shares.at[3].set(-math.expm1(-DT_S / (ratio * self.craft.tau[3])))
        return applied + jnp.where(command < applied, falling, shares) * (command - applied)

    def _rates_b(self, applied: jax.Array) -> jax.Array:
        """Return the body rates (3,), rad/s."""
        factors = self._of("rate_scale")
        full = [
            factors.get(axis, 1.0) * math.radians(rate)
            for axis, rate in zip(("roll", "pitch", "yaw"), self.craft.max_rate, strict=True)
        ]
        return jnp.array(full, jnp.float32) * applied[:3]

    def _thrust_acc(self, stick: jax.Array, battery_v: jax.Array, airspeed_b: jax.Array) -> jax.Array:
        """Return thrust over mass, m/s^2."""
        one, linear, square, cube, volt, both = self.craft.coeffs
        newton = one + stick * (linear + stick * (square + stick * cube)) + battery_v * (volt + stick * both)
        edgewise = airspeed_b[0] ** 2 + airspeed_b[1] ** 2
        lift = 1.0 - self._of("translational_lift").get("gain", 0.0) * jnp.expm1(-edgewise / LIFT_SPEED**2)
        return newton * self._of("thrust_scale").get("factor", 1.0) * lift / self.craft.mass

    def _force_b(self, airspeed_b: jax.Array, thrust_acc: jax.Array) -> jax.Array:
        """Return the specific force of thrust and air, (3,) m/s^2, body."""

        def coefficients(name: str, prefix: str) -> jax.Array:
            return jnp.array([self._of(name).get(f"{prefix}_{axis}", 0.0) for axis in "xyz"], jnp.float32)

        h = self._of("rotor_drag").get("h", 0.0)
        tilt = self._of("thrust_tilt")
        leaning = jnp.array([tilt.get("towards_x", 0.0), tilt.get("towards_y", 0.0), 1.0], jnp.float32)
        return (
            thrust_acc * leaning
            - coefficients("linear_drag", "d") * airspeed_b
            - coefficients("quadratic_drag", "k") * jnp.abs(airspeed_b) * airspeed_b
            - h * thrust_acc * airspeed_b * jnp.array([1.0, 1.0, 0.0], jnp.float32)
        )


def _rotation(quat: jax.Array) -> jax.Array:
    """Return the matrix (3, 3) from body to world of a unit quaternion (w, x, y, z)."""
    w, axis = quat[0], quat[1:]
    cross = jnp.cross(jnp.eye(3, dtype=quat.dtype), axis)  # its rows are e_i x axis, so it is [axis]_x
    return (2.0 * w * w - 1.0) * jnp.eye(3, dtype=quat.dtype) + 2.0 * (jnp.outer(axis, axis) + w * cross)


def _turned(quat: jax.Array, rates_b: jax.Array) -> jax.Array:
    """Return the attitude a step later: the handout's equation 2, normalised."""
    w, axis = quat[0], quat[1:]
    spin = jnp.concatenate([-(axis @ rates_b)[None], w * rates_b + jnp.cross(axis, rates_b)])
    moved = quat + 0.5 * DT_S * spin
    return moved / jnp.linalg.norm(moved)
