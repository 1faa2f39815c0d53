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
from baselines.purejaxrl_ppo.report import share
from flytrack_env.battery import BatteryWarning
from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import effect_of
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.model_file import model_from_json
from flytrack_env.params import EnvParams
from flytrack_env.plants import Plant
from flytrack_env.tracks import Track
from flytrack_env.wrappers import DomainRandomization, RandomizationParams

MODEL_AS_GIVEN = RandomizationParams(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, low=(), high=())  # all factors are 1
NUM_DRAWS = 7  # drag on three axes, thrust, wind and where it blows, delay
# Drawn uniformly; what the robust baseline must tolerate. The drag is added to the model's on each body axis
# independently, the wind from any direction, and the delay; the thrust is multiplied.
RANGES = {
    "quadratic_drag_per_m": (0.0, 0.02),
    "thrust_scale": (0.88, 1.05),
    "wind_m_s": (0.0, 3.0),
    "command_delay_s": (0.0, 0.02),
}


def plant_env(
    checkpoint: Checkpoint, plant: Plant, track: str | Path | Track | None = None
) -> EpisodicEnvironment:
    """Return the checkpoint's environment with a plant (a black box, say) in place of the simulator.

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


def simulated_env(checkpoint: Checkpoint, track: str | Path | Track | None = None) -> EpisodicEnvironment:
    """Return the checkpoint's environment with the simulator and the model that it was trained on.

    Raises:
        CheckpointError, TrackError: a file that cannot be used, a checkpoint that does not hold its model.
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
    """Return parameters with which an id that randomises the model in every episode keeps the given one."""
    if DomainRandomization.key not in params.wrappers:
        return params
    return params.replace(wrappers={**params.wrappers, DomainRandomization.key: MODEL_AS_GIVEN})


class Plants(NamedTuple):
    """Drawn plants.

    models: leaves (num_plants, ...). drawn: values by the names of ``RANGES``, (num_plants,) each; of
    the drag, the mean of the three axes.
    """

    models: ModelParameters
    drawn: dict[str, np.ndarray]

    def model(self, index: int) -> ModelParameters:
        """Return the model of one plant."""
        return jax.tree.map(lambda leaf: leaf[index], self.models)

    def repeated(self, times: int) -> ModelParameters:
        """Return every model repeated, leaves (num_plants * times, ...)."""
        return jax.tree.map(lambda leaf: np.repeat(leaf, times, axis=0), self.models)

    def summarise(self, is_complete: np.ndarray) -> dict[str, Any]:
        """Return on how many plants every flight completes its laps, as JSON values.

        is_complete: (num_plants, num_episodes), of flights.
        """
        return {
            "success": share(np.asarray(is_complete.all(axis=1))),
            "ranges": {name: list(bounds) for name, bounds in RANGES.items()},
            "by_thirds": by_thirds(self.drawn, is_complete),
        }


def perturb(
    model: ModelParameters, drag_per_m: Any, thrust_scale: Any, wind_w_m_s: Any, delay_s: Any
) -> ModelParameters:
    """Return one plant: a model with drag, wind and delay added, and its thrust multiplied.

    drag_per_m: quadratic, (3,), body axes, 1/m. wind_w_m_s: (2,), horizontal velocity of the air, world, m/s.
    Values are clipped to the effects' ranges.
    """
    drag, wind = model.effect("quadratic_drag"), model.effect("wind")
    thrust, delay = model.effect("thrust_scale"), model.effect("command_delay")
    return model.with_effects(
        _clipped(
            drag, k_x=drag.k_x + drag_per_m[0], k_y=drag.k_y + drag_per_m[1], k_z=drag.k_z + drag_per_m[2]
        ),
        _clipped(wind, v_x=wind.v_x + wind_w_m_s[0], v_y=wind.v_y + wind_w_m_s[1]),
        _clipped(thrust, factor=thrust.factor * thrust_scale),
        _clipped(delay, delay_s=delay.delay_s + delay_s),
    )


def _clipped(parameters: Any, **values: jax.Array) -> Any:
    """Return an effect's parameters with new values, clipped to its ranges."""
    ranges = effect_of(parameters).ranges
    return parameters._replace(
        **{name: jnp.clip(value, ranges[name].low, ranges[name].high) for name, value in values.items()}
    )


def draw_plants(seed: int, num_plants: int, model: ModelParameters) -> Plants:
    """Return plants around a model (``perturb``); a smaller number returns the first of the same plants."""
    # Row by row, so that the first plants do not depend on how many there are.
    uniform = np.random.default_rng(seed).uniform(size=(num_plants, NUM_DRAWS))
    models, drawn = jax.vmap(partial(plant_of, model=model))(uniform)
    return Plants(jax.tree.map(np.asarray, models), {name: np.asarray(one) for name, one in drawn.items()})


def draw_model(key: jax.Array, model: ModelParameters) -> ModelParameters:
    """Return the model of a plant drawn around a model, as ``draw_plants`` draws them."""
    return plant_of(jax.random.uniform(key, (NUM_DRAWS,)), model)[0]


def plant_of(uniform: Any, model: ModelParameters) -> tuple[ModelParameters, dict[str, jax.Array]]:
    """Return a plant and what of it is drawn, by the names of ``RANGES``; uniform: (NUM_DRAWS,), 0 to 1."""

    def draw(columns: Any, bounds: tuple[float, float]) -> jax.Array:
        return bounds[0] + (bounds[1] - bounds[0]) * uniform[columns]

    drag, thrust = draw(slice(0, 3), RANGES["quadratic_drag_per_m"]), draw(3, RANGES["thrust_scale"])
    wind, heading_rad = draw(4, RANGES["wind_m_s"]), draw(5, (-np.pi, np.pi))
    delay = draw(6, RANGES["command_delay_s"])
    wind_w = wind * jnp.stack([jnp.cos(heading_rad), jnp.sin(heading_rad)])
    return perturb(model, drag, thrust, wind_w, delay), dict(
        zip(RANGES, (drag.mean(), thrust, wind, delay), strict=True)
    )


def by_thirds(drawn: dict[str, np.ndarray], is_complete: np.ndarray) -> list[dict[str, Any]]:
    """Return how success depends on each drawn quantity, as JSON values: a row per third of the plants.

    is_complete: (num_plants, num_episodes), of flights. from, to: smallest and largest value in the third.
    """
    rows = []
    for name, values in drawn.items():
        for third, plants in enumerate(np.array_split(np.argsort(values, kind="stable"), 3)):
            if plants.size:
                rows.append(
                    {
                        "quantity": name,
                        "third": third + 1,
                        "from": float(values[plants].min()),
                        "to": float(values[plants].max()),
                        "plants": share(np.asarray(is_complete[plants].all(axis=1))),
                        "flights_share": float(is_complete[plants].mean()),
                    }
                )
    return rows
