"""Write a diagnosis: ``report.html``, ``diagnosis.json``, the extended model, and text."""

import json
from collections import Counter
from pathlib import Path

import numpy as np

from flytrack_env import __version__, save_model
from flytrack_env.dynamics import SECONDS_PER_MINUTE
from flytrack_env.effects import BY_NAME, LearnedLaw, takes_motors
from flytrack_env.files import write_atomically
from flytrack_env.pictures.drawing import new_figure, plain
from flytrack_env.scene import BLUE, GREEN, GREY, ORANGE
from flytrack_sysid.diagnosis.controller import AXES
from flytrack_sysid.diagnosis.evidence import (
    EVIDENCE,
    Panel,
    draw_cause,
    list_words,
    without,
    words_of,
)
from flytrack_sysid.diagnosis.result import (
    CAUSES_FOUND,
    CONSISTENT,
    DRIFT,
    TO_LOG,
    Cause,
    Diagnosis,
    Estimated,
    HalfResponse,
    RateLoop,
    Unexplained,
)
from flytrack_sysid.diagnosis.traces import Traces, traces
from flytrack_sysid.log import FlightLog
from flytrack_sysid.page import (
    Bullets,
    Part,
    Picture,
    Section,
    Table,
    Text,
    Verdict,
    page,
    text_table,
)
from flytrack_sysid.plots import WIDTH_IN, png_of

JSON_NAME, MODEL_NAME, REPORT_NAME = "diagnosis.json", "extended_model.json", "report.html"
MAX_PICTURED = 6  # causes with the largest gain that have a picture: nobody reads more pictures
BARS_HEIGHT_IN = 2.6  # of the picture of errors, inches
MAX_LISTED = 3  # names in one cell
# More says only that a sensor has hardly any noise of its own: rates derived from an attitude.
MAX_TIMES_NOISE = 100.0
MAX_HALF_WIDTH = 0.5  # of thrust over weight, and of a stick: with more nothing is known
LIMITED_S = 1e-3  # a step to full stick takes longer by more than this if a limit acts
NO_BREAK = "\u00a0"  # a space at which lines do not break
MIN_CHANGE_PERCENT = 0.5  # of an error: a smaller change counts as none
HEADLINE_HORIZON = "1"  # s of free flight, the horizon of the error in the first sentence
WRONG = "has the wrong value of"
LOG_BARS = 20.0  # ratio of largest to smallest error above which bars vanish on a linear scale
MAX_LIMITS = 8  # rows in the text's table of effects that a log could not show
CHANNEL_WORDS = {"rates": "body rates", "force": "specific force"}
DIFFERENCES = (
    "The log lacks a gyro or an accelerometer; attitude or velocity replace them, by their change "
    "per row."
)
HOW = (
    "Every step of the log is predicted from the row before it. The model carries on what follows "
    "from the commands alone; attitude, velocity, position and voltage are taken from the log.",
    "A cause is named where it explains more than chance on the fitted part, where the held-out "
    "part does not contradict it, and where no other cause explains more.",
    "In the plot of a cause, orange dots are what the extended model leaves without this one cause "
    "and with nothing else refitted. The line is the difference between both models. Blue rings "
    "are what is left.",
    "Residuals are measured minus modelled. Forces are specific forces along the body's axes, "
    "thrust along z, except where world axes are given; rates are about the body's axes.",
    "Pictures show the whole log, the table of errors the held-out part.",
)


def _number(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.3g}"


def _unit(unit: str) -> str:
    return "" if unit == "1" else " " + unit.replace("^2", "²")


def _parameter(name: str, value: Estimated) -> str:
    low, high = value.ci95
    text = f"{name.split('.')[-1]} = {value.value:.3g} [{low:.3g}, {high:.3g}]{_unit(value.unit)}"
    return text.replace(" ", NO_BREAK)


def _plus_minus(cause: Cause) -> str:
    """Return a cause's values with half of their 95 % intervals."""
    return ", ".join(
        f"{name} {estimate.value:.3g} ± {estimate.half_width:.2g}{_unit(estimate.unit)}"
        for name, estimate in cause.parameters.items()
    )


