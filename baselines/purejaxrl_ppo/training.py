"""Trainings: seeds begun or resumed, checked before anything is written, trained alone or side by side.

Updates run in chunks. Neither their length nor where a run was cut off and resumed changes a bit of the
result: the compiled program is one update in a loop whose length is an argument.
"""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tyro.conf import Suppress

import flytrack_env
from baselines.purejaxrl_ppo import checkpoint as files
from baselines.purejaxrl_ppo.checkpoint import Checkpoint
from baselines.purejaxrl_ppo.config import Config, Count
from baselines.purejaxrl_ppo.metrics import summarise_updates
from baselines.purejaxrl_ppo.monitor import ProgressLine, evaluate_policy
from baselines.purejaxrl_ppo.networks import Policy
from baselines.purejaxrl_ppo.ppo import Algorithm, Runner, make_network_for, make_ppo
from baselines.purejaxrl_ppo.tracking import RUN_FILE, Tracker
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.files import locked_folder
from flytrack_env.params import EnvParams

Metrics = dict[str, np.ndarray]
CHUNK_STEPS = 131_072  # environment steps without a return to Python: a fraction of a second
MAY_BE_UNDEFINED = "explained_variance"  # where all returns are the same there is no variance to explain
MOST_NAMES = 4  # in the message on numbers that are not finite: where one is not, most soon are not


class DivergedError(ValueError):
    """A training whose numbers are not finite any more; the message says since when, and what to do."""


class Options(NamedTuple):
    """What a run does beside training; none of it changes the result."""

    checkpoint_every: Count = 0
    """Write step_<N>.safetensors every so many environment steps; 0: only at the end."""
    evaluate_every: Count = 0
    """Fly and draw the policy every so many environment steps; 0: never."""
    evaluation_episodes: int = 64
    """Noisy starts of an evaluation."""
    tracking_uri: str = ""
    """MLflow store; local: an SQLite file in OUT."""
    resume: Suppress[Path | None] = None
    """Checkpoint, or folder of checkpoints, to continue from."""
    seeds: Suppress[tuple[int, ...]] = ()
    """That one command trains, this one among them."""

    def check(self) -> None:
        """Raise ValueError, naming the option, for numbers out of range."""
        least = {"checkpoint_every": 0, "evaluate_every": 0, "evaluation_episodes": 1}
        for name, low in least.items():
            if getattr(self, name) < low:
                raise ValueError(f"{name}: found {getattr(self, name)}, expected at least {low}")


class Task(NamedTuple):
    """One seed's run: its folder, its seed, its options, and where it continues from, if anywhere."""

    out: Path
    seed: int
    options: Options
    start: Checkpoint | None = None


