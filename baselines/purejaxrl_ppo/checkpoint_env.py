"""The environment that a checkpoint races in: its id and track, with any plant or its own model.

Plants are drawn around that model, to find which deviations a policy tolerates.
"""

import warnings
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import Checkpoint, CheckpointError
from flytrack_env.battery import BatteryWarning
from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import effect_of
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.model_file import model_from_json
from flytrack_env.params import EnvParams
from flytrack_env.plants import Plant
from flytrack_env.tracks import Track
from flytrack_env.wrappers import DomainRandomization, RandomizationParams

MODEL_AS_GIVEN = RandomizationParams(
    1.0, 1.0, 1.0, 1.0, 1.0, 1.0, low=(), high=()
)  # all factors are 1
NUM_DRAWS = 7  # drag on three axes, thrust, wind and where it blows, delay
# Drawn uniformly; what the robust baseline must tolerate. The drag is added to the model's on each
# body axis independently, the wind from any direction, and the delay; the thrust is multiplied.
RANGES = {
    "quadratic_drag_per_m": (0.0, 0.02),
    "thrust_scale": (0.88, 1.05),
    "wind_m_s": (0.0, 3.0),
    "command_delay_s": (0.0, 0.02),
}


def plant_env(
    checkpoint: Checkpoint, plant: Plant, track: str | Path | Track | None = None
) -> EpisodicEnvironment:
    """Return the checkpoint's environment with a plant in place of the simulator.

    The plant may be a black box, for example.

    Args:
        track: name or file; the checkpoint's if None.

    Raises:
        CheckpointError, TrackError: a checkpoint that does not fit, a track that cannot be used.
    """
    env = _checked_env(checkpoint, track, plant=plant)
    if "model" in checkpoint.meta:
        trained = model_from_json(checkpoint.meta["model"], "checkpoint: model").battery
        flown = env.default_params.model.battery
        ends = np.array([[float(one.empty_v), float(one.full_v)] for one in (trained, flown)])
        if not np.allclose(ends[0], ends[1]):
            text = (
                f"checkpoint: trained with a battery of {trained.describe()}, and the plant's has "
                f"{flown.describe()}: the policy meets another thrust"
            )
            warnings.warn(BatteryWarning(text), stacklevel=2)
    return env


def simulated_env(
    checkpoint: Checkpoint, track: str | Path | Track | None = None
) -> EpisodicEnvironment:
    """Return the checkpoint's environment with the simulator and the model that it was trained on.

    Raises:
        CheckpointError: a file that cannot be used, a checkpoint that does not hold its model.
        TrackError: a track that cannot be used.
    """
    if "model" not in checkpoint.meta:
        raise CheckpointError("checkpoint: model: found none, expected the one it was trained on")
    return _checked_env(
        checkpoint, track, model=model_from_json(checkpoint.meta["model"], "checkpoint: model")
    )


def _checked_env(
    checkpoint: Checkpoint, track: str | Path | Track | None, **arguments: Any
) -> EpisodicEnvironment:
    env = flytrack_env.make(
        checkpoint.env_id,
        track=checkpoint.track if track is None else track,
        missed_gate=checkpoint.meta["missed_gate"],
        **arguments,
    )
    checkpoint.check_fits(env)
    env.check_params(env.default_params)
    return env


def with_model_as_given(params: EnvParams) -> EnvParams:
    """Return parameters that keep the given model where the id randomises it in every episode."""
    if DomainRandomization.key not in params.wrappers:
        return params
    return params.replace(wrappers={**params.wrappers, DomainRandomization.key: MODEL_AS_GIVEN})


class Plants(NamedTuple):
    """Drawn plants.

    Attributes:
        models: leaves (num_plants, ...).
        drawn: values by the names of ``RANGES``, (num_plants,) each; of the drag, the mean of the
            three axes.
    """

    models: ModelParameters
    drawn: dict[str, np.ndarray]

    def model(self, index: int) -> ModelParameters:
        """Return the model of one plant."""
        return jax.tree.map(lambda leaf: leaf[index], self.models)

    def repeated(self, times: int) -> ModelParameters:
        """Return every model repeated, leaves (num_plants * times, ...)."""
        return jax.tree.map(lambda leaf: np.repeat(leaf, times, axis=0), self.models)


def draw_plants(seed: int, num_plants: int, model: ModelParameters) -> Plants:
    """Draw plants around a model; a smaller number returns the first of the same plants."""
    # Row by row, so that the first plants do not depend on how many there are.
    uniform = np.random.default_rng(seed).uniform(size=(num_plants, NUM_DRAWS))
    return Plants(*jax.tree.map(np.asarray, jax.vmap(partial(make_plant, model))(uniform)))


def draw_model(key: jax.Array, model: ModelParameters) -> ModelParameters:
    """Draw the model of a plant around a model, as ``draw_plants`` draws them."""
    return make_plant(model, jax.random.uniform(key, (NUM_DRAWS,)))[0]


def make_plant(
    model: ModelParameters, uniform: Any
) -> tuple[ModelParameters, dict[str, jax.Array]]:
    """Return a plant around a model: drag, wind and delay are added, and the thrust is multiplied.

    Args:
        model: that the plant is around; values are clipped to the ranges of its effects.
        uniform: random numbers from 0 to 1, (NUM_DRAWS,).

    Returns:
        The plant's model, and its drawn values by the names of ``RANGES``.
    """

    def scale(columns: Any, low: float, high: float) -> Any:
        return low + (high - low) * uniform[columns]

    drag_per_m = scale(slice(0, 3), *RANGES["quadratic_drag_per_m"])
    thrust_scale = scale(3, *RANGES["thrust_scale"])
    wind_m_s, heading_rad = scale(4, *RANGES["wind_m_s"]), scale(5, -np.pi, np.pi)
    delay_s = scale(6, *RANGES["command_delay_s"])
    drag, wind = model.effect("quadratic_drag"), model.effect("wind")
    thrust, delay = model.effect("thrust_scale"), model.effect("command_delay")
    changed = model.with_effects(
        _clipped(
            drag,
            k_x=drag.k_x + drag_per_m[0],
            k_y=drag.k_y + drag_per_m[1],
            k_z=drag.k_z + drag_per_m[2],
        ),
        _clipped(
            wind,
            v_x=wind.v_x + wind_m_s * jnp.cos(heading_rad),
            v_y=wind.v_y + wind_m_s * jnp.sin(heading_rad),
        ),
        _clipped(thrust, factor=thrust.factor * thrust_scale),
        _clipped(delay, delay_s=delay.delay_s + delay_s),
    )
    return changed, dict(
        zip(RANGES, (drag_per_m.mean(), thrust_scale, wind_m_s, delay_s), strict=True)
    )


def _clipped(parameters: Any, **values: jax.Array) -> Any:
    """Return an effect's parameters with new values, clipped to its ranges."""
    ranges = effect_of(parameters).ranges
    clipped = {
        name: jnp.clip(value, ranges[name].low, ranges[name].high) for name, value in values.items()
    }
    return parameters._replace(**clipped)
