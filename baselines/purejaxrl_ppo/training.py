"""A training run: compiled chunks of updates, and between them checkpoints, evaluations, tracking, a line.

How long the chunks are, and where a run was cut off and taken up again, changes no bit of its result:
the compiled program is one update in a loop whose length is an argument.
"""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import Checkpoint, load_checkpoint
from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.metrics import summarise_updates
from baselines.purejaxrl_ppo.monitor import LiveLine, evaluate_policy, record_flight
from baselines.purejaxrl_ppo.named_arrays import is_key
from baselines.purejaxrl_ppo.ppo import Algorithm, Runner, make_network_for, make_ppo
from baselines.purejaxrl_ppo.resume import (
    FINAL,
    check_same_run,
    describe_run,
    newest_intact,
    restore_runner,
    save_run,
)
from baselines.purejaxrl_ppo.tracking import Tracker

CHUNK_STEPS = 131_072  # environment steps between two looks from outside: a fraction of a second

Metrics = dict[str, np.ndarray]


class Options(NamedTuple):
    """What a run does beside training; none of it changes the result.

    checkpoint_every, evaluate_every: environment steps; None: only the final checkpoint, no evaluation.
    evaluation_episodes: noisy starts of an evaluation. tracking_uri: MLflow store; None: no tracking.
    resume: checkpoint, or folder of checkpoints, to go on from.
    """

    checkpoint_every: int | None = None
    evaluate_every: int | None = None
    evaluation_episodes: int = 64
    tracking_uri: str | None = None
    resume: Path | None = None

    def check(self) -> None:
        """Raise ValueError, naming the option, for numbers that are not positive."""
        for name in ("checkpoint_every", "evaluate_every", "evaluation_episodes"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name}: found {value}, expected at least 1")


