"""Effects that a log cannot show or tell apart, and the manoeuvres that would show them.

All manoeuvres are flown by the fitted model and measured by the log's sensors with their noise. The
advised manoeuvre is chosen by the Fisher information that each would add to the log's.
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
from flytrack_env.effects import BY_NAME, MAX_DELAY_STEPS, takes_motors
from flytrack_env.plants import Simulator
from flytrack_sysid.collect import states_flown
from flytrack_sysid.diagnosis.result import SCHEMA, TO_LOG, NotIdentifiable
from flytrack_sysid.excitation import ANY_VOLTAGE, DT_S, FLIGHT_STEPS, SCRIPT_HEIGHTS, is_inside
from flytrack_sysid.inference.chunks import CHUNK_S, Chunks, make_chunks, measured_voltage_range
from flytrack_sysid.inference.parameters import TAUS, THRUST_COEFFS, from_vector
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.record import UPRIGHT
from flytrack_sysid.inference.score_test import (
    Candidate,
    Linearization,
    list_candidates,
    searched_in,
)
from flytrack_sysid.inference.search import FittedModel, SearchState
from flytrack_sysid.inference.trace_cache import fast_jit
from flytrack_sysid.log import FlightLog, log_of_states
from flytrack_sysid.log_voltage import voltages_of
from flytrack_sysid.manoeuvres import (
    FLIGHTS_PER_MANOEUVRE,
    MANOEUVRES,
    SECONDS_PER_MANOEUVRE,
    flights_of,
    hover_action,
)
from flytrack_sysid.script_file import Script, ScriptError, build_script

DETECTED = 30.0  # noncentrality from which a log shows an effect nearly always
SEPARATE = 20.0  # noncentrality beside a rival from which a log tells the two apart
LOOKS_ALIKE = 0.1  # of an effect's noncentrality: a look-alike leaves less than this
ROUNDING = 1e-6  # of DETECTED
BASE_ONLY = ("thrust_scale",)  # no log tells it from the free thrust curve: a cause of the base
CHUNKS_PER_MANOEUVRE = int(FLIGHTS_PER_MANOEUVRE * FLIGHT_STEPS * DT_S) // CHUNK_S
PRIOR_SHARE = 1e-2  # of what shows an effect: less comes from the log's own prior
# Of the best share: manoeuvres this close to the best are equally good; the easiest is chosen.
NEARLY_BEST = 0.8
PLENTY = 30.0  # shares: thirty times what shows an effect


def _typical_candidate(effect: str) -> Candidate:
    """Return the candidate of an effect whose probes are nearest to its notable size."""

    def distance(candidate: Candidate) -> float:
        notable = BY_NAME[effect].notable
        return sum(
            abs(np.log(probe.value / notable[probe.field.split(".")[1]]))
            for probe in candidate.probes
        )

    return min(list_candidates(BY_NAME[effect]), key=distance)


class Question:
    """How well a log shows an effect, also beside effects that look alike.

    Attributes:
        linearization: the log's, at the fitted model, along everything
            (``SearchState.linearized``).
        effect: its name.
        given: the columns of the model's free parameters.
        fields: the effect's parameters.
        columns: of the fields in the linearization.
        sizes: notable sizes of the fields, in steps along the columns.
        alike: the columns of each look-alike.
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
        candidate, shapes = _typical_candidate(effect), BY_NAME[effect].search.shapes
        notable = BY_NAME[effect].notable
        fields = [field for field in candidate.other_fields if field.split(".")[1] not in shapes]
        # The columns of probes come first; their steps are shares of the way to them.
        self.columns = [
            *map(linearization.probe_column, candidate.probes),
            *map(linearization.column, fields),
        ]
        self.fields = [*(probe.field for probe in candidate.probes), *fields]
        steps = np.array([*(probe.value for probe in candidate.probes), *np.ones(len(fields))])
        self.sizes = np.array([notable[field.split(".")[1]] for field in self.fields]) / steps
        self.alike = [Question(linearization, model, other).columns for other in alike]

    def noncentralities(
        self, beside: Sequence[int] = (), information: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Return the noncentrality of each parameter at its notable size.

        All other free parameters are projected out.

        Args:
            beside: columns that are projected out as well.
            information: added to the log's.
        """
        joint = copy.copy(self.linearization)
        joint.total = joint.total + information
        given = self.given + [column for column in beside if column not in self.given]
        result = np.zeros(len(self.columns))
        for index, column in enumerate(self.columns):
            value = joint.projected([column], [free for free in given if free != column])[0][0, 0]
            value -= joint.prior[column]  # the prior does not come from the log
            result[index] = max(float(value), 0.0) * self.sizes[index] ** 2
        return result

    def shares(self, information: np.ndarray | float = 0.0) -> np.ndarray:
        """Return how well the effect would show at its notable size, ascending; 1 or more suffices.

        The shares are the noncentrality of each parameter over DETECTED, and the noncentrality
        beside each look-alike over SEPARATE.

        Args:
            information: added to the log's.
        """
        beside = [self.noncentralities(columns, information) / SEPARATE for columns in self.alike]
        return np.sort(np.concatenate([self.noncentralities((), information) / DETECTED, *beside]))


def unit_of(effect: str, field: str | None = None) -> str:
    """Return the unit of an effect's parameter; that of the first notable one if None."""
    return BY_NAME[effect].ranges[field or next(iter(BY_NAME[effect].notable))].unit


def unseen_effects(
    state: SearchState, linearization: Linearization, model: FittedModel
) -> dict[str, NotIdentifiable]:
    """Return effects that the log cannot show, by name, without the manoeuvre to fly.

    Sizes are infinite where no size would show.
    """
    result: dict[str, NotIdentifiable] = {}
    for effect in searched_in(state.problem):
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
    """Return effects beside which this one hardly shows."""
    sizes = question.noncentralities()
    result = []
    for other in searched_in(state.problem):
        if other in (question.effect, *BASE_ONLY, *state.unobservable):
            continue
        beside = question.noncentralities(Question(question.linearization, model, other).columns)
        if np.any((beside < SEPARATE) & (beside < LOOKS_ALIKE * sizes)):
            result.append(other)
    return tuple(result)


@fast_jit
def _flown(
    vector: jax.Array, like: ModelParameters, starts: jax.Array, commands: jax.Array
) -> jax.Array:
    """Return the states of flights, (flights, steps, 21), each before its command."""
    fly = partial(states_flown, Simulator(MAX_DELAY_STEPS), from_vector(vector, like))
    return jax.vmap(fly)(starts, commands)[:, :-1]


def _absent_channels(chunks: Chunks) -> list[str]:
    """Return the channels of states that the log of these chunks does not have."""
    record, has_turns, has_velocity = (
        chunks.record,
        chunks.counts[..., 0, 1].any(),
        chunks.counts[..., 3, 1].any(),
    )
    present = {
        "w": "w" in chunks.measured,
        "a": "f" in chunks.measured,
        "q": bool(has_turns or np.any(record.quat != UPRIGHT)),
        "v": bool(has_velocity),
        "p": bool(record.pos_w.any()),
        "v_bat": measured_voltage_range(chunks) is not None,
        "uprev": bool(record.is_applied_known.any()),
    }
    return [name for name, is_present in present.items() if not is_present]


def _seen_flights(problem: Problem, vector: np.ndarray) -> tuple[FlightLog, np.ndarray]:
    """Return a log of all manoeuvres flown by a model, and the rows that count, (num_rows,) bool.

    The log has the channels of the problem's log.
    """
    model = problem.like._replace(thrust_coeffs=vector[problem.parameter_indices(THRUST_COEFFS)])
    voltages = measured_voltage_range(problem.chunks) or voltages_of(problem.like.battery)
    flights = flights_of(MANOEUVRES, hover_action(model, voltages), voltages=voltages)
    starts = np.stack([flight.start for flight in flights])
    commands = np.stack([flight.command for flight in flights])
    states = np.asarray(_flown(vector, problem.like, starts, commands))
    # A flight keeps its last state once it leaves the envelope.
    inside = np.logical_and.accumulate(is_inside(states, SCRIPT_HEIGHTS, ANY_VOLTAGE), axis=1)
    last = np.maximum.accumulate(np.where(inside, np.arange(states.shape[1]), 0), axis=1)
    states = np.take_along_axis(states, last[..., None], axis=1)
    log = log_of_states(zip(states, commands, strict=True), DT_S, "manoeuvres")
    return log.without(*_absent_channels(problem.chunks)), inside.reshape(-1)


def _in_parts(chunks: Chunks, size: int) -> Iterator[Chunks]:
    """Yield ``size`` chunks at a time, the last ones padded with chunks that do not count."""
    num_chunks = chunks.counts.shape[1]
    for first in range(0, num_chunks, size):
        indices = np.arange(first, first + size)
        part = chunks.selected(np.minimum(indices, num_chunks - 1))
        yield part._replace(counts=part.counts & (indices < num_chunks)[:, None, None])


def _information_along(
    linearization: Linearization, columns: Sequence[int], ahead: Problem, vector: np.ndarray
) -> np.ndarray:
    """Return the information by chunk about some columns, (chunks, columns, columns)."""
    end = len(linearization.indices)
    indices = [linearization.indices[column] for column in columns if column < end]
    probes = [linearization.probes[column - end] for column in columns if column >= end]
    others = np.array([probe.placed_in(ahead, vector) for probe in probes]) if probes else None
    slopes = ahead.slopes(vector, indices, others)
    # A flight of the model itself has no residuals, and no outliers.
    slopes = slopes._replace(residuals=np.zeros_like(slopes.residuals))
    by_block = Linearization(ahead, slopes, probes).by_block
    return by_block.reshape(-1, ahead.counts.shape[1], *by_block.shape[1:]).sum(axis=0)


def information_of_manoeuvres(
    problem: Problem, model: FittedModel, linearization: Linearization, columns: Sequence[int]
) -> dict[str, np.ndarray]:
    """Return the information about columns that each manoeuvre would add, shaped like ``total``.

    This is the Fisher information at the fitted model, with the noise and the channels of the
    problem's log, of eight flights of 2.5 s each. It is 0 for other columns. Call it inside
    ``jax.enable_x64(True)``.
    """
    columns = sorted(set(columns))
    log, counts = _seen_flights(problem, model.vector)
    chunks = make_chunks(
        log, counts, model.vector[problem.parameter_indices(TAUS)], float(problem.like.g)
    )
    by_chunk = []
    # As many chunks at a time as the log has, for which programs are compiled.
    for part in _in_parts(chunks, problem.counts.shape[1]):
        ahead = Problem.of(part, problem.like).with_noise(problem.noise)
        by_chunk.append(_information_along(linearization, columns, ahead, model.vector))
    added = np.concatenate(by_chunk)[: len(MANOEUVRES) * CHUNKS_PER_MANOEUVRE]
    result = {}
    for name, of_manoeuvre in zip(MANOEUVRES, np.split(added, len(MANOEUVRES)), strict=True):
        result[name] = np.zeros_like(linearization.total)
        result[name][np.ix_(columns, columns)] = of_manoeuvre.sum(axis=0)
    return result


def _best_manoeuvre(shares: Mapping[str, np.ndarray]) -> str:
    """Return the easiest manoeuvre whose shares are plenty, or about as large as those of the best.

    The best has the largest worst share. If the worst one shows in no manoeuvre, the next one
    decides.
    """
    floored = {name: np.where(values < PRIOR_SHARE, 0.0, values) for name, values in shares.items()}
    best = max(floored.values(), key=lambda values: values.tolist())
    return next(
        name
        for name, values in floored.items()
        if np.all(values >= np.minimum(NEARLY_BEST * best, PLENTY))
    )


def advise(
    problem: Problem,
    model: FittedModel,
    linearization: Linearization,
    wanted: Mapping[str, Sequence[str]],
) -> dict[str, str]:
    """Return for each wanted effect the manoeuvre that would show it best, of ``MANOEUVRES``.

    None is known for a craft whose motors are commanded. The best is returned even if it does not
    suffice (``Question.shares`` below 1). Call it inside ``jax.enable_x64(True)``.

    Args:
        problem: the log's, with its noise.
        model: the fitted one.
        linearization: of the model, along everything (``SearchState.linearized``).
        wanted: effect -> effects that look alike in this log, maybe none.
    """
    if takes_motors(problem.like.effects):  # manoeuvres are flown by sticks
        return dict.fromkeys(wanted, "")
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
    """The flights to fly next.

    Attributes:
        script: of the flights.
        reasons: manoeuvre -> the effects that it would settle.
    """

    script: Script
    reasons: Mapping[str, tuple[str, ...]]

    def describe(self) -> str:
        """Return lines on the manoeuvres, their reasons, and how to fly them on a real drone."""
        lines = [f"{len(self.script.kinds)} flights, {SECONDS_PER_MANOEUVRE:g} s of each manoeuvre"]
        for name, effects in self.reasons.items():
            lines += [f"{name}: to settle {', '.join(effects)}", f"    {MANOEUVRES[name].how}"]
        return "\n".join(lines)


def _reasons(path: Path, content: Any) -> dict[str, tuple[str, ...]]:
    """Return manoeuvre -> effects from a diagnosis, in the order of ``MANOEUVRES``."""
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        found = content.get("schema") if isinstance(content, dict) else type(content).__name__
        raise ScriptError(f"{path}: schema: found {found!r}, expected {SCHEMA}")
    listed = content.get("not_identifiable")
    if not isinstance(listed, list):
        raise ScriptError(
            f"{path}: not_identifiable: found {type(listed).__name__}, expected a list"
        )
    wanted: dict[str, list[str]] = {name: [] for name in MANOEUVRES}
    for number, item in enumerate(listed):
        effect, fly = (
            item.get(key) if isinstance(item, dict) else None for key in ("effect", "fly")
        )
        place = f"{path}: not_identifiable[{number}]"
        if not isinstance(effect, str):
            raise ScriptError(f"{place}: effect: found {effect!r}, expected a name")
        if isinstance(fly, str) and (not fly or fly.startswith(TO_LOG)):
            continue  # no manoeuvre is known, or a sensor settles it
        if not isinstance(fly, str) or fly not in MANOEUVRES:
            raise ScriptError(
                f"{place}: fly: found {fly!r}, expected one of {', '.join(MANOEUVRES)}"
            )
        wanted[fly].append(effect)
    return {name: tuple(effects) for name, effects in wanted.items() if effects}


def _voltages(path: Path, content: dict[str, Any], model: ModelParameters) -> tuple[float, float]:
    """Return the range of voltages in a diagnosis, else that of the model's battery."""
    data = content.get("data")
    found = data.get("voltages") if isinstance(data, dict) else None
    if found is None:
        return voltages_of(model.battery)
    numbers = (
        found
        if isinstance(found, list) and all(isinstance(number, int | float) for number in found)
        else []
    )
    if len(numbers) != 2 or not 0.0 < numbers[0] <= numbers[1] < np.inf:
        raise ScriptError(
            f"{path}: data: voltages: found {found!r}, expected the lowest and the highest, V"
        )
    return float(numbers[0]), float(numbers[1])


def next_flight(path: str | Path, model: ModelParameters, seed: int = 0) -> NextFlight:
    """Return the flights that a ``diagnosis.json`` advises, starting at a model's hover action.

    Raises:
        ScriptError: a file that cannot be read or is no diagnosis, or that advises no flight.
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
    return NextFlight(build_script(flights_of(reasons, hover, seed, voltages)), reasons)
