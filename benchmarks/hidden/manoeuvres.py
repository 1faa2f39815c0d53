"""Manoeuvres: what a scripted flight is put together from."""

import math
from collections.abc import Callable

import numpy as np

from benchmarks.hidden.plans import Rng, Sketch, steps_of
from benchmarks.hidden.truth import DT_S

# Of rate sticks: on each axis, one of each row in a minute. Beyond QUICK, pulses are short.
AMPLITUDES, QUICK = ((0.1, 0.2), (0.35, 0.6), (1.0,)), 0.6
PULSE_S, QUICK_PULSE_S = (0.15, 0.3), (0.08, 0.16)  # a full stick turns by 90 degrees in 0.15 s
CHIRP_S, CHIRP_FROM_HZ, CHIRP_HZ_PER_S = 1.3, 1.2, (3.0, 8.0)
RECOVER_S, AFTER_FLIP_S, AFTER_STEPS_S, AFTER_LOW_S = 1.0, 1.6, 0.8, 0.4
JUMP_S, JUMP_STICK, FLIP_S, FLIP_STICK = 0.2, 0.6, (0.45, 0.62), (-0.6, -0.1)
# Steps of thrust: sticks, and how long they are held; the higher, the shorter, to end near the same speed.
STEPS_UP, STEPS_DOWN, HELD_DOWN_S = (0.1, 1.0), (-1.0, -0.4), 0.3
HELD_UP_S, SHORTER_S, UNEVEN = 0.45, 0.3, (0.8, 1.2)  # the middle one per unit of stick
HOMEWARD_M, HOMEWARD_SPREAD = 30.0, 0.4  # from the origin, where legs lead back; rad
SPEEDING_UP, MOST_NOSE_RATE = 7.0, 1.0  # m/s^2, rad/s
HIGH_M = (16.0, 24.0)  # where manoeuvres on one stick are flown
HIGH_SPEEDS, HIGH_HOLD_S, HIGH_TURNING = (2.0, 18.0), (0.4, 1.2), 0.5  # m/s, s, rad/s
LOW_SPEEDS, LOW_HOLD_S, LOW_TURNING = (0.5, 12.0), (0.5, 1.2), 0.3
LOW_M, SINK_M, SINK_S, SETTLE_S = (0.15, 1.0), 0.7, 0.8, 0.7  # the last metre is sunk slowly
LOWER_M, SLOWER = 0.2, 0.9  # what a pilot who has to fly again changes: low heights, and speeds
YAW_TURN = (1.2, math.pi)  # rad


def leg(sketch: Sketch, speed: float, hold_s: float, turning: float) -> None:
    """Append a leg: up to a speed, hold it, and brake; its direction turns, rad/s, and leads home.

    The nose points anywhere, and turns slowly.
    """
    rng = sketch.rng
    x, y, _ = sketch.pos_w
    way = rng.uniform(-math.pi, math.pi)
    if math.hypot(x, y) > HOMEWARD_M:
        way = math.atan2(-y, -x) + rng.normal(0.0, HOMEWARD_SPREAD)
    sketch.turn_to(sketch.heading + rng.uniform(-1.0, 1.0) * math.pi * rng.integers(2))
    nose = rng.uniform(-1.0, 1.0) * MOST_NOSE_RATE
    ramp = max(1, steps_of(speed / SPEEDING_UP))
    shares = np.concatenate([np.linspace(0, 1, ramp), np.ones(steps_of(hold_s)), np.linspace(1, 0, ramp)])
    for share in shares.tolist():
        way += turning * DT_S
        vel_w = (share * speed * math.cos(way), share * speed * math.sin(way), 0.0)
        sketch.add(vel_w, sketch.heading + nose * DT_S)


def wave(axis: int, amplitude: float, rng: Rng) -> np.ndarray:
    """Return a doublet, chirp or short pulse on one rate stick, the other two centred, (num_rows, 4)."""
    name, sign = rng.choice(["doublet", "chirp", "pulses"]), rng.choice([-1.0, 1.0])
    if name == "chirp":
        time = np.arange(steps_of(CHIRP_S)) * DT_S
        shape = np.cos(2.0 * np.pi * (CHIRP_FROM_HZ * time + 0.5 * rng.uniform(*CHIRP_HZ_PER_S) * time**2))
    else:
        steps = steps_of(rng.uniform(*(QUICK_PULSE_S if amplitude >= QUICK else PULSE_S)))
        gap = 0 if name == "doublet" else steps
        shape = np.concatenate([np.ones(steps), np.zeros(gap), -np.ones(steps), np.zeros(gap)])
    sticks = np.zeros((len(shape), 4))
    sticks[:, axis], sticks[:, 3] = sign * amplitude * shape, np.nan
    return sticks


