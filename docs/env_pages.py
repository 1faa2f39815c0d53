"""A page per environment id."""

from typing import Any

import jax
import jax.numpy as jnp

import flytrack_env
from docs.markdown import field_texts, render, sentence
from flytrack_env.effects import effect_of
from flytrack_env.registration import ENVIRONMENTS
from flytrack_env.rewards import TERMS
from flytrack_env.terminations import Causes
from flytrack_env.wrappers import RandomizationParams, Wrapper, layers_of

INFO = {  # its keys that are not causes of termination
    "gates_passed": "gates passed in this episode",
    "laps": "laps completed; a lap is as many gates as the track has, wherever the episode began",
    "lap_completed": "whether a lap was completed in this step",
    "lap_time_s": (
        "time of the last complete lap, interpolated at the crossing, s; 0 before the first"
    ),
    "gate_distance_m": "distance to the centre of the next gate, m",
    "terminated": "as returned",
    "truncated": "as returned",
    "final_observation": "the observation before auto-reset",
}


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
    layer = {
        "name": type(wrapper).__name__,
        "about": sentence(type(wrapper).__doc__),
        "key": wrapper.key,
    }
    if isinstance(own, RandomizationParams):
        return {**layer, "columns": ("from", "to"), "rows": range_rows(own)}
    rows = (
        [(f"`{name}`", f"{value:g}") for name, value in own._asdict().items()]
        if own is not None
        else []
    )
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
        layers=[
            layer_of(layer) for layer in reversed(layers_of(env)) if isinstance(layer, Wrapper)
        ],
        is_randomised="domain_randomization" in (params.wrappers or {}),
        size=observation.size,
        image=None if env.image_shape is None else " x ".join(map(str, env.image_shape)),
        observation=observation_rows(env),
        terms={term.__name__: sentence(term.__doc__) for term in TERMS},
        causes={name: causes[name] for name in Causes._fields},
        info={name: INFO[name] for name in info if name not in Causes._fields},
    )
