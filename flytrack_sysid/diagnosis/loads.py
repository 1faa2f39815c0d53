"""Where a load on a string was, by the measured velocity of the drone that it hung from.

It remembers for seconds, longer than a lead-in, so that it is followed through the whole log.
"""

from typing import NamedTuple

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import LearnedLaw
from flytrack_env.effects.pendulum import Pendulum, hanging, swung
from flytrack_env.quaternion import Vec3
from flytrack_sysid.record import Record
from flytrack_sysid.replay import where_true


class Towed(NamedTuple):
    """What a load is driven by, of a whole log; as in ``flytrack_sysid.record``."""

    source_row: np.ndarray
    step_s: np.ndarray
    begins: np.ndarray
    vel_w: np.ndarray

    @classmethod
    def of(cls, record: Record) -> "Towed":
        """Return what a load is driven by in a record."""
        return cls(*(getattr(record, name) for name in cls._fields))


def pendulum_of(model: ModelParameters) -> tuple[float, float] | None:
    """Return length, m, and damping, 1/s, of the load in a model's learned law; None without one."""
    return next((one.law.pendulum for one in model.effects if isinstance(one, LearnedLaw)), None)


@jax.jit
def _loads(towed: Towed, length: float, damping: float) -> Pendulum:
    def next_row(load: Pendulum, row: Towed) -> tuple[Pendulum, Pendulum]:
        vel_w = Vec3(*row.vel_w)
        load = where_true(row.begins, hanging(vel_w), load)
        return swung(load, vel_w, row.step_s, length, damping), load

    return jax.lax.scan(next_row, hanging(Vec3(*towed.vel_w[0])), towed)[1]


def loads_along(towed: Towed, pendulum: tuple[float, float]) -> np.ndarray:
    """Return a load at every row of a log, (num_rows, 4); it hangs still where a flight begins."""
    return np.stack(_loads(towed, *pendulum), axis=-1)


def with_loads(record: Record, towed: Towed | None, pendulum: tuple[float, float]) -> Record:
    """Return rows of a record, (...), with the load at each; not a number in rows of no log."""
    assert towed is not None, "lanes of a log know what a load is driven by"
    found = np.append(loads_along(towed, pendulum), np.full((1, 4), np.nan), axis=0)
    place = np.full(towed.source_row.max() + 2, -1)
    place[towed.source_row] = np.arange(len(towed.source_row))
    place[-1] = -1
    return record._replace(load=found[place[record.source_row]])
