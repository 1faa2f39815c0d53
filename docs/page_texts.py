"""The Markdown of the pages that the code determines, from docstrings and templates, ``docs/templates``.

There is a page per environment id, per effect and per shipped track.
"""

import inspect
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from latex2mathml.converter import convert

import flytrack_env
from docs.page_pictures import NUM_NOTABLE
from flytrack_env.effects import EFFECTS, Effect, effect_of
from flytrack_env.references import KINDS, shipped_path, shipped_reference
from flytrack_env.registration import ENVIRONMENTS
from flytrack_env.rewards import TERMS
from flytrack_env.terminations import Causes
from flytrack_env.tracks import Gate, Track, build_course, load_track, way_length
from flytrack_env.tracks.track import TRACK_FOLDER
from flytrack_env.wrappers import RandomizationParams, Wrapper, layers_of
from flytrack_sysid.diagnosis.evidence import EVIDENCE
from flytrack_sysid.diagnosis.traces import REGRESSORS

TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"),
    undefined=StrictUndefined,
    keep_trailing_newline=True,
)
TEMPLATES.filters["g"] = lambda value: f"{value:g}"
INFO = {  # its keys that are not causes of termination
    "gates_passed": "gates passed in this episode",
    "laps": "laps completed; a lap is as many gates as the track has, wherever the episode began",
    "lap_completed": "whether a lap was completed in this step",
    "lap_time_s": "time of the last complete lap, interpolated at the crossing, s; 0 before the first",
    "gate_distance_m": "distance to the centre of the next gate, m",
    "terminated": "as returned",
    "truncated": "as returned",
    "final_observation": "the observation before auto-reset",
}
CHANNELS = {
    "p": "position",
    "v": "velocity",
    "q": "attitude",
    "w": "gyro",
    "f": "accelerometer",
    "v_bat": "battery voltage",
}
FLIGHTS = {"flying": "flying lap", "standing": "standing start, every gate once"}
MODELS = {"nominal": "nominal drone", "black_box": "shipped black box, as identified"}


def render(template: str, **values: Any) -> str:
    """Return a template's Markdown; its filter ``g`` writes numbers as Python's format "g" does."""
    return TEMPLATES.get_template(f"{template}.md.jinja").render(values)


def one_line(docstring: str | None) -> str:
    """Return a docstring as one line of Markdown."""
    text = re.sub(r"\s+", " ", docstring or "").strip()
    return text.replace("``", "`").replace("_*", r"_\*")  # v_* is no emphasis


def sentence(docstring: str | None) -> str:
    """Return a docstring's first paragraph without its "Return" and its full stop."""
    first = one_line((docstring or "").split("\n\n")[0]).removeprefix("Return ")
    return first.removeprefix("whether ").rstrip(".")


def field_texts(record: Any) -> dict[str, str]:
    """Return what a class's docstring says of its fields, each "name: text." or "name, name: text."."""
    body = one_line(record.__doc__.partition("\n\n")[2])
    parts = re.split(r"(?:^|(?<=[.;] ))((?:[a-z_*/]+(?:, )?)+): ", body)
    return {name: text.strip().rstrip(".;") for name, text in zip(parts[1::2], parts[2::2], strict=True)}


def range_rows(ranges: RandomizationParams) -> list[tuple[str, str, str]]:
    """Return the rows of a randomisation: what, from, to."""
    factors = {
        "mass, factor": (ranges.mass_factor_low, ranges.mass_factor_high),
        "effects that the model has, factor": (ranges.effect_factor_low, ranges.effect_factor_high),
        "each of the four lags, factor": (ranges.lag_factor_low, ranges.lag_factor_high),
    }
    for low, high in zip(ranges.low, ranges.high, strict=True):
        effect = effect_of(low)
        for name, lowest in low._asdict().items():
            if lowest is not None:
                what = f"`{effect.name}.{name}`, {effect.ranges[name].unit}"
                factors[what] = (lowest, getattr(high, name))
    return [(what, f"{lowest:g}", f"{highest:g}") for what, (lowest, highest) in factors.items()]


def layer_of(wrapper: Wrapper) -> dict[str, Any]:
    """Return what a page says of a wrapper: name, first sentence, parameters."""
    own = wrapper.own_defaults()
    layer = {"name": type(wrapper).__name__, "about": sentence(type(wrapper).__doc__), "key": wrapper.key}
    if isinstance(own, RandomizationParams):
        return {**layer, "columns": ("from", "to"), "rows": range_rows(own)}
    rows = [(f"`{name}`", f"{value:g}") for name, value in own._asdict().items()] if own is not None else []
    return {**layer, "columns": ("value",), "rows": rows}


def observation_rows(env: Any) -> list[tuple[str, Any]]:
    """Return the observation's entries with their indices."""
    rows, start = [], 0
    for entry in env.observation_table:
        end = start + entry.size
        rows.append((str(start) if entry.size == 1 else f"{start}:{end}", entry))
        start = end
    return rows


