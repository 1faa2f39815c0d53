"""Sentences of warning that go with a diagnosis."""

from collections.abc import Mapping, Sequence

from flytrack_env.effects import BY_NAME
from flytrack_sysid.diagnosis.lanes import lead_in_of, voltages_of
from flytrack_sysid.diagnosis.linear import AT_BOUND
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.result import Cause, Errors
from flytrack_sysid.diagnosis.search import Found
from flytrack_sysid.record import BATTERY_UNKNOWN_V

WORSE = 1.1  # times the error of free flight


def cautions(
    problem: Problem,
    found: Found,
    causes: Sequence[Cause],
    errors: Mapping[str, Errors],
    lost: Sequence[str],
    learnt: int,
) -> tuple[str, ...]:
    """Return what a reader must know before trusting causes or the extended model.

    lost: names that were taken back because held-out rows contradict them. learnt: rows to learn from.
    """
    taken_back = [
        f"{name} gained nothing on the held-out part: it was there for a time only, or never" for name in lost
    ]
    return (
        *_thinned(problem, learnt),
        *_voltage_unknown(problem, causes),
        *taken_back,
        *_at_bounds(problem, found, causes),
        *_flies_worse(errors),
    )


def _voltage_unknown(problem: Problem, causes: Sequence[Cause]) -> list[str]:
    """Return a warning where thrust is named and the voltage it depends on was not measured."""
    thrust = [cause.effect for cause in causes if cause.effect in ("thrust_curve", "thrust_scale")]
    if not thrust or voltages_of(problem.lanes) is not None:
        return []
    taken = f"no voltage was logged and {BATTERY_UNKNOWN_V:g} V were taken"
    return [f"{taken}: {thrust[0]} may be no more than that"]


def _thinned(problem: Problem, learnt: int) -> list[str]:
    """Return a warning where a log is so long that only lanes of it are learnt from."""
    own = problem.lanes.row[lead_in_of(len(problem.lanes.row)) :]
    used = int((own >= 0).sum())
    if used >= learnt:
        return []
    return [
        f"of {learnt} rows to learn from, {used} were looked at, evenly spread: more need too much memory"
    ]


def _at_bounds(problem: Problem, found: Found, causes: Sequence[Cause]) -> list[str]:
    """Return a warning for each value at the end of its range: the true cause may be another one."""
    result = []
    for cause in causes:
        for name, one in cause.parameters.items():
            field = f"{cause.effect}.{name}"
            if field not in problem.names or name in BY_NAME[cause.effect].shapes:
                continue  # a base parameter, or one that may well be as sharp as it gets
            place = problem.names.index(field)
            low, high = problem.low[place], problem.high[place]
            room = AT_BOUND * max(abs(found.vector[place]), 1.0)
            if low + room < found.vector[place] < high - room:
                continue
            why = "its law may stand in for something else"
            if name in BY_NAME[cause.effect].most_steps:
                why = "so many rows of the log are remembered; import it with fewer rows a second"
            result.append(
                f"{field} = {one.value:.3g} is at the end of what is searched ({low:g} to {high:g}): {why}"
            )
    return result


def _flies_worse(errors: Mapping[str, Errors]) -> list[str]:
    """Return a warning where, held out, free flight of the extended model ends up farther off."""
    base, extended = errors["refitted_base"].position_m, errors["extended"].position_m
    worse = [horizon for horizon in extended if extended[horizon] > WORSE * base[horizon]]
    if not worse:
        return []
    compared = ", ".join(
        f"{extended[horizon]:.3g} m against {base[horizon]:.3g} m after {horizon} s" for horizon in worse
    )
    return [
        f"the extended model flies farther off than the refitted one without effects ({compared}, held out): "
        "the named causes are right step by step, or stand in for something else"
    ]
