"""What a log could not have shown or told apart, and what to fly to settle it.

All manoeuvres are flown by the fitted model and seen by the log's sensors with their noise. The
Fisher information that each would add to the log's decides which one to advise.
"""

import copy
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME, MAX_DELAY_STEPS
from flytrack_env.plants import Simulator
from flytrack_sysid.collect import states_flown
from flytrack_sysid.diagnosis.chunks import CHUNK_S, Chunks, make_chunks, voltages_of
from flytrack_sysid.diagnosis.problem import SEARCHED, Problem
from flytrack_sysid.diagnosis.result import SCHEMA, TO_LOG, NotIdentifiable
from flytrack_sysid.diagnosis.score_test import Candidate, Linearization, candidates_of
from flytrack_sysid.diagnosis.search import FittedModel, SearchState
from flytrack_sysid.excitation import ANY_VOLTAGE, DT_S, FLIGHT_STEPS, SCRIPT_HEIGHTS, is_inside
from flytrack_sysid.log import FlightLog, log_of_states
from flytrack_sysid.manoeuvres import (
    FLIGHTS_PER_MANOEUVRE,
    MANOEUVRES,
    SECONDS_PER_MANOEUVRE,
    flights_of,
    hover_action,
)
from flytrack_sysid.parameters import TAUS, THRUST_COEFFS, from_vector
from flytrack_sysid.record import UPRIGHT
from flytrack_sysid.script_file import Script, ScriptError, script_of

DETECTED = 30.0  # noncentrality from which a log shows an effect nearly always
SEPARATE = 20.0  # noncentrality beside a rival from which it tells the two apart
LOOKS_ALIKE = 0.1  # of an effect's noncentrality: what is left of it beside a look-alike
ROUNDING = 1e-6  # of DETECTED
BASE_ONLY = ("thrust_scale",)  # no log tells it from the free thrust curve: a cause of the base
CHUNKS_PER_MANOEUVRE = int(FLIGHTS_PER_MANOEUVRE * FLIGHT_STEPS * DT_S) // CHUNK_S
PRIOR_SHARE = 1e-2  # of what shows an effect: less comes from the log's own prior
# Of the best share: a manoeuvre that comes so near is as good, and an easier one comes first.
NEARLY_BEST = 0.8
PLENTY = 30.0  # shares: thirty times what shows an effect


def _typical_candidate(effect: str) -> Candidate:
    """Return the way to look for an effect that is nearest to its notable size."""

    def distance(way: Candidate) -> float:
        notable = BY_NAME[effect].notable
        return sum(abs(np.log(one.value / notable[one.field.split(".")[1]])) for one in way.probes)

    return min(candidates_of(BY_NAME[effect]), key=distance)