def _by_flight(cause: Cause) -> list[str]:
    """Return a line for each parameter with its values of several flights."""
    return [
        f"{name} by flight: {', '.join(f'{one.value:.3g}' for one in flights)}"
        for name, flights in cause.by_flight.items()
    ]


def format_span(cause: Cause) -> str:
    """Return when a cause acts, " from 31.2 ± 0.4 s on"; empty if it acts throughout."""

    def time(estimate: Estimated) -> str:
        return f"{estimate.value:.1f} ± {max(estimate.half_width, 0.05):.1f} s"

    if cause.onset_s is not None and cause.end_s is not None:
        return f" from {time(cause.onset_s)} to {time(cause.end_s)}"
    if cause.onset_s is not None:
        return f" from {time(cause.onset_s)} on"
    return "" if cause.end_s is None else f" until {time(cause.end_s)}"


def _confused(cause: Cause) -> str:
    if cause.equivalent:
        return f"this log cannot tell it from: {list_words(cause.equivalent[:MAX_LISTED])}"
    if cause.family:
        return "it may stand for other laws of the same response"
    return f"no; the closest is: {words_of(cause.closest)}" if cause.closest else "not compared"


def _faults(diagnosis: Diagnosis) -> str:
    """Return a sentence on what the model lacks, has too much or too little of, or has wrong."""
    by_fault: dict[str, list[str]] = {}
    for cause in diagnosis.causes:
        equivalent = () if cause.effect == "thrust_scale" else cause.equivalent[:MAX_LISTED]
        alternatives = f" (or {' or '.join(map(words_of, equivalent))})" if equivalent else ""
        name = words_of(cause.effect) + format_span(cause) + alternatives
        by_fault.setdefault(describe_fault(cause.effect, diagnosis), []).append(name)
    clauses = [
        " ".join([fault, "; ".join(f"the {name}" if fault == WRONG else name for name in names)])
        for fault, names in by_fault.items()
    ]
    return f"The model {', and it '.join(clauses)}."


def _families(diagnosis: Diagnosis) -> str:
    """Return a sentence on names that stand for their families; empty without any."""
    names = [cause.effect for cause in diagnosis.causes if cause.family]
    if not names:
        return ""
    others = [name for cause in diagnosis.causes for name in cause.family if name not in names]
    listed = list_words(list(dict.fromkeys(others)))
    times = " Times to half of it repeat better." if diagnosis.half_response_s else ""
    return (
        f"While something in the response to the commands is unexplained, {list_words(names)} may "
        f"stand for other laws of it ({listed}), which another flight may show.{times}"
    )


def describe_fault(cause: str, diagnosis: Diagnosis) -> str:
    """Return the verb for a cause: compares the value in the flight with that in the model."""
    if cause not in BY_NAME or cause.endswith("_scale") or BY_NAME[cause].search.is_setting:
        return WRONG
    neutral, notable = BY_NAME[cause].parameters(), BY_NAME[cause].notable
    models = [model.effect(cause) for model in (diagnosis.nominal, diagnosis.extended)]
    if [*map(float, models[0])] == [*map(float, neutral)]:
        return "lacks"
    nominal, extended = (
        np.array(
            [
                float(getattr(effect, name) - getattr(neutral, name)) / notable[name]
                for name in notable
            ]
        )
        for effect in models
    )
    if nominal @ extended < 0.0:
        return WRONG  # the other sign
    return "has too much" if extended @ extended < nominal @ nominal else "has too little"


def _gain(diagnosis: Diagnosis) -> str:
    """Return a sentence on how much closer the extended model predicts; empty if unknown.

    It says what the refitted base, the named effects and a learnt law contribute.
    """

    def error(model: str) -> float:
        errors = diagnosis.error[model].position_m if model in diagnosis.error else {}
        return errors.get(HEADLINE_HORIZON, np.nan)

    before, refitted, after = (error(model) for model in ("nominal", "refitted_base", "extended"))
    if not np.isfinite(before + after):
        return ""
    names = ", ".join(cause.effect for cause in diagnosis.causes)
    text = f"Named {names}: flies {_closer(before, after)} after 1 s"
    details = [f"{after:.2g} m instead of {before:.2g} m on held-out flight"]
    if np.isfinite(refitted):
        named = after if diagnosis.learned is None else error("without_learned")
        steps = {"the refitted base": before - refitted}
        if any(cause.effect in BY_NAME for cause in diagnosis.causes):
            steps["the named effects"] = refitted - named
        if diagnosis.learned is not None:
            steps["the learnt law"] = named - after
        shares = [f"{name} {100.0 * gain / before:.0f} %" for name, gain in steps.items()]
        details.append(f"by {', '.join(shares)}")
    placebo = (
        diagnosis.prediction.errors.get("placebo", {})
        .get("position_m", {})
        .get(HEADLINE_HORIZON, np.inf)
    )
    if placebo <= after:
        details.append(f"a guess that ignores the commands, {placebo:.2g} m")
    return f"{text} ({'; '.join(details)})."


