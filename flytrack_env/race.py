"""The race: which gate is next, what was passed, laps and their times."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.fusion import compute_once
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.tracks import Course, GateFrame, cross_gate


class Race(NamedTuple):
    """Where the drone stands in the race, scalars.

    Attributes:
        gate_index: the gate to fly next, in [0, num_gates).
        gate, next_gate: its flight frame and that of the gate after it, kept because looking them
            up is the most expensive part of a step.
        gates_passed: in this episode.
        laps: completed, a lap being num_gates gates from wherever the episode began.
        lap_start_s: time of the crossing that began the lap.
        lap_time_s: the last complete lap, 0 if none.
    """

    gate_index: jax.Array
    gate: GateFrame
    next_gate: GateFrame
    gates_passed: jax.Array
    laps: jax.Array
    lap_start_s: jax.Array
    lap_time_s: jax.Array


class RaceEvents(NamedTuple):
    """What happened in one step: gates passed (0 to 2), lap completed, frame touched, gate missed.

    Attributes:
        offset: of the worst pass from its gate's centre, over the free half opening.
    """

    num_passed: jax.Array
    is_lap: jax.Array
    is_frame: jax.Array
    is_miss: jax.Array
    offset: jax.Array


def start_race(gate_index: jax.Array, course: Course) -> Race:
    """Return a race that begins now, with ``gate_index`` (int32) to fly first."""
    return Race(
        gate_index=gate_index,
        gate=course.gate(gate_index),
        next_gate=course.gate(course.next_index(gate_index)),
        gates_passed=jnp.int32(0),
        laps=jnp.int32(0),
        lap_start_s=jnp.float32(0.0),
        lap_time_s=jnp.float32(0.0),
    )


def _count_pass(
    race: Race, is_pass: jax.Array, time_s: Scalar, course: Course
) -> tuple[Race, jax.Array]:
    """Return the race after a possible pass, and whether a lap ended.

    The gate frames of the race are not moved on yet.
    """
    gates_passed = race.gates_passed + is_pass.astype(jnp.int32)
    is_lap = is_pass & (gates_passed == (race.laps + 1) * course.num_gates)
    counted = race._replace(
        gate_index=jnp.where(is_pass, course.next_index(race.gate_index), race.gate_index),
        gates_passed=gates_passed,
        laps=race.laps + is_lap.astype(jnp.int32),
        lap_start_s=jnp.where(is_lap, time_s, race.lap_start_s),
        lap_time_s=jnp.where(is_lap, time_s - race.lap_start_s, race.lap_time_s),
    )
    return counted, is_lap


def advance_race(
    race: Race,
    start_w: Vec3,
    end_w: Vec3,
    start_time_s: Scalar,
    dt: Scalar,
    course: Course,
    radius: Scalar,
) -> tuple[Race, RaceEvents]:
    """Return the race after a step from ``start_w`` to ``end_w``, and what happened.

    The segment meets the current gate and, behind that crossing, the next one: two gates in one
    step both count, each at its own time.
    """
    first = cross_gate(race.gate, start_w, end_w, radius)
    middle_w = start_w + (end_w - start_w).scale(first.fraction)
    second = cross_gate(race.next_gate, middle_w, end_w, radius)
    is_second = first.is_pass & second.is_pass
    second_fraction = first.fraction + (1.0 - first.fraction) * second.fraction

    first_time_s = start_time_s + first.fraction * dt
    second_time_s = start_time_s + second_fraction * dt
    after_first, is_first_lap = _count_pass(race, first.is_pass, first_time_s, course)
    after, is_second_lap = _count_pass(after_first, is_second, second_time_s, course)
    events = RaceEvents(
        num_passed=first.is_pass.astype(jnp.int32) + is_second.astype(jnp.int32),
        is_lap=is_first_lap | is_second_lap,
        is_frame=first.is_frame | (first.is_pass & second.is_frame),
        is_miss=first.is_miss | (first.is_pass & second.is_miss),
        offset=jnp.where(is_second, jnp.maximum(first.offset, second.offset), first.offset),
    )
    following = course.next_index(after.gate_index)
    after = after._replace(gate=course.gate(after.gate_index), next_gate=course.gate(following))
    return compute_once((after, events))
