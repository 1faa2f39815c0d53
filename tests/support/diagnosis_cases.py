"""Plants for the slow tests of the diagnosis, drawn from a seed: what the recorded plants do not cover."""

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmarks import hidden
from flytrack_env.plants import Simulator
from flytrack_sysid import collect
from flytrack_sysid.log import FlightLog

SEED = int(os.environ.get("FLYTRACK_TEST_SEED", "11"))
SECONDS = 40.0  # all logs have as many lanes, so that all share one compiled program
SIGNED = {"thrust_tilt": -1.0, "wind": -1.0, "yaw_reaction": -1.0}  # what mirrors each parameter
SEGMENT_ROWS, HELD_OUT_EVERY = 330, 4  # twelve segments, each short enough to be a block
OUTSIDE_AMPLITUDE = 2.0
HOVER_WIND = 0.25  # m/s^2; corrections of a few degrees tell a stronger one from a tilt
Rng = np.random.Generator


class Case(NamedTuple):
    """A plant, what its team believes in, and its measured log."""

    truth: hidden.Truth
    believed: hidden.Truth
    log: FlightLog


def rng_of(name: str) -> Rng:
    """Return the random numbers of a case."""
    return np.random.default_rng([SEED, *name.encode()])


def _flown(truth: hidden.Truth, rng: Rng, kind: str = "scripted") -> Case:
    return Case(truth, truth, hidden.measure(hidden.fly(truth, kind, SECONDS, rng), "sensors", rng))


def _signed(rng: Rng, sign: float = 1.0) -> Case:
    """Return a plant with a large signed effect, or its mirror image; both are drawn and flown alike."""
    truth, name = hidden.draw_base(rng), str(rng.choice(list(SIGNED)))
    values = hidden.draw_effect(name, rng, hidden.EFFECTS[name].high)
    effects = {name: {field: sign * value for field, value in values.items()}}
    return _flown(replace(truth, effects=effects), rng)


def _in_training_only(rng: Rng) -> Case:
    """Return a plant with drag that is absent from the last of every four segments."""
    still = hidden.draw_base(rng)
    dragged = replace(still, effects={"linear_drag": hidden.draw_effect("linear_drag", rng, 0.4)})
    parts = [hidden.fly(truth, "scripted", SECONDS, rng) for truth in (dragged, still)]
    rows = np.arange(len(parts[0]))
    segment = rows // SEGMENT_ROWS
    is_still = segment % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    channels = {
        name: np.where(is_still[:, None], parts[1][name], values)
        for name, values in parts[0].channels.items()
    }
    clean = FlightLog(parts[0].time, channels, segment).select(segment < len(rows) // SEGMENT_ROWS)
    return Case(still, still, hidden.measure(clean, "sensors", rng))


def _wind_in_hover(rng: Rng) -> Case:
    truth = hidden.draw_base(rng)
    way = rng.uniform(-np.pi, np.pi)
    wind = {"a_x": HOVER_WIND * float(np.cos(way)), "a_y": HOVER_WIND * float(np.sin(way)), "a_z": 0.0}
    return _flown(replace(truth, effects={"wind": wind}), rng, kind="hover")


def _thermal(rng: Rng) -> Case:
    truth = replace(hidden.draw_base(rng), outside=hidden.draw_outside(rng, "position", OUTSIDE_AMPLITUDE))
    return _flown(truth, rng)


def _changed(field: str, low: float, high: float, rng: Rng) -> Case:
    """Return a plant of which the team believes an older base, flown as it is now.

    low, high: range of the largest |ln factor| of the field's values; the upper half is drawn from.
    """
    believed = hidden.draw_base(rng)
    size = float(np.exp(rng.uniform(np.log(low * high) / 2.0, np.log(high))))
    values = np.atleast_1d(getattr(believed, field))
    shares = rng.uniform(0.5, 1.0, len(values))
    shares[rng.integers(len(values))] = 1.0
    changed = [
        float(value * np.exp(size * share * rng.choice([-1.0, 1.0])))
        for value, share in zip(values, shares, strict=True)
    ]
    now = replace(believed, **{field: tuple(changed) if len(changed) > 1 else changed[0]})
    return _flown(now, rng)._replace(believed=believed)


def _simulated(rng: Rng) -> Case:
    """Return flights of the simulator itself, without noise; all kinds, as many rows as the other logs."""
    log = collect(Simulator(), 1.0, int(rng.integers(2**31)))
    log = log.select(log.segment % 3 != 2)
    nominal = hidden.Truth((0.03,) * 4, (0.0,) * 6)  # not looked at: the model is the simulator's own
    return Case(nominal, nominal, log)


def _broken(rng: Rng, channel: str, value: float) -> Case:
    """Return a flight with one channel stuck at a value from the first row to the last."""
    case = _flown(hidden.draw_base(rng), rng)
    stuck = np.full_like(case.log[channel], value)
    return case._replace(log=replace(case.log, channels={**case.log.channels, channel: stuck}))


CASES: Mapping[str, Callable[[Rng], Case]] = {
    "signed": _signed,
    "mirrored": lambda rng: _signed(rng_of("signed"), -1.0),
    "training_only": _in_training_only,
    "wind_in_hover": _wind_in_hover,
    "thermal": _thermal,
    "tau": lambda rng: _changed("tau", 0.05, 0.6, rng),
    "mass": lambda rng: _changed("mass", 0.01, 0.2, rng),
    "simulated": _simulated,
    "stuck_gyro": lambda rng: _broken(rng, "w", 0.0),
    "stuck_commands": lambda rng: _broken(rng, "u", -0.3),
}
