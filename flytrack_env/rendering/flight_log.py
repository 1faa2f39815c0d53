"""What a picture shows: one row of numbers per step, and the log of an episode.

A row is the drone's state, laid out as in ``flytrack_env.state``, and index of the gate to fly
next, laps completed, time of the crossing that began the lap (s since the reset), last lap time (s,
0 if none).
"""

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.race import Race
from flytrack_env.state import STATE_SIZE, Drone, pack

GATE_INDEX, LAPS, LAP_START, LAP_TIME = range(STATE_SIZE, STATE_SIZE + 4)
SCENE_SIZE = STATE_SIZE + 4

FIRST_CAPACITY = 256  # rows


def scene_row(drone: Drone, race: Race) -> jax.Array:
    """Return the row of one step, (SCENE_SIZE,) float32."""
    numbers = (race.gate_index, race.laps, race.lap_start_s, race.lap_time_s)
    return jnp.concatenate([pack(drone), jnp.stack([jnp.float32(number) for number in numbers])])


class FlightLog:
    """The rows of one episode from its start on; row k is the state k steps after it.

    Args:
        step_s: length of a step, s.
    """

    def __init__(self, step_s: float):
        self.step_s = step_s
        self._rows = np.empty((FIRST_CAPACITY, SCENE_SIZE), np.float32)
        self._length = 0

    def append(self, row: np.ndarray) -> None:
        """Add the row (SCENE_SIZE,) of the next step."""
        if self._length == len(self._rows):
            self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
        self._rows[self._length] = row
        self._length += 1

    @property
    def rows(self) -> np.ndarray:
        """The rows so far, (number of steps + 1, SCENE_SIZE), float32."""
        return self._rows[: self._length]

    @property
    def time_s(self) -> float:
        """Time since the episode began, s."""
        return (self._length - 1) * self.step_s
