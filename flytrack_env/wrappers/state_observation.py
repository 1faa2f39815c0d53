"""The true state beside the observation: what a critic may see that the policy may not."""

from typing import Any

import jax

from flytrack_env.observations import OBSERVATION, Entry, observe_race
from flytrack_env.params import EnvParams
from flytrack_env.state import Drone
from flytrack_env.wrappers.base import Wrapper


class StateObservation(Wrapper):
    """Append FlyTrack's own observation, of the true drone, to the observation.

    For training with a critic that knows the state while the policy has sensors only
    (L. Pinto et al., arXiv 1710.06542); the policy must leave these rows alone.

    Raises:
        WrapperError: as ``Wrapper``, or an image inside.
    """

    key = "state_observation"
    needs_rows = True

    @property
    def observation_table(self) -> tuple[Entry, ...]:
        """The inner environment's, and FlyTrack's."""
        own = (entry._replace(key=f"state_{entry.key}") for entry in OBSERVATION)
        return (*self.env.observation_table, *own)

    def observe_drone(self, drone: Drone, state: Any, params: EnvParams) -> list[jax.Array]:
        """Return the inner observation, and that of the true drone behind it."""
        race, battery = self.race(state), self.model(state, params).battery
        true = observe_race(self.drone(state), race.gate, race.next_gate, battery)
        return [*self.env.observe_drone(drone, state.inner, params), *true]
