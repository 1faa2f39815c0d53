"""The table of effects and a page for each."""

import inspect
from collections.abc import Mapping

from latex2mathml.converter import convert

from docs.markdown import one_line, render
from docs.page_pictures import NUM_NOTABLE
from flytrack_env.effects import EFFECTS, Effect
from flytrack_sysid.diagnosis.evidence import EVIDENCE
from flytrack_sysid.diagnosis.traces import REGRESSORS

CHANNELS = {
    "p": "position",
    "v": "velocity",
    "q": "attitude",
    "w": "gyro",
    "f": "accelerometer",
    "v_bat": "battery voltage",
}


def needs_of(effect: Effect) -> str:
    """Return the channels without which a log cannot show the effect, in sentences."""
    channels = " and ".join(f"`{name}` ({CHANNELS[name]})" for name in effect.search.needs)
    parts = [f"The log must have {channels or '`w` or `q`'}."]
    if {"lag", "thrust", "air", "force"} & set(effect.stages):
        parts.append("Without `f`, `v`, or `a` and `q`, it shows nothing of a force.")
    if effect.acts_on == ("sensor",):
        parts.append(
            "An error of one sensor shows only where another one measures the same motion."
        )
    return " ".join(parts)


def arguments(values: Mapping[str, float]) -> str:
    """Return values as keyword arguments."""
    return ", ".join(f"{name}={value:g}" for name, value in values.items())


def effect_page(effect: Effect) -> str:
    """Return the page of an effect."""
    neutral = effect.parameters()._asdict()
    shown = effect.search.fitted or (
        effect.search.groups[-1] if effect.search.groups else effect.notable
    )
    names = [name for name in shown if name in effect.notable]
    high = {name: neutral[name] + effect.notable[name] for name in names}
    varied = [REGRESSORS[panel.regressor] for panel in EVIDENCE[effect.name].panels]
    return render(
        "effect",
        picture_size=f"{NUM_NOTABLE:g}",
        effect=effect,
        about=one_line(inspect.getdoc(inspect.getmodule(effect.parameters))),
        law=convert(effect.equation, display="block"),
        parameters_about=one_line(effect.parameters.__doc__),
        neutral=neutral,
        high=arguments(high),
        low=arguments({name: neutral[name] for name in high}),
        in_file="{" + ", ".join(f'"{name}": {value:g}' for name, value in high.items()) + "}",
        needs=needs_of(effect),
        varied=dict.fromkeys(
            label if unit == "1" else f"{label} ({unit})" for label, unit in varied
        ),
        reading=EVIDENCE[effect.name].reading,
        **{"class": effect.parameters.__name__},
    )


def effects_table() -> str:
    """Return the table of all effects."""
    return render("effects", effects=EFFECTS, evidence=EVIDENCE)
