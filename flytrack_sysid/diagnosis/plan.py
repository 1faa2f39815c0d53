"""What to fly to settle what a log could not show.

All manoeuvres are flown by the model that was found, seen by the sensors of the log with their noise. What each
of them would say of every parameter (its Fisher information) is added to what the log says.
"""

import copy
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.plants import Simulator
from flytrack_env.state import pack, unpack, unpack_action
from flytrack_sysid.diagnosis.candidates import opened
from flytrack_sysid.diagnosis.lanes import LANE_ROWS, Lanes, make_lanes
from flytrack_sysid.diagnosis.limits import DETECTED, SEPARATE, Seen
from flytrack_sysid.diagnosis.linear import Outlook
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.search import Found
from flytrack_sysid.envelope import SCRIPT_HEIGHTS, is_inside
from flytrack_sysid.excitation import DT_S, FLIGHT_STEPS
from flytrack_sysid.log import FlightLog, log_of_states
from flytrack_sysid.manoeuvres import FLIGHTS_PER_MANOEUVRE, MANOEUVRES, flights_of, hover_action
from flytrack_sysid.parameters import TAUS, from_vector
from flytrack_sysid.record import BATTERY_UNKNOWN_V, UPRIGHT

LANES_PER_MANOEUVRE = FLIGHTS_PER_MANOEUVRE * FLIGHT_STEPS // LANE_ROWS


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
    inside = np.logical_and.accumulate(is_inside(states, SCRIPT_HEIGHTS), axis=1)
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
    flights = flights_of(MANOEUVRES, hover_action(model))
    starts, commands = (np.stack(part) for part in zip(*((one.start, one.command) for one in flights), strict=True))
    states, inside = _until_outside(np.asarray(_flown(vector, problem.like, starts, commands)))
    log = log_of_states(zip(states, commands, strict=True), DT_S, "manoeuvres")
    return log.without(*_absent(problem.lanes)), inside.reshape(-1)


def information_of_manoeuvres(problem: Problem, found: Found, outlook: Outlook) -> dict[str, np.ndarray]:
    """Return what each manoeuvre would tell of the columns of an outlook, (columns, columns).

    Fisher information at the model that was found, with the noise and the channels of the problem's log;
    eight flights of 2.5 s each. Inside of ``jax.enable_x64(True)``.
    """
    log, counts = _seen_flights(problem, found.vector)
    tau = found.vector[problem.index(TAUS)]
    ahead = Problem(make_lanes(log, counts, tau, float(problem.like.g)), problem.like)
    ahead.set_noise(problem.noise)
    others = [opened(problem, found.vector, probe) for probe in outlook.probes]
    slopes = ahead.slopes(found.vector, outlook.places, np.array(others) if others else None)
    # What the model leaves of its own flight is nothing, and no outlier.
    slopes = slopes._replace(left=np.zeros_like(slopes.left))
    by_block = Outlook(ahead, slopes, outlook.probes).by_block
    lane = np.arange(len(by_block)) % ahead.counts.shape[1]
    return {
        name: by_block[lane // LANES_PER_MANOEUVRE == number].sum(axis=0)
        for number, name in enumerate(MANOEUVRES)
    }


def share_shown(outlook: Outlook, found: Found, effect: str, alike: tuple[str, ...] = ()) -> float:
    """Return how well an effect of notable size shows in what an outlook knows: from 1 on it does.

    The smallest lambda of its parameters over what shows, or beside each look-alike over what separates.
    """
    given = [outlook.places.index(place) for place in found.places]
    seen = Seen(outlook, given, effect)
    given_alike = [Seen(outlook, given, other).columns for other in alike]
    shares = [seen.lambdas().min() / DETECTED]
    shares += [seen.lambdas(columns).min() / SEPARATE for columns in given_alike]
    return float(min(shares))


def _with(outlook: Outlook, information: np.ndarray) -> Outlook:
    later = copy.copy(outlook)
    later.total = outlook.total + information
    return later


def advise(
    problem: Problem, found: Found, outlook: Outlook, wanted: Mapping[str, tuple[str, ...]]
) -> dict[str, str]:
    """Return for each wanted effect the manoeuvre that would show it best, of ``MANOEUVRES``.

    problem: the log's, with its noise. found: the model. outlook: of it, along everything
    (``search.full_outlook``). wanted: effect -> effects that look alike in this log, maybe none. The best is
    returned even where it would not do (``share_shown`` below 1). Inside of ``jax.enable_x64(True)``.
    """
    if not wanted:
        return {}
    information = information_of_manoeuvres(problem, found, outlook)
    after = {name: _with(outlook, added) for name, added in information.items()}

    def best(effect: str, alike: tuple[str, ...]) -> str:
        return max(after, key=lambda name: share_shown(after[name], found, effect, alike))

    return {effect: best(effect, alike) for effect, alike in wanted.items()}
