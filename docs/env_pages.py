"""A page per environment id, in ``docs/envs/``."""

import inspect
import re
from typing import Any

import jax
import jax.numpy as jnp

import flytrack_env
from docs.markdown import field_texts, page, paragraph, sentence, table
from flytrack_env.effects import effect_of
from flytrack_env.env import FlyTrack
from flytrack_env.registration import ENVIRONMENTS
from flytrack_env.resets import ResetParams
from flytrack_env.rewards import TERMS
from flytrack_env.terminations import Causes
from flytrack_env.wrappers import Wrapper, layers_of

DESCRIPTION = (
    "A quadcopter in acro (rate) mode races through the gates of a track, laps repeating, at 100 Hz. "
    "World frame: x forward, y left, z up; quaternions (w, x, y, z), body to world; body frame: x "
    "forward, y left, z up. SI units. What a gate is and how passing it is decided: "
    "[environment](../environment.md)."
)

# Keys of info that are not causes of termination.
INFO = {
    "gates_passed": "gates passed in this episode",
    "laps": "laps completed; a lap is as many gates as the track has, from wherever the episode began",
    "lap_completed": "whether a lap was completed in this step",
    "lap_time_s": "time of the last complete lap, interpolated at the crossing, s; 0 before the first",
    "gate_distance_m": "distance to the centre of the gate to fly next, m",
    "terminated": "as returned",
    "truncated": "as returned",
    "final_observation": "the observation before auto-reset",
}

RATES = (
    "roll rate command, positive left side up",
    "pitch rate command, positive nose down",
    "yaw rate command, positive nose left",
)

HISTORY = {"v0": "First version."}


def action_section(env: Any) -> list[str]:
    """Return the action table."""
    max_rate = env.default_params.model.max_rate
    rows = [(i, name, "[-1, 1]", f"1 = {max_rate[i]:g} deg/s") for i, name in enumerate(RATES)]
    rows.append((3, "collective thrust command; -1 none, 1 all", "[-1, 1]", "1 = full thrust"))
    text = paragraph(
        "`Box(-1, 1, (4,), float32)`. Values beyond the range are clipped, infinite ones too. A NaN is "
        "flown as 0 and ends the episode as a crash. An action of another shape raises `ValueError`."
    )
    return ["## Action", "", *table(("number", "meaning", "range", "unit"), rows), *text]


def observation_section(env: Any) -> list[str]:
    """Return the observation table."""
    rows, start = [], 0
    for entry in env.observation_table:
        end = start + entry.size
        index = str(start) if entry.size == 1 else f"{start}:{end}"
        limits = f"[{-entry.limit:g}, {entry.limit:g}]"
        rows.append((index, entry.name, entry.frame, entry.unit, f"{entry.scale:g}", limits))
        start = end
    text = paragraph(
        f"{start} float32. A value is the quantity in its unit divided by the scale, clipped to the range.",
        "The gate frame is the flight frame of the gate to fly next: origin at its centre, x along the",
        "direction of flight, z the gate's up, y left.",
    )
    header = ("index", "meaning", "frame", "unit", "scale", "range")
    return ["## Observation", "", *text, *table(header, rows)]


def reward_section(env: Any) -> list[str]:
    """Return the reward terms with their weights."""
    weights = env.default_params.reward
    rows = [
        (f"`{term.__name__}`", f"{getattr(weights, term.__name__):g}", sentence(term.__doc__ or ""))
        for term in TERMS
    ]
    text = paragraph(
        "The sum of these terms, each times its weight: a field of `params.reward`, and a key of",
        "`make(..., reward={...})`.",
    )
    return ["## Reward", "", *text, *table(("term", "weight", "what"), rows)]


def start_section(env: Any) -> list[str]:
    """Return how episodes start, with the ranges."""
    params = env.default_params.reset
    share = params.course_fraction
    text = paragraph(
        f"With probability {share:g} in flight between two gates, on a curve that leaves and meets them",
        "along their directions of flight; else at rest at the track's start pose with noise. Uniform",
        "draws; fields of `params.reset`:",
    )
    rows = [(f"`{name}`", f"{value:g}") for name, value in params._asdict().items()]
    note = f"What they mean: `{ResetParams.__module__}.{ResetParams.__name__}`."
    return ["## Start", "", *text, *table(("field", "value"), rows), note, ""]


def end_section(env: Any) -> list[str]:
    """Return causes of termination, and truncation."""
    texts = field_texts(Causes)
    rows = [(f"`{name}`", texts[name]) for name in Causes._fields]
    steps = env.default_params.max_steps_in_episode
    text = paragraph(
        f"`truncated`: after `params.max_steps_in_episode` ({steps}) steps. `terminated`: for one of these",
        "causes, each a key of `info`.",
    )
    return ["## End of an episode", "", *text, *table(("cause", "when"), rows)]


