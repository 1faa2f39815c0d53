"""The check of a simulator that somebody else wrote: flown by a standard excitation.

Each episode starts at rest and lasts a second or two, so that it needs no controller: a tilt, held
and taken back, with a turn about z, under some thrust.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.state import POSITION, QUATERNION, RATES, VELOCITY
from flytrack_sysid.check.result import Check, check_log
from flytrack_sysid.log import FlightLog

Step = Callable[[np.ndarray, np.ndarray], np.ndarray]
NUM_EPISODES, EPISODE_S = 60, 1.6
PULSE_S, TILTED_S = 0.15, 0.6  # of a rate command; between it and its opposite
LARGEST_PULSE = 0.35  # of the full stick
SEED = 0
# The handout's state; it begins at rest, 5 m up, with full propellers' hover left to the plant.
HANDOUT = {
    "dt": 0.01,
    "actions": 4,
    "p": range(21)[POSITION],
    "v": range(21)[VELOCITY],
    "q": range(21)[QUATERNION],
    "w": range(21)[RATES],
}


def excitation(dt: float, rng: np.random.Generator) -> np.ndarray:
    """Return the commands of an episode, (num_steps, 4) in [-1, 1]."""
    steps, pulse, tilted = (round(seconds / dt) for seconds in (EPISODE_S, PULSE_S, TILTED_S))
    commands = np.zeros((steps, 4))
    for axis in range(3):
        start = rng.integers(1, max(2, steps - tilted - 2 * pulse))
        size = rng.uniform(0.1, LARGEST_PULSE) * rng.choice([-1.0, 1.0])
        commands[start : start + pulse, axis] = size
        back = start + pulse + tilted
        commands[back : back + pulse, axis] = -size
    levels = rng.uniform(-1.0, 1.0, 4)
    commands[:, 3] = np.repeat(levels, -(-steps // len(levels)))[:steps]
    return commands


def fly(step: Step, layout: dict[str, Any], seed: int = SEED) -> FlightLog:
    """Return the log of episodes of a plant, a segment each.

    Args:
        step: the state after ``dt`` from a state and an action, both (n,).
        layout: ``dt``, s; ``x0``, the state at rest; indices of ``p``, ``v``, ``w`` and ``q`` in a
            state: 4 are a quaternion, 3 roll, pitch and yaw, 9 a matrix by rows.
        seed: of the excitation.
    """
    rng, dt = np.random.default_rng(seed), float(layout["dt"])
    states, commands, segments = [], [], []
    for episode in range(NUM_EPISODES):
        x = np.asarray(layout["x0"], float)
        for command in excitation(dt, rng):
            states.append(x)
            commands.append(command)
            segments.append(episode)
            x = np.asarray(step(x, command), float)
    values = np.array(states)
    channels = {"u": np.array(commands)}
    for name in (name for name in ("p", "v", "q", "w") if name in layout):
        numbers = values[:, list(layout[name])]
        channels[name] = quaternions_of(numbers) if name == "q" else numbers
    time = np.arange(len(values)) * dt
    return FlightLog(time, channels, np.array(segments), "plant", "simulated")


def quaternions_of(numbers: np.ndarray) -> np.ndarray:
    """Return quaternions, (num_rows, 4), of an attitude in 4, 3 or 9 numbers."""
    if numbers.shape[1] == 4:
        return numbers / np.linalg.norm(numbers, axis=1, keepdims=True)
    if numbers.shape[1] == 3:
        attitude = Rotation.from_euler("ZYX", numbers[:, ::-1])
    else:
        attitude = Rotation.from_matrix(numbers.reshape(-1, 3, 3))
    return attitude.as_quat(scalar_first=True)


def check_plant(step: Step, layout: dict[str, Any], seed: int = SEED) -> Check:
    """Return where a plant's conventions differ from FlyTrack's; ``fly`` describes a layout."""
    return check_log(fly(step, layout, seed))
