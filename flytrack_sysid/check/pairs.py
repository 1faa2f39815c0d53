"""Pairs of channels that physics connects: which frames each allows, and whether they agree."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_sysid.check.commands import compare_commands
from flytrack_sysid.check.explain import Edges
from flytrack_sysid.check.frames import (
    DIRECTIONS,
    IDENTITY,
    NUM_FRAMES,
    READINGS,
    number_of,
)
from flytrack_sysid.check.motion import (
    MARGIN,
    RATE_FLOOR,
    SPEED_FLOOR,
    Likelihoods,
    compare,
    compare_forces,
    compare_thrust,
)
from flytrack_sysid.kinematics import summed_turns
from flytrack_sysid.log import FlightLog

AGAINST = 2.0  # nats by which a part of the log may be against the best frame
# Nats against the axes of the log's forces. Clean flights of 60 s in coloured and in heavy-tailed
# noise reached 13 (2 of 60), the weakest of 22 true faults of an accelerometer 39.
FORCE_MARGIN = 20.0
CLEARLY = 2.0  # times the other axes: the mean force of a flight points along one
MIRRORS = [
    number_of(np.diag(1.0 - 2.0 * axis)) for axis in np.eye(3)
]  # frames with one sign changed
AXES = ("x", "y", "z")
AGREES, CONTRADICTS, STILL = "agrees", "contradicts", "not enough motion"
MANOEUVRES = {
    "q and w": "roll, pitch and yaw by more than 10 degrees and back",
    "v, f and q": "accelerate forward, sideways and upwards by more than 1 m/s^2",
    "v and q": "accelerate forward, sideways and upwards by more than 1 m/s^2",
    "p and v": "fly faster than 0.5 m/s forward, sideways and upwards",
    "u and w": "command roll, pitch and yaw rates of more than 30 deg/s",
    "f in flight": "stay in the air for more than 2 s",
    "v_bat and t": "stay in the air for more than 30 s",
}


class Pair(NamedTuple):
    """How channels that physics connects agree.

    Attributes:
        name: such as "q and w".
        verdict: ``AGREES``, ``CONTRADICTS`` or ``STILL``.
        correlations: of the axes as they are logged; NaN where unknown.
        unseen: axes whose sign the motion does not show.
        evidence: nats by which the best frames are more likely than those of the log.
        margin: nats by which the best frames are more likely than the best that contradict.
    """

    name: str
    verdict: str
    correlations: tuple[float, ...]
    unseen: tuple[str, ...]
    evidence: float
    margin: float

    @property
    def manoeuvre(self) -> str:
        """What to fly so that the pair can be compared."""
        return MANOEUVRES[self.name]


def allowed(values: np.ndarray) -> np.ndarray:
    """Return which hypotheses are allowed, by log-likelihoods of the parts, (NUM_PARTS, ...).

    One is excluded if the best is more likely by ``MARGIN`` and no part of the log is against it.
    """
    total = values.sum(axis=0)
    of_best = values.reshape(len(values), -1)[:, np.argmax(total)]
    ahead = of_best.reshape(-1, *[1] * total.ndim) - values
    return ~((total.max() - total > MARGIN) & np.all(ahead > -AGAINST, axis=0))


def _pair(name: str, found: Likelihoods, is_allowed: np.ndarray, of_frames: np.ndarray) -> Pair:
    """Return a pair; ``is_allowed`` and the likelihoods begin with the frames of the log.

    Args:
        name: of the pair.
        found: the likelihoods.
        is_allowed: by ``allowed``.
        of_frames: the same of one channel's frames, all else as in the log, (48,) bool.
    """
    total = found.values.sum(axis=0)
    evidence = float(total.max() - total.flat[0])
    margin = float(total.max() - total[~is_allowed].max(initial=-np.inf))
    unseen = tuple(axis for axis, is_seen in zip(AXES, of_frames[MIRRORS], strict=True) if is_seen)
    verdict = AGREES if is_allowed.flat[0] else CONTRADICTS
    if verdict == AGREES and len(unseen) == len(AXES):
        verdict = STILL
    correlations = tuple(float(value) for value in found.correlations)
    return Pair(name, verdict, correlations, unseen, evidence, margin)


def compare_pairs(log: FlightLog) -> tuple[tuple[Pair, ...], Edges]:
    """Return the pairs of a log, and the frames that they allow."""
    rate_pair, rates = _compare_rates(log)
    force_pair, forces = _compare_forces(log, rates)
    position_pair, positions = _compare_positions(log)
    command_pair, commands = _compare_commands(log)
    up_pair, force_up = _compare_up(log)
    every = (rate_pair, force_pair, position_pair, command_pair, up_pair)
    edges = Edges(rates, forces, positions, commands, force_up)
    return tuple(pair for pair in every if pair is not None), edges


def _attitudes(log: FlightLog) -> list[Rotation]:
    """Return the attitude by each reading of its columns."""
    return [
        Rotation.from_quat(reading.correct(log["q"]), scalar_first=True) for reading in READINGS
    ]


def _compare_rates(log: FlightLog) -> tuple[Pair | None, np.ndarray]:
    """Compare attitude with gyroscope, by each reading of the attitude."""
    rates = np.ones((len(READINGS), NUM_FRAMES), bool)
    if "q" not in log or "w" not in log:
        return None, rates
    every = [
        compare(log, summed_turns(attitude), log["w"], RATE_FLOOR) for attitude in _attitudes(log)
    ]
    found = [one for one in every if one is not None]
    if not found:
        return None, rates
    values = np.stack([one.values for one in found], axis=1)
    rates = allowed(values)
    return _pair("q and w", found[0]._replace(values=values), rates, rates[0]), rates


def _compare_forces(log: FlightLog, rates: np.ndarray) -> tuple[Pair | None, np.ndarray]:
    """Compare attitude with velocity and accelerometer, or with the thrust's direction.

    Args:
        log: a flight.
        rates: readings and frames that attitude and gyroscope allow; others are not tried.
    """
    forces = np.ones((len(READINGS), len(DIRECTIONS), NUM_FRAMES, NUM_FRAMES), bool)
    if "q" not in log or "v" not in log:
        return None, forces
    name, function = ("v, f and q", compare_forces) if "f" in log else ("v and q", compare_thrust)
    attitudes = _attitudes(log)
    # The reading of the log is compared too, to say that it contradicts.
    tried = [number for number in range(len(READINGS)) if number == 0 or rates[number].any()]
    by_reading = {number: function(log, attitudes[number]) for number in tried}
    known = {number: one for number, one in by_reading.items() if one is not None}
    if not known:
        return None, forces
    values = np.stack([one.values for one in known.values()], axis=1)
    is_allowed = allowed(values)
    if "f" in log and not is_allowed.flat[0]:  # nothing contradicts that a bias explains
        comparisons = [compare_forces(log, attitudes[number], with_bias=True) for number in known]
        is_allowed |= allowed(
            np.stack([one.values for one in comparisons if one is not None], axis=1)
        )
    evidence = values.sum(axis=0)
    if evidence.max() - evidence.flat[0] < FORCE_MARGIN:
        is_allowed.flat[0] = True
    forces[:] = False
    forces[list(known)] = is_allowed
    of_velocity = is_allowed[0, 0, :, IDENTITY]
    return _pair(name, known[0]._replace(values=values), is_allowed, of_velocity), forces


def _compare_positions(log: FlightLog) -> tuple[Pair | None, np.ndarray]:
    """Compare position with velocity."""
    found = compare(log, log["p"], log["v"], SPEED_FLOOR) if "p" in log and "v" in log else None
    if found is None:
        return None, np.ones(NUM_FRAMES, bool)
    is_allowed = allowed(found.values)
    return _pair("p and v", found, is_allowed, is_allowed), is_allowed


def _compare_commands(log: FlightLog) -> tuple[Pair | None, np.ndarray]:
    """Compare commands with the rates that follow them."""
    followed = compare_commands(log) if "w" in log else None
    if followed is None:
        return None, np.ones(NUM_FRAMES, bool)
    is_allowed = allowed(followed.likelihoods.values)
    return _pair("u and w", followed.likelihoods, is_allowed, is_allowed), is_allowed


def _compare_up(log: FlightLog) -> tuple[Pair | None, np.ndarray]:
    """Return whether the thrust points along z, and the directions in which it may point."""
    force_up = np.ones(len(DIRECTIONS), bool)
    if "f" not in log:
        return None, force_up
    middle = np.median(log["f"], axis=0)
    along = np.sort(np.abs(middle))
    if along[2] > CLEARLY * along[1]:
        force_up = np.arange(len(DIRECTIONS)) == np.argmax(DIRECTIONS @ middle)
    verdict = STILL if force_up.all() else AGREES if force_up[0] else CONTRADICTS
    return Pair("f in flight", verdict, (), (), float("nan"), float("nan")), force_up