def info_section(env: Any) -> list[str]:
    """Return every other key of info."""
    params = env.default_params
    _, state = jax.eval_shape(env.reset, jax.random.key(0), params)
    *_, info = jax.eval_shape(env.step, jax.random.key(0), state, jnp.zeros(4), params)
    rows = [(f"`{name}`", INFO[name]) for name in info if name not in Causes._fields]
    return ["## Info", "", *table(("key", "what"), rows)]


def arguments_section(env_id: str) -> list[str]:
    """Return the arguments of ``make``, from the class's docstring."""
    body = (FlyTrack.__doc__ or "").partition("Args:")[2].partition("Raises:")[0]
    entries = re.findall(r"^ {8}(\w+): (.*(?:\n {12}.*)*)", body, re.MULTILINE)
    rows = [(f"`{name}`", re.sub(r"\s+", " ", text).replace("``", "`")) for name, text in entries]
    parameters = inspect.signature(FlyTrack).parameters.values()
    shown = [f"    {parameter.name}={parameter.default!r},".replace("'", '"') for parameter in parameters]
    lines = [
        "## Arguments",
        "",
        "```python",
        "gymnax.make(",
        f'    "{env_id}",',
        *shown,
        ")",
        f'gymnasium.make("flytrack_env:{env_id}", track="split_s")  # the same arguments',
        "```",
        "",
        *table(("argument", "what"), rows),
        *paragraph(
            "`params` is a pytree of which every leaf may be batched, fitted or randomised: `model`,",
            "`course`, `reset`, `reward`, `dt`, `drone_radius`, `max_steps_in_episode`, and `wrappers`,",
            "each wrapper's own.",
        ),
    ]
    return lines


def range_rows(ranges: Any) -> list[tuple[str, str, str]]:
    """Return the rows of a randomisation: what, from, to."""
    effect_factors = f"{ranges.effect_factor_low:g}", f"{ranges.effect_factor_high:g}"
    rows = [
        ("mass, factor", f"{ranges.mass_factor_low:g}", f"{ranges.mass_factor_high:g}"),
        ("what the model has of the effects below, factor", *effect_factors),
        ("each of the four lags, factor", f"{ranges.lag_factor_low:g}", f"{ranges.lag_factor_high:g}"),
    ]
    for low, high in zip(ranges.low, ranges.high, strict=True):
        effect = effect_of(low)
        for name, lowest in low._asdict().items():
            if lowest is not None:
                what = f"`{effect.name}.{name}`, {effect.ranges[name].unit}"
                rows.append((what, f"{lowest:g}", f"{getattr(high, name):g}"))
    return rows


def wrappers_section(env: Any) -> list[str]:
    """Return what the variant's wrappers are and draw."""
    wrappers = [layer for layer in reversed(layers_of(env)) if isinstance(layer, Wrapper)]
    if not wrappers:
        return []
    lines = ["## What is different", ""]
    for wrapper in wrappers:
        name, own = type(wrapper).__name__, wrapper.own_defaults()
        about = sentence(type(wrapper).__doc__ or "")
        arguments = {"length": getattr(wrapper, "length", None), "kind": getattr(wrapper, "kind", None)}
        given = ", ".join(f"{key} {value}" for key, value in arguments.items() if value is not None)
        lines += paragraph(f"**{name}**{f' ({given})' if given else ''}. {about}.")
        if hasattr(own, "mass_factor_low"):
            lines += paragraph(
                f'Once per episode, uniform; `params.wrappers["{wrapper.key}"]`. Effects:',
                "[effects](../effects.md).",
            )
            lines += [*table(("what", "from", "to"), range_rows(own))]
        elif own is not None:
            rows = [(f"`{field}`", f"{value:g}") for field, value in own._asdict().items()]
            lines += [f'`params.wrappers["{wrapper.key}"]`:', "", *table(("field", "value"), rows)]
    return lines


def env_page(env_id: str) -> str:
    """Return the page of an environment id."""
    variant, env = ENVIRONMENTS[env_id], flytrack_env.make(env_id)
    history = [(version, text) for version, text in HISTORY.items()]
    return page(
        f"# {env_id}",
        "",
        *paragraph(variant.summary, DESCRIPTION),
        *wrappers_section(env),
        *action_section(env),
        *observation_section(env),
        *reward_section(env),
        *start_section(env),
        *end_section(env),
        *info_section(env),
        *arguments_section(env_id),
        "## Versions",
        "",
        *table(("version", "change"), history),
    )
