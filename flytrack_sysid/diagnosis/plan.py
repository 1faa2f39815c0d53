"""What to fly to settle what a log could not show.

All manoeuvres are flown by the model that was found, and seen by the log's sensors with their noise. What
each of them would say of every parameter (its Fisher information) is added to what the log says.
"""

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.plants import Simulator
from flytrack_env.state import pack, unpack, unpack_action
from flytrack_sysid.diagnosis.candidates import opened
from flytrack_sysid.diagnosis.lanes import LANE_S, Lanes, make_lanes, voltages_of
from flytrack_sysid.diagnosis.limits import DETECTED, SEPARATE, Seen
from flytrack_sysid.diagnosis.linear import Outlook
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.search import Found
from flytrack_sysid.envelope import ANY_VOLTAGE, SCRIPT_HEIGHTS, VOLTAGES, is_inside
from flytrack_sysid.excitation import DT_S, FLIGHT_STEPS
from flytrack_sysid.log import FlightLog, log_of_states
from flytrack_sysid.manoeuvres import FLIGHTS_PER_MANOEUVRE, MANOEUVRES, flights_of, hover_action
from flytrack_sysid.parameters import TAUS, from_vector
from flytrack_sysid.record import BATTERY_UNKNOWN_V, UPRIGHT

LANES_PER_MANOEUVRE = int(FLIGHTS_PER_MANOEUVRE * FLIGHT_STEPS * DT_S) // LANE_S
NOTHING = 1e-2  # of what shows an effect: less is what the log's own prior says
ABOUT = 0.8  # of the best share: what comes so near is as good, and what is easier to fly comes first
PLENTY = 30.0  # shares: thirty times what shows an effect


@jax.jit
def _flown(vector: jax.Array, like: ModelParameters, starts: jax.Array, commands: jax.Array) -> jax.Array:
    """Return the states of flights, (flights, steps, 21), each before its command."""
    model, simulator = from_vector(vector, like), Simulator()

    def step(state: Any, action: jax.Array) -> tuple:
        return simulator.step(state, unpack_action(action), DT_S, model), pack(simulator.drone(state))

    def fly(start: jax.Array, command: jax.Array) -> jax.Array:
        return jax.lax.scan(step, simulator.reset(unpack(start), model), command)[1]

    return jax.vmap(fly)(starts, commands)