def _closer(before: float, after: float) -> str:
    """Return the decrease of an error as words, such as "13 % closer"."""
    share = 100.0 * (1.0 - after / before)
    if abs(share) < MIN_CHANGE_PERCENT:
        return "no closer"
    return f"{abs(share):.0f} % {'closer' if share > 0.0 else 'farther off'}"


def _beyond(diagnosis: Diagnosis) -> str:
    """Return a sentence on effects with a value at the end of its range; empty without any."""
    listed = "; ".join(f"{words_of(cause.effect)} ({cause.beyond})" for cause in diagnosis.beyond)
    return f"Beyond the list, so that its cause may be another: {listed}." if listed else ""


def _learned(diagnosis: Diagnosis) -> str:
    """Return a sentence on what was learnt beyond the list; empty without any."""
    if diagnosis.learned is None:
        return ""
    return "The extended model has a law for it, learnt from this log."


def _dependences(unexplained: Unexplained) -> list[str]:
    """Return sentences on what the unexplained part varies with."""
    names = unexplained.depends_on
    lines = [name.removeprefix("periodic at ") for name in names if name.startswith("periodic")]
    smooth = [name for name in names if name != "stochastic" and not name.startswith("periodic")]
    sentences = [f"It depends on {', '.join(smooth)}."] if smooth else []
    sentences += [f"It swings at {', '.join(lines)}."] if lines else []
    return sentences + ["It wanders at random, as gusts do."] * ("stochastic" in names)


def describe_verdict(diagnosis: Diagnosis) -> Verdict:
    """Return the verdict in a sentence or two."""
    unexplained = diagnosis.unexplained
    depends = "".join(f" {sentence}" for sentence in _dependences(unexplained))
    if diagnosis.verdict == CONSISTENT:
        return Verdict(
            "The log agrees with the model: the residuals look like sensor noise.", "good"
        )
    beyond = _beyond(diagnosis)
    if not diagnosis.causes:
        text = f"The model is wrong, and no known cause explains it.{depends}"
        return Verdict(" ".join(filter(None, [text, beyond, _learned(diagnosis)])), "open")
    parts = [_faults(diagnosis), _families(diagnosis), _gain(diagnosis), beyond]
    if unexplained.depends_on:
        parts.append(f"Something else remains that no known cause explains.{depends}")
    parts.append(_learned(diagnosis))
    return Verdict(
        " ".join(filter(None, parts)), "found" if diagnosis.verdict == CAUSES_FOUND else "open"
    )


def _causes_part(diagnosis: Diagnosis) -> Part:
    if not diagnosis.causes:
        return Text("No cause is named. See below for what this log could not have shown.")
    rows = [
        [
            f"{words_of(cause.effect)}{format_span(cause)}\n({cause.effect}, in {cause.channel})",
            "\n".join(
                [
                    *(_parameter(name, value) for name, value in cause.parameters.items()),
                    *_by_flight(cause),
                ]
            ),
            _number(cause.heldout_gain),
            _confused(cause),
        ]
        for cause in diagnosis.causes
    ]
    caption = (
        "Values with 95 % intervals. Gain: fall of minus twice the log likelihood on the held-out "
        "part."
    )
    return Table(
        ["cause", "parameters", "gain", "could it be another?"], rows, caption, is_text=True
    )


