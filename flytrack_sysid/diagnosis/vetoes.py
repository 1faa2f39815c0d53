"""Vetoes: rules that reject an effect or base change despite its gain where it was fitted.

``VETOES`` is the one list of rules on a selected model; each returns the effects that it rejects. A
rejected effect is not searched for again, the model is selected again without it, and the rules
start over.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flytrack_env.effects import BY_NAME, takes_motors
from flytrack_sysid.diagnosis import model_selection
from flytrack_sysid.diagnosis import unexplained as unknown
from flytrack_sysid.diagnosis.result import Unexplained
from flytrack_sysid.inference.chunks import AXES
from flytrack_sysid.inference.problem import SEARCHED, Problem, split_blocks
from flytrack_sysid.inference.record import Record
from flytrack_sysid.inference.score_test import ALL_BASE_CAUSES, change_threshold, threshold
from flytrack_sysid.inference.search import FittedModel, SearchState
from flytrack_sysid.inference.torque import unseen_in_chunks

# Held-out rows contradict a cause if two conditions hold. Its gain is HELD_OUT_SIGMAS standard
# deviations below the expected gain, and less than HELD_OUT_SHARE of its size shows. The second one
# is needed because laws are not exact in harder flight.
HELD_OUT_SIGMAS, HELD_OUT_SHARE = 4.0, 0.35
HELD_OUT_SHOWN = 20.0  # of chi2: held-out rows with a lower expected gain contradict nothing
LOSS_SIGMAS = 2.5  # instead of both, where held-out rows are likelier without the cause
# Commands are at rest if, for this long, they changed by no more than this share of the largest
# stick.
REST_S, REST_SHARE = 0.1, 0.05
# A choice among many effects can fit the noise of one log. So an effect that gains less than this
# many thresholds has to gain on held-out rows, too, if at least this chi2 is expected there.
BARELY, BARELY_SHOWN = 2.0, 1.0
# A change of the base that gains less than this share of the gain of an effect that shows in the
# same channels is the remainder of the effect's law: lags and thrust curves absorb those easily.
BASE_REMAINDER = 0.01
# A name on a side that something unknown disturbs needs this many thresholds; base changes, which
# absorb remainders easily, need more. A name that keeps less than KEPT_SHARE of its noncentrality
# beside what the unknown depends on is a stand-in for it.
DISTURBED, DISTURBED_BASE, KEPT_SHARE = 3.0, 10.0, 0.1
# A stand-in for something unknown explains a part of it. A name that explains this many times what
# the dependences explain is no stand-in: the dependences are the remainder of its law.
OUTWEIGHS = 30.0


class Selection(NamedTuple):
    """A selected model, and what it leaves unexplained.

    Attributes:
        state: of the search that led to the model.
        base: the refitted model without effects.
        model: the selected one.
        ablations: of each effect of the model.
        unexplained: what the model leaves unexplained.
        stand_ins: effects and causes in the base that stand in for something unknown.
    """

    state: SearchState
    base: FittedModel
    model: FittedModel
    ablations: dict[str, model_selection.Ablation]
    unexplained: Unexplained = Unexplained()
    stand_ins: tuple[str, ...] = ()


Veto = Callable[[Selection, Problem], list[str]]


def select(state: SearchState, base: FittedModel, model: FittedModel) -> Selection:
    """Swap or remove effects while that helps."""
    state, model, ablations = model_selection.select_effects(state, model)
    selection = Selection(state, base, model, ablations)
    return loaded(selection) if takes_motors(state.problem.like.effects) else selection


def loaded(selection: Selection) -> Selection:
    """Return the selection with a load, where that explains other thrust and inertia as well."""
    trial = model_selection.held_for_load(selection.state, selection.model)
    if trial is None:
        return selection
    state, model, ablations = model_selection.select_effects(*trial)
    if not model_selection.has_load(model):
        return selection
    start = state.problem.at_start(selection.base.vector, model_selection.THRUST_AND_INERTIA)
    return Selection(state, state.fitted((), start), model, ablations)


def reject(selection: Selection, effects: Sequence[str]) -> Selection:
    """Return the selection without some effects, which stay refused even if it has not all."""
    state, model = selection.state, selection.model
    base = selection.base
    if model_selection.has_load(model) and model_selection.LOAD_EFFECT in effects:
        # Thrust and inertia are free again, which were held for the load.
        state = replace(state, held=unseen_in_chunks(state.problem.chunks, state.problem.like))
        base = state.fitted((), base.vector)
    state = replace(state, refused=(*state.refused, *effects))
    for effect in (one for one in effects if one in model.effects):
        model = model_selection.without_effect(state, model, effect)
    state, model, ablations = model_selection.select_effects(state, model)
    return Selection(state, base, model, ablations)


def apply_vetoes(selection: Selection, test: Problem) -> tuple[Selection, dict[str, str]]:
    """Return the selection without effects that a veto rejects, and the veto's name for each.

    Args:
        selection: to examine.
        test: held-out rows, with the noise of the selection's problem.
    """
    vetoed: dict[str, str] = {}
    selection = examined(selection)
    while True:
        for rule in VETOES:
            rejected = dict.fromkeys(rule(selection, test), rule.__name__)
            if rejected:
                vetoed |= rejected
                selection = examined(reject(selection, tuple(rejected)))
                break
        else:
            return selection, vetoed


def examined(selection: Selection) -> Selection:
    """Return the selection with its unexplained part, and the names that stand in for it."""
    problem, model = selection.state.problem, selection.model
    unexplained, dependences = unknown.find_unexplained(problem, model, selection.base.vector)
    selection = selection._replace(unexplained=unexplained, stand_ins=())
    if not unexplained.flagged:
        return selection
    suspects = [
        Suspect(candidate.effect, candidate.fields, ablation.robust, ablation.num_parameters)
        for candidate, ablation in zip(model.candidates, selection.ablations.values(), strict=True)
    ]
    state, linearization = selection.state.linearized(model.vector)
    for name, change in model_selection.base_changes(state, linearization, model).items():
        robust = change.gain / change.marginal.inflation
        suspects.append(Suspect(name, tuple(change.fields), robust, len(change.fields)))
    return selection._replace(
        state=state, stand_ins=find_stand_ins(selection, suspects, dependences)
    )


class Suspect(NamedTuple):
    """A name that may stand in for something unknown.

    Attributes:
        name: of the effect, or of the cause in the base.
        fields: its parameters.
        robust: its gain over its inflation.
        num_parameters: of its parameters, the number that the log determines.
    """

    name: str
    fields: tuple[str, ...]
    robust: float
    num_parameters: int


def find_stand_ins(
    selection: Selection, suspects: Sequence[Suspect], dependences: Sequence[unknown.Dependence]
) -> tuple[str, ...]:
    """Return names that stand in for something that is not in the list of effects.

    Their gain vanishes beside smooth functions of what the rest depends on (and beside constants,
    which a wind, for example, would be), or is small while something unknown disturbs the same
    side. A name is no stand-in if its gain outweighs what the dependences explain.
    """
    problem, model = selection.state.problem, selection.model
    residuals, slopes = unknown.linearized_residuals(problem, model)
    flight = unknown.build_flight_variables(problem, model)
    disturbed = {name.split(":")[0] for name in selection.unexplained.shares}
    changing = {one.effect for one in problem.windows}

    def noncentralities(suspect: Suspect, side: str) -> tuple[float, float]:
        """Return a suspect's noncentrality on a side, alone and beside the found dependences."""
        axes = unknown.SIDES[side]
        own_columns = [
            model.indices.index(index) for index in problem.parameter_indices(suspect.fields)
        ]
        acting = slopes[own_columns][..., axes, :]
        if not (problem.counts[..., axes, :].any() and np.abs(acting).max() > 0.0):
            return 0.0, 0.0
        test = unknown.SideTest.of(side, residuals, np.delete(slopes, own_columns, axis=0))
        columns = split_blocks(acting * test.root)
        size = (model.vector - problem.start)[problem.parameter_indices(suspect.fields)]
        before = test.noncentrality(columns, size)
        smooth_columns = [
            dependence.columns for dependence in dependences if dependence.side == side
        ]
        if smooth_columns:
            constants = unknown.whitened(problem, unknown.constants(flight, side), side)
            smooth_columns.append(split_blocks(constants * test.root))
        return before, test.given_also(*smooth_columns).noncentrality(columns, size)

    result = []
    for suspect in suspects:
        by_side = {side: noncentralities(suspect, side) for side in unknown.SIDES}
        before, after = (sum(values) for values in zip(*by_side.values(), strict=True))
        if before == 0.0:
            continue  # it acts on neither side: the battery
        own_side = max(by_side, key=lambda side: by_side[side][0])
        limit = change_threshold if suspect.name in changing else threshold
        min_gain = limit(suspect.num_parameters)
        rest_gain = sum(
            dependence.gain for dependence in dependences if dependence.side == own_side
        )
        is_gone = is_absorbed(before, after, min_gain, suspect.robust, rest_gain)
        needed = min_gain * (DISTURBED_BASE if suspect.name in ALL_BASE_CAUSES else DISTURBED)
        if is_gone or (own_side in disturbed and suspect.robust < needed):
            result.append(suspect.name)
    return tuple(result)


