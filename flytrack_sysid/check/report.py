"""A check as files: check.json, check.html and a picture of each pair before and after."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from flytrack_env.pictures.drawing import new_figure, plain
from flytrack_env.scene import BLUE, ORANGE
from flytrack_sysid.check.commands import compare_commands, follow, thinned
from flytrack_sysid.check.pairs import CONTRADICTS, Pair
from flytrack_sysid.check.result import Check
from flytrack_sysid.check.words import HEADER, describe, row_of, text_of, verdict_of
from flytrack_sysid.kinematics import (
    WINDOWS_S,
    acceleration_of,
    attitude_of,
    cut_windows,
    summed_turns,
)
from flytrack_sysid.log import FlightLog, time_in_line
from flytrack_sysid.page import Bullets, Part, Picture, Section, Table, Verdict, page, write_report
from flytrack_sysid.plots import png_of

SHOWN_S = 20.0  # of flight in a picture: longer ones are black
MAX_STEP_S = 3.0 * WINDOWS_S[0]  # a longer one is a pause
LEGENDS = {  # of the two quantities of each pair, and their unit
    "q and w": ("turn of the attitude", "gyroscope", "rad/s"),
    "v, f and q": ("change of the velocity", "accelerometer, turned by the attitude", "m/s^2"),
    "p and v": ("change of the position", "velocity", "m/s"),
    "u and w": ("gyroscope", "commanded rates, scaled and delayed", "rad/s"),
}
Signals = tuple[np.ndarray, np.ndarray, np.ndarray]  # time, two quantities (num_windows, 3)


def signals_of(log: FlightLog, pair: str) -> Signals | None:
    """Return the two quantities of a pair over windows of 0.1 s; None if they are no signals."""
    if pair == "u and w":
        log = thinned(log)
        followed = compare_commands(log)
        if followed is None:
            return None
        commands = follow(log, log["u"][:, :3], followed.delay_s, followed.lag_s)
        sizes = np.linalg.norm(log["w"], axis=0) / np.maximum(
            np.linalg.norm(commands, axis=0), 1e-12
        )
        sums, rates = None, commands * sizes
    elif pair == "q and w":
        sums, rates = summed_turns(attitude_of(log)), log["w"]
    elif pair == "v, f and q":
        sums, rates = log["v"], acceleration_of(log)
    elif pair == "p and v":
        sums, rates = log["p"], log["v"]
    else:
        return None
    windows = cut_windows(log, WINDOWS_S[0])
    shown = windows.mean_of(log, log["w"]) if sums is None else windows.mean_rate(sums)
    return time_in_line(log)[windows.starts], shown, windows.mean_of(log, rates)


def most_different(time: np.ndarray, shown: np.ndarray, measured: np.ndarray) -> float:
    """Return when the part of a flight begins, s, in which two quantities differ most.

    Args:
        time: (num_windows,) s.
        shown: (num_windows, 3).
        measured: (num_windows, 3).
    """
    size = np.maximum(np.mean(shown**2, axis=0), np.mean(measured**2, axis=0))
    differences = np.sum((shown - measured) ** 2 / np.maximum(size, 1e-12), axis=1)
    summed = np.concatenate([[0.0], np.cumsum(differences)])
    ends = np.searchsorted(time, time + SHOWN_S)
    return float(time[np.argmax(summed[ends] - summed[:-1])])


def draw_pair(name: str, before: Signals, after: Signals) -> Figure:
    """Draw the two quantities of a pair as they were logged (left) and as they would agree."""
    figure = new_figure(9.0, 6.0)
    panels = figure.subplots(3, 2, sharex=True, sharey="row")
    first, second, unit = LEGENDS[name]
    start_s = most_different(*before)
    for column, (title, (time, shown, measured)) in enumerate(
        (("as logged", before), ("as it agrees", after))
    ):
        is_shown = (time >= start_s) & (time < start_s + SHOWN_S)
        time = time[is_shown]
        # A row without a value interrupts the lines at pauses.
        pauses = np.flatnonzero(np.diff(time) > MAX_STEP_S) + 1
        time, shown, measured = (
            np.insert(values, pauses, np.nan, axis=0)
            for values in (time, shown[is_shown], measured[is_shown])
        )
        for axis in range(3):
            panel = plain(panels[axis, column])
            panel.plot(time, shown[:, axis], color=BLUE, label=first)
            panel.plot(time, measured[:, axis], color=ORANGE, label=second, lw=1)
            if column == 0:
                panel.set_ylabel(f"{'xyz'[axis]} ({unit})")
        panels[0, column].set_title(title)
        panels[2, column].set_xlabel("time (s)")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    figure.suptitle(name, fontweight="bold")
    return figure


def as_json(check: Check) -> dict[str, Any]:
    """Return a check as JSON values; null where a number is unknown."""

    def pair_json(pair: Pair) -> dict[str, Any]:
        numbers = {"evidence": pair.evidence, "margin": pair.margin}
        return {
            **pair._asdict(),
            **{name: one if np.isfinite(one) else None for name, one in numbers.items()},
            "correlations": [None if one != one else one for one in pair.correlations],
        }

    return {
        "log": check.source,
        "verdict": verdict_of(check),
        "contradicts": check.contradicts,
        "pairs": [pair_json(pair) for pair in check.pairs],
        "pairs_after": [pair_json(pair) for pair in check.after],
        "explanations": [
            [{**change._asdict(), "text": describe(change)} for change in one]
            for one in check.explanations
        ],
        "remarks": list(check.remarks),
    }


def write_check(folder: str | Path, check: Check, log: FlightLog) -> list[Path]:
    """Write a check's files into a folder; return their paths.

    Args:
        folder: for the files.
        check: of the log.
        log: that was checked.
    """
    pictures = {}
    for pair in check.pairs:
        if pair.verdict != CONTRADICTS:
            continue
        before, after = signals_of(log, pair.name), signals_of(check.corrected, pair.name)
        if before is not None and after is not None:
            name = pair.name.replace(", ", "_").replace(" ", "_")
            pictures[f"{name}.png"] = png_of(draw_pair(pair.name, before, after))
    introduction: list[Part] = [
        Verdict(verdict_of(check), "found" if check.contradicts else "good")
    ]
    if any(check.explanations):
        introduction.append(Bullets([describe(change) for change in check.explanations[0]]))
    table = Table(list(HEADER), [row_of(pair) for pair in check.pairs], is_text=True)
    after_table = Table(list(HEADER), [row_of(pair) for pair in check.after], is_text=True)
    sections = [Section("Pairs of channels", [table])]
    if check.after:
        sections.append(Section("With the first explanation", [after_table]))
    if len(check.explanations) > 1:
        others = ["; ".join(map(describe, one)) for one in check.explanations[1:]]
        sections.append(Section("Explanations that fit as well", [Bullets(others)]))
    if pictures:
        shown = [Picture(png, name.removesuffix(".png")) for name, png in pictures.items()]
        sections.append(Section("Before and after", shown))
    if check.remarks:
        sections.append(Section("Model and log", [Bullets(check.remarks)]))
    document = json.dumps(as_json(check), indent=1, allow_nan=False) + "\n"
    files = {
        "check.json": document.encode(),
        "check.txt": (text_of(check) + "\n").encode(),
        "check.html": page(f"Check of {check.source}", sections, introduction).encode(),
        **pictures,
    }
    return write_report(folder, files)