def _errors_table(diagnosis: Diagnosis) -> Table:
    models = diagnosis.error.values()
    steps = dict.fromkeys(key for column in models for key in column.one_step_nrmse)
    flights = dict.fromkeys(key for column in models for key in column.position_m)
    rows = [
        [
            CHANNEL_WORDS.get(key, key),
            "NRMSE",
            *(_number(column.one_step_nrmse.get(key)) for column in models),
        ]
        for key in steps
    ]
    rows += [
        [
            f"position after {key} s",
            "m",
            *(_number(column.position_m.get(key)) for column in models),
        ]
        for key in flights
    ]
    responses = [diagnosis.half_response_s.get(name, {}) for name in diagnosis.error]
    rows += [
        [
            f"time to half response, {stick}",
            "ms",
            *(_half_response(column.get(stick)) for column in responses),
        ]
        for stick in diagnosis.half_response_s.get("extended", {})
    ]
    lifts = [diagnosis.lift.get(name) for name in diagnosis.error]
    stick = "motors" if takes_motors(diagnosis.nominal.effects) else "stick"
    for lift in [one for one in lifts if one is not None][:1]:
        rows += [
            [
                f"thrust over weight at full {stick}, {lift.full_v:.3g} V",
                "1",
                *("-" if one is None else _known(one.thrust_to_weight) for one in lifts),
            ],
            [
                f"{stick} of the hover, {lift.middle_v:.3g} V",
                "1",
                *("-" if one is None else _known(one.hover) for one in lifts),
            ],
        ]
    caption = (
        "Held-out part. One step: 1 is as bad as predicting the mean; position in free flight, "
        "rms. Half response: of body rate or thrust to a small step of the stick; in brackets, to "
        "full stick. Thrust and hover by the thrust curve alone."
    )
    return Table(
        ["error", "unit", *(name.replace("_", " ") for name in diagnosis.error)], rows, caption
    )


BARS = {
    "nominal": ORANGE,
    "refitted_base": GREY,
    "extended": BLUE,
    "without_learned": "lightsteelblue",
    "noise_floor": GREEN,
}


def _errors_picture(diagnosis: Diagnosis) -> list[Part]:
    """Draw bars of the free-flight errors by horizon and model; nothing without such flights."""
    horizons = list(diagnosis.error["extended"].position_m)
    if not horizons:
        return []
    figure = new_figure(WIDTH_IN, BARS_HEIGHT_IN)
    axes = figure.subplots()
    models = [
        (name, model_errors.position_m)
        for name, model_errors in diagnosis.error.items()
        if model_errors.position_m
    ]
    width = 0.8 / len(models)
    for index, (name, errors) in enumerate(models):
        positions, heights = (
            np.arange(len(horizons)) + index * width,
            [errors[horizon] for horizon in horizons],
        )
        axes.bar(positions, heights, width, color=BARS[name], label=name.replace("_", " "))
    all_errors = [error for _, errors in models for error in errors.values()]
    if max(all_errors) > LOG_BARS * min(all_errors):
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.5 * min(all_errors))  # the smallest bar stays visible
    axes.set_xticks(
        np.arange(len(horizons)) + 0.5 * (len(models) - 1) * width,
        [f"{horizon} s" for horizon in horizons],
    )
    axes.set_ylabel("position error (m, rms)")
    plain(axes)
    axes.legend(frameon=False, fontsize="small", ncols=len(models))
    caption = "Free flight on the held-out part, by how long it lasts."
    return [Picture(png_of(figure), caption)]


def _half_response(response: HalfResponse | None) -> str:
    """Return a time (ms) with its interval, and the time to full stick where it differs."""
    if response is None or not np.isfinite(response.time):
        return "-"
    text = f"{1e3 * response.time:.1f}"
    if response.ci95 is not None:
        half_width = response.ci95[1] - response.time
        if half_width > response.time:
            return "not determined"
        text += f" ± {1e3 * half_width:.1f}"
    differs = abs(response.full_stick - response.time) > LIMITED_S
    return f"{text} ({1e3 * response.full_stick:.0f})" if differs else text


def _known(estimate: Estimated) -> str:
    """Return a value, with half of its interval if it has one."""
    half = estimate.half_width
    if half > MAX_HALF_WIDTH:
        return "not determined"
    return f"{estimate.value:.3g}" + (f" ± {half:.2g}" if half > 0.0 else "")


