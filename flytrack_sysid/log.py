"""Flight logs: named columns in SI units, for simulated and measured flights alike.

docs/identification.md lists columns, units and frames: position ``p``, velocity ``v``, acceleration
``a`` (0 in hover), world; specific force ``f``, angular velocity ``w``, body; orientation ``q``,
(w, x, y, z), body to world; command ``u`` and applied action ``uprev`` in [-1, 1]; battery
``v_bat``, V; and ``sticks``, what a controller was asked for, in logs whose commands are motors.

Row k holds what was measured at t_k and the command held from t_k to t_k+1. As in the handout's
state, ``a`` and ``f`` of row k are those of the step that led to t_k, with the attitude before it.
``t`` and the commands are always there; other channels may be absent (never zero instead), but only
whole ones.

Columns of ``STATED`` hold the same number in every row: ``measured``, 1 where a real drone flew and
0 where a simulator did; ``motors``, 1 where ``u`` holds the outputs of the motors rear right, front
right, rear left and front left instead of sticks, -1 off and 1 full; ``v_bat_low`` and
``v_bat_high``, V, the range that is stated for a pack that was not logged; ``mass_kg``, the mass
that is stated for the craft.
"""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from flytrack_env.state import (
    ACCELERATION,
    APPLIED_ACTION,
    BATTERY,
    POSITION,
    QUATERNION,
    RATES,
    VELOCITY,
)

_XYZ, _STICKS = ("x", "y", "z"), ("roll", "pitch", "yaw", "thrust")
CHANNELS: dict[str, tuple[str, ...]] = {
    "u": tuple(f"u_{stick}" for stick in _STICKS),
    **{name: tuple(f"{name}_{axis}" for axis in _XYZ) for name in ("p", "v", "a", "f")},
    "q": tuple(f"q_{axis}" for axis in ("w", *_XYZ)),
    "w": tuple(f"w_{axis}" for axis in _XYZ),
    "uprev": tuple(f"uprev_{stick}" for stick in _STICKS),
    "v_bat": ("v_bat",),
    "sticks": tuple(f"sticks_{stick}" for stick in _STICKS),
}
REQUIRED = ("t", *CHANNELS["u"])
MEASURED, OF_MOTORS, STATED_VOLTAGES = "measured", "motors", ("v_bat_low", "v_bat_high")
STATED_MASS = "mass_kg"
STATED = (MEASURED, OF_MOTORS, *STATED_VOLTAGES, STATED_MASS)
COLUMNS = (
    "t",
    "segment",
    *(column for columns in CHANNELS.values() for column in columns),
    *STATED,
)
# Origins of a log, and the values of the column ``measured`` that state them.
Origin = Literal["measured", "simulated"]
ORIGINS: dict[float, Origin] = {1.0: "measured", 0.0: "simulated"}
GAP_STEPS = 1.5  # of the usual step: a longer step lacks a sample; loggers jitter by less
NOMINAL_STEP_S = 0.01  # of a log without two rows
BETWEEN_S = 1.0  # from the end of a segment to the start of the next, on one time line
IN_STATE = {  # where a channel is in the handout's state
    "p": POSITION,
    "v": VELOCITY,
    "a": ACCELERATION,
    "q": QUATERNION,
    "w": RATES,
    "uprev": APPLIED_ACTION,
    "v_bat": slice(BATTERY, BATTERY + 1),
}


class LogError(ValueError):
    """A flight log that cannot be used; the message says file, row, column, found and expected."""


