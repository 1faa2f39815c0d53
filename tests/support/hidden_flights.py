"""Flights of hidden plants: scripted as logs, and by given commands in plain floats."""

from dataclasses import replace

import numpy as np

from benchmarks.hidden import draw_base, fly, measure
from flytrack_bench.hidden import HiddenDrone, Start

LOW_START = Start((1.0, -2.0, 3.0), 0.7, 23.5, -0.3)
# The state as the handout has it; what is tracked and what is felt of each step.
COLUMNS = ("x", "p", "v", "q", "f", "w", "slope")


def scripted(seed, seconds, noise="sensors", **changes):
    """Return a plant of a seed, with some fields replaced, and the measured log of its flight."""
    rng = np.random.default_rng(seed)
    truth = replace(draw_base(rng), **changes)
    return truth, measure(fly(truth, seconds, rng), noise, rng)


def state_of(plant):
    """Return the handout's vector (21,) of a plant."""
    vectors = (plant.pos_w, plant.vel_w, plant.acc_w, plant.quat, plant.rates_b, plant.applied)
    return np.concatenate([*vectors, [plant.battery_v]])


def flown_in_floats(truth, commands, start=LOW_START):
    """Return ``COLUMNS`` after each command, (num_steps, n)."""
    plant, rows = HiddenDrone(truth, start, np.random.default_rng(5)), []
    for command in np.asarray(commands, float).tolist():
        plant.step(tuple(command))
        rows.append((state_of(plant), *plant.tracked, *plant.felt))
    columns = map(np.array, zip(*rows, strict=True))
    return dict(zip(COLUMNS, columns, strict=True))


def random_sticks(num_steps):
    """Return steps of the sticks at random, each held for ten steps, (num_steps, 4)."""
    sticks = np.random.default_rng(4).uniform(-1.0, 1.0, (num_steps // 10, 4))
    return np.repeat(sticks * [0.5, 0.5, 1.0, 1.0], 10, axis=0)
