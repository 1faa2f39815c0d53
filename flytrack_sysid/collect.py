"""Excitation: short manoeuvres, one axis at a time, flown on a plant from chosen states.

Rate axes: sines, steps, doublets and chirps at several amplitudes, at about hovering thrust. Thrust: sweeps
over the whole stick at voltages from full to nearly empty. Legs: tilted flight from several speeds and
headings, where what the minimal model lacks shows.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import signal

from flytrack_env.dynamics import nominal_parameters
from flytrack_env.plants import Plant
from flytrack_env.state import (
    ACTION_SIZE,
    BATTERY,
    BATTERY_EMPTY_V,
    BATTERY_FULL_V,
    QUATERNION,
    STATE_SIZE,
    VELOCITY,
    pack,
    unpack,
    unpack_action,
)

DT = 0.01
NUM_STEPS = 150
AMPLITUDES = (0.1, 0.3, 0.6, 1.0)
LEG_SPEEDS = (3.0, 8.0, 14.0)
HOVER_THRUST = -0.25
CRUISE_HEIGHT = 50.0
RESERVE_V = 0.05


class Excitation(NamedTuple):
    """What was flown; leaves (num_manoeuvres, num_steps, ...), float32, 100 Hz.

    states: (21,) before each step. actions: (4,) commanded. next_states: (21,) after it.
    kinds: a name per manoeuvre: roll, pitch, yaw, thrust or leg.
    """

    states: np.ndarray
    actions: np.ndarray
    next_states: np.ndarray
    kinds: tuple[str, ...]

    def select(self, manoeuvres: np.ndarray) -> "Excitation":
        """Return some of the manoeuvres, by index or mask."""
        kinds = tuple(np.array(self.kinds)[manoeuvres])
        arrays = (self.states, self.actions, self.next_states)
        return Excitation(*(array[manoeuvres] for array in arrays), kinds)

    def split(self) -> tuple["Excitation", "Excitation"]:
        """Return training data and held-out data: every fourth manoeuvre, of each kind, is held out."""
        order: dict[str, int] = {}
        held_out = []
        for kind in self.kinds:
            order[kind] = order.get(kind, -1) + 1
            held_out.append(order[kind] % 4 == 3)
        mask = np.array(held_out)
        return self.select(~mask), self.select(mask)


def waveforms(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return one sine, step, doublet and chirp each, (num_steps,), amplitude 1, random phase or timing."""
    time = np.arange(NUM_STEPS) * DT
    duration = NUM_STEPS * DT
    begin = rng.uniform(0.1, 0.3) * duration
    width = rng.uniform(0.15, 0.3) * duration
    is_on = (time >= begin) & (time < begin + width)
    is_reversed = (time >= begin + width) & (time < begin + 2 * width)
    sign = rng.choice([-1.0, 1.0])
    return {
        "sine": np.sin(2 * np.pi * rng.uniform(0.7, 3.0) * time + rng.uniform(0, 2 * np.pi)),
        "step": sign * is_on,
        "doublet": sign * (is_on.astype(float) - is_reversed),
        "chirp": sign * signal.chirp(time, f0=0.5, t1=duration, f1=15.0, phi=-90),
    }


def start_state(rng: np.random.Generator, voltage: float, tilt_deg: float, speed: float) -> Any:
    """Return a start, (21,): tilted towards a random side, moving along a random direction."""
    x = np.zeros(STATE_SIZE)
    x[2] = CRUISE_HEIGHT
    heading, side = rng.uniform(-np.pi, np.pi, 2)
    half = 0.5 * np.deg2rad(tilt_deg)
    x[QUATERNION] = [np.cos(half), np.sin(half) * np.cos(side), np.sin(half) * np.sin(side), 0.0]
    x[VELOCITY] = [speed * np.cos(heading), speed * np.sin(heading), rng.uniform(-0.2, 0.2) * speed]
    x[16:20] = [0.0, 0.0, 0.0, HOVER_THRUST]
    x[BATTERY] = voltage
    return x


def script(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Return starts (num_manoeuvres, 21), commands (num_manoeuvres, num_steps, 4) and kinds."""
    starts, commands, kinds = [], [], []
    drain = nominal_parameters().battery_drain_v_per_min * NUM_STEPS * DT / 60.0
    lowest = BATTERY_EMPTY_V + drain + RESERVE_V

    def add(kind: str, command: np.ndarray, voltage: float, tilt_deg: float, speed: float) -> None:
        starts.append(start_state(rng, voltage, tilt_deg, speed))
        commands.append(np.clip(command, -1.0, 1.0))
        kinds.append(kind)

    for axis, kind in enumerate(("roll", "pitch", "yaw")):
        for amplitude in AMPLITUDES:
            for wave in waveforms(rng).values():
                command = np.full((NUM_STEPS, ACTION_SIZE), [0.0, 0.0, 0.0, HOVER_THRUST])
                command[:, axis] = amplitude * wave
                add(kind, command, rng.uniform(lowest, BATTERY_FULL_V), 0.0, 0.0)
    for voltage in np.linspace(lowest, BATTERY_FULL_V, 8):
        for wave in waveforms(rng).values():
            command = np.zeros((NUM_STEPS, ACTION_SIZE))
            command[:, 3] = wave
            add("thrust", command, voltage, rng.uniform(0.0, 20.0), 0.0)
    for speed in LEG_SPEEDS:
        for _ in range(8):
            command = np.zeros((NUM_STEPS, ACTION_SIZE))
            command[:, 3] = HOVER_THRUST + 0.3 * waveforms(rng)["sine"]
            add("leg", command, rng.uniform(lowest, BATTERY_FULL_V), rng.uniform(0, 60), speed)
    return np.array(starts), np.array(commands), tuple(kinds)


def collect(plant: Plant, seed: int = 0) -> Excitation:
    """Fly the excitation script on a plant and return what was measured.

    plant: anything with the contract of ``flytrack_env.plants``; only its outputs are used.
    """
    starts, commands, kinds = script(np.random.default_rng(seed))
    model = nominal_parameters()  # part of the contract; a black box does not look at it

    def fly(start: jax.Array, command: jax.Array) -> tuple[jax.Array, jax.Array]:
        def step(state: Any, action: jax.Array) -> tuple:
            next_state = plant.step(state, unpack_action(action), DT, model)
            return next_state, (pack(plant.drone(state)), pack(plant.drone(next_state)))

        return jax.lax.scan(step, plant.reset(unpack(start), model), command)[1]

    commands = commands.astype(np.float32)
    states, next_states = jax.jit(jax.vmap(fly))(jnp.asarray(starts, jnp.float32), commands)
    return Excitation(np.asarray(states), commands, np.asarray(next_states), kinds)