def next_due(update: int, every: int | None, batch_size: int) -> float:
    """Return the first update, after one, that reaches another multiple of ``every`` environment steps."""
    if every is None:
        return float("inf")
    reached = update * batch_size // every
    return -(-(reached + 1) * every // batch_size)


def is_due(update: int, every: int | None, batch_size: int) -> bool:
    """Return whether an update reaches another multiple of ``every`` environment steps."""
    return next_due(update - 1, every, batch_size) == update


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


class Trainer:
    """PPO on one environment, compiled once for any number of seeds.

    Raises:
        ValueError: settings, id, track or model that cannot be used, before any training.
    """

    def __init__(self, config: Config, env_id: str = "FlyTrack-v0", **env_arguments: Any):
        self.config, self.env_id = config, env_id
        self.track = track_reference(env_arguments.get("track", "flytrack"))
        self.env = flytrack_env.make(env_id, **env_arguments)
        config.check()
        self.env.check_params(self.env.default_params)
        params = self.env.default_params.replace(max_steps_in_episode=config.episode_steps)
        ppo = make_ppo(self.env, params, config)
        self.network = make_network_for(self.env, params, config)
        self.most = max(1, CHUNK_STEPS // config.batch_size)
        self.start = jax.jit(lambda key: with_strong_types(ppo.start(key)))
        self.chunk = make_chunk(ppo, self.most)

    def train(self, out: Path, seed: int, options: Options) -> tuple[Checkpoint, Metrics]:
        """Train and write ``out``/final.msgpack; return it, and the metrics of every update made here.

        Raises:
            CheckpointError: a checkpoint to go on from that cannot be used or is of another run.
        """
        options.check()
        description = describe_run(self.env, self.env_id, self.track, self.config, seed)
        key = jax.random.key(seed)
        if options.resume is None:
            runner, update, seconds = self.start(key), 0, 0.0
        else:
            path, checkpoint = newest_intact(options.resume)
            check_same_run(path, checkpoint, description)
            runner = restore_runner(path, checkpoint, jax.eval_shape(self.start, key))
            update = checkpoint.meta["steps"] // self.config.batch_size
            seconds = float(checkpoint.meta["seconds"])
        return Run(self, out, description, options, seconds).finish(runner, update)


class Chunk(NamedTuple):
    """Where a training stands after some updates: state, updates so far, metrics and rate of the chunk."""

    runner: Runner
    update: int
    metrics: Metrics
    steps_per_second: float


class Run:
    """One seed's training under way: where it writes, and who is told of it."""

    def __init__(
        self, trainer: Trainer, out: Path, description: dict[str, Any], options: Options, seconds: float
    ):
        self.trainer, self.config, self.out = trainer, trainer.config, out
        self.description, self.options = description, options
        self.started_s = time.perf_counter() - seconds
        self.tracker: Tracker | None = None
        out.mkdir(parents=True, exist_ok=True)

    def finish(self, runner: Runner, update: int) -> tuple[Checkpoint, Metrics]:
        """Train from an update on to the end; return the final checkpoint and the metrics since."""
        if self.options.checkpoint_every is not None and update == 0:
            self.checkpoint("step_0.msgpack", runner, update)
        if self.options.tracking_uri is not None:
            self.tracker = self._make_tracker(self.options.tracking_uri)
        batch_size = self.config.batch_size
        line = LiveLine(self.config.num_updates * batch_size, update * batch_size)
        status = "FAILED"
        try:
            rows = []
            self.trainer.chunk(runner, jnp.int32(0))  # compiles
            line.begin()
            for chunk in self._chunks(runner, update):
                runner = chunk.runner
                rows.append(chunk.metrics)
                self._between_chunks(chunk, line)
            path = self.checkpoint(FINAL, runner, self.config.num_updates)
            status = "FINISHED"
        except KeyboardInterrupt:
            status = "KILLED"
            raise
        finally:
            line.close()
            if self.tracker is not None:
                self.tracker.end(status)
        metrics = jax.tree.map(lambda *parts: np.concatenate(parts), *rows) if rows else {}
        return load_checkpoint(path), metrics

    def _make_tracker(self, uri: str) -> Tracker:
        """Return who tells MLflow; parameters are the whole description but the observation's table."""
        params = {name: value for name, value in self.description.items() if name != "observation"}
        software = {"flytrack": flytrack_env.__version__, "jax": jax.__version__}
        device = f"{jax.device_count()} {jax.default_backend()}"
        params |= {"version": software, "device": device}
        name = f"{self.trainer.env_id} {Path(self.trainer.track).stem} seed {self.description['seed']}"
        return Tracker(self.out, uri, name, params, is_new=self.options.resume is None)

    def _chunks(self, runner: Runner, update: int) -> Iterator[Chunk]:
        """Train, yielding between chunks."""
        config, options = self.config, self.options
        while update < config.num_updates:
            due = (
                next_due(update, every, config.batch_size)
                for every in (options.checkpoint_every, options.evaluate_every)
            )
            count = int(min(*due, update + self.trainer.most, config.num_updates)) - update
            started_s = time.perf_counter()
            runner, rows = jax.block_until_ready(self.trainer.chunk(runner, jnp.int32(count)))
            rate = count * config.batch_size / (time.perf_counter() - started_s)
            update += count
            metrics = {name: np.asarray(row)[:count] for name, row in rows.items()}
            yield Chunk(runner, update, metrics, rate)

    def _between_chunks(self, chunk: Chunk, line: LiveLine) -> None:
        """Show, store, evaluate and tell what is due after a chunk."""
        config, options = self.config, self.options
        runner, update = chunk.runner, chunk.update
        steps, is_last = update * config.batch_size, update == config.num_updates
        values = {**summarise_updates(chunk.metrics), "steps_per_second": chunk.steps_per_second}
        line.trained(steps, values["last_return"])
        if not is_last and is_due(update, options.checkpoint_every, config.batch_size):
            self.checkpoint(f"step_{steps}.msgpack", runner, update)
        if options.evaluate_every and (is_last or is_due(update, options.evaluate_every, config.batch_size)):
            evaluation = self._evaluate(runner, steps, is_last)
            line.evaluated(evaluation)
            values = {**values, **evaluation}
        if self.tracker is not None:
            self.tracker.metrics(steps, values)

    def _evaluate(self, runner: Runner, steps: int, is_last: bool) -> dict[str, float]:
        """Fly and draw the policy as it is; return the metrics."""
        env, params = self.trainer.env, runner.train_state.params
        metrics, files = evaluate_policy(
            env, self.trainer.network, params, self.options.evaluation_episodes, self.out, steps
        )
        if is_last and (recording := record_flight(files[0], env.track)) is not None:
            files.append(recording)
        for path in files:
            self._tell(path, "evaluation")
        return metrics

    def checkpoint(self, name: str, runner: Runner, update: int) -> Path:
        """Write a checkpoint and return its path."""
        path = self.out / name
        progress = {
            "steps": update * self.config.batch_size,
            "seconds": round(time.perf_counter() - self.started_s, 1),
        }
        save_run(path, runner, self.config, {**self.description, **progress})
        self._tell(path, "checkpoints")
        return path

    def _tell(self, path: Path, group: str) -> None:
        if self.tracker is not None:
            self.tracker.file(path, group)


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
        ValueError: settings, id, track, model or checkpoint that cannot be used, before any training.
    """
    return Trainer(config, env_id, **env_arguments).train(out, seed, options)
