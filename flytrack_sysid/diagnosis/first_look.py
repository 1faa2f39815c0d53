"""The first look at a log: the refitted base, and what each effect would gain to first order.

It takes seconds, and nothing in it is confirmed. The search with refits of every candidate, rivals,
held-out rows, free flight and the unexplained part come later.
"""

from collections.abc import Mapping
from typing import NamedTuple

from flytrack_sysid.diagnosis.model_selection import base_changes
from flytrack_sysid.diagnosis.result import Estimated
from flytrack_sysid.diagnosis.summary import estimates
from flytrack_sysid.inference.score_test import threshold
from flytrack_sysid.inference.search import FittedModel, SearchState, score_candidates

MAX_LISTED = 6  # effects
NOT_CHECKED = (
    "Not checked: whether an effect stands in for another or for something unknown, whether "
    "held-out rows and free flight agree, changes within the log, and what no cause explains. "
    "Nothing is written."
)


class Likely(NamedTuple):
    """The first-order gain of an effect.

    Attributes:
        effect: its name.
        gain: in minus twice the log likelihood.
        threshold: the gain from which the effect is named.
    """

    effect: str
    gain: float
    threshold: float


class FirstLook(NamedTuple):
    """The first look at a log.

    Attributes:
        base: causes of the base that differ from the model, with their parameters.
        likely: effects that gain more than chance beside the base alone, the strongest first.
    """

    base: Mapping[str, Mapping[str, Estimated]]
    likely: tuple[Likely, ...]

    @classmethod
    def of(cls, state: SearchState, base: FittedModel) -> "FirstLook":
        """Return the first look of a search that has fitted the base and the noise."""
        state, linearization = state.linearized(base.vector)
        changes = base_changes(state, linearization, base)
        base_estimates = {
            name: estimates(linearization, base, change.fields) for name, change in changes.items()
        }
        scored = (
            Likely(one.candidate.effect, one.gain.robust, threshold(one.gain.num_parameters))
            for one in score_candidates(state, linearization, base)
        )
        return cls(base_estimates, tuple(one for one in scored if one.gain > one.threshold))

    def text(self) -> str:
        """Return the first look as lines of text."""
        base = [
            f"{parameter} = {one.value:.4g}" + f" {one.unit}" * (one.unit != "1")
            for values in self.base.values()
            for parameter, one in values.items()
            if parameter == "mean_factor" or not parameter.startswith("c")
        ]
        likely = [
            f"{one.effect}: {one.gain:.0f}, named from {one.threshold:.0f}"
            for one in self.likely[:MAX_LISTED]
        ]
        return "\n".join(
            [
                "First look, to first order; nothing is confirmed yet.",
                f"The base refitted: {', '.join(base) or 'as the model has it'}.",
                "Effects by what they would gain beside it, each alone:",
                *(f"  {line}" for line in likely or ["none more than chance"]),
            ]
        )
