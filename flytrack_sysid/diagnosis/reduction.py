"""The selected model less the effects that held-out flights did not need, never worse than its base."""

from collections.abc import Sequence
from dataclasses import replace

from flytrack_sysid.diagnosis.model_selection import ablate
from flytrack_sysid.diagnosis.onset import ended
from flytrack_sysid.diagnosis.refinement import Judge, Refined
from flytrack_sysid.diagnosis.score_test import Candidate
from flytrack_sysid.diagnosis.vetoes import Selection


def reduced(selection: Selection, refined: Refined) -> Selection:
    """Return the selection with only those effects that a refinement kept; its base alone without any.

    Where none was fitted to flights, as sensors that flights do not see, single steps decide; the base alone
    stands where it flies better.
    """
    model = selection.model
    if refined.fit is not None:
        if refined.kept == model.candidates:
            return selection
        return selection._replace(model=model._replace(candidates=refined.kept, places=refined.fit.places))
    if refined.kept:
        kept = selection if refined.kept == model.candidates else _narrowed(selection, refined.kept)
        if not _flies_worse(kept, refined.judge):
            return kept
    state, base = selection.state, selection.base
    # What an effect that is gone held at nominal is free again, as it was when the base was fitted.
    held = tuple(one for one in state.held if state.problem.names.index(one.field) not in base.places)
    return selection._replace(state=replace(state, held=held), model=base)


def _narrowed(selection: Selection, kept: Sequence[Candidate]) -> Selection:
    """Return the selection with some of its effects, fitted to single steps again."""
    state, model = selection.state, selection.model
    removed = [one.effect for one in model.candidates if one not in kept]
    state = replace(state, held=tuple(one for one in state.held if one.effect not in removed))
    model = state.fitted(kept, state.problem.without(model.vector, removed))
    state, linearization = state.linearized(model.vector)
    ablations = {one.effect: ablate(state, model, linearization, one.effect) for one in kept}
    return selection._replace(state=state, model=model, ablations=ablations)


def _flies_worse(selection: Selection, judge: Judge | None) -> bool:
    """Return whether a model predicts held-out flights after its last change worse than its base does."""
    if judge is None:
        return False
    vector = selection.state.problem.without(selection.model.vector, ended(selection))
    if selection.unexplained.flagged:
        return judge.worst_ratio(vector) >= 1.0
    return judge.is_surely_worse(vector)
