"""What an unknown effect may depend on: smooth functions of the flight, as forces and rates."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from flytrack_sysid.diagnosis.lanes import Lanes
from flytrack_sysid.diagnosis.noise import step_to

TIME_WAVES, RANK_WAVES, CHANGE_WAVES, HEADING_WAVES, PLACE_WAVES = 8, 6, 4, 4, 2
TINY_SPEED = 0.3  # m/s: slower flight has no direction
STICKS = 4
# Bumps about places on the way: how many places, and widths, m.
BUMP_PLACES, BUMP_WIDTHS_M = 24, (3.0, 8.0)
BUMP_SIZE = 3  # features of one bump: a force along each world axis


class Flown(NamedTuple):
    """The flight at the step to each row, (rows, lanes, ...): what a force or rate of the step may depend on.

    body_to_world: (rows, lanes, 3, 3). applied: action, and change: its derivative, 1/s; (rows, lanes, 4).
    is_counted: bool, rows that are judged.
    """

    body_to_world: np.ndarray
    pos_w: np.ndarray
    vel_w: np.ndarray
    applied: np.ndarray
    change: np.ndarray
    time_s: np.ndarray
    is_counted: np.ndarray


def flown(lanes: Lanes, tau: np.ndarray) -> Flown:
    """Return what was flown; tau: (4,) s, lags between commands and applied action."""

    def before(values: np.ndarray) -> np.ndarray:  # a step begins at the row before
        return np.concatenate([values[:1], values[:-1]])

    record = lanes.record
    quat = before(record.quat).reshape(-1, 4)
    rotation = Rotation.from_quat(quat, scalar_first=True).as_matrix().reshape(*lanes.row.shape, 3, 3)
    applied = _lagged(record.command, record.step_s, tau)
    change = (record.command - applied) / tau
    time_s = np.where(lanes.row >= 0, lanes.row, 0) * float(np.median(step_to(lanes)))
    is_counted = np.asarray(lanes.counts.any(axis=(2, 3)))
    return Flown(
        rotation, before(record.pos_w), before(record.vel_w), applied, before(change), time_s, is_counted
    )


def _lagged(command: np.ndarray, step_s: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return commands behind a first-order lag; its start is forgotten within the lanes' lead-in."""
    applied = command.copy()
    for row in range(1, len(command)):
        keep = np.exp(-step_s[row - 1, :, None] / tau)
        applied[row] = command[row - 1] + keep * (applied[row - 1] - command[row - 1])
    return applied


def _rank_waves(values: np.ndarray, is_counted: np.ndarray, number: int) -> np.ndarray:
    """Return cosines of the share of the flight in which a value was lower, (number, rows, lanes)."""
    share = np.zeros(values.shape)
    share[is_counted] = (stats.rankdata(values[is_counted]) - 0.5) / max(int(is_counted.sum()), 1)
    return np.stack([np.cos(np.pi * order * share) for order in range(1, number + 1)])


def _place_waves(flight: Flown) -> np.ndarray:
    """Return products of cosines of the ranks of x, y and z, (number, rows, lanes)."""
    axes = [_rank_waves(flight.pos_w[..., axis], flight.is_counted, PLACE_WAVES) for axis in range(3)]
    axes = [np.concatenate([np.ones_like(waves[:1]), waves]) for waves in axes]
    orders = np.argwhere(np.indices((PLACE_WAVES + 1,) * 3).sum(axis=0) <= PLACE_WAVES)
    return np.stack([axes[0][i] * axes[1][j] * axes[2][k] for i, j, k in orders if i + j + k > 0])


def bumps(flight: Flown) -> np.ndarray:
    """Return forces along the world's axes that act only about some place on the way, like a thermal.

    (bumps * BUMP_SIZE, rows, lanes, 3), world frame; all axes of a bump in a row.
    """
    where = flight.pos_w[flight.is_counted]
    chosen = np.linspace(0, len(where) - 1, 2 * BUMP_PLACES + 1).astype(int)[1::2]
    waves = []
    for place in where[chosen]:
        squared = np.square(flight.pos_w - place).sum(axis=-1)
        waves += [np.exp(-0.5 * squared / width**2) for width in BUMP_WIDTHS_M]
    world = np.broadcast_to(np.eye(BUMP_SIZE)[:, None, None, :], (BUMP_SIZE, *waves[0].shape, 3))
    return _along(np.stack(waves), world)


def _along(waves: np.ndarray, vectors_w: np.ndarray) -> np.ndarray:
    """Return features times world vectors (directions, rows, lanes, 3), (features, rows, lanes, 3)."""
    product = waves[:, None, ..., None] * vectors_w[None]
    return product.reshape(-1, *product.shape[2:])


def dependences(flight: Flown) -> Mapping[str, Mapping[str, np.ndarray]]:
    """Return by side (rate, force) and dependence what an unknown effect might add, of unit size.

    (features, rows, lanes, 3), world frame.
    """
    counted = flight.is_counted
    body = np.moveaxis(flight.body_to_world, -1, 0)  # body axes in the world
    world = np.broadcast_to(np.eye(3)[:, None, None, :], body.shape)
    heading = np.arctan2(flight.body_to_world[..., 1, 0], flight.body_to_world[..., 0, 0])
    orders = range(1, HEADING_WAVES + 1)
    turns = np.stack([wave(n * heading) for n in orders for wave in (np.sin, np.cos)])
    span = max(float(flight.time_s[counted].max(initial=0.0)), 1e-9)
    times = np.stack([np.cos(np.pi * n * flight.time_s / span) for n in range(1, TIME_WAVES + 1)])
    tilt = _rank_waves(flight.body_to_world[..., 2, 2], counted, RANK_WAVES)
    fast = _rank_waves(np.linalg.norm(flight.vel_w, axis=-1), counted, RANK_WAVES)
    place = _place_waves(flight)
    sticks = [
        np.concatenate(
            [
                _rank_waves(flight.applied[..., stick], counted, RANK_WAVES),
                _rank_waves(flight.change[..., stick], counted, CHANGE_WAVES),
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
    force = rate | {
        "position": _along(place, world),
        "airspeed": _along(fast, np.stack([_direction(flight), body[2]])),
        "command": _along(sticks[3], body[2:]),
    }
    return {"rate": rate, "force": force}


def constants(flight: Flown, side: str) -> np.ndarray:
    """Return unit rates along the body's axes, or unit forces along body, world and direction of flight."""
    body = np.moveaxis(flight.body_to_world, -1, 0)
    world = np.broadcast_to(np.eye(3)[:, None, None, :], body.shape)
    return body if side == "rate" else np.concatenate([body, world, _direction(flight)[None]])


def _direction(flight: Flown) -> np.ndarray:
    """Return the direction of flight, world, (rows, lanes, 3); shorter than 1 where it is hardly moving."""
    speed = np.linalg.norm(flight.vel_w, axis=-1)
    return flight.vel_w / np.maximum(speed, TINY_SPEED)[..., None]
