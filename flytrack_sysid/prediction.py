"""What a model predicts of a flight log, in float64: one step from every row, and free flight from some."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters, advance
from flytrack_env.effects import acts
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import Action, Drone
from flytrack_sysid.log import FlightLog, usual_step
from flytrack_sysid.record import LARGEST_DOUBT, Filled, Record, applied_doubt, record_of, steps_after
from flytrack_sysid.replay import Step, replay

# For effects that remember: what they remembered when a segment began is not known.
SETTLING_S = 0.5
# Free flights at once: bounds the memory that they need, and compiles one size.
BATCH = 128


class Steps(NamedTuple):
    """How the rows of a log without gaps follow one another.

    duration: (num_rows,) s, to the next row; the median step where no row follows. median: s.
    is_step: (num_rows,) bool, a row of the same segment follows. is_measured: (num_rows,) bool, the row
    was logged; False where it fills a gap. since_start: (num_rows,) s, since the segment began.
    """

    duration: np.ndarray
    median: float
    is_step: np.ndarray
    is_measured: np.ndarray
    since_start: np.ndarray


class Prediction(NamedTuple):
    """The model's step from every row of a log; leaves of the drones are (num_rows,) float64.

    before: the measured state; zeros (upright, 23 V) where the log has no such channel.
    memories: what the model's effects remember before the step. after: the state at the next row. force_b:
    (num_rows, 3) m/s^2, specific force of the step.
    is_settled: (num_rows,) bool, applied action and memories no longer depend on how they began.
    applied_from: "log" if it has the applied action, else "lag" of the model.
    """

    before: Drone
    memories: tuple[Any, ...]
    after: Drone
    force_b: np.ndarray
    steps: Steps
    is_settled: np.ndarray
    applied_from: str


def steps_of(filled: Filled) -> Steps:
    """Return how the rows of a log whose gaps are filled follow one another."""
    log = filled.log
    starts = log.is_start()
    return Steps(
        duration=steps_after(log),
        median=float(np.median(usual_step(log))),
        is_step=np.append(~starts[1:], False),
        is_measured=filled.source_row >= 0,
        since_start=log.time - log.time[starts][np.cumsum(starts) - 1],
    )


def runs_of(rows: np.ndarray, steps: Steps) -> list[tuple[int, int]]:
    """Return the runs of judged rows, as first row and end; rows: (num_rows,) bool."""
    follows = np.append(False, rows[1:] & rows[:-1] & steps.is_step[:-1])[: len(rows)]
    starts = np.flatnonzero(rows & ~follows)
    ends = np.flatnonzero(rows & ~np.append(follows[1:], False)[: len(rows)]) + 1
    return list(zip(starts.tolist(), ends.tolist(), strict=True))


def judged_steps(rows: np.ndarray, prediction: Prediction) -> np.ndarray:
    """Return the rows whose step to the next is judged, ascending; rows: (num_rows,) bool."""
    steps = prediction.steps
    exists = rows & steps.is_measured
    both = exists & np.append(exists[1:], False)[: len(rows)]
    return np.flatnonzero(both & steps.is_step & prediction.is_settled)


def turn_between(quats: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the rotation vectors, body frame, rad, that turn (..., 4) attitudes into others; (..., 3)."""
    inverse = Quaternion(quats[..., 0], *(-quats[..., axis] for axis in (1, 2, 3)))
    turn = columns(inverse.multiply(Quaternion(*np.moveaxis(others, -1, 0))))
    turn = np.where(turn[..., :1] < 0.0, -turn, turn)
    sine = np.linalg.norm(turn[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, turn[..., :1])
    # The limit of angle over sine; a unit quaternion's cosine is 1 there.
    return turn[..., 1:] * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0.0)


def inputs_that_lack(model: ModelParameters, log: FlightLog) -> dict[str, tuple[str, ...]]:
    """Return, for every channel that a model predicts, the channels it needs and the log does not have.

    One without forces beside thrust needs no velocity to predict the specific force.
    """
    force = ["v", "q"] if acts(model.effects, "force") else []
    needs = {
        "p": ["p", "v", "q", *force],
        "v": ["v", "q", *force],
        "q": ["q"],
        "w": [],
        "a": ["q", *force],
        "f": force,
    }
    return {
        name: tuple(dict.fromkeys(channel for channel in channels if channel not in log))
        for name, channels in needs.items()
    }


def columns(vector: Any) -> np.ndarray:
    """Return a vector or quaternion of (num_rows,) leaves as an array, (num_rows, its size)."""
    return np.stack([np.asarray(leaf) for leaf in vector], axis=-1)


