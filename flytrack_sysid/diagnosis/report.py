"""A diagnosis as one page that is read in two minutes: ``report.html``."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from flytrack_env.dynamics import SECONDS_PER_MINUTE
from flytrack_env.files import write_atomically
from flytrack_sysid.diagnosis.evidence import EVIDENCE, list_words, without, words_of
from flytrack_sysid.diagnosis.figures import (
    FORCES,
    RATES,
    draw_against,
    draw_cause,
)
from flytrack_sysid.diagnosis.result import CAUSES_FOUND, CONSISTENT, Cause, Diagnosis, Estimated
from flytrack_sysid.diagnosis.traces import Traces, traces
from flytrack_sysid.log import FlightLog
from flytrack_sysid.page import Bullets, Part, Picture, Section, Table, Text, Verdict, page
from flytrack_sysid.plots import png_of

MOST_PICTURED = 6  # causes, those with the largest gain: more pictures nobody reads
MOST_LISTED = 3  # names in one cell
NO_BREAK = "\u00a0"  # a space at which lines do not break
HEADLINE_HORIZON = "1"  # s of free flight, whose error the first sentence gives
CHANNEL_WORDS = {"rates": "body rates", "force": "specific force"}
DIFFERENCES = (
    "The log lacks a gyro or an accelerometer; attitude or velocity replace them, by their change per row."
)
HOW = (
    "Every step of the log is predicted from the row before it. The model carries on what follows from the "
    "commands alone; attitude, velocity, position and voltage are taken from the log.",
    "A cause is named where it explains more than chance on the fitted part, where the held-out part does "
    "not contradict it, and where no other cause explains more.",
    "In the plot of a cause, orange dots are what the extended model leaves without this one cause and with "
    "nothing else refitted. The line is the difference between both models. Blue rings are what is left.",
    "Residuals are measured minus modelled. Forces are specific forces along the body's axes, thrust along "
    "z, except where world axes are given; rates are about the body's axes.",
    "Pictures show the whole log, the table of errors the held-out part.",
)
CAPTIONS = {
    "rates": "Means by bins with 95 % intervals. For a model that lacks nothing they are all at 0.",
    "forces": "The same for the specific force along the body's axes.",
}


def _number(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.3g}"


def _unit(unit: str) -> str:
    return "" if unit == "1" else " " + unit.replace("^2", "²")


def _parameter(name: str, found: Estimated) -> str:
    low, high = found.ci95
    text = f"{name.split('.')[-1]} = {found.value:.3g} [{low:.3g}, {high:.3g}]{_unit(found.unit)}"
    return text.replace(" ", NO_BREAK)


def _confused(cause: Cause) -> str:
    if cause.equivalent:
        return f"this log cannot tell it from: {list_words(cause.equivalent[:MOST_LISTED])}"
    return f"no; the closest is: {words_of(cause.closest)}" if cause.closest else "not compared"


def _gained(diagnosis: Diagnosis) -> str:
    """Return what the causes gain over a second of free flight; nothing where that is not known."""

    def error(model: str) -> float:
        found = diagnosis.error[model].position_m if model in diagnosis.error else {}
        return found.get(HEADLINE_HORIZON, np.nan)

    before, after = error("nominal"), error("extended")
    if not np.isfinite(before + after):
        return ""
    return f" The position after 1 s of free flight is off by {after:.2g} m instead of {before:.2g} m."


def verdict_of(diagnosis: Diagnosis) -> Verdict:
    """Return the verdict in a sentence or two."""
    left = diagnosis.unexplained
    depends = f" It depends on {', '.join(left.depends_on)}." if left.depends_on else ""
    if diagnosis.verdict == CONSISTENT:
        return Verdict("The log agrees with the model: the residuals look like sensor noise.", "good")
    if not diagnosis.causes:
        return Verdict(f"The model is wrong, and no known cause explains it.{depends}", "open")
    number = f"{len(diagnosis.causes)} things" if len(diagnosis.causes) > 1 else "one thing"
    names = list_words([cause.effect for cause in diagnosis.causes])
    text = f"The model lacks {number}: {names}." + _gained(diagnosis)
    if diagnosis.verdict == CAUSES_FOUND:
        return Verdict(text, "found")
    return Verdict(f"{text} Something else remains that no known cause explains.{depends}", "open")


def _causes_part(diagnosis: Diagnosis) -> Part:
    if not diagnosis.causes:
        return Text("No cause is named. See below for what this log could not have shown.")
    rows = [
        [
            f"{words_of(cause.effect)}\n({cause.effect}, in {cause.channel})",
            "\n".join(_parameter(name, found) for name, found in cause.parameters.items()),
            _number(cause.heldout_gain),
            _confused(cause),
        ]
        for cause in diagnosis.causes
    ]
    caption = "Values with 95 % intervals. Gain: fall of minus twice the log likelihood on the held-out part."
    return Table(["cause", "parameters", "gain", "could it be another?"], rows, caption, is_text=True)


def _errors_table(diagnosis: Diagnosis) -> Table:
    models = diagnosis.error.values()
    steps = dict.fromkeys(key for one in models for key in one.one_step_nrmse)
    flights = dict.fromkeys(key for one in models for key in one.position_m)
    rows = [
        [CHANNEL_WORDS.get(key, key), "NRMSE", *(_number(one.one_step_nrmse.get(key)) for one in models)]
        for key in steps
    ]
    rows += [
        [f"position after {key} s", "m", *(_number(one.position_m.get(key)) for one in models)]
        for key in flights
    ]
    caption = "Held-out part. One step: 1 is as bad as predicting the mean; position in free flight, rms."
    return Table(["error", "unit", *(name.replace("_", " ") for name in diagnosis.error)], rows, caption)


def _limits_part(diagnosis: Diagnosis) -> Part:
    if not diagnosis.not_identifiable:
        return Text("This log could have shown every effect that is looked for, and told it from all others.")
    rows = [
        [
            f"{words_of(one.effect)}\n({one.effect})",
            (_number(one.smallest) + _unit(one.unit)).replace(" ", NO_BREAK),
            list_words(one.confused_with[:MOST_LISTED]) or "noise",
            one.fly.replace("_", " "),
        ]
        for one in diagnosis.not_identifiable
    ]
    caption = "Smaller than the second column, such an effect may be there without showing in this log."
    header = ["effect", "visible from", "looks like", "fly this to settle it"]
    return Table(header, rows, caption, is_text=True)


def _unexplained_parts(diagnosis: Diagnosis) -> list[Part]:
    left = diagnosis.unexplained
    if not left.flagged:
        return [Text("Nothing: the residuals of the extended model are noise.")]
    what = ", ".join(left.depends_on) or "nothing that is known"
    parts: list[Part] = [Text(f"What is left is more than noise. It depends on: {what}.")]
    if left.shares:
        shares = [[name, _number(share)] for name, share in left.shares.items()]
        caption = "Size of what is left (rms) by what it depends on, in units of the sensor noise"
        parts.append(Table(["channel: dependence", "times the sensor noise"], shares, caption))
    return parts


_LESS = "without "


def traces_of(diagnosis: Diagnosis, log: FlightLog) -> Traces:
    """Return the residuals of the three models, and of the extended one less each cause ("without ...")."""
    models = {"nominal": diagnosis.nominal, "base": diagnosis.base, "extended": diagnosis.extended}
    for cause in diagnosis.causes:
        models[_LESS + cause.effect] = without(diagnosis.extended, diagnosis.nominal, cause.effect)
    return traces(log, models, like="extended")


def draw_report(diagnosis: Diagnosis, found: Traces) -> dict[str, Figure]:
    """Return the figures of a report by name; found: of ``traces_of``."""
    figures = {
        "rates": draw_against(found, RATES, "Body rates: residuals, and what they depend on"),
        "forces": draw_against(found, FORCES, "Specific force: residuals, and what they depend on"),
    }
    for cause in sorted(diagnosis.causes, key=lambda cause: -cause.chi2_gain)[:MOST_PICTURED]:
        panels = EVIDENCE[cause.effect].panels
        figures[cause.effect] = draw_cause(cause.effect, panels, found, _LESS + cause.effect, "extended")
    return figures


def html_of(diagnosis: Diagnosis, log: FlightLog) -> str:
    """Return the report of a diagnosis of a log as a self-contained page."""
    found = traces_of(diagnosis, log)
    pictures = {name: png_of(figure) for name, figure in draw_report(diagnosis, found).items()}
    minutes = found.regressors["elapsed"][-1] / SECONDS_PER_MINUTE
    introduction: list[Part] = [
        verdict_of(diagnosis),
        Text(f"{diagnosis.source}: {len(log)} rows, {minutes:.1f} min. SHA-256 {diagnosis.sha256[:12]}."),
        _causes_part(diagnosis),
    ]
    if diagnosis.warnings:
        introduction.append(Bullets(diagnosis.warnings))
    evidence: list[Part] = [
        Picture(png, f"{EVIDENCE[name].reading} ({name})")
        for name, png in pictures.items()
        if name in EVIDENCE
    ]
    residuals: list[Part] = [Picture(pictures[name], caption) for name, caption in CAPTIONS.items()]
    if any(found.used(name) != name for name in (RATES[0], FORCES[0])):
        residuals.append(Text(DIFFERENCES))
    sections = [
        Section("Errors before and after", [_errors_table(diagnosis)]),
        *([Section("The evidence, cause by cause", evidence)] if evidence else []),
        Section("What this log could not show, and what to fly", [_limits_part(diagnosis)]),
        Section("What remains unexplained", _unexplained_parts(diagnosis)),
        Section("Residuals, before and after", residuals),
        Section("How this was done", [Bullets(HOW)]),
    ]
    return page("What the model gets wrong", sections, introduction)


def write_report(path: str | Path, diagnosis: Diagnosis, log: FlightLog) -> None:
    """Write the report of a diagnosis as one HTML file, whole or not at all.

    log: the one that was diagnosed.

    Raises:
        OSError: the file cannot be written.
    """
    write_atomically(path, html_of(diagnosis, log).encode())