def _lift_text(diagnosis: Diagnosis) -> list[str]:
    """Return a line on what the craft lifts; none if the log does not show the thrust."""
    if "extended" not in diagnosis.lift:
        return []
    nominal, lift = diagnosis.lift["nominal"], diagnosis.lift["extended"]
    stick = "motors" if takes_motors(diagnosis.nominal.effects) else "stick"
    return [
        f"thrust over weight at full {stick} and {lift.full_v:.3g} V: "
        f"{_known(lift.thrust_to_weight)}, the model says {_known(nominal.thrust_to_weight)}; "
        f"{stick} of the hover at {lift.middle_v:.3g} V: {_known(lift.hover)}, the model says "
        f"{_known(nominal.hover)}"
    ]


def _loop_row(loop: RateLoop) -> list[str]:
    """Return the cells of a controller's loop."""
    shares = (
        (loop.integral, 1.0, "1/s"),
        (loop.derivative, 1e3, "ms"),
        (loop.feedforward, 1e3, "ms"),
    )
    return [
        loop.axis,
        "-" if np.isnan(loop.explained) else f"{loop.explained:.0%}",
        f"{loop.full_stick.value:.0f} ± {loop.full_stick.half_width:.0f} deg/s",
        f"{loop.gain.value:.3g} ± {loop.gain.half_width:.2g}",
        *(
            f"{factor * value.value:.3g} ± {factor * value.half_width:.2g} {unit}"
            for value, factor, unit in shares
        ),
        f"{1e3 * loop.stick_delay_s:.0f}, {1e3 * loop.gyro_delay_s:.0f} ms",
    ]


LOOP_COLUMNS = ["controller", "explained", "full stick", "P", "I/P", "D/P", "F/P", "delays"]


def describe_side(diagnosis: Diagnosis) -> str:
    """Return a sentence on which side of the motors is wrong; empty without a controller."""
    if diagnosis.controller is None:
        return ""
    wrong = [
        *(["the body"] if diagnosis.verdict != CONSISTENT else []),
        *(["the controller"] if diagnosis.controller.faults else []),
    ]
    text = "Which side of the motors is wrong: " + (" and ".join(wrong) or "neither") + "."
    axes = [loop.axis for loop in diagnosis.controller.loops]
    if len(axes) < len(AXES):
        text += f" Of the controller, only {' and '.join(axes)} showed."
    return " ".join([text, *(f"{fault}." for fault in diagnosis.controller.faults)])


def _controller_parts(diagnosis: Diagnosis) -> list[Part]:
    """Return the loops of a controller, and which side is wrong; nothing without a controller."""
    if diagnosis.controller is None:
        return []
    caption = (
        "From sticks and gyro to motors. Explained: of the held-out motors' variance by a linear "
        "loop. P: per cent of the motors' range per 100 deg/s. Delays: of sticks and gyro."
    )
    rows = [_loop_row(loop) for loop in diagnosis.controller.loops]
    return [Text(describe_side(diagnosis)), Table(LOOP_COLUMNS, rows, caption)]


def _controller_text(diagnosis: Diagnosis) -> list[str]:
    """Return the same as lines of text."""
    if diagnosis.controller is None:
        return []
    rows = [tuple(_loop_row(loop)) for loop in diagnosis.controller.loops]
    return [*text_table([tuple(LOOP_COLUMNS), *rows]), describe_side(diagnosis)]


def _limits_part(diagnosis: Diagnosis) -> Part:
    if not diagnosis.not_identifiable:
        return Text(
            "This log could have shown every effect that is looked for, and told it from all "
            "others."
        )
    rows = [
        [
            f"{words_of(limit.effect)}\n({limit.effect})",
            (_number(limit.smallest) + _unit(limit.unit)).replace(" ", NO_BREAK),
            list_words(limit.confused_with[:MAX_LISTED]) or "noise",
            limit.fly.replace("_", " "),
        ]
        for limit in diagnosis.not_identifiable
    ]
    caption = (
        "Smaller than the second column, such an effect may be there without showing in this log."
    )
    header = ["effect", "visible from", "looks like", "fly this to settle it"]
    return Table(header, rows, caption, is_text=True)


