"""A wrapper that checks every step of what is inside of it, before auto-reset hides how an episode ended."""

from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import VoltageSag
from flytrack_env.effects.voltage_sag import load_of
from flytrack_env.params import EnvParams
from flytrack_env.state import Action, Drone
from flytrack_env.wrappers import Wrapper

UNIT_TOLERANCE = 1e-5  # of a quaternion's norm
RESTING_TOLERANCE_V = 1e-5  # float32 at 24 V, where the load's part has to be added
# What the wrapper finds, each a bit of info["violations"], and what is seen from outside of it.
INSIDE = (
    "state not finite",
    "reward not finite",
    "info not finite",
    "attitude not a unit quaternion",
    "battery rises",
    "episode goes on beyond its time limit",
)
OUTSIDE = (
    "observation not finite",
    "observation outside its space",
    "NaN action without a crash",
)
VIOLATIONS = (*INSIDE, *OUTSIDE)


class CheckedState(NamedTuple):
    """The inner state, the steps of this episode, and what was wrong when it began, as bits."""

    inner: Any
    steps: jax.Array
    at_start: jax.Array


def as_bits(flags: tuple[jax.Array, ...]) -> jax.Array:
    """Return flags as the bits of an int32, the first the lowest."""
    return reduce(jnp.bitwise_or, (jnp.asarray(flag).astype(jnp.int32) << i for i, flag in enumerate(flags)))


def is_finite(tree: Any) -> jax.Array:
    """Return whether all numbers of a pytree of scalars are finite, a bool scalar."""
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    # 0 times what is not finite is not a number, nor is any sum with it: cheaper than as many tests.
    return sum(leaf * 0.0 for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)) == 0.0


def is_unit(drone: Drone) -> jax.Array:
    """Return whether the attitude's quaternion has the norm 1 within UNIT_TOLERANCE, a bool scalar."""
    squared = sum(component * component for component in drone.quat)
    return jnp.abs(jnp.sqrt(squared) - 1.0) <= UNIT_TOLERANCE


def is_risen(before: Drone, after: Drone, model: ModelParameters) -> jax.Array:
    """Return whether the battery's voltage rose, a bool scalar; where it drains upwards, whether it fell.

    Where load takes some of the voltage, it is that at rest. A drain below 0, which no battery has, is what a
    fit may find in a noisy log.
    """
    sign = jnp.where(model.battery_drain_v_per_min < 0.0, -1.0, 1.0)
    sag = next((effect for effect in model.effects if isinstance(effect, VoltageSag)), None)
    if sag is None:
        return sign * (after.battery_v - before.battery_v) > 0.0
    rest_v = [drone.battery_v + sag.at_full_v * load_of(drone.applied.thrust) for drone in (before, after)]
    return sign * (rest_v[1] - rest_v[0]) > RESTING_TOLERANCE_V


class Checked(Wrapper):
    """Add ``violations`` to info: the bits of INSIDE that a step shows, or that its episode's start showed.

    Goes outermost. A state is checked before and after every step, also the one that auto-reset replaces.
    """

    key = "checked"

    def begin(self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0) -> CheckedState:
        """Return the state of an episode that begins, itself checked."""
        inner = self.env.begin(drone, gate_index, params, seed)
        nothing = jnp.asarray(False)
        flags = (~is_finite(inner), nothing, nothing, ~is_unit(self.env.drone(inner)))
        return CheckedState(inner, jnp.int32(0), as_bits(flags))

    def advance(
        self, state: CheckedState, command: Action, params: EnvParams
    ) -> tuple[CheckedState, jax.Array, jax.Array, dict[str, Any]]:
        """Return the outcome of the inner environment, checked."""
        inner, reward, terminated, info = self.env.advance(state.inner, command, params)
        before, after = self.env.drone(state.inner), self.env.drone(inner)
        model = self.env.model(state.inner, params)
        flags = (
            ~is_finite(inner),
            ~is_finite(reward),
            ~is_finite(info),
            ~is_unit(after),
            is_risen(before, after, model),
            state.steps >= params.max_steps_in_episode,
        )
        bits = as_bits(flags) | jnp.where(state.steps == 0, state.at_start, 0)
        next_state = CheckedState(inner, state.steps + 1, jnp.int32(0))
        return next_state, reward, terminated, {**info, "violations": bits}