def is_absorbed(
    before: float, after: float, min_gain: float, robust: float, rest_gain: float
) -> bool:
    """Return whether what the rest depends on takes a name's place.

    On a short log, waves of a heading can take the place of nearly anything. So a name that
    explains far more than the rest is not absorbed by it.

    Args:
        before: the name's noncentrality.
        after: the same beside the dependences.
        min_gain: that a name needs.
        robust: the name's gain over its inflation.
        rest_gain: of the dependences.
    """
    if robust >= OUTWEIGHS * rest_gain > 0.0:
        return False
    return after < min_gain or after < KEPT_SHARE * before


def stands_in_for_unknown(selection: Selection, test: Problem) -> list[str]:
    """Reject effects that stand in for something that is not in the list of effects."""
    return [effect for effect in selection.ablations if effect in selection.stand_ins]


def held_out_under(selection: Selection, test: Problem) -> Problem:
    """Return the problem of held-out rows with a selection's noise and effect windows."""
    problem = selection.state.problem
    return replace(test.with_noise(problem.noise), windows=problem.windows)


def held_out_gain(test: Problem, less: np.ndarray, full: np.ndarray) -> tuple[float, float]:
    """Return a model's gain on held-out rows, and the gain expected if the model is right.

    Args:
        test: the rows.
        less: the vector of the smaller model.
        full: the vector of the model.
    """
    white = test.whitened_residuals(less, full)
    gain = float(np.sum(white[0] ** 2) - np.sum(white[1] ** 2))
    return gain, float(np.sum((white[0] - white[1]) ** 2))