def next_due(update: int, every: int, batch_size: int) -> float:
    """Return the first update, after one, that reaches another multiple of ``every`` environment steps."""
    if not every:
        return float("inf")
    reached = update * batch_size // every
    return -(-(reached + 1) * every // batch_size)


def is_due(update: int, every: int, batch_size: int) -> bool:
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


class Trainer:
    """PPO on one environment, compiled once for any number of seeds.

    start: key -> runner. chunk: (runner, count) -> (runner, metrics) (``make_chunk``); chunk_of_many: the
    same for stacked runners of several seeds. most: updates of a chunk. steps: of the run under way.

    Args:
        config: checked here. env_id, env_arguments: of ``flytrack_env.make``.

    Raises:
        ValueError: settings, id, track or model that cannot be used.
    """

    def __init__(self, config: Config, env_id: str = "FlyTrack-v0", **env_arguments: Any):
        self.config, self.env_id, self.steps = config, env_id, 0
        self.track = track_reference(env_arguments.get("track", "flytrack"))
        self.env = flytrack_env.make(env_id, **env_arguments)
        config.check()
        self.env.check_params(self.env.default_params)
        params = training_params(self.env, config)
        ppo = make_ppo(self.env, params, config)
        self.network = make_network_for(self.env, params, config)
        self.most = max(1, CHUNK_STEPS // config.batch_size)
        # Weak types become strong ones, as they come from a file: one program for both.
        strong = partial(jax.tree.map, lambda leaf: jnp.asarray(leaf).astype(jnp.asarray(leaf).dtype))
        self.start = jax.jit(lambda key: strong(ppo.start(key)))
        self.chunk = make_chunk(ppo, self.most)
        self.chunk_of_many = jax.jit(jax.vmap(self.chunk, in_axes=(0, None)))

    def train(self, out: Path, seed: int, options: Options) -> tuple[Checkpoint, Metrics]:
        """Train and write ``out``/final.safetensors; return it, and the metrics of every update made here.

        A run that is complete stays as it is.

        Raises:
            CheckpointError: a checkpoint to continue from that cannot be used or is of another run.
            ValueError: ``out`` holds another run.
            DivergedError: numbers that are not finite.
        """
        return self.run(self.prepare([Task(out, seed, options)]))[0]

    def prepare(self, tasks: list[Task]) -> list["Run"]:
        """Return the runs of seeds that train side by side; raises as ``train``, and nothing is written."""
        runs = [Run(self, task, len(tasks)) for task in tasks]
        for run in runs:
            run.options.check()
            files.check_free(run.out, run.start)
            if run.start is not None:
                files.check_same_run(run.start, run.description)
        return runs

    def run(self, runs: list["Run"]) -> list[tuple[Checkpoint, Metrics]]:
        """Train prepared runs; those that are as far as each other side by side.

        Raises:
            OSError: another process trains into the folder of one.
        """
        with ExitStack() as held:
            for run in runs:
                held.enter_context(locked_folder(run.out))
                files.check_free(run.out, run.start)  # another may have written since it was prepared
            left = [run for run in runs if run.load()]
            are_together = len({(run.update, run.options._replace(resume=None)) for run in left}) == 1
            for group in [left] if are_together else [[run] for run in left]:
                with kept_interrupts() as check_interrupt:
                    train_group(self, group, check_interrupt)
            return [run.result() for run in runs]


class Run:
    """One seed's training, and the files and the MLflow run that it writes.

    update: updates behind it. rows: metrics of the chunks. success, best_lap_s: of the last evaluation, and
    the shortest flying lap of all; None before the first. error: since its numbers are not finite.
    """

    runner: Runner

    def __init__(self, trainer: Trainer, task: Task, num_seeds: int):
        """num_seeds: that train side by side, this one among them."""
        self.trainer, self.config = trainer, trainer.config
        self.out, self.seed, self.options, self.start = task
        if self.start is None and self.options.resume is not None:
            self.start = files.newest_intact(self.options.resume)
        before = {} if self.start is None else self.start.meta
        self.update = before.get("steps", 0) // self.config.batch_size
        self.seconds_before = before.get("seconds", 0.0)
        self.success: float | None = before.get("success")
        self.best_lap_s: float | None = before.get("best_lap_s")
        self.last_good = None if self.start is None else self.start.path
        self.error: DivergedError | None = None
        self.status, self.rows = "FAILED", list[Metrics]()
        env_id, track = trainer.env_id, trainer.track
        self.description = files.describe_run(trainer.env, env_id, track, self.config, self.seed, num_seeds)
        # Parameters are the whole description but the observation's table.
        params = {name: value for name, value in self.description.items() if name != "observation"}
        params["package_version"] = flytrack_env.__version__
        name = f"{env_id} {Path(track).stem} seed {self.seed}"
        self.tracker = Tracker(self.out, self.options.tracking_uri, name, params)

    @property
    def steps(self) -> int:
        """Environment steps behind it."""
        return self.update * self.config.batch_size

    def load(self) -> bool:
        """Make or read its state; return whether there is anything left to do."""
        self.started_s = time.perf_counter() - self.seconds_before
        self.out.mkdir(parents=True, exist_ok=True)
        key, is_tracked = jax.random.key(self.seed), (self.out / RUN_FILE).exists()
        if self.start is None:
            (self.out / RUN_FILE).unlink(missing_ok=True)
            self.runner = self.trainer.start(key)
            return True
        if self.update == self.config.num_updates and self.start.path.name == files.FINAL:
            if is_tracked:  # it may have been killed before its end was recorded
                self._begin_tracking()
                self.tracker.end("FINISHED")
            return False
        files.warn_of_other_machine(self.start, self.description)
        self.runner = files.restore_runner(self.start, jax.eval_shape(self.trainer.start, key))
        return True

    def begin(self) -> None:
        """Begin or continue the MLflow run, and write the checkpoint of the untrained policy."""
        self._begin_tracking()
        if self.options.checkpoint_every and self.update == 0:
            self._checkpoint(files.step_file(0))

    def _begin_tracking(self) -> None:
        self.tracker.begin()
        if self.start is not None:  # a killed process may not have recorded it
            self.tracker.file(self.start.path, "checkpoints")

    def advance(self, runner: Runner, count: int, metrics: Metrics, steps_per_second: float) -> None:
        """Take the result of ``count`` updates; evaluate, record and store what is due after them.

        The checkpoint is last: a run that is killed before it repeats the updates, and loses no evaluation.
        None has metrics or parameters that are not finite; with these, ``error`` is set.
        """
        options, before = self.options, self.steps
        self.runner, self.update = runner, self.update + count
        is_last = self.update == self.config.num_updates
        self.rows.append(metrics)
        values = {**summarise_updates(metrics), "steps_per_second": steps_per_second}
        broken = find_not_finite(metrics, runner.train_state.params)
        if options.evaluate_every and not broken and (is_last or self._is_due(options.evaluate_every)):
            values |= self._evaluate(is_last)
        self.tracker.metrics(self.steps, values)
        if broken:
            self.error = DivergedError(
                f"training diverged between steps {before} and {self.steps}: found "
                f"{', '.join(broken[:MOST_NAMES])} not finite; the last good checkpoint: "
                f"{self.last_good or 'none'}. Try a smaller --learning-rate (it was "
                f"{self.config.learning_rate:g})"
            )
        elif not is_last and self._is_due(options.checkpoint_every):
            self._checkpoint(files.step_file(self.steps))

    def _is_due(self, every: int) -> bool:
        return is_due(self.update, every, self.config.batch_size)

    def _evaluate(self, is_last: bool) -> dict[str, float]:
        """Fly and draw the policy as it is; return the metrics, few where it could not be flown."""
        policy = Policy(self.trainer.network, self.runner.train_state.params)
        num_episodes, rest = self.options.evaluation_episodes, (self.out, self.steps)
        metrics, written = evaluate_policy(self.trainer.env, policy, num_episodes, *rest, is_recorded=is_last)
        for path in written:
            self.tracker.file(path, "evaluation")
        self.success = metrics.get("evaluation_success", self.success)
        laps_s = (self.best_lap_s, metrics.get("evaluation_best_lap_s"))
        self.best_lap_s = min((lap_s for lap_s in laps_s if lap_s is not None), default=None)
        if self.best_lap_s is not None:
            metrics["evaluation_best_lap_so_far_s"] = self.best_lap_s
        return metrics

    def complete(self) -> None:
        """Write the final checkpoint."""
        self._checkpoint(files.FINAL)
        self.status = "FINISHED"

    def result(self) -> tuple[Checkpoint, Metrics]:
        """Return the final checkpoint, and the metrics of every update made here."""
        metrics = jax.tree.map(lambda *parts: np.concatenate(parts), *self.rows) if self.rows else {}
        return files.load_checkpoint(self.out / files.FINAL), metrics

    def _checkpoint(self, name: str) -> None:
        path = self.out / name
        progress = {
            "steps": self.steps,
            "seconds": round(time.perf_counter() - self.started_s, 1),
            "success": self.success,
            "best_lap_s": self.best_lap_s,
            "options": {name: value for name, value in self.options._asdict().items() if name != "resume"},
        }
        self.tracker.flush()
        files.save_run(path, self.runner, self.config, {**self.description, **progress})
        self.last_good = path
        self.tracker.file(path, "checkpoints")


def find_not_finite(metrics: Metrics, policy_params: Any) -> list[str]:
    """Return the names of metrics and parameters that are not finite, and should be."""
    arrays = {name: row for name, row in metrics.items() if name != MAY_BE_UNDEFINED}
    arrays |= files.as_named_arrays(policy_params)
    return [name for name, array in arrays.items() if not np.isfinite(array).all()]


@contextmanager
def kept_interrupts() -> Iterator[Callable[[], None]]:
    """Raise KeyboardInterrupt at once, as ever, and again from the function given, if that was lost.

    Python drops an exception that is raised in a destructor or a collector's hook.

    Nothing is changed where signals cannot be handled: in a thread, or where the caller ignores them.
    """
    is_interrupted = threading.Event()

    def interrupt(number: int, frame: FrameType | None) -> None:
        is_interrupted.set()
        raise KeyboardInterrupt

    def check() -> None:
        if is_interrupted.is_set():
            raise KeyboardInterrupt

    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield check
        return
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def train_group(trainer: Trainer, runs: list[Run], check_interrupt: Callable[[], None]) -> None:
    """Train runs side by side to their end, and write their final checkpoints.

    A run that diverges ends and the others go on; its DivergedError is raised at the end.
    """
    config, number = trainer.config, len(runs)
    trainer.steps = runs[0].steps
    line = ProgressLine(config.num_updates * config.batch_size * number, trainer.steps * number)
    try:
        for run in runs:
            run.begin()
        for results in train_chunks(trainer, runs, line):
            for run, result in zip(runs, results, strict=True):
                if run.error is None:
                    run.advance(*result)
            show_progress(line, runs, trainer.steps * number)
            check_interrupt()
            if all(run.error for run in runs):
                break
        for run in runs:
            if run.error is None:
                run.complete()
    except KeyboardInterrupt:
        for run in runs:
            run.status = run.status if run.status == "FINISHED" else "KILLED"
        raise
    finally:
        line.close()
        for run in runs:
            run.tracker.end(run.status)
    for run in runs:
        if run.error is not None:
            raise run.error


def train_chunks(trainer: Trainer, runs: list[Run], line: ProgressLine) -> Iterator[list[tuple[Any, ...]]]:
    """Train runs that are as far as each other; yield, chunk by chunk, what ``Run.advance`` takes of each."""
    config, options, update = trainer.config, runs[0].options, runs[0].update
    if update == config.num_updates:
        return
    is_one = len(runs) == 1
    advance = trainer.chunk if is_one else trainer.chunk_of_many
    split: Callable[[Any], list[Any]] = (lambda tree: [tree]) if is_one else _split
    state = runs[0].runner if is_one else _stack([run.runner for run in runs])
    advance(state, jnp.int32(0))  # compiles
    line.begin()
    while update < config.num_updates:
        every = options.checkpoint_every, options.evaluate_every
        due = (next_due(update, steps, config.batch_size) for steps in every)
        count = int(min(*due, update + trainer.most, config.num_updates)) - update
        started_s = time.perf_counter()
        state, rows = jax.block_until_ready(advance(state, jnp.int32(count)))
        rate = count * config.batch_size / (time.perf_counter() - started_s)
        update += count
        trainer.steps = update * config.batch_size
        yield [
            (runner, count, _first_rows(own, count), rate)
            for runner, own in zip(split(state), split(rows), strict=True)
        ]


def _first_rows(rows: Metrics, count: int) -> Metrics:
    """Return the first rows as copies: a view would keep JAX's arrays of every chunk to the end."""
    return {name: np.asarray(row)[:count].copy() for name, row in rows.items()}


@jax.jit
def _stack(runners: list[Runner]) -> Runner:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *runners)


@jax.jit
def _split(tree: Any) -> list[Any]:
    size = jax.tree.leaves(tree)[0].shape[0]
    return [jax.tree.map(lambda leaf, index=index: leaf[index], tree) for index in range(size)]


def show_progress(line: ProgressLine, runs: list[Run], steps: int) -> None:
    """Show means over the runs, and the best lap of any."""
    successes = [run.success for run in runs if run.success is not None]
    laps_s = [run.best_lap_s for run in runs if run.best_lap_s is not None]
    last_return = np.mean([run.rows[-1]["last_return"][-1] for run in runs])
    success = float(np.mean(successes)) if successes else None
    line.update(steps, float(last_return), success, min(laps_s, default=None))


def train_policy(
    out: Path,
    config: Config,
    seed: int,
    env_id: str = "FlyTrack-v0",
    options: Options = Options(),  # noqa: B008, a tuple of constants
    **env_arguments: Any,
) -> tuple[Checkpoint, Metrics]:
    """Train and write ``out``/final.safetensors; return the checkpoint and the metrics, one value per update.

    env_arguments: of ``flytrack_env.make``. Where training continues (``options.resume``), the metrics are
    those since then.

    Raises:
        ValueError: settings, id, track, model or checkpoint that cannot be used, or ``out`` that holds
            another run, before any training.
        DivergedError: numbers that are not finite.
    """
    return Trainer(config, env_id, **env_arguments).train(out, seed, options)
