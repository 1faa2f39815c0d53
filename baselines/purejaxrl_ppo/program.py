"""PPO on one environment, compiled once for any number of seeds.

Updates run in chunks. Neither their length nor where a run was cut off and resumed changes a bit of the
result: the compiled program is one update in a loop whose length is an argument.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import flytrack_env
from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.ppo import Algorithm, Runner, make_network_for, make_ppo
from baselines.purejaxrl_ppo.resume import describe_run
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.params import EnvParams

CHUNK_STEPS = 131_072  # environment steps without a return to Python: a fraction of a second


def make_chunk(ppo: Algorithm, most: int) -> Callable[[Runner, jax.Array], tuple[Runner, Any]]:
    """Return ``chunk(runner, count) -> (runner, metrics)``: ``count`` updates, at most ``most``.

    metrics: leaves (most,), of which the first ``count`` are filled.
    """

    def chunk(runner: Runner, count: jax.Array) -> tuple[Runner, Any]:
        def one(index: jax.Array, carry: tuple[Runner, Any]) -> tuple[Runner, Any]:
            runner, rows = carry
            runner, metrics = ppo.update(runner)
            return runner, jax.tree.map(lambda row, value: row.at[index].set(value), rows, metrics)

        forms = jax.eval_shape(ppo.update, runner)[1]
        rows = jax.tree.map(lambda form: jnp.zeros((most,), form.dtype), forms)
        return jax.lax.fori_loop(0, count, one, (runner, rows))

    return jax.jit(chunk)


def with_strong_types(runner: Runner) -> Runner:
    """Return the state with JAX's weak types made strong, as they come from a file: one program for both."""

    def strong(leaf: Any) -> jax.Array:
        leaf = jnp.asarray(leaf)
        return leaf if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else jnp.asarray(leaf, leaf.dtype)

    return jax.tree.map(strong, runner)


def training_params(env: EpisodicEnvironment, config: Config) -> EnvParams:
    """Return the parameters to train with: short episodes, and a drone that is thicker than in the race."""
    params = env.default_params
    params = params.replace(
        max_steps_in_episode=config.episode_steps, drone_radius=params.drone_radius + config.gate_margin
    )
    try:
        env.check_params(params)
    except ValueError as error:
        raise ValueError(f"gate_margin: found {config.gate_margin}: {error}") from error
    return params


def track_reference(track: str | Path) -> str:
    """Return what finds a track from any folder: its name, or the absolute path of its file.

    Raises:
        ValueError: a ``Track``, which no checkpoint could name; save it to a file first.
    """
    if not isinstance(track, (str, Path)):
        raise ValueError(f"track: found a {type(track).__name__}, expected a name or the path of a file")
    return str(Path(track).resolve()) if str(track).endswith(".toml") else str(track)


class Program:
    """PPO on one environment, compiled once for any number of seeds.

    start: key -> runner. chunk: (runner, count) -> (runner, metrics) (``make_chunk``); chunk_of_many: the
    same for stacked runners of several seeds. most: updates of a chunk.

    Args:
        config: checked here. env_id, env_arguments: of ``flytrack_env.make``.

    Raises:
        ValueError: settings, id, track or model that cannot be used.
    """

    def __init__(self, config: Config, env_id: str = "FlyTrack-v0", **env_arguments: Any):
        self.config, self.env_id = config, env_id
        self.track = track_reference(env_arguments.get("track", "flytrack"))
        self.env = flytrack_env.make(env_id, **env_arguments)
        config.check()
        self.env.check_params(self.env.default_params)
        params = training_params(self.env, config)
        ppo = make_ppo(self.env, params, config)
        self.network = make_network_for(self.env, params, config)
        self.most = max(1, CHUNK_STEPS // config.batch_size)
        self.start = jax.jit(lambda key: with_strong_types(ppo.start(key)))
        self.chunk = make_chunk(ppo, self.most)
        self.chunk_of_many = jax.jit(jax.vmap(self.chunk, in_axes=(0, None)))

    def describe(self, seed: int, num_seeds: int = 1) -> dict[str, Any]:
        """Return the description of a seed's run that its checkpoints hold (``describe_run``)."""
        return describe_run(self.env, self.env_id, self.track, self.config, seed, num_seeds)