def _unexplained_parts(diagnosis: Diagnosis) -> list[Part]:
    unexplained = diagnosis.unexplained
    if not unexplained.depends_on:
        beyond = _beyond(diagnosis)
        return [Text(f"Nothing more. {beyond}" if beyond else "Nothing: the residuals are noise.")]
    sentences = " ".join(_dependences(unexplained))
    parts: list[Part] = [Text(f"What is left is more than noise. {sentences}")]
    if unexplained.shares:
        shares = [
            [name, _number(share) if share < MAX_TIMES_NOISE else f"above {MAX_TIMES_NOISE:g}"]
            for name, share in unexplained.shares.items()
        ]
        caption = "Size of what is left (rms) by what it depends on, in units of the sensor noise"
        parts.append(Table(["channel: dependence", "times the sensor noise"], shares, caption))
    return parts


def _learned_parts(diagnosis: Diagnosis, model_traces: Traces) -> list[Part]:
    """Return the formulas of what was learnt, and the residuals without and with it."""
    learned = diagnosis.learned
    if learned is None:
        return []
    panels = [Panel(*arguments) for arguments in learned.drawn()][:MAX_PICTURED]
    figure = draw_cause("what was learnt", panels, model_traces, _LESS + LEARNT)
    return [Bullets(learned.text().splitlines()), Picture(png_of(figure), LEARNT_READING)]


_LESS, LEARNT = "without ", "what was learnt"
LEARNT_READING = (
    "Orange: what the extended model leaves without it, nothing else refitted. The line is what "
    "was learnt. It holds in the ranges that were flown."
)


def collect_traces(diagnosis: Diagnosis, log: FlightLog) -> Traces:
    """Return the residuals of both models, and of the extended model "without" each cause."""
    models = {"nominal": diagnosis.nominal, "extended": diagnosis.extended}
    for cause in diagnosis.causes:
        models[_LESS + cause.effect] = without(diagnosis.extended, diagnosis.nominal, cause.effect)
    if diagnosis.learned is not None:
        kept = tuple(
            effect for effect in diagnosis.extended.effects if not isinstance(effect, LearnedLaw)
        )
        models[_LESS + LEARNT] = diagnosis.extended._replace(effects=kept)
    return traces(log, models, like="extended")


def while_acting(model_traces: Traces, cause: Cause, start_s: float) -> Traces:
    """Return traces whose scored rows are only those where a cause acts.

    Args:
        start_s: time of the log's first row (s).
    """
    time = start_s + model_traces.elapsed_s
    since = -np.inf if cause.onset_s is None else cause.onset_s.value
    until = np.inf if cause.end_s is None else cause.end_s.value
    acts = (time >= since) & (time < until)
    return model_traces._replace(
        counts={name: counts & acts for name, counts in model_traces.counts.items()}
    )


def _evidence_parts(diagnosis: Diagnosis, model_traces: Traces, start_s: float) -> list[Part]:
    """Return the pictures of the causes with the largest gain.

    Args:
        model_traces: the result of ``collect_traces``.
        start_s: time of the log's first row (s).
    """
    parts: list[Part] = []
    for cause in sorted(diagnosis.causes, key=lambda cause: -cause.chi2_gain)[:MAX_PICTURED]:
        evidence = EVIDENCE[cause.effect]
        acting = while_acting(model_traces, cause, start_s)
        figure = draw_cause(
            cause.effect, evidence.panels, acting, _LESS + cause.effect, format_span(cause)
        )
        parts.append(
            Picture(png_of(figure), f"{evidence.reading} ({cause.effect}{format_span(cause)})")
        )
    if parts and any(model_traces.used(name) != name for name in ("rates_x", "force_x")):
        parts.append(Text(DIFFERENCES))
    return parts


