"""The overview of effects, ``docs/effects.md``, and a page per effect in ``docs/effects/``."""

import inspect
from typing import Any

from docs.markdown import code, page, paragraph, table, words_of_docstring
from flytrack_env.effects import EFFECTS, STAGES, Effect
from flytrack_sysid.diagnosis.evidence import EVIDENCE, After
from flytrack_sysid.diagnosis.traces import REGRESSORS

CHANNELS = {
    "p": "position",
    "v": "velocity",
    "q": "attitude",
    "w": "gyro",
    "f": "accelerometer",
    "v_bat": "battery voltage",
}
FORCE_STAGES = {"lag", "thrust", "air", "force"}
CHANGES = {0: "changes of the {} command", 1: "rising {} commands", -1: "falling {} commands"}


def shown_values(effect: Effect) -> dict[str, float]:
    """Return parameters at which an effect begins to matter: neutral and what is notable of one group."""
    neutral = effect.parameters()
    names = effect.groups[-1] if effect.groups else effect.notable
    return {name: getattr(neutral, name) + effect.notable[name] for name in names}


def call(effect: Effect, values: dict[str, Any]) -> str:
    """Return Python that makes parameters of an effect, as one line."""
    inner = ", ".join(f"{name}={value if value is None else f'{value:g}'}" for name, value in values.items())
    return f"{effect.parameters.__name__}({inner})"


def law_section(effect: Effect) -> list[str]:
    """Return the equation, where it acts, and its source."""
    memory = "It has a memory, which begins anew with every episode." if effect.start else "It has no memory."
    text = paragraph(
        f"Acts on: {', '.join(effect.acts_on)}. Stage of the step: {', '.join(effect.stages)}. {memory}",
        f"Source: {effect.source}.",
    )
    return ["## Law", "", *code(effect.equation, language="text"), *text]


def parameter_section(effect: Effect) -> list[str]:
    """Return the table of parameters, and what it does not say."""
    neutral = effect.parameters()
    rows = []
    for name, bounds in effect.ranges.items():
        notable = f"{effect.notable[name]:g}" if name in effect.notable else "-"
        limits = f"{bounds.low:g} to {bounds.high:g}"
        rows.append((f"`{name}`", bounds.unit, f"{getattr(neutral, name):g}", limits, notable))
    notes = [
        "At the neutral value the effect does nothing, bit for bit.",
        "Model files and `env.reset` refuse values beyond the range.",
        "Notable is how far from neutral a parameter is worth knowing.",
    ]
    if effect.shapes:
        names = ", ".join(f"`{name}`" for name in effect.shapes)
        notes.append(f"Only shapes what the others do, and does nothing while they are neutral: {names}.")
    notes += [
        f"`{name}` is at most {steps} steps of the simulation." for name, steps in effect.most_steps.items()
    ]
    header = ("parameter", "unit", "neutral", "range", "notable")
    about = words_of_docstring(effect.parameters)
    return ["## Parameters", "", *paragraph(about), *table(header, rows), *paragraph(*notes)]


def use_section(effect: Effect) -> list[str]:
    """Return how a model, a fit and a randomisation name the effect."""
    values, name = shown_values(effect), effect.parameters.__name__
    neutral = effect.parameters()
    high = {field: values.get(field) for field in effect.ranges}
    low = {field: getattr(neutral, field) if field in values else None for field in effect.ranges}
    lines = code(
        "import gymnax",
        "from flytrack_env import FlyTrack, nominal_parameters",
        f"from flytrack_env.effects import {name}",
        "from flytrack_env.wrappers import DomainRandomization, RandomizationParams",
        "",
        f"effect = {call(effect, values)}",
        'env, params = gymnax.make("FlyTrack-v0", model=nominal_parameters().with_effects(effect))',
        "",
        "env = DomainRandomization(FlyTrack())  # or drawn in every episode, from neutral to that",
        "ranges = RandomizationParams(",
        f"    low=({call(effect, low)},),",
        f"    high=({call(effect, high)},),",
        ")",
        'params = env.default_params.replace(wrappers={"domain_randomization": ranges})',
    )
    in_file = ", ".join(f'"{field}": {value:g}' for field, value in values.items())
    text = paragraph(
        f'In a model file: `"effects": {{"{effect.name}": {{{in_file}}}}}`. To identify it:',
        f"`flytrack-sysid fit data.npz --effect {effect.name} --out model.json`.",
    )
    return ["## In a model", "", *lines, *text]


