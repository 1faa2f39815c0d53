"""Sensor noise: the policy sees a slightly displaced drone."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.effects import Range
from flytrack_env.fusion import compute_once
from flytrack_env.params import EnvParams
from flytrack_env.quaternion import Quaternion, Scalar, Vec3
from flytrack_env.randomness import Draws, next_word
from flytrack_env.state import Action, Drone
from flytrack_env.wrappers.base import Wrapper


class NoiseParams(NamedTuple):
    """Standard deviations of white noise on the drone that the policy sees, per component.

    The defaults are those of a good motion capture or visual-inertial estimate and a filtered gyro.

    Attributes:
        position_m, velocity_m_per_s: world.
        attitude_deg: a turn about each body axis.
        rates_rad_per_s: body.
        acceleration_m_per_s2: of an accelerometer, body, where one is observed.
    """

    position_m: Scalar = 0.02
    velocity_m_per_s: Scalar = 0.05
    attitude_deg: Scalar = 0.5
    rates_rad_per_s: Scalar = 0.1
    acceleration_m_per_s2: Scalar = 0.5


RANGES: Mapping[str, Range] = {
    "position_m": Range(0.0, 1e6, "m"),
    "velocity_m_per_s": Range(0.0, 1e6, "m/s"),
    "attitude_deg": Range(0.0, 180.0, "deg"),
    "rates_rad_per_s": Range(0.0, 1e6, "rad/s"),
    "acceleration_m_per_s2": Range(0.0, 1e6, "m/s^2"),
}


class NoisyState(NamedTuple):
    """The inner state, and the word that this step's noise is drawn from."""

    inner: Any
    word: jax.Array


class ObservationNoise(Wrapper):
    """Add white noise to what the sensors report of position, velocity, attitude and body rates.

    The standard deviations are ``params.wrappers["observation_noise"]``, a ``NoiseParams``.
    Independent in every step and episode; the observation of a state is always the same, so that
    ``final_observation`` is what the policy would have seen.
    """

    key = "observation_noise"
    needs_rows = True

    def own_defaults(self) -> NoiseParams:
        """Return the default standard deviations."""
        return NoiseParams()

    def check_params(self, params: EnvParams) -> None:
        """Raise ValueError for a deviation beyond ``RANGES``, or what the inner check refuses."""
        super().check_params(params)
        self.check_ranges(params, RANGES)

    def begin(self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0) -> NoisyState:
        """Return the state of an episode that begins, with noise of its own."""
        inner = self.env.begin(drone, gate_index, params, seed)
        return NoisyState(inner, Draws(seed).word("observation_noise"))

    def advance(
        self, state: NoisyState, command: Action, params: EnvParams
    ) -> tuple[NoisyState, jax.Array, jax.Array, dict[str, Any]]:
        """Return the outcome of the inner environment, with another draw of noise to come."""
        inner, reward, terminated, info = self.env.advance(state.inner, command, params)
        return NoisyState(inner, next_word(state.word)), reward, terminated, info

    def observe_drone(self, drone: Drone, state: NoisyState, params: EnvParams) -> list[jax.Array]:
        """Return the inner observation of a drone as noisy sensors report it.

        Attitude is disturbed before the observation is made of it. What is a vector is disturbed
        after: white noise of equal deviation along all axes is the same in every frame, and this is
        cheaper.
        """
        noise, draws = self.own_params(params), Draws(state.word)
        turned = compute_once(_turn(drone.quat, draws, noise.attitude_deg))
        values = self.env.observe_drone(drone._replace(quat=turned), state.inner, params)
        deviations = {
            "position": noise.position_m,
            "velocity": noise.velocity_m_per_s,
            "rates": noise.rates_rad_per_s,
            "accelerometer": noise.acceleration_m_per_s2,
        }
        row = 0
        for entry in self.observation_table:
            if entry.key in deviations:
                deviation = deviations[entry.key] / entry.scale
                for i in range(row, row + entry.size):
                    noisy = values[i] + deviation * draws.normal(f"{entry.key}_{i - row}")
                    values[i] = jnp.clip(noisy, -entry.limit, entry.limit)
            row += entry.size
        return values


def _turn(quat: Quaternion, draws: Draws, deviation_deg: Scalar) -> Quaternion:
    """Return an attitude turned by a random angle about each body axis.

    The rotation of a vector t is (1 - t^2, 2 t) / (1 + t^2), about 4 t for small ones: a unit
    quaternion for any t without a normalisation, so that no noise changes no bit.
    """
    normals = Vec3(*(draws.normal(f"attitude_{axis}") for axis in "xyz"))
    quarter_turn = compute_once(normals.scale(0.25 * jnp.deg2rad(deviation_deg)))
    square = quarter_turn.dot(quarter_turn)
    scale = 1.0 / (1.0 + square)
    return quat.multiply(Quaternion((1.0 - square) * scale, *quarter_turn.scale(2.0 * scale)))