def manoeuvre(sketch: Sketch, axis: int, amplitude: float) -> None:
    """Append a wave on one rate stick, and time to recover."""
    sketch.hands_on(wave(axis, amplitude, sketch.rng))
    sketch.wait(RECOVER_S)


def flip(sketch: Sketch) -> None:
    """Append a jump and about one turn in the air at full stick, and time to recover."""
    rng = sketch.rng
    jump, turn = np.full((steps_of(JUMP_S), 4), np.nan), np.zeros((steps_of(rng.uniform(*FLIP_S)), 4))
    jump[:, 3] = JUMP_STICK
    turn[:, rng.integers(2)], turn[:, 3] = rng.choice([-1.0, 1.0]), rng.uniform(*FLIP_STICK)
    sketch.hands_on(np.concatenate([jump, turn]))
    sketch.wait(AFTER_FLIP_S)


def thrust_steps(sketch: Sketch) -> None:
    """Append steps of the thrust stick up and down, upright, and time to recover."""
    rng = sketch.rng
    sticks = []
    for up in rng.permutation([1.0, 0.0, 1.0, 0.0]).tolist():
        level = rng.uniform(*(STEPS_UP if up else STEPS_DOWN))
        seconds = rng.uniform(*UNEVEN) * (HELD_UP_S - SHORTER_S * level if up else HELD_DOWN_S)
        sticks.append(np.tile([np.nan, np.nan, np.nan, level], (steps_of(seconds), 1)))
    sketch.hands_on(np.concatenate(sticks))
    sketch.wait(AFTER_STEPS_S)


def low_pass(sketch: Sketch) -> None:
    """Append a descent, a leg near the ground, and a climb half way."""
    rng = sketch.rng
    raised = LOWER_M * sketch.caution
    height = math.exp(rng.uniform(*np.log(LOW_M))) + raised
    sketch.climb_to(height + SINK_M)
    for _ in range(steps_of(SINK_S)):
        sketch.add((0.0, 0.0, -SINK_M / SINK_S))
    sketch.wait(SETTLE_S)
    speed = SLOWER**sketch.caution * rng.uniform(*LOW_SPEEDS)
    leg(sketch, speed, rng.uniform(*LOW_HOLD_S), rng.normal(0.0, LOW_TURNING))
    sketch.wait(AFTER_LOW_S)


Block = Callable[[Sketch], None]


def _fast(low: float, high: float) -> Block:
    def block(sketch: Sketch) -> None:
        rng = sketch.rng
        speed = SLOWER**sketch.caution * rng.uniform(low, high)
        leg(sketch, speed, rng.uniform(*HIGH_HOLD_S), rng.normal(0.0, HIGH_TURNING))

    return block


def _yaw_turn(sketch: Sketch) -> None:
    sketch.turn_to(sketch.heading + sketch.rng.choice([-1.0, 1.0]) * sketch.rng.uniform(*YAW_TURN))


def _on_axis(axis: int, amplitude: float) -> Block:
    return lambda sketch: manoeuvre(sketch, axis, amplitude)


def cycle(sketch: Sketch) -> None:
    """Append 50 to 60 s: manoeuvres and legs at height, two low passes among them."""
    rng = sketch.rng
    waves = [(axis, float(rng.choice(row))) for axis in range(3) for row in AMPLITUDES]
    first, last = HIGH_SPEEDS
    middle = 0.5 * (first + last)
    blocks: list[Block] = [
        *(_on_axis(*one) for one in waves),
        _fast(middle, last),
        _fast(first, middle),
        _fast(first, last),
        thrust_steps,
        thrust_steps,
        flip,
        _yaw_turn,
    ]
    blocks = [blocks[number] for number in rng.permutation(len(blocks))]
    half = len(blocks) // 2
    for number, block in enumerate(blocks):
        if number == half:
            low_pass(sketch)
            low_pass(sketch)
            sketch.climb_to(rng.uniform(*HIGH_M))
        block(sketch)
