"""A training: PPO compiled once, in chunks of updates, for any number of runs (``run.py``).

How long the chunks are, and where a run was cut off and taken up again, changes no bit of its result:
the compiled program is one update in a loop whose length is an argument.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import Checkpoint
from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.distributed import (
    check_agree,
    check_divides,
    digest,
    is_first,
    on_devices,
    spread,
    wait_for_all,
    whole,
)
from baselines.purejaxrl_ppo.journal import forget
from baselines.purejaxrl_ppo.named_arrays import is_key
from baselines.purejaxrl_ppo.options import Options
from baselines.purejaxrl_ppo.ppo import Algorithm, Runner, make_network_for, make_ppo
from baselines.purejaxrl_ppo.resume import (
    check_same_run,
    describe_run,
    newest_intact,
    own_start,
    restore_runner,
    take_over,
    warn_of_other_bits,
)
from baselines.purejaxrl_ppo.run import Metrics, Run
from baselines.purejaxrl_ppo.run_folder import FINAL, begins, check_free, remove_half_written
from baselines.purejaxrl_ppo.side_by_side import Ready, finish, groups_of
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.params import EnvParams

CHUNK_STEPS = 131_072  # environment steps between two looks from outside: a fraction of a second


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
        return leaf if is_key(leaf) else jnp.asarray(leaf, leaf.dtype)

    return jax.tree.map(strong, runner)


def training_params(env: EpisodicEnvironment, config: Config) -> EnvParams:
    """Return the parameters to train with: short episodes, and a drone that is thicker than in the race.

    Raises:
        ValueError: a margin that leaves no opening.
    """
    params = env.default_params
    params = params.replace(
        max_steps_in_episode=config.episode_steps, drone_radius=params.drone_radius + config.gate_margin
    )
    try:
        env.check_params(params)
    except ValueError as error:
        raise ValueError(f"gate_margin: found {config.gate_margin}: {error}") from error
    return params


class Trainer:
    """PPO on one environment, compiled once for any number of seeds; ``steps``: of the run under way.

    mesh: of the devices that the environments are spread over (``distributed.all_devices``); None: one.

    Raises:
        ValueError: settings, id, track or model that cannot be used, before any training.
    """

    def __init__(
        self, config: Config, env_id: str = "FlyTrack-v0", mesh: Mesh | None = None, **env_arguments: Any
    ):
        self.config, self.env_id = config, env_id
        self.mesh = mesh if mesh is not None and mesh.size > 1 else None
        self.track = track_reference(env_arguments.get("track", "flytrack"))
        self.env = flytrack_env.make(env_id, **env_arguments)
        config.check()
        self.env.check_params(self.env.default_params)
        params = training_params(self.env, config)
        if self.mesh is None:
            ppo = make_ppo(self.env, params, config)
        else:
            check_divides(config, self.mesh)
            ppo = on_devices(make_ppo(self.env, params, config, self.mesh.size), self.mesh)
        self.network = make_network_for(self.env, params, config)
        self.most = max(1, CHUNK_STEPS // config.batch_size)
        self.steps = 0
        self.start = jax.jit(lambda key: with_strong_types(ppo.start(key)))
        self.chunk = make_chunk(ppo, self.most)
        self.chunk_of_many = jax.jit(jax.vmap(self.chunk, in_axes=(0, None)))

    def train(self, out: Path, seed: int, options: Options) -> tuple[Checkpoint, Metrics]:
        """Train and write ``out``/final.msgpack; return it, and the metrics of every update made here.

        A run that is complete stays as it is.

        Raises:
            CheckpointError: a checkpoint to go on from that cannot be used or is of another run.
            ValueError: ``out`` holds another run.
            DivergedError: numbers that are not finite.
        """
        return self.train_all([(out, seed, options)])[0]

    def train_all(self, asked: list[tuple[Path, int, Options]]) -> list[tuple[Checkpoint, Metrics]]:
        """Train seeds side by side, in one program: as ``train``, for each folder, seed and options.

        Seeds that are not as far as each other, or are looked at at other times, train one after the other.
        """
        runs, ready = [], list[Ready]()
        for out, seed, options in asked:
            run, start = self._prepare(out, seed, options, len(asked))
            runs.append(run)
            ready += [start] if start is not None else []
        for group in groups_of(ready):
            finish(self, group)
        if self.mesh is not None:
            wait_for_all("trained")
        return [run.result() for run in runs]

    def _prepare(self, out: Path, seed: int, options: Options, number: int) -> tuple[Run, Ready | None]:
        """Return a run and how it begins or goes on; None where it is complete. number: side by side."""
        options.check()
        source = options.resume
        check_free(out, source)
        is_new = begins(out, source)
        description = self.describe(seed, number)
        if self.mesh is not None:
            wait_for_all("checked")  # before the first process writes what the others would find
            shared = {name: value for name, value in description.items() if name != "machine"}
            check_agree("settings", digest([options._replace(report=None), shared]))
        key = jax.random.key(seed)
        if is_first():
            remove_half_written(out)
            if source is None:
                forget(out)
        if source is None or is_new:
            run = Run(self, out, description, options._replace(resume=None))
            return run, Ready(run, self.start(key), 0)
        path, checkpoint = newest_intact(source)
        check_same_run(path, checkpoint, description)
        take_over([(out, (path, checkpoint))])
        path = own_start(out, (path, checkpoint))
        run = Run(self, out, description, options._replace(resume=path), checkpoint.meta)
        update = checkpoint.meta["steps"] // self.config.batch_size
        self.steps = checkpoint.meta["steps"]
        if update == self.config.num_updates and path.resolve() == (out / FINAL).resolve():
            run.send_unsent()
            return run, None
        warn_of_other_bits(path, checkpoint, description)
        runner = restore_runner(path, checkpoint, jax.eval_shape(self.start, key))
        if self.mesh is not None:
            check_agree(f"{path}: steps", checkpoint.meta["steps"])
            runner = spread(runner, self.mesh)
        return run, Ready(run, runner, update)

    def whole(self, runner: Runner) -> Runner:
        """Return the state as this process can read it; on several devices all processes have to ask."""
        return runner if self.mesh is None else whole(runner, self.mesh)

    def policy_of(self, runner: Runner) -> Any:
        """Return the network's parameters as this process alone can compute with."""
        params = runner.train_state.params
        return params if self.mesh is None else jax.tree.map(np.asarray, params)

    def describe(self, seed: int, number: int = 1) -> dict[str, Any]:
        """Return what the run of a seed is, as its checkpoints say. number: of seeds side by side."""
        return describe_run(self.env, self.env_id, self.track, self.config, seed, number)


def track_reference(track: str | Path) -> str:
    """Return what finds a track from any folder: its name, or the absolute path of its file.

    Raises:
        ValueError: a ``Track``, which no checkpoint could name; save it to a file first.
    """
    if not isinstance(track, (str, Path)):
        raise ValueError(f"track: found a {type(track).__name__}, expected a name or the path of a file")
    return str(Path(track).resolve()) if str(track).endswith(".toml") else str(track)


def train_policy(
    out: Path,
    config: Config,
    seed: int,
    env_id: str = "FlyTrack-v0",
    options: Options = Options(),  # noqa: B008, a tuple of constants
    **env_arguments: Any,
) -> tuple[Checkpoint, Metrics]:
    """Train and write ``out``/final.msgpack; return the checkpoint and the metrics, one value per update.

    env_arguments: of ``flytrack_env.make``. Where training goes on (``options.resume``), the metrics are
    those since then.

    Raises:
        ValueError: settings, id, track, model or checkpoint that cannot be used, or ``out`` that holds
            another run, before any training.
        DivergedError: numbers that are not finite.
    """
    return Trainer(config, env_id, **env_arguments).train(out, seed, options)
