"""Sentences on a check, for terminals, reports and errors."""

from collections.abc import Sequence

import numpy as np

from flytrack_env.motors import NAMES as MOTORS
from flytrack_sysid.check.explain import Change
from flytrack_sysid.check.motion import MARGIN
from flytrack_sysid.check.pairs import CONTRADICTS, STILL, Pair
from flytrack_sysid.check.result import Check
from flytrack_sysid.check.scales import unit_of
from flytrack_sysid.log import CHANNELS
from flytrack_sysid.page import text_table

MAX_SHOWN = 4  # alternatives
# Frames that have names, of a body's and of a world's axes.
BODY_NAMES = {"x -y -z": "FRD, read as FLU", "-x -y z": "x backward, y right"}
WORLD_NAMES = {
    "x -y -z": "z down, read as z up",
    "y x -z": "NED, read as ENU (or ENU, read as NED)",
    "y -x z": "turned by a quarter about z",
    "-y x z": "turned by a quarter about z",
}
BODY_CHANNELS = ("w", "f", "u_rates")
NAMES = {"u_rates": "u_roll, u_pitch, u_yaw", "u_thrust": "u_thrust", "rows": "rows"}


def columns_of(channel: str) -> str:
    """Return the columns of a channel, or of one of its axes, as they are in a log."""
    return NAMES.get(channel) or ", ".join(CHANNELS.get(channel, (channel,)))


def describe(change: Change) -> str:
    """Return a sentence on one change: what the log holds instead of what it was read as."""
    channel, kind, value = change
    return f"{columns_of(channel)}: {_says(channel, kind, value)}"


def _says(channel: str, kind: str, value: str | float | bool) -> str:
    if channel == "motors":
        return f"their columns hold motors {value}, read as 1 2 3 4 ({', '.join(MOTORS)})"
    if kind == "axes" and value == "-":
        return {
            "u_thrust": "upside down: more command is less thrust",
            "v_bat": "rises in flight, as no battery does: the charge used, or rows in reverse?",
        }[channel]
    if kind in ("axes", "body", "world"):
        is_of_body = channel in BODY_CHANNELS if kind == "axes" else kind == "body"
        names = BODY_NAMES if is_of_body else WORLD_NAMES
        known = f" ({names[str(value)]})" if str(value) in names else ""
        what = f"the {kind}'s axes are"
        if kind == "axes":
            what = "roll, pitch, yaw are about" if channel == "u_rates" else "x, y, z hold"
        return f"{what} {', '.join(str(value).split())}{known}"
    if kind == "scale":
        unit = unit_of(channel, float(value))
        return f"{float(value):.4g} times the true size" + (f": in {unit}" if unit else "")
    if kind == "delay":
        late = "late" if float(value) > 0.0 else "early"
        return f"{1e3 * abs(float(value)):.0f} ms {late}"
    if kind == "repeated":
        return f"{float(value):.0%} repeat the row before"
    return {
        "order": f"the columns w, x, y, z hold {', '.join(str(value))}",
        "conjugate": "inverted: from world to body, read as from body to world",
        "frame": "about the world's axes, read as about the body's",
        "curve": f"stick positions, before a rate curve (Betaflight's {value})",
        "range": f"in the range {'1000 to 2000 us' if value == 'pwm' else value}, read as -1 to 1",
        "held": f"each sample is held for {value} rows",
        "wrapped": "the heading was interpolated across 180 degrees",
    }[kind]


def list_explanations(explanations: Sequence[Sequence[Change]]) -> list[str]:
    """Return a line for each change, with the alternatives one after the other."""
    common = [change for change in explanations[0] if all(change in one for one in explanations)]
    lines = [f"  {describe(change)}" for change in common]
    others = [[change for change in one if change not in common] for one in explanations]
    for number, alternative in enumerate(others[:MAX_SHOWN] if any(others) else []):
        text = "; ".join(map(describe, alternative)) or "nothing else"
        lines.append(f"  {'either' if number == 0 else 'or'} {text}")
    if any(others) and len(others) > MAX_SHOWN:
        lines.append(f"  or {len(others) - MAX_SHOWN} more that fit as well")
    return lines


def row_of(pair: Pair) -> list[str]:
    """Return the cells of a pair: name, verdict, correlations, and what to fly."""
    numbers = " ".join(f"{one:+.2f}" for one in pair.correlations) or "-"
    remark = ""
    if pair.verdict == STILL:
        remark = f"fly: {pair.manoeuvre}"
    elif pair.verdict == CONTRADICTS and pair.evidence > MARGIN:
        remark = f"the best reading is e^{pair.evidence:.0f} times as likely{ahead(pair.margin)}"
    elif pair.verdict == CONTRADICTS and pair.correlations:
        remark = "sizes differ"
    elif pair.unseen:
        remark = f"the sign of {', '.join(pair.unseen)} does not show"
    return [pair.name, pair.verdict, numbers, remark]


def ahead(margin: float) -> str:
    """Return how much more likely the best reading is than the next that differs, in words."""
    return f", and e^{margin:.0f} times the next" if np.isfinite(margin) else ""


HEADER = ("pair", "verdict", "correlation of x, y, z", "")


def verdict_of(check: Check) -> str:
    """Return the result in one sentence."""
    if not check.contradicts:
        compared = [pair for pair in check.pairs if pair.verdict != STILL]
        if not compared:
            return "Nothing could be compared: the log has too few channels or too little motion."
        return "All channels that could be compared agree."
    if not any(check.explanations):
        return "Channels contradict each other, and no change of conventions explains it."
    number = len(check.explanations)
    return "The log contradicts itself" + (
        "; it agrees if" if number == 1 else f"; {number} readings agree, the simplest first:"
    )


def text_of(check: Check) -> str:
    """Return a check as plain text: a table of the pairs, and what explains contradictions."""
    table = text_table([HEADER, *map(row_of, check.pairs)])
    lines = [f"{check.source}: {len(check.pairs)} pairs of channels", *table, verdict_of(check)]
    if any(check.explanations):
        lines += list_explanations(check.explanations)
    return "\n".join([*lines, *check.remarks])


def problems_of(check: Check) -> list[str]:
    """Return what contradicts, a sentence each; empty if nothing does."""
    if not check.contradicts:
        return []
    pairs = "; ".join(
        f"{pair.name} contradict each other" for pair in check.pairs if pair.verdict == CONTRADICTS
    )
    if not any(check.explanations):
        return [f"{pairs}: no change of conventions explains it"]
    text = "; ".join(line.strip() for line in list_explanations(check.explanations))
    return [f"found channels that contradict each other; they agree if {text}"]