def _until_outside(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return flights that stand still once they leave the envelope, and where they are within it."""
    inside = np.logical_and.accumulate(is_inside(states, SCRIPT_HEIGHTS, ANY_VOLTAGE), axis=1)
    last = np.maximum.accumulate(np.where(inside, np.arange(states.shape[1]), 0), axis=1)
    return np.take_along_axis(states, last[..., None], axis=1), inside


def _absent(lanes: Lanes) -> list[str]:
    """Return the channels of states that the log of these lanes did not have."""
    record, turned, moved = lanes.record, lanes.counts[..., 0, 1].any(), lanes.counts[..., 3, 1].any()
    present = {
        "w": "w" in lanes.measured,
        "a": "f" in lanes.measured,
        "q": bool(turned or np.any(record.quat != UPRIGHT)),
        "v": bool(moved),
        "p": bool(record.pos_w.any()),
        "v_bat": bool(np.any(record.battery_v != BATTERY_UNKNOWN_V)),
        "uprev": bool(record.is_applied_known.any()),
    }
    return [name for name, is_there in present.items() if not is_there]


def _seen_flights(problem: Problem, vector: np.ndarray) -> tuple[FlightLog, np.ndarray]:
    """Return all manoeuvres flown by a model, seen by the sensors of a problem's log, and rows that count."""
    model = problem.like._replace(thrust_coeffs=vector[problem.index([f"c{power}" for power in range(6)])])
    voltages = voltages_of(problem.lanes) or VOLTAGES
    flights = flights_of(MANOEUVRES, hover_action(model, voltages), voltages=voltages)
    starts, commands = (
        np.stack(part) for part in zip(*((one.start, one.command) for one in flights), strict=True)
    )
    states, inside = _until_outside(np.asarray(_flown(vector, problem.like, starts, commands)))
    log = log_of_states(zip(states, commands, strict=True), DT_S, "manoeuvres")
    return log.without(*_absent(problem.lanes)), inside.reshape(-1)


def _in_parts(lanes: Lanes, size: int) -> Iterator[Lanes]:
    """Return lanes so many at a time, the last ones filled with lanes that count for nothing."""
    number = lanes.counts.shape[1]
    for begin in range(0, number, size):
        places = np.arange(begin, begin + size)
        part = jax.tree.map(
            partial(np.take, indices=np.minimum(places, number - 1), axis=1), lanes._replace(quanta=None)
        )._replace(quanta=lanes.quanta)
        yield part._replace(counts=part.counts & (places < number)[:, None, None])


def _along(outlook: Outlook, columns: Sequence[int], ahead: Problem, vector: np.ndarray) -> np.ndarray:
    """Return what lanes tell of some columns of an outlook, (lanes, columns, columns)."""
    ends = len(outlook.places)
    places = [outlook.places[column] for column in columns if column < ends]
    probes = [outlook.probes[column - ends] for column in columns if column >= ends]
    others = np.array([opened(ahead, vector, probe) for probe in probes]) if probes else None
    slopes = ahead.slopes(vector, places, others)
    # What the model leaves of its own flight is nothing, and no outlier.
    slopes = slopes._replace(left=np.zeros_like(slopes.left))
    by_block = Outlook(ahead, slopes, probes).by_block
    return by_block.reshape(-1, ahead.counts.shape[1], *by_block.shape[1:]).sum(axis=0)


def information_of_manoeuvres(
    problem: Problem, found: Found, outlook: Outlook, columns: Sequence[int]
) -> dict[str, np.ndarray]:
    """Return what each manoeuvre would tell of columns of an outlook, as part of its ``total``.

    Fisher information at the model that was found, with the noise and the channels of the problem's log;
    eight flights of 2.5 s each. 0 for other columns. Inside of ``jax.enable_x64(True)``.
    """
    columns = sorted(set(columns))
    log, counts = _seen_flights(problem, found.vector)
    lanes = make_lanes(log, counts, found.vector[problem.index(TAUS)], float(problem.like.g))
    by_lane = []
    # As many lanes at a time as the log has: its programs are compiled.
    for part in _in_parts(lanes, problem.counts.shape[1]):
        ahead = Problem(part, problem.like)
        ahead.set_noise(problem.noise)
        by_lane.append(_along(outlook, columns, ahead, found.vector))
    by_lane = np.concatenate(by_lane)[: len(MANOEUVRES) * LANES_PER_MANOEUVRE]
    found_of = {}
    for name, own in zip(MANOEUVRES, np.split(by_lane, len(MANOEUVRES)), strict=True):
        found_of[name] = np.zeros_like(outlook.total)
        found_of[name][np.ix_(columns, columns)] = own.sum(axis=0)
    return found_of


class Question:
    """An effect that a log did not show, or not beside those that look alike.

    outlook: the log's, of the model that was found, along everything (``search.full_outlook``).
    """

    def __init__(self, outlook: Outlook, found: Found, effect: str, alike: Iterable[str] = ()):
        self.outlook = outlook
        self.given = [outlook.places.index(place) for place in found.places]
        self.effect = effect
        self.alike = [Seen(outlook, self.given, other).columns for other in alike]

    @property
    def columns(self) -> list[int]:
        """The columns of the outlook that the answer depends on."""
        own = Seen(self.outlook, self.given, self.effect).columns
        return [*self.given, *own, *(column for columns in self.alike for column in columns)]

    def shares(self, information: np.ndarray | float = 0.0) -> np.ndarray:
        """Return how well the effect would show at its notable size, the worst first; from 1 on it does.

        Lambda of each of its parameters over what shows, and beside each look-alike over what separates.
        information: added to the log's.
        """
        later = copy.copy(self.outlook)
        later.total = self.outlook.total + information
        seen = Seen(later, self.given, self.effect)
        beside = [seen.lambdas(columns) / SEPARATE for columns in self.alike]
        return np.sort(np.concatenate([seen.lambdas() / DETECTED, *beside]))


def _best(shares: Mapping[str, np.ndarray]) -> str:
    """Return the easiest manoeuvre whose shares are plenty, or about as large as those of the best.

    The best has the largest worst share; where the worst shows in no manoeuvre, the next one decides.
    """
    floored = {name: np.where(own < NOTHING, 0.0, own) for name, own in shares.items()}
    best = max(floored.values(), key=lambda own: own.tolist())
    return next(name for name, own in floored.items() if np.all(own >= np.minimum(ABOUT * best, PLENTY)))


def advise(
    problem: Problem, found: Found, outlook: Outlook, wanted: Mapping[str, tuple[str, ...]]
) -> dict[str, str]:
    """Return for each wanted effect the manoeuvre that would show it best, of ``MANOEUVRES``.

    problem: the log's, with its noise. found: the model. outlook: of it, along everything
    (``search.full_outlook``). wanted: effect -> effects that look alike in this log, maybe none. The best is
    returned even where it would not do (``Question.shares`` below 1). Inside of ``jax.enable_x64(True)``.
    """
    if not wanted:
        return {}
    questions = [Question(outlook, found, effect, alike) for effect, alike in wanted.items()]
    columns = [column for question in questions for column in question.columns]
    told = information_of_manoeuvres(problem, found, outlook, columns)
    return {
        question.effect: _best({name: question.shares(added) for name, added in told.items()})
        for question in questions
    }
