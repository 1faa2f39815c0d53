"""The time-optimal lap as an opponent: a ghost flies its line, whatever the others do."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.flown_race import follow_race
from flytrack_env.multi_drone.opponents import Standing, progress_of
from flytrack_env.params import DT_S
from flytrack_env.quaternion import Vec3
from flytrack_env.references import ghost_rollout, shipped_references
from flytrack_env.state import POSITION, VELOCITY
from flytrack_env.tracks import Track, build_course

NUM_ROWS = 3000  # after which it hangs in the air


class Ghost(NamedTuple):
    """Where a ghost is at each step since the start: leaves (num_steps,); world, m, m/s, gates."""

    pos_w: Vec3
    vel_w: Vec3
    progress: np.ndarray

    def standing(self, step: jax.Array) -> Standing:
        """Return a ghost's standing ``step`` steps after the start, int32 of any shape."""
        row = jnp.clip(step, 0, NUM_ROWS - 1)
        pos_w, vel_w, progress = jax.tree.map(lambda leaf: jnp.asarray(leaf)[row], tuple(self))
        return Standing(pos_w, vel_w, progress, jnp.zeros(jnp.shape(step), bool))


def time_optimal_ghost(track: Track, delay_s: float = 0.0) -> Ghost:
    """Return the ghost of a track's time-optimal laps with the nominal drone.

    The first lap is from standstill.

    Args:
        delay_s: for which it waits at the start pose.

    Raises:
        ReferenceFileError: a track without shipped references.
    """
    states, _ = ghost_rollout(shipped_references(track, ("nominal",)), NUM_ROWS)
    waiting = round(delay_s / DT_S)
    states = np.concatenate([np.repeat(states[:1], waiting, axis=0), states])[:NUM_ROWS]
    pos_w = Vec3(*states[:, POSITION].T.astype(np.float32))
    race = follow_race(states[:, POSITION], track, first_gate=0)
    centres = build_course(track).gates.centre
    centre, before = (
        Vec3(*(np.asarray(coordinate)[index] for coordinate in centres))
        for index in (race.gate, race.gate - 1)
    )
    passed = race.laps * len(track.gates) + race.gate
    progress = progress_of(passed, pos_w, centre, (centre - before).norm())
    return Ghost(
        pos_w, Vec3(*states[:, VELOCITY].T.astype(np.float32)), np.asarray(progress, np.float32)
    )
