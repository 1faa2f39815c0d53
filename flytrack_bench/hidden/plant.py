"""Hidden drones as plants for an environment: the equations of ``drone``, traced by JAX."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_bench.hidden import drone as equations
from flytrack_bench.hidden.drone import HiddenDrone, Start
from flytrack_bench.hidden.laws import STATELESS_KINDS
from flytrack_bench.hidden.truth import DT_S, MOTIONS, Truth
from flytrack_bench.hidden.vectors import Number, Quaternion, Vector
from flytrack_env.dynamics import ModelParameters
from flytrack_env.plants import Plant
from flytrack_env.quaternion import Quaternion as StateQuaternion
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Action, Drone

# Without those that remember more than commands, and those of the sensors.
EFFECTS = {"command_delay", "thrust_lag_asymmetry", "voltage_sag"}.union(
    *equations.EFFECTS.values()
)
EFFECTS -= {"rate_slew_limit"}
START = Start((0.0, 0.0, 0.0), 0.0, 0.0, 0.0)  # every number of it is replaced


class HiddenState(NamedTuple):
    """A hidden drone in flight: what its next step depends on, a scalar per leaf."""

    pos_w: Vector
    vel_w: Vector
    acc_w: Vector
    quat: Quaternion
    rates_b: Vector
    applied: tuple[Number, ...]
    open_v: Number
    past: tuple[tuple[Number, ...], ...]
    has_flown: Any
    turning_b: Vector


class HiddenPlant(Plant):
    """A plant that flies a truth in steps of 0.01 s, without what it remembers but commands.

    Raises:
        ValueError: a truth with an effect, law or motion that cannot be flown in this way.
    """

    dt = DT_S

    def __init__(self, truth: Truth):
        self.truth = truth
        unknown = sorted(set(truth.effects) - EFFECTS)
        if unknown:
            raise ValueError(
                f"effects: found {', '.join(unknown)}, expected some of {sorted(EFFECTS)}"
            )
        if truth.outside is not None and truth.outside.kind not in STATELESS_KINDS:
            raise ValueError(
                f"outside: found {truth.outside.kind!r}, expected one of {STATELESS_KINDS}"
            )
        accepted: dict[str, tuple[Any, ...]] = {
            "motion": MOTIONS,
            "step_s": (DT_S,),
            "gust": (None,),
            "onset_s": (None,),
        }
        for name, values in accepted.items():
            if getattr(truth, name) not in values:
                raise ValueError(f"{name}: found {getattr(truth, name)!r}, expected {values[0]!r}")

    def __repr__(self) -> str:
        return f"HiddenPlant({self.truth})"

    def reset(self, drone: Drone, model: ModelParameters) -> HiddenState:
        """Return the plant with a drone in it, nothing remembered; ``model`` is not used."""
        hidden = self._hidden()
        for name in ("pos_w", "vel_w", "acc_w", "quat", "rates_b", "applied"):
            setattr(hidden, name, tuple(getattr(drone, name)))
        hidden.turning_b = tuple(drone.rates_b)
        hidden.open_v = 0.0
        hidden.open_v = drone.battery_v - hidden.loaded_v()
        state = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), _state_of(hidden))
        return state._replace(has_flown=jnp.bool_(False))

    def drone(self, state: HiddenState) -> Drone:
        """Return the drone."""
        return Drone(
            pos_w=Vec3(*state.pos_w),
            vel_w=Vec3(*state.vel_w),
            acc_w=Vec3(*state.acc_w),
            quat=StateQuaternion(*state.quat),
            rates_b=Vec3(*state.rates_b),
            applied=Action(*state.applied),
            battery_v=self._hidden(state).battery_v,
        )

    def step(
        self, state: HiddenState, command: Action, dt: Scalar, model: ModelParameters
    ) -> HiddenState:
        """Return the plant 0.01 s later under a held command in [-1, 1].

        ``dt`` and ``model`` are not used.
        """
        hidden = self._hidden(state)
        hidden.step(
            tuple(jnp.clip(jnp.asarray(stick, jnp.float32), -1.0, 1.0) for stick in command)
        )
        return _state_of(hidden)._replace(has_flown=jnp.bool_(True))

    def _hidden(self, state: HiddenState | None = None) -> HiddenDrone:
        """Return the drone in a state."""
        hidden = HiddenDrone(self.truth, START, np.random.default_rng(0))
        if state is not None:
            for name, value in state._asdict().items():
                setattr(hidden, name, value)
            hidden.battery_v = hidden.loaded_v()
        return hidden


def _state_of(hidden: HiddenDrone) -> HiddenState:
    return HiddenState(*(getattr(hidden, name) for name in HiddenState._fields))
