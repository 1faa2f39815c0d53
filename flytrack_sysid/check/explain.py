"""The fewest channels whose change makes all pairs of channels agree.

Each channel is a node, with the frame in which it was logged; each pair is an edge, which allows
some relative frames. Body frame: commands - gyroscope - attitude - accelerometer. World frame:
attitude - velocity - position. The edge of attitude, velocity and accelerometer joins both; gravity
and the direction of the thrust fix what is up.
"""

from collections.abc import Mapping
from itertools import islice, product
from typing import NamedTuple

import numpy as np

from flytrack_sysid.check.frames import (
    COSTS,
    IDENTITY,
    INVERSE,
    NUM_FRAMES,
    PRODUCT,
    READINGS,
    ROTATIONS,
    UP_OF,
    name_of,
    number_of,
)

CHANGED, MIRRORED = 1.0, 0.5  # cost of a changed channel; added if its axes are a mirror image
MAX_LISTED = 200  # explanations that are alike
NODES = ("u_rates", "w", "f", "v", "p")


class Change(NamedTuple):
    """How a channel was logged in another way than it was read.

    Attributes:
        channel: of ``CHANNELS``, or "u_rates", "u_thrust", "motors", "rows", "model".
        kind: "axes", "order", "conjugate", "body", "world", "scale", "delay", "curve", "range",
            "held", "repeated", "wrapped", or a field of a model.
        value: what was logged, such as "x -y -z", or the factor or seconds by which it differs.
    """

    channel: str
    kind: str
    value: str | float | bool


class Edges(NamedTuple):
    """Relative frames that the pairs of a log allow.

    Attributes:
        rates: attitude with gyroscope, by reading of the quaternion, (num_readings, 48) bool.
        forces: attitude with velocity and accelerometer, (num_readings, 6, 48, 48) bool.
        positions: position with velocity, (48,) bool.
        commands: gyroscope with commands, (48,) bool.
        force_up: directions of the log's axes in which the thrust may point, (6,) bool.
    """

    rates: np.ndarray
    forces: np.ndarray
    positions: np.ndarray
    commands: np.ndarray
    force_up: np.ndarray


class Explanation(NamedTuple):
    """Frames in which the channels of a log were logged.

    Attributes:
        reading: row of ``READINGS``; -1 for quaternions that were read right.
        body: frame of the attitude's body, of ``FRAMES``.
        world: frame of the attitude's world.
        frames: of the channels in ``NODES``.
    """

    reading: int
    body: int
    world: int
    frames: Mapping[str, int]

    def changes(self) -> tuple[Change, ...]:
        """Return what differs from how the log was read."""
        reading = READINGS[self.reading]
        found = [Change("q", "order", reading.order)] * (reading.order != "wxyz")
        found += [Change("q", "conjugate", True)] * reading.is_conjugate
        for kind, frame in (("body", self.body), ("world", self.world)):
            found += [Change("q", kind, name_of(frame))] * (frame != IDENTITY)
        found += [
            Change(channel, "axes", name_of(frame))
            for channel, frame in self.frames.items()
            if frame != IDENTITY
        ]
        return tuple(found)


# Frames that all channels of a body or a world may share: the whole log is FRD, or NED, which is
# one change.
BODY_FRAMES = (IDENTITY, number_of(np.diag([1.0, -1.0, -1.0])))
WORLD_FRAMES = (
    *BODY_FRAMES,
    number_of(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])),
)


RELATIVE = PRODUCT[:, INVERSE]  # [one, other]: one @ other.T
# [frame of the attitude, relative frame]: that of velocity or accelerometer which follows.
OTHER = PRODUCT[INVERSE].T


def _costs(is_logged: bool, shared: int, numbers: np.ndarray | None = None) -> np.ndarray:
    """Return the cost of each frame of a channel, (48,), where the others have a shared one."""
    costs = np.full(NUM_FRAMES, np.inf)
    if not is_logged:
        costs[IDENTITY] = 0.0
        return costs
    allowed = np.arange(NUM_FRAMES) if numbers is None else numbers
    is_mirrored = ~np.isin(allowed, ROTATIONS)
    costs[allowed] = np.where(allowed == shared, 0.0, CHANGED + MIRRORED * is_mirrored)
    return costs


def _forbidden(is_allowed: np.ndarray) -> np.ndarray:
    return np.where(is_allowed, 0.0, np.inf)


class _Costs(NamedTuple):
    """Costs of explanations with one reading of the quaternion and shared frames.

    Attributes:
        total: by the attitude's world and body, each beside the relative frame of velocity and of
            accelerometer, (24, 48, 24, 48): the lowest of the frames that are not named here.
        positions: of the position's frame, by that of the velocity, (48, 48).
        sticks: of the frames of gyroscope and commands, by that of the attitude's body,
            (48, 48, 48).
    """

    total: np.ndarray
    positions: np.ndarray
    sticks: np.ndarray


