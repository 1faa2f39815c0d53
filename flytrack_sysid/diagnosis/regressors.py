"""What an unknown effect may depend on, as smooth features of the flight, and their forces and rates."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from flytrack_sysid.diagnosis.lanes import Lanes
from flytrack_sysid.diagnosis.noise import step_to

TIME_WAVES, RANK_WAVES, CHANGE_WAVES, HEADING_WAVES, PLACE_WAVES = 8, 6, 4, 4, 2
TINY_SPEED = 0.3  # m/s: slower flight has no direction
SIDES = {"rate": slice(0, 3), "force": slice(3, 6)}  # axes of a residual
STICKS = 4
# Bumps about places on the way: how many places, and widths, m.
BUMP_PLACES, BUMP_WIDTHS_M = 24, (3.0, 8.0)
BUMP_SIZE = 3  # features of one bump: a force along each world axis


class Flown(NamedTuple):
    """The flight at the step to each row, (rows, lanes, ...): what a force or rate of the step may depend on.

    body_to_world: (rows, lanes, 3, 3). time_share: 0 to 1. counts: bool, rows that are measured.
    """

    body_to_world: np.ndarray
    pos_w: np.ndarray
    vel_w: np.ndarray
    applied: np.ndarray
    change: np.ndarray
    time_s: np.ndarray
    counts: np.ndarray


def flown(lanes: Lanes, tau: np.ndarray) -> Flown:
    """Return what was flown; tau: (4,) s, lags by which commands become sticks that act."""

    def before(values: np.ndarray) -> np.ndarray:  # a step begins at the row before
        return np.concatenate([values[:1], values[:-1]])

    record = lanes.record
    shape = lanes.row.shape
    quat = before(record.quat).reshape(-1, 4)
    rotation = Rotation.from_quat(quat, scalar_first=True).as_matrix().reshape(*shape, 3, 3)
    applied = _lagged(record.command, record.step_s, tau)
    step_s = step_to(lanes)
    starts = np.where(lanes.row >= 0, lanes.row, 0)
    usual = float(np.median(step_s))
    change = (record.command - applied) / tau
    counts = lanes.counts.any(axis=(2, 3))
    return Flown(
        rotation, before(record.pos_w), before(record.vel_w), applied, before(change), starts * usual, counts
    )


def _lagged(command: np.ndarray, step_s: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return commands behind a first-order lag; lanes lead in, so that where they begin is forgotten."""
    applied = command.copy()
    for row in range(1, len(command)):
        keep = np.exp(-step_s[row - 1, :, None] / tau)
        applied[row] = command[row - 1] + keep * (applied[row - 1] - command[row - 1])
    return applied


def _rank_waves(values: np.ndarray, counts: np.ndarray, number: int) -> np.ndarray:
    """Return cosines of the share of the flight in which a value was lower, (number, rows, lanes)."""
    share = np.zeros(values.shape)
    share[counts] = (stats.rankdata(values[counts]) - 0.5) / max(int(counts.sum()), 1)
    return np.stack([np.cos(np.pi * order * share) for order in range(1, number + 1)])


def _place_waves(flight: Flown) -> np.ndarray:
    """Return products of cosines of the ranks of x, y and z, (number, rows, lanes)."""
    axes = [_rank_waves(flight.pos_w[..., axis], flight.counts, PLACE_WAVES) for axis in range(3)]
    axes = [np.concatenate([np.ones_like(waves[:1]), waves]) for waves in axes]
    orders = np.argwhere(np.indices((PLACE_WAVES + 1,) * 3).sum(axis=0) <= PLACE_WAVES)
    return np.stack([axes[0][i] * axes[1][j] * axes[2][k] for i, j, k in orders if i + j + k > 0])


def bumps(flight: Flown) -> np.ndarray:
    """Return forces along the world's axes that are there about some place on the way only, as a thermal is.

    (bumps * BUMP_SIZE, rows, lanes, 3), world frame; of each bump all axes in a row.
    """
    where = flight.pos_w[flight.counts]
    chosen = np.linspace(0, len(where) - 1, 2 * BUMP_PLACES + 1).astype(int)[1::2]
    waves = []
    for place in where[chosen]:
        squared = np.square(flight.pos_w - place).sum(axis=-1)
        waves += [np.exp(-0.5 * squared / width**2) for width in BUMP_WIDTHS_M]
    world = np.broadcast_to(np.eye(BUMP_SIZE)[:, None, None, :], (BUMP_SIZE, *squared.shape, 3))
    return _along(np.stack(waves), world)


def _along(waves: np.ndarray, vectors_w: np.ndarray) -> np.ndarray:
    """Return features times world vectors (directions, rows, lanes, 3), (features, rows, lanes, 3)."""
    product = waves[:, None, ..., None] * vectors_w[None]
    return product.reshape(-1, *product.shape[2:])


def dependences(flight: Flown) -> Mapping[str, Mapping[str, np.ndarray]]:
    """Return by side (rate, force) and dependence what an unknown effect might add, of unit size.

    (features, rows, lanes, 3), world frame.
    """
    counts = flight.counts
    body = np.moveaxis(flight.body_to_world, -1, 0)  # body axes in the world
    world = np.broadcast_to(np.eye(3)[:, None, None, :], body.shape)
    speed = np.linalg.norm(flight.vel_w, axis=-1)
    heading = np.arctan2(flight.body_to_world[..., 1, 0], flight.body_to_world[..., 0, 0])
    orders = range(1, HEADING_WAVES + 1)
    turns = np.stack([wave(n * heading) for n in orders for wave in (np.sin, np.cos)])
    span = max(float(flight.time_s[counts].max(initial=0.0)), 1e-9)
    times = np.stack([np.cos(np.pi * n * flight.time_s / span) for n in range(1, TIME_WAVES + 1)])
    tilt = _rank_waves(flight.body_to_world[..., 2, 2], counts, RANK_WAVES)
    fast = _rank_waves(speed, counts, RANK_WAVES)
    place = _place_waves(flight)
    sticks = [
        np.concatenate(
            [
                _rank_waves(flight.applied[..., stick], counts, RANK_WAVES),
                _rank_waves(flight.change[..., stick], counts, CHANGE_WAVES),
            ]
        )
        for stick in range(STICKS)
    ]
    rate = {
        "position": _along(place, body),
        "time": _along(times, body),
        "heading": _along(turns, body),
        "airspeed": _along(fast, body),
        "attitude": _along(tilt, body),
        "command": np.concatenate([_along(sticks[axis], body[axis : axis + 1]) for axis in range(3)]),
    }
    force = {
        "position": _along(place, world),
        "time": _along(times, body),
        "heading": _along(turns, body),
        "airspeed": _along(fast, np.stack([_way(flight), body[2]])),
        "attitude": _along(tilt, body),
        "command": _along(sticks[3], body[2:]),
    }
    return {"rate": rate, "force": force}


def constants(flight: Flown, side: str) -> np.ndarray:
    """Return unit rates along the body's axes, or unit forces along the body's, the world's and the way."""
    body = np.moveaxis(flight.body_to_world, -1, 0)
    world = np.broadcast_to(np.eye(3)[:, None, None, :], body.shape)
    return body if side == "rate" else np.concatenate([body, world, _way(flight)[None]])


def _way(flight: Flown) -> np.ndarray:
    """Return the direction of flight, world, (rows, lanes, 3); shorter than 1 where there is hardly any."""
    speed = np.linalg.norm(flight.vel_w, axis=-1)
    return flight.vel_w / np.maximum(speed, TINY_SPEED)[..., None]
