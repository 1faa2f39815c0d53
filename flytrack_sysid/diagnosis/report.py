"""A diagnosis as one page that is read in two minutes: ``report.html``."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from flytrack_env.dynamics import SECONDS_PER_MINUTE
from flytrack_env.files import write_atomically
from flytrack_sysid.diagnosis.conviction import draw_cause
from flytrack_sysid.diagnosis.evidence import EVIDENCE, in_words, without, words_of
from flytrack_sysid.diagnosis.pictures import (
    CHANNEL_WORDS,
    FORCES,
    MODELS,
    RATES,
    autocorrelations,
    draw_against,
    draw_errors,
    draw_independence,
    draw_over_time,
    draw_whiteness,
    error_style,
    keys_of,
)
from flytrack_sysid.diagnosis.result import CAUSES_FOUND, CONSISTENT, Cause, Diagnosis, Estimated
from flytrack_sysid.diagnosis.traces import Traces, traces
from flytrack_sysid.diagnosis.whiteness import whiteness
from flytrack_sysid.log import FlightLog
from flytrack_sysid.page import Bullets, Part, Picture, Section, Table, Text, Verdict, page
from flytrack_sysid.plots import png_of

MOST_PICTURED = 6  # causes, those with the largest gain: more pictures nobody reads
MOST_LISTED = 3  # names in one cell
DIFFERENCES = (
    "The log lacks a gyro or an accelerometer; attitude or velocity stand in, by their change from row to "
    "row. White noise of theirs shows as a correlation of -0.5 at the first lag."
)
NO_BREAK = "\u00a0"  # a space at which lines do not break
HEADLINE_HORIZON = "1"  # s of free flight, whose error the first sentence gives
HOW = (
    "Every step of the log is predicted from the row before it. What follows from the commands alone is "
    "carried on by the model; attitude, velocity, position and voltage are taken from the log.",
    "A cause is named where it explains more than chance on the fitted part, where the held-out part does "
    "not contradict it, and where no other cause explains more.",
    "In the plot of a cause, orange dots are what the extended model leaves with this one cause taken out, "
    "nothing else refitted. The line is the difference between both models. Blue rings are what is left.",
    "Residuals are measured less said by the model. Forces are specific forces along the body's axes, thrust "
    "along z, where not said to be along the world's; rates are about the body's axes.",
    "Pictures show the whole log, the table of errors the held-out part.",
)


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
        return f"this log cannot tell it from: {in_words(cause.equivalent[:MOST_LISTED])}"
    if cause.closest:
        return f"told apart; closest is: {words_of(cause.closest)}"
    return "not put against others"


def _named(causes: tuple[Cause, ...]) -> str:
    things = f"{len(causes)} things" if len(causes) > 1 else "one thing"
    return f"The model lacks {things}: {in_words([cause.effect for cause in causes])}."


def _gained(diagnosis: Diagnosis) -> str:
    """Return what the causes do for a second of free flight; nothing where that is not known."""

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
        return Verdict("The log agrees with the model: what is left looks like the noise of sensors.", "good")
    if not diagnosis.causes:
        return Verdict(f"The model is wrong, and no known cause explains it.{depends}", "open")
    text = _named(diagnosis.causes) + _gained(diagnosis)
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
    error = diagnosis.error
    rows = [
        [
            CHANNEL_WORDS.get(key, key),
            "NRMSE",
            *(_number(one.one_step_nrmse.get(key)) for one in error.values()),
        ]
        for key in keys_of([one.one_step_nrmse for one in error.values()])
    ]
    rows += [
        [
            f"position after {key} s",
            "m",
            *(_number(one.position_m.get(key)) for one in error.values()),
        ]
        for key in keys_of([one.position_m for one in error.values()])
    ]
    return Table(["error", "unit", *(error_style(name)[0] for name in error)], rows)


def _not_seen(diagnosis: Diagnosis) -> list[Part]:
    if not diagnosis.not_identifiable:
        return [Text("This log could have shown every effect that is looked for, apart from all others.")]
    rows = [
        [
            f"{words_of(one.effect)}\n({one.effect})",
            (_number(one.smallest) + _unit(one.unit)).replace(" ", NO_BREAK),
            in_words(one.confused_with[:MOST_LISTED]) or "noise",
            one.fly.replace("_", " "),
        ]
        for one in diagnosis.not_identifiable
    ]
    caption = "Smaller than the second column, such an effect may be there, unseen in this log."
    return [
        Table(["effect", "seen from", "looks like", "fly this to settle it"], rows, caption, is_text=True)
    ]


def _unexplained(diagnosis: Diagnosis) -> list[Part]:
    left = diagnosis.unexplained
    shares = [[name, _number(share)] for name, share in left.shares.items()]
    what = ", ".join(left.depends_on) or "nothing that is known"
    more = f"What is left is more than noise. It depends on: {what}."
    parts: list[Part] = [Text(more if left.flagged else "Nothing: what the extended model leaves is noise.")]
    if shares:
        caption = "Size of what is left (rms) by what it depends on, in units of the sensor noise"
        parts.append(Table(["channel: dependence", "times the sensor noise"], shares, caption))
    return parts


def _whiteness_table(found: Traces) -> Table:
    rows = []
    for residual in (*RATES, *FORCES):
        tests = {name: whiteness(one).statistic for name, one in autocorrelations(found, residual).items()}
        rows.append([residual.replace("_", " "), *(_number(tests.get(name)) for name in MODELS)])
    caption = "Sum of squared autocorrelations over that of white noise: 1 is white"
    return Table(["residual", *(words for words, _ in MODELS.values())], rows, caption)


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
        "errors": draw_errors(diagnosis.error),
        "over_time": draw_over_time(found),
        "rates": draw_against(found, RATES, "Body rates: what is left, and what it depends on"),
        "forces": draw_against(found, FORCES, "Specific force: what is left, and what it depends on"),
        "whiteness": draw_whiteness(found),
        "independence": draw_independence(found),
    }
    for cause in _pictured(diagnosis):
        panels = EVIDENCE[cause.effect].panels
        figures[cause.effect] = draw_cause(cause.effect, panels, found, _LESS + cause.effect, "extended")
    return figures


def _pictured(diagnosis: Diagnosis) -> list[Cause]:
    return sorted(diagnosis.causes, key=lambda cause: -cause.chi2_gain)[:MOST_PICTURED]


def _evidence(diagnosis: Diagnosis, pictures: Mapping[str, bytes]) -> list[Section]:
    if not diagnosis.causes:
        return []
    parts = [
        Picture(pictures[cause.effect], f"{EVIDENCE[cause.effect].reading} ({cause.effect})")
        for cause in _pictured(diagnosis)
    ]
    return [Section("The evidence, cause by cause", parts)]


def _residual_parts(found: Traces, pictures: Mapping[str, bytes]) -> list[Part]:
    parts: list[Part] = [
        Picture(pictures["over_time"], "Means over short pieces of time. Noise has been averaged out."),
        Picture(
            pictures["rates"],
            "Means by bins with 95 % intervals. A model that lacks nothing has them all at 0.",
        ),
        Picture(pictures["forces"], "The same for the specific force along the body's axes."),
        Picture(
            pictures["whiteness"],
            "White noise leaves the 95 % band at 5 lags in 100, the 99 % band at 1.",
        ),
        _whiteness_table(found),
        Picture(
            pictures["independence"],
            "Beyond the bands the model answers to the command in another way than the drone. Right of 0 the "
            "residual follows the command; commands that change slowly show on both sides.",
        ),
    ]
    if any(found.used(name) != name for name in (RATES[0], FORCES[0])):
        parts.append(Text(DIFFERENCES))
    return parts


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
    sections = [
        Section("Errors before and after", [Picture(pictures["errors"], ""), _errors_table(diagnosis)]),
        *_evidence(diagnosis, pictures),
        Section("What this log could not show, and what to fly", _not_seen(diagnosis)),
        Section("What remains unexplained", _unexplained(diagnosis)),
        Section("Residuals, before and after", _residual_parts(found, pictures)),
        Section("How this was done", [Bullets(HOW)]),
    ]
    return page("What the model gets wrong", sections, introduction)


def write_report(path: str | Path, diagnosis: Diagnosis, log: FlightLog) -> None:
    """Write the report of a diagnosis as one HTML file, whole or not at all.

    log: the one that was diagnosed.

    Raises:
        OSError: what the system says.
    """
    write_atomically(path, html_of(diagnosis, log).encode())
