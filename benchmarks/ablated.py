"""FlyTrack with something taken out of the observation, for ``benchmarks.ablations``."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.observations import BATTERY_MIDDLE_V, OBSERVATION, Entry
from flytrack_env.params import EnvParams
from flytrack_env.state import Action, Drone
from flytrack_env.wrappers import Wrapper

GATE_FRAME = {entry.key: entry for entry in OBSERVATION}


def _in_world(key: str) -> Entry:
    """Return an entry of the observation, as it is called in the world's frame."""
    entry = GATE_FRAME[key]
    return entry._replace(name=entry.name.replace("body to gate", "body to world"), frame="world")


# The course spans 25 m and 35 m, hence the scale of the position; all else is scaled as in the gate's frame.
WORLD = (
    Entry("position", "position", 3, "world", "m", 10.0, 10.0),
    _in_world("velocity"),
    _in_world("attitude"),
    GATE_FRAME["rates"],
    GATE_FRAME["applied"],
    GATE_FRAME["battery"],
    Entry("gate", "gate's centre relative to the drone", 3, "world", "m", 3.0, 30.0),
    Entry("direction", "gate's direction of flight", 3, "world", "1", 1.0, 1.0),
    _in_world("next_gate"),
    _in_world("next_direction"),
)


class Shown(NamedTuple):
    """The inner state and nothing else."""

    inner: Any


class OtherObservation(Wrapper):
    """A wrapper that changes only what is shown."""

    def begin(self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0) -> Shown:
        """Return the inner state of an episode that begins."""
        return Shown(self.env.begin(drone, gate_index, params, seed))

    def advance(
        self, state: Shown, command: Action, params: EnvParams
    ) -> tuple[Shown, jax.Array, jax.Array, dict[str, Any]]:
        """Return the outcome of the inner environment."""
        inner, *outcome = self.env.advance(state.inner, command, params)
        return Shown(inner), *outcome


class WithoutEntries(OtherObservation):
    """Show zeros in place of some entries of the observation."""

    key = "without_entries"

    def __init__(self, env: EpisodicEnvironment, keys: tuple[str, ...]):
        super().__init__(env)
        self.keys = keys

    def observe_drone(self, drone: Drone, state: Any, params: EnvParams) -> list[jax.Array]:
        """Return the inner observation with zeros where the entries were."""
        values = self.env.observe_drone(drone, state.inner, params)
        hidden = [entry.key in self.keys for entry in self.observation_table for _ in range(entry.size)]
        return [
            jnp.zeros_like(value) if is_hidden else value
            for value, is_hidden in zip(values, hidden, strict=True)
        ]


class InWorldFrame(OtherObservation):
    """Show everything in the world's frame, the same quantities as in the gate's."""

    key = "in_world_frame"

    @property
    def observation_table(self) -> tuple[Entry, ...]:
        """The rows of ``WORLD``."""
        return WORLD

    def observe_drone(self, drone: Drone, state: Any, params: EnvParams) -> list[jax.Array]:
        """Return the observation; gates as the race of the state has them."""
        race = self.race(state)
        body_axes = drone.quat.axes()
        quantities: list[tuple[Any, ...]] = [
            drone.pos_w,
            drone.vel_w,
            tuple(component for row in zip(*body_axes, strict=True) for component in row),
            drone.rates_b,
            drone.applied,
            (drone.battery_v - BATTERY_MIDDLE_V,),
            race.gate.centre - drone.pos_w,
            race.gate.forward,
            race.next_gate.centre - race.gate.centre,
            race.next_gate.forward,
        ]
        return [
            jnp.clip(value * (1.0 / entry.scale), -entry.limit, entry.limit)
            for entry, group in zip(WORLD, quantities, strict=True)
            for value in group
        ]
