"""Where the search begins: along the way from gate to gate at an even pace, thrust where it is needed."""

import numpy as np

from benchmarks.optimal.problem import Guess, Task
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import (
    ACCELERATION,
    ACTION_SIZE,
    APPLIED_ACTION,
    BATTERY,
    POSITION,
    QUATERNION,
    STATE_SIZE,
    VELOCITY,
)
from flytrack_env.tracks import hermite_curve, sample_way

FINE = 400  # points of the way per segment, to measure along it
GRAVITY = np.array([0.0, 0.0, 9.80665])  # m/s^2, good enough to begin with whatever the model's
FOLLOW = None  # a heading that turns with the way
UPSIDE_DOWN = 1e-6  # of a quaternion: no shortest turn leads there


def _ways(task: Task) -> np.ndarray:
    """Return points of the way to every gate, (num_gates, FINE, 3), m; the first may be from the start."""
    ways = np.roll(sample_way(task.course, FINE), 1, axis=0)
    if not task.is_lap:
        gates, position = task.course.gates, task.start[POSITION]
        centre = np.array([np.float64(axis[0]) for axis in gates.centre])
        forward = np.array([np.float64(axis[0]) for axis in gates.forward])
        chord = centre - position
        length = np.linalg.norm(chord)
        s = np.linspace(0.0, 1.0, FINE)
        ends = (position, chord, centre, forward * length)
        start, leave, end, meet = (Vec3(*vector) for vector in ends)
        ways[0] = np.stack(hermite_curve(start, leave, end, meet, s)[0], axis=-1)
    return ways


def segment_lengths(task: Task) -> np.ndarray:
    """Return the length of the way to every gate from the one before, or the start, (num_gates,), m."""
    return np.linalg.norm(np.diff(_ways(task), axis=1), axis=-1).sum(axis=1)


def _along(points: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Return points at shares of the length of a polyline."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return np.stack([np.interp(shares * lengths[-1], lengths, axis) for axis in points.T], axis=1)


def _attitudes(thrust_w: np.ndarray, velocity: np.ndarray, heading_rad: float | None) -> np.ndarray:
    """Return attitudes, (N, 4), whose body z lies along thrust_w, after a heading; without jumps in sign."""
    quats: list[np.ndarray] = []
    for force, speed in zip(thrust_w, velocity, strict=True):
        axis = force / np.linalg.norm(force)
        # The shortest turn from the world's z to the axis, after a turn about z.
        tilt = np.array([1.0 + axis[2], -axis[1], axis[0], 0.0])
        tilt = tilt / max(np.linalg.norm(tilt), UPSIDE_DOWN)
        half = 0.5 * (np.arctan2(speed[1], speed[0]) if heading_rad is None else heading_rad)
        turn = Quaternion(np.cos(half), 0.0, 0.0, np.sin(half))
        quat = np.array(Quaternion(*tilt).multiply(turn))
        quats.append(-quat if quats and quat @ quats[-1] < 0.0 else quat)
    return np.array(quats)


def first_guess(task: Task, counts: np.ndarray, speed_m_s: float, heading_rad: float | None) -> Guess:
    """Return a flight along the way at one speed, m/s, that turns to a heading, rad, or along the way.

    counts: (num_gates,), steps of each segment. It satisfies no equation of motion.
    """
    ways = _ways(task)
    steps_s = segment_lengths(task) / speed_m_s / counts
    pieces = [_along(way, np.arange(n) / n) for way, n in zip(ways, counts, strict=True)]
    positions = np.concatenate([*pieces, ways[-1][-1:]])
    times = np.concatenate([[0.0], np.cumsum(np.repeat(steps_s, counts))])
    velocity = np.gradient(positions, times, axis=0)
    acceleration = np.gradient(velocity, times, axis=0)
    if task.is_lap:
        velocity[0] = velocity[-1] = 0.5 * (velocity[0] + velocity[-1])
    states = np.zeros((len(times), STATE_SIZE))
    states[:, POSITION], states[:, VELOCITY], states[:, ACCELERATION] = positions, velocity, acceleration
    states[:, QUATERNION] = _attitudes(acceleration + GRAVITY, velocity, heading_rad)
    states[:, BATTERY] = task.start[BATTERY]
    if not task.is_lap:
        states[0] = task.start
        if states[0, QUATERNION] @ states[1, QUATERNION] < 0.0:
            states[1:, QUATERNION] *= -1.0
    states[1:, APPLIED_ACTION] = 0.0
    commands = np.zeros((len(times) - 1, ACTION_SIZE))
    return Guess(states, commands, steps_s, np.ones(len(counts)))


def resample(flight: Guess, counts: np.ndarray, new_counts: np.ndarray) -> Guess:
    """Return a flight cut into other numbers of steps of each segment, over the same times."""
    old = np.concatenate([[0.0], np.cumsum(np.repeat(flight.steps_s, counts))])
    steps_s = flight.steps_s * counts / new_counts
    new = np.concatenate([[0.0], np.cumsum(np.repeat(steps_s, new_counts))])
    states = np.stack([np.interp(new, old, column) for column in flight.states.T], axis=1)
    states[:, QUATERNION] /= np.linalg.norm(states[:, QUATERNION], axis=1, keepdims=True)
    middles = 0.5 * (new[:-1] + new[1:])
    held = np.clip(np.searchsorted(old, middles, side="right") - 1, 0, len(flight.commands) - 1)
    return Guess(states, flight.commands[held], steps_s, flight.fractions)
