"""Where a load on a string was, by the measured velocity of the drone that it hung from.

It swings for seconds, longer than a lead-in lasts, so that it is followed through the whole log.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import LearnedLaw
from flytrack_env.effects.pendulum import Pendulum, advance_load, start_load
from flytrack_env.quaternion import Vec3
from flytrack_sysid.record import Record
from flytrack_sysid.replay import where_true


class LoadInput(NamedTuple):
    """What drives a load in a whole log, (num_rows, ...): as in ``flytrack_sysid.record``.

    mean_w: mean velocity until the next row, m/s.
    """

    step_s: np.ndarray
    begins: np.ndarray
    vel_w: np.ndarray
    mean_w: np.ndarray

    @classmethod
    def of(cls, record: Record) -> "LoadInput":
        """Return what drives a load in a record."""
        vel_w, ends = record.vel_w, np.append(record.begins[1:], True)[:, None]
        after = np.where(ends, vel_w, np.roll(vel_w, -1, axis=0))
        return cls(record.step_s, record.begins, vel_w, 0.5 * (vel_w + after))


def pendulum_of(model: ModelParameters) -> tuple[float, float] | None:
    """Return length, m, and damping, 1/s, of the load in a model's learned law; None without one."""
    return next((one.law.pendulum for one in model.effects if isinstance(one, LearnedLaw)), None)


def load_at(given: LoadInput, row: np.ndarray, pendulum: tuple[float, float]) -> Any:
    """Return the load at rows of the whole log, (..., 4), as in ``pendulum.Pendulum``; for ``jit``, too.

    It hangs still where a flight begins.
    """

    def next_row(load: Pendulum, one: LoadInput) -> tuple[Pendulum, Pendulum]:
        load = where_true(one.begins, start_load(Vec3(*one.vel_w)), load)
        return advance_load(load, Vec3(*one.mean_w), one.step_s, *pendulum), load

    first = start_load(Vec3(*given.vel_w[0]))
    loads = jax.lax.scan(next_row, first, jax.tree.map(jnp.asarray, given))[1]
    return jnp.stack(loads, axis=-1)[row]
