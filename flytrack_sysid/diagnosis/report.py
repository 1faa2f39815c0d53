"""Writing a diagnosis: ``report.html``, ``diagnosis.json``, the extended model, and a few lines of text."""

import json
from pathlib import Path

import numpy as np

from flytrack_env import __version__, save_model
from flytrack_env.dynamics import SECONDS_PER_MINUTE
from flytrack_env.files import write_atomically
from flytrack_sysid.diagnosis.evidence import EVIDENCE, draw_cause, list_words, without, words_of
from flytrack_sysid.diagnosis.result import CAUSES_FOUND, CONSISTENT, TO_LOG, Cause, Diagnosis, Estimated
from flytrack_sysid.diagnosis.traces import Traces, traces
from flytrack_sysid.log import FlightLog
from flytrack_sysid.page import Bullets, Part, Picture, Section, Table, Text, Verdict, page
from flytrack_sysid.plots import png_of

JSON_NAME, MODEL_NAME, REPORT_NAME = "diagnosis.json", "extended_model.json", "report.html"
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
    """Return the residuals of both models, and of the extended one less each cause ("without ...")."""
    models = {"nominal": diagnosis.nominal, "extended": diagnosis.extended}
    for cause in diagnosis.causes:
        models[_LESS + cause.effect] = without(diagnosis.extended, diagnosis.nominal, cause.effect)
    return traces(log, models, like="extended")


def _evidence_parts(diagnosis: Diagnosis, found: Traces) -> list[Part]:
    """Return the pictures of the causes that gain most; found: of ``traces_of``."""
    parts: list[Part] = []
    for cause in sorted(diagnosis.causes, key=lambda cause: -cause.chi2_gain)[:MOST_PICTURED]:
        evidence = EVIDENCE[cause.effect]
        figure = draw_cause(cause.effect, evidence.panels, found, _LESS + cause.effect, "extended")
        parts.append(Picture(png_of(figure), f"{evidence.reading} ({cause.effect})"))
    if parts and any(found.used(name) != name for name in ("rates_x", "force_x")):
        parts.append(Text(DIFFERENCES))
    return parts


def html_of(diagnosis: Diagnosis, log: FlightLog) -> str:
    """Return the report of a diagnosis of a log as a self-contained page."""
    found = traces_of(diagnosis, log)
    minutes = found.elapsed_s[-1] / SECONDS_PER_MINUTE
    introduction: list[Part] = [
        verdict_of(diagnosis),
        Text(f"{diagnosis.source}: {len(log)} rows, {minutes:.1f} min. SHA-256 {diagnosis.sha256[:12]}."),
        _causes_part(diagnosis),
    ]
    if diagnosis.warnings:
        introduction.append(Bullets(diagnosis.warnings))
    evidence = _evidence_parts(diagnosis, found)
    sections = [
        Section("Errors before and after", [_errors_table(diagnosis)]),
        *([Section("The evidence, cause by cause", evidence)] if evidence else []),
        Section("What this log could not show, and what to fly", [_limits_part(diagnosis)]),
        Section("What remains unexplained", _unexplained_parts(diagnosis)),
        Section("How this was done", [Bullets(HOW)]),
    ]
    return page("What the model gets wrong", sections, introduction)


def write_diagnosis(folder: str | Path, diagnosis: Diagnosis, log: FlightLog) -> list[Path]:
    """Write a diagnosis into a folder, which is made if need be, and return the files.

    log: what was diagnosed (``diagnose.joined`` of several).

    Raises:
        OSError: a file cannot be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    content = diagnosis.as_json()
    provenance = {
        "tool": f"flytrack_sysid.diagnose {__version__}",
        "data": content["data"],
        "causes": content["causes"],
        "verdict": diagnosis.verdict,
    }
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    write_atomically(folder / JSON_NAME, text.encode())
    save_model(folder / MODEL_NAME, diagnosis.extended, provenance)
    write_atomically(folder / REPORT_NAME, html_of(diagnosis, log).encode())
    return [folder / name for name in (JSON_NAME, MODEL_NAME, REPORT_NAME)]


def text_of(diagnosis: Diagnosis) -> str:
    """Return a diagnosis as a few lines of text."""
    lines = [f"verdict: {diagnosis.verdict}"]
    for cause in diagnosis.causes:
        values = ", ".join(
            f"{name} {one.value:.4g} ({one.ci95[0]:.4g} to {one.ci95[1]:.4g}) {one.unit}"
            for name, one in cause.parameters.items()
        )
        twins = f"; not told apart from {', '.join(cause.equivalent)}" if cause.equivalent else ""
        lines.append(f"  {cause.effect}: {values}; held-out gain {cause.heldout_gain:.4g}{twins}")
    if diagnosis.unexplained.flagged:
        lines.append(f"unexplained, depends on: {', '.join(diagnosis.unexplained.depends_on)}")
    for one in diagnosis.not_identifiable:
        below = f" below {one.smallest:.3g} {one.unit}" if np.isfinite(one.smallest) else ""
        alike = f", looks like {', '.join(one.confused_with)}" if one.confused_with else ""
        to_do = one.fly if one.fly.startswith(TO_LOG) else f"fly {one.fly}"
        is_named = any(one.effect == cause.effect for cause in diagnosis.causes)
        what = "not told apart by this log" if is_named else "not shown by this log"
        lines.append(f"{what}: {one.effect}{below}{alike}; {to_do}")
    return "\n".join([*lines, *diagnosis.warnings])