def needs_of(effect: Effect) -> str:
    """Return which channels a log must have for the effect to show, in sentences."""
    channels = " and ".join(f"`{name}` ({CHANNELS[name]})" for name in effect.needs)
    parts = [
        f"The log must have {channels}." if channels else "Any log with `w` or `q` can be asked about it."
    ]
    if FORCE_STAGES & set(effect.stages):
        parts.append("With neither `f` nor `v` (or `a` and `q`) it shows nothing of a force.")
    if effect.acts_on == ("sensor",):
        parts.append("An effect on a sensor shows only where another sensor sees the same motion.")
    return " ".join(parts)


def log_section(effect: Effect) -> list[str]:
    """Return what a log must hold for the diagnosis to name the effect, and what convicts it."""
    evidence = EVIDENCE[effect.name]
    varied = []
    for panel in evidence.panels:
        if isinstance(panel, After):
            varied.append(CHANGES[panel.only].format(panel.stick))
        else:
            label, unit = REGRESSORS[panel.regressor]
            varied.append(label if unit == "1" else f"{label} ({unit})")
    text = paragraph(
        needs_of(effect),
        f"The flight must vary: {'; '.join(dict.fromkeys(varied))}. How the model's error depends on that",
        f"convicts the effect. {evidence.reading}",
    )
    more = paragraph(
        "The [diagnosis](../diagnosis.md) looks for this effect in every log. Where a log cannot show it,",
        "the diagnosis says from which size on it would, what looks alike, and",
        "[what to fly](../diagnosis.md#how-to-read-it).",
    )
    return ["## In a flight log", "", *text, *more]


def effect_page(effect: Effect) -> str:
    """Return the page of an effect."""
    module = inspect.getmodule(effect.parameters)
    return page(
        f"# {effect.name}",
        "",
        *paragraph(words_of_docstring(module)),
        *law_section(effect),
        *parameter_section(effect),
        *use_section(effect),
        *log_section(effect),
        *paragraph("All effects: [effects](../effects.md)."),
    )


def effects_page() -> str:
    """Return the overview of all effects."""
    rows = [
        (
            f"[`{effect.name}`](effects/{effect.name}.md)",
            EVIDENCE[effect.name].words,
            ", ".join(effect.stages),
            ", ".join(effect.acts_on),
            ", ".join(f"`{name}`" for name in effect.needs) or "-",
        )
        for effect in EFFECTS
    ]
    return page(
        "# Effects",
        "",
        *paragraph(
            "What a drone does beyond the minimal model, one file each in `flytrack_env/effects/`. A",
            "model carries the parameters of the effects that it has; the simulator folds them in the",
            f"order of this page within the stages of a step: {', '.join(STAGES)}. At its neutral value an",
            "effect does nothing, bit for bit. Effects on a sensor change what it says and nothing of the",
            "flight: `flytrack_env.dynamics.read_sensors` reads both sensors, and the body rates of an",
            "observation are the gyro's.",
        ),
        *code(
            "from flytrack_env import nominal_parameters",
            "from flytrack_env.effects import CommandDelay, LinearDrag",
            "",
            "model = nominal_parameters().with_effects(LinearDrag(0.3, 0.3, 0.1), CommandDelay(0.02))",
            'env, params = gymnax.make("FlyTrack-v0", model=model)',
        ),
        *paragraph(
            "Each effect has a page with its law, parameters, units, ranges, neutral values and source, how",
            "to use it in a model, and what a flight log must hold to show it. The last column names the",
            "channels of a [flight log](identification.md#the-flight-log) without which the",
            "[diagnosis](diagnosis.md) cannot be asked about the effect; every log needs `w` or `q`.",
        ),
        *table(("effect", "in words", "stage", "acts on", "a log needs"), rows),
        *paragraph("To add an effect: [contributing](../CONTRIBUTING.md#add-an-effect)."),
    )
