"""Manoeuvres: flights from chosen states that answer one question each.

The excitation (``flytrack_sysid.excitation``) excites everything a little. A manoeuvre repeats one
motion in eight flights of 2.5 s. ``MANOEUVRES`` says how to fly each on a real drone.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env import thrust
from flytrack_env.dynamics import ModelParameters
from flytrack_env.state import BATTERY, BATTERY_EMPTY_V, BATTERY_FULL_V
from flytrack_sysid import excitation

# All manoeuvres have the same length, so that they are comparable. The number is even, because two
# flights fill a chunk of a diagnosis.
FLIGHTS_PER_MANOEUVRE = 8
SECONDS_PER_MANOEUVRE = FLIGHTS_PER_MANOEUVRE * excitation.FLIGHT_STEPS * excitation.DT_S
STARTS_V = np.linspace(
    BATTERY_EMPTY_V + excitation.RESERVE_V, BATTERY_FULL_V, FLIGHTS_PER_MANOEUVRE
)
SWING_HZ = 1.0  # frequency of a thrust that oscillates about hover
HOVER_SWING = 0.05  # of the stick: no pilot holds it constant
VOLTAGE_SWING = 0.5
STEEPNESS = 0.8  # climb of a leg over its ground speed; the sign alternates
LOW_HEIGHTS = (0.2, 0.35, 0.6, 1.0)  # m: a rotor's radius or two, where ground effect acts
LOW_SPEED = 2.0  # m/s, of every other low pass
TILTS_DEG = (20.0, 40.0, 60.0, 80.0)
QUICK_STEPS = (1, 6)  # shortest and longest hold of fast switching
# m/s upwards at the start of flips, whose mean thrust lifts nothing: half of the speed lost in a
# flight.
FLIP_CLIMB = 0.5 * 9.8 * excitation.FLIGHT_STEPS * excitation.DT_S
SPIN_STICKS = (
    *((sign, 0.0, 0.0) for sign in (1.0, -1.0)),
    *((0.0, sign, 0.0) for sign in (1.0, -1.0)),
    *((0.0, 0.0, sign) for sign in (1.0, -1.0)),
    (1.0, 0.0, 1.0),
    (0.0, 1.0, -1.0),
)


Flight = Callable[[int, float, np.random.Generator], tuple[np.ndarray, np.ndarray]]


class Manoeuvre(NamedTuple):
    """A manoeuvre.

    Attributes:
        how: how to fly it on a real drone.
        flight: returns start and command of a flight by its number and the hover action.
    """

    how: str
    flight: Flight


MANOEUVRES: dict[str, Manoeuvre] = {}


def _manoeuvre(how: str) -> Callable[[Flight], Flight]:
    """Return a decorator that adds a function to ``MANOEUVRES``, under its name."""

    def add(flight: Flight) -> Flight:
        MANOEUVRES[flight.__name__.removeprefix("_")] = Manoeuvre(how, flight)
        return flight

    return add


def _start(
    hover: float,
    voltage: float = excitation.MIDDLE_V,
    yaw_deg: float = 0.0,
    tilt_deg: float = 0.0,
    vel_w: Iterable[float] = (0.0, 0.0, 0.0),
    height: float = excitation.HEIGHT,
) -> np.ndarray:
    """Return a start (21,): yawed, then tilted about body x, with the thrust action ``hover``."""
    attitude = Rotation.from_euler("ZX", [yaw_deg, tilt_deg], degrees=True)
    return excitation.start_at(attitude, hover, voltage, tuple(vel_w), height)


def _swing(hover: float, size: float, rng: np.random.Generator) -> np.ndarray:
    """Return centred sticks and a thrust that oscillates slowly about hover, (FLIGHT_STEPS, 4)."""
    command = np.zeros((excitation.FLIGHT_STEPS, 4))
    time = np.arange(excitation.FLIGHT_STEPS) * excitation.DT_S
    command[:, 3] = hover + size * np.sin(2 * np.pi * SWING_HZ * time + rng.uniform(0, 2 * np.pi))
    return command


@_manoeuvre("Hover with the nose to the north, east, south and west, a few seconds each.")
def _headings(number: int, hover: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return _start(hover, yaw_deg=90.0 * number), _swing(hover, HOVER_SWING, rng)


@_manoeuvre(
    "Fly straight legs at 3, 7, 11 and 15 m/s, nose first and sideways, climbing and sinking."
)
def _speeds(number: int, hover: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return a leg along x or y of the body, in turn; pairs climb and sink in turn."""
    speed, yaw_deg = excitation.LEG_SPEEDS[number // 2], 90.0 * rng.integers(4)
    course = np.deg2rad(yaw_deg + 90.0 * (number % 2))
    climb = STEEPNESS * (-1.0) ** (number // 2)
    vel_w = speed * np.array([np.cos(course), np.sin(course), climb]) / np.hypot(1.0, climb)
    return _start(hover, STARTS_V[number], yaw_deg, vel_w=vel_w), _swing(
        hover, excitation.LEG_SWING, rng
    )


@_manoeuvre("Hover and pass slowly between 0.2 and 1 m above flat ground.")
def _low_passes(
    number: int, hover: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    vel_w = (LOW_SPEED * (number % 2), 0.0, 0.0)
    return _start(hover, vel_w=vel_w, height=LOW_HEIGHTS[number // 2]), _swing(
        hover, HOVER_SWING, rng
    )


@_manoeuvre(
    "High and away from people, level: thrust stick to both ends, in jabs and for half a second."
)
def _thrust_steps(
    number: int, hover: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    command = np.zeros((excitation.FLIGHT_STEPS, 4))
    command[:, 3] = excitation.switching(rng, *((0.5, excitation.SLOW_STEPS) if number % 2 else ()))
    return _start(hover, STARTS_V[number]), command


@_manoeuvre(
    "Hold the drone at 20 to 80 degrees to one side and to the other, moving thrust up and down."
)
def _thrust_tilted(
    number: int, hover: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    tilt_deg = TILTS_DEG[number // 2] * (-1.0) ** number
    start = _start(hover, STARTS_V[number], 90.0 * rng.integers(4), tilt_deg)
    return start, _swing(hover, excitation.LEG_SWING, rng)


@_manoeuvre(
    "Give roll, pitch and yaw to both sides, at a tenth, a third, two thirds and all of the stick."
)
def _stick_amplitudes(
    number: int, hover: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return roll, then pitch at one amplitude; or yaw, then all axes."""
    command = _swing(hover, HOVER_SWING, rng)
    slots = slice(excitation.SLOT_STEPS), slice(excitation.SLOT_STEPS, excitation.FLIGHT_STEPS)
    for slot, axes in zip(slots, ((2,), (0, 1, 2)) if number % 2 else ((0,), (1,)), strict=True):
        for axis in axes:
            wave = excitation.wave("sine" if len(axes) > 1 else "doublet", rng)
            command[slot, axis] = excitation.AMPLITUDES[number // 2] * wave
    return _start(hover, STARTS_V[number]), command


@_manoeuvre(
    "High and away from people, move all four sticks quickly to both sides, a little, then more."
)
def _fast_switching(
    number: int, hover: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    command = [excitation.switching(rng, hold_steps=QUICK_STEPS) for _ in range(4)]
    size = excitation.FREE_AMPLITUDES[number // 2]
    return _start(hover, STARTS_V[number]), size * np.stack(command, axis=1)


@_manoeuvre(
    "High and away from people, turn at full stick for two seconds: flips, rolls, yaw, and both."
)
def _spins(number: int, hover: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    command = _swing(hover, HOVER_SWING, rng)
    command[:, :3] = SPIN_STICKS[number]
    climb = FLIP_CLIMB if np.any(command[0, :2]) else 0.0
    return _start(hover, STARTS_V[number], vel_w=(0.0, 0.0, climb)), command


@_manoeuvre("Move thrust up and down about hovering, from a full pack to an empty one.")
def _voltages(number: int, hover: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return _start(hover, STARTS_V[number]), _swing(hover, VOLTAGE_SWING, rng)


def hover_action(
    model: ModelParameters, voltages: tuple[float, float] = excitation.VOLTAGES
) -> float:
    """Return the thrust action at which a model's thrust holds its weight, at the mean voltage.

    If no action does, it is the nearest end of the stick. Effects are ignored, because they hardly
    matter for the start of a flight.
    """
    weight_n = float(model.m) * float(model.g)
    return thrust.hover_action(model.thrust_coeffs, weight_n, 0.5 * sum(voltages))


def flights_of(
    names: Iterable[str],
    hover: float,
    seed: int = 0,
    voltages: tuple[float, float] = excitation.VOLTAGES,
) -> list[excitation.ScriptedFlight]:
    """Return the flights of manoeuvres, eight of each, in the order of the names.

    The flights of a manoeuvre do not depend on the other names.

    Args:
        names: of manoeuvres.
        hover: the thrust action that holds the weight.
        seed: of random directions and waves.
        voltages: of an empty and a full battery, V.

    Raises:
        KeyError: no manoeuvre of that name.
    """
    flights = []
    for name in names:
        manoeuvre = MANOEUVRES[name]
        rng = np.random.default_rng([seed, list(MANOEUVRES).index(name)])
        for number in range(FLIGHTS_PER_MANOEUVRE):
            start, command = manoeuvre.flight(number, hover, rng)
            start[BATTERY] = np.interp(start[BATTERY], excitation.VOLTAGES, voltages)
            flights.append(excitation.ScriptedFlight(name, start, np.clip(command, -1.0, 1.0)))
    return flights