def html_of(diagnosis: Diagnosis, log: FlightLog) -> str:
    """Return the report of a diagnosis of a log as a self-contained page."""
    model_traces = collect_traces(diagnosis, log)
    minutes = model_traces.elapsed_s[-1] / SECONDS_PER_MINUTE
    introduction: list[Part] = [
        describe_verdict(diagnosis),
        Text(
            f"{diagnosis.source}: {len(log)} rows, {minutes:.1f} min. SHA-256 "
            f"{diagnosis.sha256[:12]}."
        ),
        _causes_part(diagnosis),
    ]
    if diagnosis.negligible:
        listed = "; ".join(
            f"{words_of(cause.effect)} ({_plus_minus(cause)})" for cause in diagnosis.negligible
        )
        introduction.append(Text(f"Seen, but negligible: {listed}."))
    if diagnosis.warnings:
        introduction.append(Bullets(diagnosis.warnings))
    evidence = _evidence_parts(diagnosis, model_traces, float(log.time[0]))
    controller = _controller_parts(diagnosis)
    sections = [
        Section("Errors before and after", [*_errors_picture(diagnosis), _errors_table(diagnosis)]),
        *([Section("The evidence, cause by cause", evidence)] if evidence else []),
        *([Section("The controller", controller)] if controller else []),
        Section("What this log could not show, and what to fly", [_limits_part(diagnosis)]),
        Section(
            "What remains unexplained",
            _unexplained_parts(diagnosis) + _learned_parts(diagnosis, model_traces),
        ),
        Section("How this was done", [Bullets(HOW)]),
    ]
    return page("What the model gets wrong", sections, introduction)


def write_diagnosis(folder: str | Path, diagnosis: Diagnosis, log: FlightLog) -> list[Path]:
    """Write a diagnosis into a folder, which is created if needed, and return the files.

    Args:
        log: the log that was diagnosed; for several logs, the result of ``diagnose.joined``.

    Raises:
        OSError: a file cannot be written.
    """
    folder = Path(folder)
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
    lines = [f"verdict: {diagnosis.verdict}", f"motion: {diagnosis.extended.motion.value}"]
    for cause in diagnosis.causes:
        values = ", ".join(
            f"{name} {value.value:.4g} ({value.ci95[0]:.4g} to {value.ci95[1]:.4g}) {value.unit}"
            for name, value in cause.parameters.items()
        )
        names = [
            words_of(equivalent) if equivalent == DRIFT else equivalent
            for equivalent in cause.equivalent
        ]
        twins = f"; not told apart from {', '.join(names)}" if names else ""
        twins += f"; or its family: {', '.join(cause.family)}" if cause.family else ""
        lines.append(
            f"  {cause.effect}{format_span(cause)}: {values}; held-out gain "
            f"{cause.heldout_gain:.4g}{twins}"
        )
        lines += [f"    {line}" for line in _by_flight(cause)]
    for cause in diagnosis.beyond:
        lines.append(f"beyond the list: {cause.effect}: {cause.beyond}")
    for cause in diagnosis.negligible:
        lines.append(f"negligible: {cause.effect}: {_plus_minus(cause)}")
    answers = diagnosis.half_response_s.get("extended", {}).items()
    if answers:
        times = ", ".join(f"{stick} {_half_response(response)}" for stick, response in answers)
        lines.append(f"time from a stick to half of the response, ms: {times}")
    lines += _lift_text(diagnosis) + _controller_text(diagnosis)
    if diagnosis.unexplained.depends_on:
        lines.append(f"unexplained, depends on: {', '.join(diagnosis.unexplained.depends_on)}")
    if diagnosis.learned is not None:
        lines += [f"learnt: {line}" for line in diagnosis.learned.text().splitlines()]
    closing = _gain(diagnosis) if diagnosis.causes else ""
    return "\n".join(
        [*lines, *_limits_text(diagnosis), *diagnosis.warnings, *filter(None, [closing])]
    )


def _limits_text(diagnosis: Diagnosis) -> list[str]:
    """Return a small table of what a log could not show, and the flight that settles most of it."""
    limits = diagnosis.not_identifiable
    if not limits:
        return []
    rows = [("not shown by this log", "visible from", "looks like")]
    for limit in limits[:MAX_LIMITS]:
        size = f"{limit.smallest:.3g} {limit.unit}" if np.isfinite(limit.smallest) else "-"
        rows.append((limit.effect, size, ", ".join(limit.confused_with[:MAX_LISTED]) or "noise"))
    lines = text_table(rows)
    if len(limits) > MAX_LIMITS:
        lines.append(f"and {len(limits) - MAX_LIMITS} more, in {REPORT_NAME}")
    flights = Counter(limit.fly for limit in limits if limit.fly)
    if not flights:  # no manoeuvre is known for this craft
        return lines
    ((flight, count),) = flights.most_common(1)
    to_do = flight if flight.startswith(TO_LOG) else f"fly {flight}"
    return [*lines, f"recommended: {to_do}, which settles {count} of {len(limits)}"]