def explain(channels: frozenset[str], edges: Edges) -> list[Explanation]:
    """Return the explanations of a log with the fewest changed channels, simplest first.

    Mirror images are listed beside what is as simple but for them.

    Args:
        channels: of the log: "q" and those of ``NODES``.
        edges: what its pairs allow.
    """
    cheapest, lowest = np.inf, {}
    for body, world, reading in product(BODY_FRAMES, WORLD_FRAMES, range(len(READINGS))):
        key = body, world, reading
        lowest[key] = _least(key, channels) if cheapest > 0.0 else np.inf
        if lowest[key] < cheapest:
            costs = _build_costs(key, channels, edges)
            lowest[key] = np.inf if costs is None else float(costs.total.min())
            cheapest = min(cheapest, lowest[key])
    if not np.isfinite(cheapest):
        return []
    limit = cheapest + (MIRRORED if cheapest > 0.0 else 0.0)
    found: list[tuple[float, int, Explanation]] = []
    for key, cost in lowest.items():
        costs = _build_costs(key, channels, edges) if cost <= limit else None
        if costs is not None:
            found += _listed(costs, key[2], limit)
    unique: dict[tuple[Change, ...], Explanation] = {}
    for _, _, one in sorted(found, key=lambda each: each[:2]):
        unique.setdefault(one.changes(), one)
    return list(unique.values())


def _least(key: tuple[int, int, int], channels: frozenset[str]) -> float:
    """Return what shared frames and a reading cost at least; infinity for impossible ones."""
    body, world, reading = key
    misread = (READINGS[reading].order != "wxyz") + READINGS[reading].is_conjugate
    if misread and "q" not in channels:
        return np.inf
    return CHANGED * (misread + (body != IDENTITY) + (world != IDENTITY))


def _build_costs(
    key: tuple[int, int, int], channels: frozenset[str], edges: Edges
) -> _Costs | None:
    """Return the costs with shared frames of body and world, and a reading; None if impossible."""
    body_frame, world_frame, number = key
    if not (edges.rates[number].any() and edges.forces[number].any()):
        return None
    body_costs = _costs("q" in channels, body_frame, ROTATIONS)[:, None]
    world_costs = _costs("q" in channels, world_frame, ROTATIONS)[:, None]
    commands, rates, force = (_costs(name in channels, body_frame) for name in NODES[:3])
    velocity, position = (_costs(name in channels, world_frame) for name in NODES[3:])
    force = force + _forbidden(edges.force_up[UP_OF])
    by_command = commands[None] + _forbidden(edges.commands[RELATIVE])  # (rates, commands)
    by_position = position[:, None] + _forbidden(edges.positions[RELATIVE])  # (position, velocity)
    by_rates = rates[None] + _forbidden(edges.rates[number][RELATIVE])  # (body, rates)
    sticks = by_rates[:, :, None] + by_command[None]
    world = (world_costs + (velocity + by_position.min(axis=0))[OTHER])[ROTATIONS]
    body = (body_costs + sticks.min(axis=(1, 2))[:, None] + force[OTHER])[ROTATIONS]
    total = (
        _least(key, channels)
        + world[:, :, None, None]
        + body[None, None]
        + _forbidden(edges.forces[number][UP_OF[ROTATIONS]])[:, :, None, :]
    )
    return _Costs(total, by_position, sticks)


def _listed(costs: _Costs, reading: int, limit: float) -> list[tuple[float, int, Explanation]]:
    """Return explanations up to a cost, each after its cost and how many axes it changes."""
    found = []
    for row, moved, column, turned in islice(np.argwhere(costs.total <= limit), MAX_LISTED):
        cost = costs.total[row, moved, column, turned]
        world, body = int(ROTATIONS[row]), int(ROTATIONS[column])
        velocity, force = int(OTHER[world, moved]), int(OTHER[body, turned])
        positions = costs.positions[:, velocity] - costs.positions[:, velocity].min()
        sticks = costs.sticks[body] - costs.sticks[body].min()
        places = np.flatnonzero(cost + positions <= limit)
        for place, (gyro, stick) in product(places, np.argwhere(cost + sticks <= limit)):
            whole = float(cost + positions[place] + sticks[gyro, stick])
            if whole > limit:
                continue
            values = (stick, gyro, force, velocity, place)
            frames = {name: int(value) for name, value in zip(NODES, values, strict=True)}
            one = Explanation(reading, body, world, frames)
            axes = sum(COSTS[frame] for frame in (body, world, *frames.values()))
            found.append((whole, int(axes), one))
    return found
