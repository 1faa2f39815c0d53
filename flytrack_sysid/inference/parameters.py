"""Names for every number in a model, for fits, for fixed parameters and for reports."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME, EFFECTS, Range, effect_of, stick_fields, takes_motors

STICKS = ("roll", "pitch", "yaw", "thrust")
TAUS = tuple(f"tau_{stick}" for stick in STICKS)
THRUST_COEFFS = tuple(f"c{power}" for power in range(6))
MAX_RATES = tuple(f"max_rate_{stick}" for stick in STICKS[:3])
NO_BATTERY: Any = ()  # replaces a battery, because none of its numbers is fitted
DRAIN = "battery_drain_v_per_min"
BASE = (*TAUS, *THRUST_COEFFS, *MAX_RATES, "m", "g", DRAIN)
# The range in which a fit searches each parameter, and its unit. Ranges are wide enough for any
# craft that flies at 100 Hz; a result at an end is refused.
TAU_RANGE = Range(1e-3, 0.5, "s")
RANGES = {
    **dict.fromkeys(TAUS, TAU_RANGE),
    **dict.fromkeys(THRUST_COEFFS[:4], Range(-np.inf, np.inf, "N")),
    **dict.fromkeys(THRUST_COEFFS[4:], Range(-np.inf, np.inf, "N/V")),
    **dict.fromkeys(MAX_RATES, Range(1.0, 5000.0, "deg/s")),
    "m": Range(1e-3, 1e3, "kg"),
    "g": Range(-np.inf, np.inf, "m/s^2"),
    DRAIN: Range(-np.inf, np.inf, "V/min"),
}


def names_of(model: ModelParameters) -> tuple[str, ...]:
    """Return the names of all numbers in a model: the base, then ``effect.parameter``."""
    effects = [effect_of(parameters) for parameters in model.effects]
    return (*BASE, *(f"{effect.name}.{field}" for effect in effects for field in effect.ranges))


def base_of(model: ModelParameters) -> tuple[str, ...]:
    """Return the parameters that every fit frees: lags, thrust map, drain, and those of the craft.

    Lags are left out where an effect replaces them.
    """
    effects = [effect_of(parameters) for parameters in model.effects]
    taus = () if any("respond" in effect.hooks for effect in effects) else TAUS
    craft = [f"{effect.name}.{field}" for effect in effects for field in effect.search.fitted]
    return (*taus, *THRUST_COEFFS, DRAIN, *craft)


def fields_of_sticks(model: ModelParameters) -> set[str]:
    """Return the parameters of effects that act on sticks, where a model has none: motors do.

    As ``effect.parameter``; empty for a model that sticks command.
    """
    if not takes_motors(model.effects):
        return set()
    return {f"{effect.name}.{field}" for effect in EFFECTS for field in stick_fields(effect)}


def range_of(name: str) -> Range:
    """Return the range in which a fit searches a parameter, and its unit."""
    effect, _, field = name.partition(".")
    return BY_NAME[effect].ranges[field] if field else RANGES[name]


def neutral_value(name: str) -> float:
    """Return the value at which a parameter of an effect, ``effect.parameter``, does nothing."""
    effect, _, field = name.partition(".")
    return float(getattr(BY_NAME[effect].parameters(), field))


def to_vector(model: ModelParameters) -> np.ndarray:
    """Return a model's numbers except its battery's, in the order of ``names_of``, float64."""
    leaves = jax.tree.leaves(_numbers_of(model))
    return np.concatenate([np.ravel(np.asarray(leaf, float)) for leaf in leaves])


def from_vector(vector: Any, like: ModelParameters) -> ModelParameters:
    """Return a model with these numbers, and all else as in another; differentiable."""
    leaves, structure = jax.tree.flatten(_numbers_of(like))
    ends = np.cumsum([np.size(leaf) for leaf in leaves])
    reshaped = [
        jnp.reshape(vector[end - np.size(leaf) : end], np.shape(leaf))
        for leaf, end in zip(leaves, ends, strict=True)
    ]
    model = jax.tree.unflatten(structure, reshaped)
    effects = tuple(
        values._replace(**{static: getattr(given, static)})
        if (static := effect_of(given).static)
        else values
        for values, given in zip(model.effects, like.effects, strict=True)
    )
    return model._replace(battery=like.battery, effects=effects)


def _numbers_of(model: ModelParameters) -> ModelParameters:
    """Return a model of the numbers of ``names_of`` only."""
    effects = tuple(
        values._replace(**{static: ()}) if (static := effect_of(values).static) else values
        for values in model.effects
    )
    return model._replace(battery=NO_BATTERY, effects=effects)


def in_batches(program: Callable[[np.ndarray], Any], values: np.ndarray, size: int) -> np.ndarray:
    """Run a program that is compiled for ``size`` values at once on all values.

    Args:
        program: returns an array (size, ...) from values (size, ...).
        values: (num_values, ...).
        size: number of values in a batch.
    """
    results = []
    for begin in range(0, len(values), size):
        batch = values[begin : begin + size]
        padded = np.concatenate([batch, np.repeat(batch[-1:], size - len(batch), axis=0)])
        results.append(np.asarray(program(padded))[: len(batch)])
    return np.concatenate(results)


def in_float64(model: ModelParameters) -> ModelParameters:
    """Return the same model with leaves of float64."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, float), model)


def as_float32(model: ModelParameters) -> ModelParameters:
    """Return the model in the environment's precision: float32 arrays and Python floats."""

    def leaf(value: Any) -> Any:
        return np.asarray(value, np.float32) if np.ndim(value) else float(np.float32(value))

    return jax.tree.map(leaf, model)._replace(battery=model.battery)


def parameter_values(model: ModelParameters) -> dict[str, float]:
    """Return a model's numbers by name."""
    return dict(zip(names_of(model), to_vector(model).tolist(), strict=True))


def with_values(model: ModelParameters, values: Mapping[str, float]) -> ModelParameters:
    """Return the model with some numbers replaced, by name.

    Raises:
        KeyError: no number of that name in the model.
    """
    vector = to_vector(model)
    names = names_of(model)
    for name, value in values.items():
        if name not in names:
            raise KeyError(f"{name}: unknown; expected of {', '.join(names)}")
        vector[names.index(name)] = value
    return jax.tree.map(np.asarray, from_vector(vector, model))


def without_neutral_effects(model: ModelParameters) -> ModelParameters:
    """Return the same model without effects that do nothing."""
    acting = (one for one in model.effects if not all(map(np.array_equal, one, type(one)())))
    return model._replace(effects=tuple(acting))


def with_neutral_effects(model: ModelParameters, effects: Iterable[str]) -> ModelParameters:
    """Return the model with effects added where it lacks them, at their neutral values.

    Raises:
        KeyError: no effect of that name.
    """
    added = [BY_NAME[name].parameters() for name in effects]
    present = {type(parameters) for parameters in model.effects}
    return model.with_effects(
        *(parameters for parameters in added if type(parameters) not in present)
    )