def is_contradicted(gain: float, expected: float, inflation: float) -> bool:
    """Return whether a gain on held-out rows contradicts a cause.

    Args:
        gain: of the cause, there.
        expected: the gain if the cause is real; its spread is that of a chi2 about it.
        inflation: of the gain's variance.
    """
    spread = 2.0 * np.sqrt(expected * inflation)
    if gain < 0.0 and expected > HELD_OUT_SHOWN:
        return bool(gain < expected - LOSS_SIGMAS * spread)
    if expected < HELD_OUT_SHOWN * inflation:
        return False
    share = 0.5 * (1.0 + gain / expected)
    return bool(gain < expected - HELD_OUT_SIGMAS * spread and share < HELD_OUT_SHARE)


def contradicted_on_held_out(selection: Selection, test: Problem) -> list[str]:
    """Reject effects that held-out rows show too little: they acted for a time or never."""

    def is_rejected(ablation: model_selection.Ablation) -> bool:
        gain, expected = held_out_gain(test, ablation.without.vector, selection.model.vector)
        return is_contradicted(gain, expected, ablation.inflation)

    return [effect for effect, ablation in selection.ablations.items() if is_rejected(ablation)]


def rests(record: Record) -> np.ndarray:
    """Return where the rate commands have rested for ``REST_S``, (rows, chunks) bool.

    Args:
        record: in chunks.
    """
    sticks = record.command[..., :3]
    rows = max(round(REST_S / record.median_step_s), 1)
    padded = np.pad(sticks, ((rows, 0), (0, 0), (0, 0)), mode="edge")
    moved = np.ptp(np.lib.stride_tricks.sliding_window_view(padded, rows + 1, axis=0), axis=-1)
    return np.asarray(moved.max(axis=-1) <= REST_SHARE * np.abs(sticks).max(axis=-1))