class Question:
    """How well a log shows an effect, also beside effects that look alike.

    linearization: the log's, at the fitted model, along everything (``SearchState.linearized``).
    fields: the effect's parameters, columns: theirs in the linearization, sizes: notable ones, in
    steps along these.
    """

    def __init__(
        self,
        linearization: Linearization,
        model: FittedModel,
        effect: str,
        alike: Iterable[str] = (),
    ):
        self.linearization, self.effect = linearization, effect
        self.given = linearization.columns_at(model.indices)
        way, shapes = _typical_candidate(effect), BY_NAME[effect].search.shapes
        notable = BY_NAME[effect].notable
        fields = [field for field in way.other_fields if field.split(".")[1] not in shapes]
        # The columns of probes come first, in shares of the way to them.
        self.columns = [
            *map(linearization.probe_column, way.probes),
            *map(linearization.column, fields),
        ]
        self.fields = [*(one.field for one in way.probes), *fields]
        ways = np.array([*(one.value for one in way.probes), *np.ones(len(fields))])
        self.sizes = np.array([notable[field.split(".")[1]] for field in self.fields]) / ways
        self.alike = [Question(linearization, model, other).columns for other in alike]

    def noncentralities(
        self, beside: Sequence[int] = (), information: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Return the noncentrality of each parameter at its notable size.

        All that is free and ``beside`` are projected out. information: added to the log's.
        """
        line = copy.copy(self.linearization)
        line.total = line.total + information
        given = self.given + [column for column in beside if column not in self.given]
        found = np.zeros(len(self.columns))
        for number, column in enumerate(self.columns):
            own = line.projected([column], [one for one in given if one != column])[0][0, 0]
            own -= line.prior[column]  # which does not come from the log
            found[number] = max(float(own), 0.0) * self.sizes[number] ** 2
        return found

    def shares(self, information: np.ndarray | float = 0.0) -> np.ndarray:
        """Return how well the effect would show at its notable size, ascending; 1 or more suffices.

        Noncentrality of each of its parameters over DETECTED, and beside each look-alike over
        SEPARATE. information: added to the log's.
        """
        beside = [self.noncentralities(columns, information) / SEPARATE for columns in self.alike]
        return np.sort(np.concatenate([self.noncentralities((), information) / DETECTED, *beside]))


def unit_of(effect: str, field: str | None = None) -> str:
    """Return the unit of an effect's parameter, the first notable one if None."""
    return BY_NAME[effect].ranges[field or next(iter(BY_NAME[effect].notable))].unit


def unseen_effects(
    state: SearchState, linearization: Linearization, model: FittedModel
) -> dict[str, NotIdentifiable]:
    """Return effects that the log could not have shown, by name; what to fly is still to be said.

    Sizes are infinite where no size would show.
    """
    result: dict[str, NotIdentifiable] = {}
    for effect in (one.name for one in SEARCHED):
        if effect in model.effects or effect in BASE_ONLY:
            continue
        if effect in state.unobservable:
            result[effect] = NotIdentifiable(effect, float("inf"), unit_of(effect), (), "")
            continue
        question = Question(linearization, model, effect)
        sizes = question.noncentralities()
        worst = int(np.argmin(sizes))
        if sizes[worst] >= DETECTED:
            continue
        field = question.fields[worst].split(".")[1]
        smallest = float("inf")
        if sizes[worst] > DETECTED * ROUNDING:
            smallest = float(BY_NAME[effect].notable[field] * np.sqrt(DETECTED / sizes[worst]))
        alike = _look_alikes(state, model, question) if sizes[worst] > 0.0 else ()
        result[effect] = NotIdentifiable(effect, smallest, unit_of(effect, field), alike, "")
    return result


def _look_alikes(state: SearchState, model: FittedModel, question: Question) -> tuple[str, ...]:
    """Return effects beside which this one hardly shows any more."""
    sizes = question.noncentralities()
    result = []
    for other in SEARCHED:
        if other.name in (question.effect, *BASE_ONLY, *state.unobservable):
            continue
        beside = question.noncentralities(
            Question(question.linearization, model, other.name).columns
        )
        if np.any((beside < SEPARATE) & (beside < LOOKS_ALIKE * sizes)):
            result.append(other.name)
    return tuple(result)


@jax.jit
def _flown(
    vector: jax.Array, like: ModelParameters, starts: jax.Array, commands: jax.Array
) -> jax.Array:
    """Return the states of flights, (flights, steps, 21), each before its command."""
    fly = partial(states_flown, Simulator(MAX_DELAY_STEPS), from_vector(vector, like))
    return jax.vmap(fly)(starts, commands)[:, :-1]


def _absent_channels(chunks: Chunks) -> list[str]:
    """Return the channels of states that the log of these chunks did not have."""
    record, turned, moved = (
        chunks.record,
        chunks.counts[..., 0, 1].any(),
        chunks.counts[..., 3, 1].any(),
    )
    present = {
        "w": "w" in chunks.measured,
        "a": "f" in chunks.measured,
        "q": bool(turned or np.any(record.quat != UPRIGHT)),
        "v": bool(moved),
        "p": bool(record.pos_w.any()),
        "v_bat": voltages_of(chunks) is not None,
        "uprev": bool(record.is_applied_known.any()),
    }
    return [name for name, is_present in present.items() if not is_present]


def _seen_flights(problem: Problem, vector: np.ndarray) -> tuple[FlightLog, np.ndarray]:
    """Return all manoeuvres as flown by a model, and which rows count, (num_rows,) bool.

    The log of the flights has the channels of the problem's log.
    """
    model = problem.like._replace(thrust_coeffs=vector[problem.indices_of(THRUST_COEFFS)])
    voltages = voltages_of(problem.chunks) or _battery_range(problem.like)
    flights = flights_of(MANOEUVRES, hover_action(model, voltages), voltages=voltages)
    starts = np.stack([one.start for one in flights])
    commands = np.stack([one.command for one in flights])
    states = np.asarray(_flown(vector, problem.like, starts, commands))
    # A flight stands still once it leaves the envelope.
    inside = np.logical_and.accumulate(is_inside(states, SCRIPT_HEIGHTS, ANY_VOLTAGE), axis=1)
    last = np.maximum.accumulate(np.where(inside, np.arange(states.shape[1]), 0), axis=1)
    states = np.take_along_axis(states, last[..., None], axis=1)
    log = log_of_states(zip(states, commands, strict=True), DT_S, "manoeuvres")
    return log.without(*_absent_channels(problem.chunks)), inside.reshape(-1)


def _in_parts(chunks: Chunks, size: int) -> Iterator[Chunks]:
    """Return chunks so many at a time, the last ones filled with chunks that count for nothing."""
    number = chunks.counts.shape[1]
    for begin in range(0, number, size):
        places = np.arange(begin, begin + size)
        part = chunks.selected(np.minimum(places, number - 1))
        yield part._replace(counts=part.counts & (places < number)[:, None, None])


def _information_along(
    linearization: Linearization, columns: Sequence[int], ahead: Problem, vector: np.ndarray
) -> np.ndarray:
    """Return the information by chunk about some columns, (chunks, columns, columns)."""
    end = len(linearization.indices)
    places = [linearization.indices[column] for column in columns if column < end]
    probes = [linearization.probes[column - end] for column in columns if column >= end]
    others = np.array([probe.placed_in(ahead, vector) for probe in probes]) if probes else None
    slopes = ahead.slopes(vector, places, others)
    # A model leaves no residuals of its own flight, and no outliers.
    slopes = slopes._replace(residuals=np.zeros_like(slopes.residuals))
    by_block = Linearization(ahead, slopes, probes).by_block
    return by_block.reshape(-1, ahead.counts.shape[1], *by_block.shape[1:]).sum(axis=0)


def information_of_manoeuvres(
    problem: Problem, model: FittedModel, linearization: Linearization, columns: Sequence[int]
) -> dict[str, np.ndarray]:
    """Return the information about columns that each manoeuvre would add, shaped like ``total``.

    Fisher information at the fitted model, with the noise and the channels of the problem's log;
    eight flights of 2.5 s each. 0 for other columns. Inside ``jax.enable_x64(True)``.
    """
    columns = sorted(set(columns))
    log, counts = _seen_flights(problem, model.vector)
    chunks = make_chunks(log, counts, model.vector[problem.indices_of(TAUS)], float(problem.like.g))
    by_chunk = []
    # As many chunks at a time as the log has, for which programs are compiled.
    for part in _in_parts(chunks, problem.counts.shape[1]):
        ahead = Problem.of(part, problem.like).with_noise(problem.noise)
        by_chunk.append(_information_along(linearization, columns, ahead, model.vector))
    every = np.concatenate(by_chunk)[: len(MANOEUVRES) * CHUNKS_PER_MANOEUVRE]
    result = {}
    for name, own in zip(MANOEUVRES, np.split(every, len(MANOEUVRES)), strict=True):
        result[name] = np.zeros_like(linearization.total)
        result[name][np.ix_(columns, columns)] = own.sum(axis=0)
    return result


def _best_manoeuvre(shares: Mapping[str, np.ndarray]) -> str:
    """Return the easiest manoeuvre whose shares are plenty, or about as large as those of the best.

    The best has the largest worst share; where the worst shows in no manoeuvre, the next one
    decides.
    """
    floored = {name: np.where(own < PRIOR_SHARE, 0.0, own) for name, own in shares.items()}
    best = max(floored.values(), key=lambda own: own.tolist())
    return next(
        name
        for name, own in floored.items()
        if np.all(own >= np.minimum(NEARLY_BEST * best, PLENTY))
    )


def advise(
    problem: Problem,
    model: FittedModel,
    linearization: Linearization,
    wanted: Mapping[str, Sequence[str]],
) -> dict[str, str]:
    """Return for each wanted effect the manoeuvre that would show it best, of ``MANOEUVRES``.

    problem: the log's, with its noise. linearization: of the model, along everything
    (``SearchState.linearized``). wanted: effect -> effects that look alike in this log, maybe none.
    The best is returned even where it would not do (``Question.shares`` below 1). Inside
    ``jax.enable_x64(True)``.
    """
    if not wanted:
        return {}
    questions = [Question(linearization, model, effect, alike) for effect, alike in wanted.items()]
    groups = [columns for one in questions for columns in (one.given, one.columns, *one.alike)]
    columns = [column for group in groups for column in group]
    added = information_of_manoeuvres(problem, model, linearization, columns)
    return {
        question.effect: _best_manoeuvre(
            {name: question.shares(one) for name, one in added.items()}
        )
        for question in questions
    }


class NextFlight(NamedTuple):
    """A script, and the effects that each of its manoeuvres is for."""

    script: Script
    reasons: Mapping[str, tuple[str, ...]]

    def describe(self) -> str:
        """Return lines on what is in it, why, and how to fly the same on a real drone."""
        lines = [f"{len(self.script.kinds)} flights, {SECONDS_PER_MANOEUVRE:g} s of each manoeuvre"]
        for name, effects in self.reasons.items():
            lines += [f"{name}: to settle {', '.join(effects)}", f"    {MANOEUVRES[name].how}"]
        return "\n".join(lines)


def _reasons(path: Path, content: Any) -> dict[str, tuple[str, ...]]:
    """Return manoeuvre -> effects that a diagnosis names, in the order of ``MANOEUVRES``."""
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        found = content.get("schema") if isinstance(content, dict) else type(content).__name__
        raise ScriptError(f"{path}: schema: found {found!r}, expected {SCHEMA}")
    listed = content.get("not_identifiable")
    if not isinstance(listed, list):
        raise ScriptError(
            f"{path}: not_identifiable: found {type(listed).__name__}, expected a list"
        )
    wanted: dict[str, list[str]] = {name: [] for name in MANOEUVRES}
    for number, one in enumerate(listed):
        effect, fly = (one.get(key) if isinstance(one, dict) else None for key in ("effect", "fly"))
        place = f"{path}: not_identifiable[{number}]"
        if not isinstance(effect, str):
            raise ScriptError(f"{place}: effect: found {effect!r}, expected a name")
        if isinstance(fly, str) and fly.startswith(TO_LOG):
            continue  # a sensor settles it, no flight
        if not isinstance(fly, str) or fly not in MANOEUVRES:
            raise ScriptError(
                f"{place}: fly: found {fly!r}, expected one of {', '.join(MANOEUVRES)}"
            )
        wanted[fly].append(effect)
    return {name: tuple(effects) for name, effects in wanted.items() if effects}


def _battery_range(model: ModelParameters) -> tuple[float, float]:
    return float(model.battery.empty_v), float(model.battery.full_v)


def _voltages(path: Path, content: dict[str, Any], model: ModelParameters) -> tuple[float, float]:
    """Return the voltages that a diagnosis has seen, else those of the model's battery."""
    data = content.get("data")
    found = data.get("voltages") if isinstance(data, dict) else None
    if found is None:
        return _battery_range(model)
    numbers = (
        found
        if isinstance(found, list) and all(isinstance(one, int | float) for one in found)
        else []
    )
    if len(numbers) != 2 or not 0.0 < numbers[0] <= numbers[1] < np.inf:
        raise ScriptError(
            f"{path}: data: voltages: found {found!r}, expected the lowest and the highest, V"
        )
    return float(numbers[0]), float(numbers[1])


def next_flight(path: str | Path, model: ModelParameters, seed: int = 0) -> NextFlight:
    """Return the flights that a ``diagnosis.json`` asks for, starting at a model's hover action.

    Raises:
        ScriptError: a file that cannot be read or is no diagnosis, or that asks for no flight.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ScriptError(f"{path}: cannot be read: {error}") from error
    reasons = _reasons(path, content)
    if not reasons:
        raise ScriptError(
            f"{path}: not_identifiable: found nothing that another flight would settle"
        )
    voltages = _voltages(path, content, model)
    hover = hover_action(model, voltages)
    return NextFlight(script_of(flights_of(reasons, hover, seed, voltages)), reasons)