@dataclass(frozen=True)
class FlightLog:
    """A flight log in memory. ``load_log`` checks the content of files; this class checks nothing.

    Attributes:
        time: (num_rows,) s.
        channels: of ``CHANNELS``, by name, (num_rows, number of columns) float64; "u" is always
            there.
        segment: (num_rows,) int; rows of equal number are adjacent.
        source: where the log is from, for messages.
        origin: whether a real drone or a simulator flew; None if it is unknown.
        stated_voltage_v: lowest and highest voltage of the pack in flight, V, if they are stated
            but ``v_bat`` was not logged.
        has_motors: whether the commands are the outputs of four motors instead of sticks.
        stated_mass_kg: mass of the craft, kg, if it is stated.
    """

    time: np.ndarray
    channels: Mapping[str, np.ndarray]
    segment: np.ndarray
    source: str = "flight log"
    origin: Origin | None = None
    stated_voltage_v: tuple[float, float] | None = None
    has_motors: bool = False
    stated_mass_kg: float | None = None

    def __len__(self) -> int:
        return len(self.time)

    def __contains__(self, channel: str) -> bool:
        return channel in self.channels

    def __getitem__(self, channel: str) -> np.ndarray:
        return self.channels[channel]

    @cached_property
    def sha256(self) -> str:
        """The hash of the rows, the same in memory and in any file.

        It does not depend on origin, stated voltages and stated mass.
        """
        digest = hashlib.sha256()
        segment = np.cumsum(self.is_start())
        for name, values in (
            ("t", self.time),
            ("segment", segment),
            *sorted(self.channels.items()),
        ):
            digest.update(name.encode() + np.ascontiguousarray(values, float).tobytes())
        return digest.hexdigest()

    @property
    def throttle(self) -> np.ndarray:
        """The thrust command, (num_rows,); of motors their mean."""
        return self["u"].mean(axis=1) if self.has_motors else self["u"][:, 3]

    def select(self, rows: np.ndarray) -> "FlightLog":
        """Return some of the rows, by mask or slice."""
        channels = {name: values[rows] for name, values in self.channels.items()}
        return replace(self, time=self.time[rows], channels=channels, segment=self.segment[rows])

    def without(self, *names: str) -> "FlightLog":
        """Return the log as if these channels had not been measured."""
        channels = {name: values for name, values in self.channels.items() if name not in names}
        return replace(self, channels=channels)

    def is_start(self) -> np.ndarray:
        """Return where a segment begins, (num_rows,) bool."""
        return np.concatenate([[True], self.segment[1:] != self.segment[:-1]])[: len(self)]


def usual_step(log: FlightLog) -> np.ndarray:
    """Return the median time between rows of each row's segment, (num_rows,) s."""
    starts = np.flatnonzero(log.is_start())
    steps = [np.diff(times) for times in np.split(log.time, starts[1:])]
    all_steps = np.concatenate(steps)
    fallback = float(np.median(all_steps)) if len(all_steps) else NOMINAL_STEP_S
    medians = [
        float(np.median(segment_steps)) if len(segment_steps) else fallback
        for segment_steps in steps
    ]
    return np.repeat(medians, [len(segment_steps) + 1 for segment_steps in steps])


def median_step(log: FlightLog) -> float:
    """Return the usual time between rows of a log, s."""
    return float(np.median(usual_step(log)))


def time_in_line(log: FlightLog, between_s: np.ndarray | float = BETWEEN_S) -> np.ndarray:
    """Return the time of rows with segments one after the other, (num_rows,) s from 0.

    Args:
        between_s: from the end of each segment to the start of the next; one number, or one for
            each segment.
    """
    starts = np.flatnonzero(log.is_start())
    lengths = np.diff(np.append(starts, len(log)))
    durations_s = log.time[starts + lengths - 1] - log.time[starts]
    begins_s = np.concatenate([[0.0], np.cumsum(durations_s + between_s)[:-1]])
    return log.time + np.repeat(begins_s - log.time[starts], lengths)


def log_of_states(
    flights: Iterable[tuple[np.ndarray, np.ndarray]], dt: float, source: str = "flight log"
) -> FlightLog:
    """Return the log of a simulator's flights, a segment each.

    The first acceleration of a flight is that of the step before it.

    Args:
        flights: states, (T, 21), and actions, (T, 4), of each flight.
        dt: time between states, s.
        source: where the flights are from, for messages.
    """
    flights = [
        (np.asarray(states, float), np.asarray(actions, float)) for states, actions in flights
    ]
    states = np.concatenate([states for states, _ in flights])
    channels = {name: states[:, where] for name, where in IN_STATE.items()}
    return FlightLog(
        time=np.concatenate([np.arange(len(states)) * dt for states, _ in flights]),
        channels={"u": np.concatenate([actions for _, actions in flights]), **channels},
        segment=np.repeat(np.arange(len(flights)), [len(states) for states, _ in flights]),
        source=source,
        origin="simulated",
    )
