"""What a drone sees of its opponents, and where they stand in the race."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.fusion import compute_once
from flytrack_env.observations import Entry
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.tracks import GateFrame

MAX_OBSERVED = 3
OPPONENT = (
    Entry(
        "opponent_position",
        "position of a nearest opponent relative to the drone",
        3,
        "gate",
        "m",
        3.0,
        10.0,
    ),
    Entry("opponent_velocity", "its velocity relative to the drone's", 3, "gate", "m/s", 5.0, 12.0),
    Entry("opponent_lead", "how many gates it is ahead", 1, "-", "gates", 1.0, 10.0),
)


class Standing(NamedTuple):
    """What others see of a drone, scalars.

    Attributes:
        pos_w, vel_w: world, m, m/s.
        progress: gates passed, and the share of the way to the next one.
        is_out: whether it is out of the race.
    """

    pos_w: Vec3
    vel_w: Vec3
    progress: jax.Array
    is_out: jax.Array


def opponent_table(num_drones: int) -> tuple[Entry, ...]:
    """Return the observation's rows on opponents: the three nearest, or all if there are fewer."""
    return OPPONENT * min(num_drones - 1, MAX_OBSERVED)


def observe_opponents(
    own: Standing, others: Sequence[Standing], gate: GateFrame
) -> list[jax.Array]:
    """Return the rows of ``opponent_table``, nearest first, in the frame of a drone's own gate.

    An opponent that is out of the race looks like one as far behind as an observation goes.
    """
    frame = (gate.forward, compute_once(gate.left()), gate.up)
    rows = [_rows(own, other, frame) for other in _nearest(own, others)]
    return [row for group in rows for row in group]


def _rows(own: Standing, other: Standing, frame: tuple[Vec3, ...]) -> list[jax.Array]:
    """Return one opponent's rows."""
    position, velocity, lead = OPPONENT
    quantities: list[tuple[Entry, Scalar, float]] = [
        *((position, axis.dot(other.pos_w - own.pos_w), 0.0) for axis in frame),
        *((velocity, axis.dot(other.vel_w - own.vel_w), 0.0) for axis in frame),
        (lead, other.progress - own.progress, -lead.limit),
    ]
    quantities[0] = (*quantities[0][:2], -position.limit)
    return [
        jnp.where(
            other.is_out, absent, jnp.clip(value * (1.0 / entry.scale), -entry.limit, entry.limit)
        )
        for entry, value, absent in quantities
    ]


def _nearest(own: Standing, others: Sequence[Standing]) -> list[Standing]:
    """Return the three nearest opponents, nearest first, those still in the race before the others.

    Of two that are equally near, as on a start grid, the one ahead comes first. By exchanging
    neighbours: a handful of selects, where a sort could not be part of the step's kernel.
    """
    if len(others) < 2:
        return list(others)

    def distance(other: Standing) -> jax.Array:
        apart = other.pos_w - own.pos_w
        return jnp.where(other.is_out, jnp.inf, apart.dot(apart))

    ranking = compute_once([(distance(other), other) for other in others])
    for rank in range(min(len(ranking) - 1, MAX_OBSERVED)):
        for i in reversed(range(rank, len(ranking) - 1)):
            pair = (first, nearer), (second, other) = ranking[i], ranking[i + 1]
            is_wrong = (second < first) | ((second == first) & (other.progress > nearer.progress))
            ranking[i] = jax.tree.map(lambda a, b, swap=is_wrong: jnp.where(swap, b, a), *pair)
            ranking[i + 1] = jax.tree.map(lambda a, b, swap=is_wrong: jnp.where(swap, a, b), *pair)
        ranking = compute_once(ranking)
    return [other for _, other in ranking[:MAX_OBSERVED]]


def rank_of(own: Standing, others: Sequence[Standing]) -> jax.Array:
    """Return the place in the race, int32, 1 for the first.

    Drones are ranked by progress; those that are out come last.
    """
    rank = jnp.int32(1)
    for other in others:
        is_ahead = (other.progress > own.progress) & (other.is_out == own.is_out)
        rank = rank + (is_ahead | (own.is_out & ~other.is_out)).astype(jnp.int32)
    return rank


def gap_of(own: Standing, others: Sequence[Standing]) -> jax.Array:
    """Return how many gates the best opponent is behind, float32: below 0 where it is ahead."""
    if not others:
        return jnp.float32(0.0)
    best = others[0].progress
    for other in others[1:]:
        best = jnp.maximum(best, other.progress)
    return own.progress - best


def progress_of(gates_passed: Scalar, pos_w: Vec3, centre_w: Vec3, leg_m: Scalar) -> jax.Array:
    """Return the gates passed plus the share of the way to the next gate, float32.

    Args:
        centre_w: of the next gate.
        leg_m: its distance from the gate before.
    """
    distance_m = jnp.asarray(compute_once((centre_w - pos_w).norm()))
    return jnp.asarray(gates_passed, distance_m.dtype) + 1.0 - distance_m / leg_m