def to_body(drone: Drone, vectors_w: np.ndarray) -> np.ndarray:
    """Return world-frame vectors in the body frames of drones; (num_rows, 3), leaves (num_rows,)."""
    world = Vec3(*vectors_w.T)
    return np.stack([axis.dot(world) for axis in drone.quat.axes()], axis=-1)


def specific_force_w(acc_w: np.ndarray, model: ModelParameters) -> np.ndarray:
    """Return the specific force of accelerations, (num_rows, 3) m/s^2, world frame."""
    return acc_w + np.array([0.0, 0.0, float(model.g)])


def in_float64(model: ModelParameters) -> ModelParameters:
    """Return the same model with leaves of float64."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, float), model)


@jax.jit
def _step_from_every_row(
    record: Record, gyro_b: np.ndarray, model: ModelParameters
) -> tuple[Drone, tuple[Any, ...], Drone, Vec3]:
    """Return all rows' steps: drones and memories before, drones after, specific forces."""

    def observe(step: Step, _: None) -> tuple[Any, ...]:
        return step.before, step.memories, step.after, step.moved.context.force_b

    return replay(model, record, "measured", gyro_b, observe)


def _is_settled(model: ModelParameters, filled: Filled, steps: Steps, has_memory: bool) -> np.ndarray:
    """Return where applied action and memories no longer depend on what is not known of the past."""
    begins = filled.log.is_start()
    if "uprev" in filled.log:
        is_known: Any = np.ones(len(filled.log), bool)
    else:
        tau = np.asarray(model.tau, float)
        doubt = applied_doubt(steps.duration, filled.command_doubt, begins, np.zeros_like(begins), tau)
        is_known = (doubt < LARGEST_DOUBT).all(axis=1)
    return is_known & ((steps.since_start >= SETTLING_S) | (not has_memory))


def predict(model: ModelParameters, filled: Filled) -> Prediction:
    """Return the model's step from every row of a log, from the measured state under the logged command.

    The applied action is the log's; without it, it follows the commands from the segment's start on.
    """
    log, steps = filled.log, steps_of(filled)
    has_applied = "uprev" in log
    record = record_of(filled)
    record = record._replace(is_applied_known=np.full(len(log), has_applied))
    gyro_b = log["w"] if "w" in log else np.zeros((len(log), 3))
    with jax.enable_x64(True):
        found = _step_from_every_row(record, gyro_b, in_float64(model))
        before, memories, after, force_b = jax.tree.map(np.asarray, found)
    return Prediction(
        before=before,
        memories=memories,
        after=after,
        force_b=columns(force_b),
        steps=steps,
        is_settled=_is_settled(model, filled, steps, bool(jax.tree.leaves(memories))),
        applied_from="log" if has_applied else "lag",
    )


@jax.jit
def _fly(
    starts: tuple[Drone, tuple[Any, ...]], commands: Action, durations: jax.Array, model: ModelParameters
) -> dict[str, Any]:
    """Return free flights: p, v, q, w after every step; leaves (num_steps, BATCH)."""

    def one(carry: Any, row: tuple[Any, ...]) -> Any:
        (drone, memories), (command, duration) = carry, row
        step_all = jax.vmap(advance, in_axes=(0, 0, 0, 0, None))
        drone, memories = step_all(drone, memories, command, duration, model)
        seen = {"p": drone.pos_w, "v": drone.vel_w, "q": drone.quat, "w": drone.rates_b}
        return (drone, memories), seen

    return jax.lax.scan(one, starts, (commands, durations))[1]


def free_flights(
    model: ModelParameters, log: FlightLog, prediction: Prediction, starts: np.ndarray, num_steps: int
) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Yield flights of the model by itself from measured rows under the logged commands, in batches.

    starts: (num_starts,) rows. Yields their rows (BATCH,) at most, and p, v, q, w at the ``num_steps``
    rows after each, (num_rows, num_steps, size), units of the log; beyond the log's end the last command
    is held.
    """
    for begin in range(0, len(starts), BATCH):
        batch = starts[begin : begin + BATCH]
        filled = np.resize(batch, BATCH)
        rows = np.minimum(filled + np.arange(num_steps)[:, None], len(log) - 1)
        with jax.enable_x64(True):
            first = jax.tree.map(lambda leaf: leaf[filled], (prediction.before, prediction.memories))  # noqa: B023
            commands = Action(*(column[rows] for column in log["u"].T))
            flown = _fly(first, commands, prediction.steps.duration[rows], in_float64(model))
            flown = {name: columns(leaves) for name, leaves in flown.items()}
        yield batch, {name: values.swapaxes(0, 1)[: len(batch)] for name, values in flown.items()}