def env_page(env_id: str) -> str:
    """Return the page of an environment id."""
    env = flytrack_env.make(env_id)
    params = env.default_params
    observation, state = jax.eval_shape(env.reset, jax.random.key(0), params)
    *_, info = jax.eval_shape(env.step, jax.random.key(0), state, jnp.zeros(4), params)
    causes = field_texts(Causes)
    return render(
        "env",
        env_id=env_id,
        summary=ENVIRONMENTS[env_id].summary,
        params=params,
        layers=[layer_of(layer) for layer in reversed(layers_of(env)) if isinstance(layer, Wrapper)],
        is_randomised="domain_randomization" in (params.wrappers or {}),
        size=observation.size,
        observation=observation_rows(env),
        terms={term.__name__: sentence(term.__doc__) for term in TERMS},
        causes={name: causes[name] for name in Causes._fields},
        info={name: INFO[name] for name in info if name not in Causes._fields},
    )


def needs_of(effect: Effect) -> str:
    """Return the channels without which a log cannot show the effect, in sentences."""
    channels = " and ".join(f"`{name}` ({CHANNELS[name]})" for name in effect.needs)
    parts = [f"The log must have {channels or '`w` or `q`'}."]
    if {"lag", "thrust", "air", "force"} & set(effect.stages):
        parts.append("Without `f`, `v`, or `a` and `q`, it shows nothing of a force.")
    if effect.acts_on == ("sensor",):
        parts.append("An error of one sensor shows only where another one measures the same motion.")
    return " ".join(parts)


def varied_by(effect: Effect) -> list[str]:
    """Return what a flight has to vary to show the effect."""
    varied = [REGRESSORS[panel.regressor] for panel in EVIDENCE[effect.name].panels]
    return list(dict.fromkeys(label if unit == "1" else f"{label} ({unit})" for label, unit in varied))


def arguments(values: Mapping[str, float]) -> str:
    """Return values as keyword arguments."""
    return ", ".join(f"{name}={value:g}" for name, value in values.items())


def effect_page(effect: Effect) -> str:
    """Return the page of an effect."""
    neutral = effect.parameters()._asdict()
    shown = effect.fitted or (effect.groups[-1] if effect.groups else effect.notable)
    names = [name for name in shown if name in effect.notable]
    high = {name: neutral[name] + effect.notable[name] for name in names}
    return render(
        "effect",
        picture_size=f"{NUM_NOTABLE:g}",
        effect=effect,
        about=one_line(effect.about or inspect.getdoc(inspect.getmodule(effect.parameters))),
        law=convert(effect.equation, display="block"),
        parameters_about=one_line(effect.parameters.__doc__),
        neutral=neutral,
        high=arguments(high),
        low=arguments({name: neutral[name] for name in high}),
        in_file="{" + ", ".join(f'"{name}": {value:g}' for name, value in high.items()) + "}",
        needs=needs_of(effect),
        varied=varied_by(effect),
        reading=EVIDENCE[effect.name].reading,
        **{"class": effect.parameters.__name__},
    )


def effects_table() -> str:
    """Return the table of all effects."""
    return render("effects", effects=EFFECTS, evidence=EVIDENCE)


def about_track(name: str) -> str:
    """Return what a track's file says of the course: its first comment, without the conventions."""
    lines = (TRACK_FOLDER / f"{name}.toml").read_text(encoding="utf-8").splitlines()
    comment = [line.removeprefix("#").strip() for line in lines[: lines.index(f'name = "{name}"')]]
    return " ".join(comment).partition("Units")[0].strip()


def gate_rows(track: Track) -> list[tuple[Gate, float, float, float]]:
    """Return gates with yaw and heading, degrees in [0, 360), and the distance to the next one, m."""
    positions = np.array([gate.position for gate in track.gates])
    distances = np.linalg.norm(np.roll(positions, -1, axis=0) - positions, axis=1)
    rows = []
    for gate, distance in zip(track.gates, distances, strict=True):
        w, _, _, z = gate.quaternion
        yaw_deg = float(np.rad2deg(2.0 * np.arctan2(z, w)))
        rows.append((gate, yaw_deg % 360.0, (yaw_deg + 90.0 * gate.direction) % 360.0, float(distance)))
    return rows


def record_rows(name: str) -> list[tuple[str, str, dict[str, Any]]]:
    """Return a track's time-optimal flights: drone, kind of flight, time and highest speed."""
    rows = []
    for model_name, model in MODELS.items():
        for kind in KINDS:
            if shipped_path(name, kind, model_name).is_file():
                flight = shipped_reference(name, kind, model_name)
                speed = np.linalg.norm(flight.states[:, 3:6], axis=1).max()
                rows.append((model, FLIGHTS[kind], {"time_s": flight.time_s, "speed": speed}))
    return rows


def track_page(name: str) -> str:
    """Return the page of a shipped track."""
    track = load_track(name)
    return render(
        "track",
        name=name,
        track=track,
        about=about_track(name),
        length=way_length(build_course(track)),
        gates=gate_rows(track),
        records=record_rows(name),
    )