def stick_laws(problem: Problem) -> list[str]:
    """Return the laws of the sticks for which dynamics of the rate loop can pass.

    Where motors are commanded, there are none.
    """
    if takes_motors(problem.like.effects):
        return []
    laws = [effect for effect in SEARCHED if effect.search.follows_sticks]
    if problem.counts[..., AXES[0], 1].any():  # attitude tells a gyro from any rate loop
        laws = [law for law in laws if "gyro" not in law.hooks]
    return [law.name for law in laws]


def not_seen_at_rest(selection: Selection, test: Problem) -> list[str]:
    """Reject laws of the sticks that do not hold while these rest, each or all together.

    A law that holds in transients only stands for dynamics that are not in the list of effects. For
    example, feedforward turns faster than commanded on the way to full stick, as a scale and a
    saturation would, but not while the stick stays there. Where turns are left unexplained, laws
    that this log never shows at rest are rejected, too. So are those that the model lacks: the next
    one would pass for the same dynamics.
    """
    state, model = selection.state, selection.model
    laws = [name for name in selection.ablations if name in stick_laws(state.problem)]
    others = [name for name in stick_laws(state.problem) if name not in laws]
    if not laws:
        return []
    at_rest = rests(state.problem.chunks.record)

    def gain_at_rest(without: np.ndarray) -> tuple[float, float]:
        white = state.problem.whitened_residuals(without, model.vector)
        less, full = white[:, at_rest][..., AXES[0], :]
        return float(np.sum(less**2) - np.sum(full**2)), float(np.sum((less - full) ** 2))

    ablations = [selection.ablations[name] for name in laws]
    contradicted = [
        is_contradicted(*gain_at_rest(ablation.without.vector), ablation.inflation)
        for ablation in ablations
    ]
    if any(contradicted):
        return [
            *(law for law, is_false in zip(laws, contradicted, strict=True) if is_false),
            *others,
        ]
    without = ablations[0].without
    for name in laws[1:]:  # a scale needs the saturation that undoes it, and vice versa
        without = model_selection.without_effect(state, without, name)
    gain, expected = gain_at_rest(without.vector)
    inflation = max(ablation.inflation for ablation in ablations)
    are_turns_unexplained = any(name.startswith("rate:") for name in selection.unexplained.shares)
    is_unseen = expected < HELD_OUT_SHOWN * inflation and are_turns_unexplained
    return [*laws, *others] if is_unseen or is_contradicted(gain, expected, inflation) else []


def is_force_law(effect: str) -> bool:
    """Return whether an effect is a law of a force, which may have the wrong form.

    A scale of thrust is not a law.
    """
    acts_on_force = not {"thrust", "air", "force"}.isdisjoint(BY_NAME[effect].hooks)
    return acts_on_force and effect != "thrust_scale"


def seen_once(selection: Selection, test: Problem) -> list[str]:
    """Reject effects that gain barely enough where they were fitted, and nothing on held-out rows.

    An effect that begins or ends in flight has to gain there in any case: a few rows can cause an
    apparent change.
    """
    changing = {one.effect for one in selection.state.problem.windows}

    def is_rejected(effect: str, one: model_selection.Ablation) -> bool:
        gain, expected = held_out_gain(test, one.without.vector, selection.model.vector)
        if effect in changing:
            return gain <= 0.0
        is_clear = one.robust >= BARELY * threshold(one.num_parameters)
        return not is_clear and gain < 0.0 and expected > BARELY_SHOWN

    return [effect for effect, one in selection.ablations.items() if is_rejected(effect, one)]


VETOES: tuple[Veto, ...] = (
    stands_in_for_unknown,
    contradicted_on_held_out,
    not_seen_at_rest,
    seen_once,
)
CONTRADICTED = contradicted_on_held_out.__name__
# Reasons that a warning gives for a rejection, by rule. Effects that held-out rows contradict have
# a warning of their own (``summary.collect_warnings``), unless a change within the log is found
# without them.
REASONS = {
    "stands_in_for_unknown": "what remains unexplained could pass for it",
    "not_seen_at_rest": (
        "dynamics of the rate loop that no list has would look the same while sticks move; fly "
        "stick_amplitudes, and hold each stick for a second"
    ),
    "seen_once": "it gains barely enough where it was fitted, and nothing on held-out rows",
}
