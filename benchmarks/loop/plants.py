"""Hidden plants that an environment can fly, drawn from a seed: ``benchmarks.hidden`` written for JAX.

Nothing but the layout of the state is shared with the simulator. A test compares each step with the plain
floats of ``benchmarks.hidden.plant``.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.hidden import EFFECTS as EFFECT_RANGES
from benchmarks.hidden import Truth, draw_effect, draw_outside
from benchmarks.hidden.effects import LIFT_SPEED
from benchmarks.hidden.plant import SECONDS_PER_MINUTE
from benchmarks.hidden.truth import DT_S
from benchmarks.loop.outside import SIGNALS, push_of
from flytrack_env import nominal_parameters
from flytrack_env.dynamics import ModelParameters
from flytrack_env.plants import Plant
from flytrack_env.quaternion import Scalar
from flytrack_env.state import APPLIED_ACTION, POSITION, QUATERNION, VELOCITY, Action, Drone, pack, unpack

EFFECTS = (
    "command_delay",
    "thrust_lag_asymmetry",
    "rate_scale",
    "thrust_scale",
    "translational_lift",
    "linear_drag",
    "quadratic_drag",
    "rotor_drag",
    "thrust_tilt",
    "voltage_sag",
)
LAG_SPREAD, THRUST_SPREAD = 0.2, 0.05  # |ln factor| of the lags, and of the thrust map, at most
LARGE = 2.0 / 3.0  # smallest size drawn, as a share of the log range
# Hidden effects of the first plants: named, or a number of random ones.
HIDDEN = (("command_delay",), ("quadratic_drag",), ("thrust_scale",), 2, 3)
LAW_AMPLITUDES = (1.0, 3.0)  # times the sensor's noise, as in benchmarks.beyond
MOST_STEPS = 8  # commands that a delay remembers
LATER = 5  # random effects of all later plants


class HiddenState(NamedTuple):
    """A plant in flight: the handout's state (21,), the battery without load (), V, and past commands.

    past: (MOST_STEPS, 4), newest first. num_past: how many of them are valid.
    """

    x: jax.Array
    open_v: jax.Array
    past: jax.Array
    num_past: jax.Array


class HiddenPlant(Plant):
    """A plant that flies a ``Truth`` with effects of ``EFFECTS`` and a law of ``outside.SIGNALS``, if any.

    Its state is a ``HiddenState``.
    """

    dt = DT_S

    def __init__(self, truth: Truth):
        self.truth = truth

    def __repr__(self) -> str:
        return f"HiddenPlant({self.truth.text()})"

    def _of(self, name: str) -> Mapping[str, float]:
        return self.truth.effects.get(name, {})

    def _sag_v(self, thrust_stick: Scalar) -> Scalar:
        return self._of("voltage_sag").get("at_full_v", 0.0) * (0.5 + 0.5 * thrust_stick) ** 2

    def reset(self, drone: Drone, model: ModelParameters) -> HiddenState:
        """Return the plant with a drone in it, nothing remembered; ``model`` is not used."""
        del model
        x = pack(jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), drone))
        open_v = jnp.asarray(drone.battery_v + self._sag_v(drone.applied.thrust), jnp.float32)
        return HiddenState(x, open_v, jnp.zeros((MOST_STEPS, 4), jnp.float32), jnp.int32(0))

    def drone(self, state: HiddenState) -> Drone:
        """Return the drone."""
        return unpack(state.x)

    def step(self, state: HiddenState, command: Action, dt: Scalar, model: ModelParameters) -> HiddenState:
        """Return the plant 0.01 s later under a held command in [-1, 1]; ``dt``, ``model`` are not used."""
        del dt, model
        newest = jnp.clip(jnp.stack([jnp.asarray(stick, jnp.float32) for stick in command]), -1.0, 1.0)
        past = jnp.concatenate([newest[None], state.past[:-1]])
        num_past = jnp.minimum(state.num_past + 1, MOST_STEPS)
        x = state.x
        applied = self._lagged(x[APPLIED_ACTION], self._delayed(past, num_past))
        to_world = _rotation(x[QUATERNION])
        airspeed_b = x[VELOCITY] @ to_world
        thrust_acc = self._thrust_acc(applied[3], x[20], airspeed_b)
        gravity_w = jnp.array([0.0, 0.0, self.truth.gravity], jnp.float32)
        force_b, rates_b = self._force_b(airspeed_b, thrust_acc), self._rates_b(applied)
        if self.truth.outside is not None:
            force, rates = push_of(self.truth.outside, x[POSITION], to_world, airspeed_b)
            force_b, rates_b = force_b + force, rates_b + rates
        acc_w = to_world @ force_b - gravity_w
        open_v = state.open_v - self.truth.drain * DT_S / SECONDS_PER_MINUTE
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

    def _delayed(self, past: jax.Array, num_past: jax.Array) -> jax.Array:
        """Return the delayed command, (4,): u(t - delay_s), averaged over the step."""
        part, whole = math.modf(self._of("command_delay").get("delay_s", 0.0) / DT_S)
        newer, older = (past[jnp.minimum(int(whole) + more, num_past - 1)] for more in (0, 1))
        return (1.0 - part) * newer + part * older

    def _lagged(self, applied: jax.Array, command: jax.Array) -> jax.Array:
        """Return the applied action (4,); thrust falls with a time constant of its own."""
        shares = jnp.array([-math.expm1(-DT_S / tau) for tau in self.truth.tau], jnp.float32)
        ratio = self._of("thrust_lag_asymmetry").get("ratio", 1.0)
        falling = shares.at[3].set(-math.expm1(-DT_S / (ratio * self.truth.tau[3])))
        return applied + jnp.where(command < applied, falling, shares) * (command - applied)

    def _rates_b(self, applied: jax.Array) -> jax.Array:
        """Return the body rates (3,), rad/s."""
        factors = self._of("rate_scale")
        full = [
            factors.get(axis, 1.0) * math.radians(rate)
            for axis, rate in zip(("roll", "pitch", "yaw"), self.truth.max_rate, strict=True)
        ]
        return jnp.array(full, jnp.float32) * applied[:3]

    def _thrust_acc(self, stick: jax.Array, battery_v: jax.Array, airspeed_b: jax.Array) -> jax.Array:
        """Return thrust over mass, m/s^2."""
        one, linear, square, cube, volt, both = self.truth.coeffs
        newton = one + stick * (linear + stick * (square + stick * cube)) + battery_v * (volt + stick * both)
        edgewise = airspeed_b[0] ** 2 + airspeed_b[1] ** 2
        lift = 1.0 - self._of("translational_lift").get("gain", 0.0) * jnp.expm1(-edgewise / LIFT_SPEED**2)
        return newton * self._of("thrust_scale").get("factor", 1.0) * lift / self.truth.mass

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


def _size(name: str, rng: np.random.Generator) -> float:
    """Return a size from the upper third of its range."""
    low, high = math.log(EFFECT_RANGES[name].low), math.log(EFFECT_RANGES[name].high)
    return math.exp(rng.uniform(low + LARGE * (high - low), high))


def _draw_values(name: str, rng: np.random.Generator) -> dict[str, float]:
    if name == "thrust_scale":  # a loss: old packs, worn propellers and payload do not add thrust
        return {"factor": math.exp(-_size(name, rng))}
    return draw_effect(name, rng, _size(name, rng))


def draw_base(rng: np.random.Generator) -> Truth:
    """Return the handout's nominal drone with other lags and another thrust map."""
    nominal = nominal_parameters()
    factors = np.exp(rng.uniform(-LAG_SPREAD, LAG_SPREAD, 4))
    thrust = math.exp(rng.uniform(-THRUST_SPREAD, THRUST_SPREAD))
    return Truth(
        tau=tuple(float(tau * factor) for tau, factor in zip(nominal.tau, factors, strict=True)),
        coeffs=tuple(float(thrust * one) for one in nominal.thrust_coeffs),
        max_rate=tuple(float(rate) for rate in nominal.max_rate),
        drain=float(nominal.battery_drain_v_per_min),
        mass=float(nominal.m),
        gravity=float(nominal.g),
    )


def draw_plant(number: int, seed: int) -> Truth:
    """Return a plant by its number, from 0: its effects follow ``HIDDEN``, their sizes the seed."""
    rng = np.random.default_rng([seed, number])
    hidden = HIDDEN[number] if number < len(HIDDEN) else LATER
    if isinstance(hidden, int):
        hidden = tuple(str(name) for name in rng.choice(EFFECTS, size=hidden, replace=False))
    base = draw_base(rng)
    return replace(base, effects={name: _draw_values(name, rng) for name in hidden})


def draw_plant_with_law(number: int, seed: int) -> Truth:
    """Return a plant by its number, from 0, with a law outside the package's list; kinds take turns."""
    rng = np.random.default_rng([seed, number, len(SIGNALS)])
    kind, (low, high) = tuple(SIGNALS)[number % len(SIGNALS)], np.log(LAW_AMPLITUDES)
    outside = draw_outside(rng, kind, math.exp(rng.uniform(low, high)))
    return replace(draw_base(rng), outside=outside)
