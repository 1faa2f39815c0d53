"""Excitation: short flights from chosen states that excite one axis each (docs/identification.md).

Four flights of a kind follow each other. So the last of every four can be held out
(``flytrack_sysid.split``), and both parts have every kind.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import signal
from scipy.spatial.transform import Rotation

from flytrack_env import state as layout

# The envelope of collected flights.
MAX_SPEED = 20.0  # m/s
HEIGHTS = (10.0, 110.0)  # m
SCRIPT_HEIGHTS = (0.1, 110.0)  # m, of a script, which may have flights close to the ground
VOLTAGES = (layout.BATTERY_EMPTY_V, layout.BATTERY_FULL_V)
ANY_VOLTAGE = (0.0, np.inf)  # V, for other craft
MIDDLE_V = 0.5 * (layout.BATTERY_EMPTY_V + layout.BATTERY_FULL_V)
MIN_STEPS = 2  # of a flight; a shorter one has no step

DT_S = 0.01
SLOT_STEPS = 125
FLIGHT_STEPS = 2 * SLOT_STEPS
FLIGHTS_PER_KIND = 4
KINDS = ("roll", "pitch", "yaw", "thrust", "free", "leg")
AMPLITUDES = (0.1, 0.3, 0.6, 1.0)
# Index at which each wave starts to cycle through the amplitudes. The last of four flights, which
# may be held out, has a large step, but no full stick, which is the most informative for the fit.
FIRST_AMPLITUDE = {"chirp": 2, "step": 3, "doublet": 3, "sine": 2}
FREE_AMPLITUDES = (0.3, 0.5, 0.8, 1.0)
LEG_SPEEDS = (3.0, 7.0, 11.0, 15.0)  # m/s
HEIGHT = 60.0  # m, at the start of each flight
LEG_SWING, LEG_STICK = 0.3, 0.2
# How long switching commands are held: fast ones identify lags, slow ones let thrust settle.
FAST_STEPS, SLOW_STEPS = (3, 12), (15, 40)
# V above empty: drain during the flight of any battery that lasts a minute.
RESERVE_V = 0.1


def is_inside(
    states: np.ndarray,
    heights: tuple[float, float],
    voltages: tuple[float, float],
) -> np.ndarray:
    """Return where states are within the envelope; NaN is outside.

    Args:
        states: (..., 21).
        heights: lowest and highest, m.
        voltages: lowest and highest, V.
    """
    height, battery_v = states[..., layout.POSITION][..., 2], states[..., layout.BATTERY]
    is_slow = np.linalg.norm(states[..., layout.VELOCITY], axis=-1) <= MAX_SPEED
    is_charged = (battery_v >= voltages[0]) & (battery_v <= voltages[1])
    return is_slow & is_charged & (height >= heights[0]) & (height <= heights[1])


class ScriptedFlight(NamedTuple):
    """One flight of a script, whose commands are not clipped yet.

    Attributes:
        kind: one of ``KINDS``, or a manoeuvre.
        start: state, (21,).
        command: (FLIGHT_STEPS, 4).
    """

    kind: str
    start: np.ndarray
    command: np.ndarray


def wave(name: str, rng: np.random.Generator) -> np.ndarray:
    """Return a sine, step, doublet or chirp of amplitude 1, (SLOT_STEPS,).

    The sign, the frequency of a sine, and the timing of a step or doublet are random.
    """
    time = np.arange(SLOT_STEPS) * DT_S
    duration = SLOT_STEPS * DT_S
    sign = rng.choice([-1.0, 1.0])
    if name == "sine":
        return sign * np.sin(2 * np.pi * rng.uniform(0.8, 3.0) * time)
    if name == "chirp":
        return sign * signal.chirp(time, f0=0.8, t1=duration, f1=16.0, phi=-90)
    begin, width = rng.uniform(0.1, 0.3) * duration, rng.uniform(0.15, 0.3) * duration
    is_on = (time >= begin) & (time < begin + width)
    is_reversed = (time >= begin + width) & (time < begin + 2 * width)
    return sign * (is_on - (1.0 * is_reversed if name == "doublet" else 0.0))


def switching(
    rng: np.random.Generator, smallest: float = 1.0, hold_steps: tuple[int, int] = FAST_STEPS
) -> np.ndarray:
    """Return a command that changes sign at random intervals, (FLIGHT_STEPS,).

    Args:
        rng: of intervals, signs and sizes.
        smallest: least size; the largest is 1.
        hold_steps: the shortest and the longest interval.
    """
    holds = rng.integers(*hold_steps, size=FLIGHT_STEPS, endpoint=True)
    signs = rng.choice([-1.0, 1.0]) * (-1.0) ** np.arange(FLIGHT_STEPS)
    return np.repeat(signs * rng.uniform(smallest, 1.0, FLIGHT_STEPS), holds)[:FLIGHT_STEPS]


def start_at(
    attitude: Rotation, hover: float, voltage: float, vel_w: ArrayLike = 0.0, height: float = HEIGHT
) -> np.ndarray:
    """Return a start state above the origin, (21,).

    Args:
        attitude: from body to world frame.
        hover: applied thrust action.
        voltage: V.
        vel_w: m/s.
        height: m.
    """
    state = np.zeros(layout.STATE_SIZE)
    state[layout.POSITION], state[layout.VELOCITY] = [0.0, 0.0, height], vel_w
    state[layout.QUATERNION] = attitude.as_quat(scalar_first=True, canonical=True)
    state[layout.APPLIED_ACTION] = [0.0, 0.0, 0.0, hover]
    state[layout.BATTERY] = voltage
    return state


def start_state(
    rng: np.random.Generator, voltage: float, hover: float, tilt_deg: float, speed: float
) -> np.ndarray:
    """Return a start (21,) at thrust action ``hover``, tilted and moving in random directions."""
    side, heading, yaw = rng.uniform(-np.pi, np.pi, 3)
    tilt = Rotation.from_rotvec(np.deg2rad(tilt_deg) * np.array([np.cos(side), np.sin(side), 0.0]))
    climb = rng.uniform(-0.3, 0.3)
    vel_w = speed * np.array([np.cos(heading), np.sin(heading), climb]) / np.hypot(1.0, climb)
    return start_at(tilt * Rotation.from_euler("z", yaw), hover, voltage, vel_w)


def _axis_command(
    axis: int, turn: int, number: int, hover: float, rng: np.random.Generator
) -> np.ndarray:
    """Return two waves on one axis: their kinds alternate by turn, amplitudes cycle by number."""
    names = ("chirp", "step") if turn % 2 == 0 else ("doublet", "sine")
    command = np.tile([0.0, 0.0, 0.0, hover], (FLIGHT_STEPS, 1))
    for slot, name in enumerate(names):
        amplitude = AMPLITUDES[(number + FIRST_AMPLITUDE[name]) % len(AMPLITUDES)]
        command[slot * SLOT_STEPS : (slot + 1) * SLOT_STEPS, axis] = amplitude * wave(name, rng)
    return command


def _flight(
    kind: str, turn: int, number: int, voltage: float, hover: float, rng: np.random.Generator
) -> ScriptedFlight:
    """Return one flight of a kind; ``number`` counts within the four of its turn."""
    if kind in KINDS[:3]:
        start = start_state(rng, voltage, hover, 0.0, 0.0)
        return ScriptedFlight(
            kind, start, _axis_command(KINDS.index(kind), turn, number, hover, rng)
        )
    command = np.tile([0.0, 0.0, 0.0, hover], (FLIGHT_STEPS, 1))
    if kind == "thrust":
        name = ("sine", "step", "doublet", "chirp")[number]
        command[:, 3] = np.append(wave(name, rng), switching(rng, 0.5, SLOW_STEPS)[SLOT_STEPS:])
        tilts_deg, speed = (0.0, 20.0), 0.0
    elif kind == "free":
        command[:, 2] = switching(rng)
        amplitude = FREE_AMPLITUDES[number]
        command[:, :2] = amplitude * np.stack([switching(rng), switching(rng)], axis=1)
        command[:, 3] = switching(rng, smallest=0.0)
        tilts_deg, speed = (20.0, 80.0), 0.0
    else:
        command[:, 2] = switching(rng)
        time = np.arange(FLIGHT_STEPS) * DT_S
        slow = [
            np.sin(2 * np.pi * rng.uniform(0.5, 1.5) * time + rng.uniform(0, 2 * np.pi))
            for _ in range(3)
        ]
        command[:, :2] = LEG_STICK * np.stack(slow[:2], axis=1)
        command[:, 3] += LEG_SWING * slow[2]
        tilts_deg, speed = (10.0, 50.0), LEG_SPEEDS[number]
    start = start_state(rng, voltage, hover, rng.uniform(*tilts_deg), speed)
    return ScriptedFlight(kind, start, command)


def _voltages(
    kind: str, turns: int, rng: np.random.Generator, voltages: tuple[float, float]
) -> np.ndarray:
    """Return the voltages of a kind's flights, (turns, 4), between nearly empty and full.

    They are denser towards both ends, which are the most informative on how thrust depends on the
    voltage. The order is random, except for the last of every four, which may be held out: these
    are spread over the range by turn and kind.
    """
    lowest_v, count = voltages[0] + RESERVE_V, turns * FLIGHTS_PER_KIND
    fraction = 0.5 - 0.5 * np.cos(np.pi * np.arange(count) / (count - 1))
    levels = lowest_v + fraction * (voltages[1] - lowest_v)
    last = np.arange(turns) * FLIGHTS_PER_KIND + KINDS.index(kind) % FLIGHTS_PER_KIND
    other_levels = rng.permutation(np.delete(levels, last)).reshape(turns, FLIGHTS_PER_KIND - 1)
    return np.column_stack([other_levels, rng.permutation(levels[last])])


def script(
    num_flights: int,
    hover: float,
    rng: np.random.Generator,
    battery: tuple[float, float] = VOLTAGES,
) -> list[ScriptedFlight]:
    """Return the flights of an excitation.

    Args:
        num_flights: how many.
        hover: the thrust action that holds the weight.
        rng: of waves, directions and the order of voltages.
        battery: voltages of an empty and a full one, V.
    """
    turns = -(-num_flights // (FLIGHTS_PER_KIND * len(KINDS)))
    voltages = {kind: _voltages(kind, turns, rng, battery) for kind in KINDS}
    flights = [
        _flight(kind, turn, number, voltages[kind][turn, number], hover, rng)
        for turn in range(turns)
        for kind in KINDS
        for number in range(FLIGHTS_PER_KIND)
    ]
    return [
        flight._replace(command=np.clip(flight.command, -1.0, 1.0))
        for flight in flights[:num_flights]
    ]
