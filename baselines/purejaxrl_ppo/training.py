"""Trainings: begun or resumed, checked before anything is written, evaluated, recorded and stored.

The compiled program is one update, so that neither what is done between updates nor where a run was
cut off and resumed changes a bit of the result.
"""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import tyro
from jax.sharding import Mesh

import flytrack_env
from baselines.purejaxrl_ppo import checkpoint as files
from baselines.purejaxrl_ppo import devices
from baselines.purejaxrl_ppo.checkpoint import Checkpoint, CheckpointError
from baselines.purejaxrl_ppo.config import Config, Count, PositiveInt
from baselines.purejaxrl_ppo.metrics import summarize_updates
from baselines.purejaxrl_ppo.monitor import evaluate_policy
from baselines.purejaxrl_ppo.networks import Policy
from baselines.purejaxrl_ppo.ppo import Algorithm, make_network_for, make_ppo, make_schedule
from baselines.purejaxrl_ppo.tracking import LOCAL, RUN_FILE, Tracker
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.files import locked_folder
from flytrack_env.params import EnvParams
from flytrack_env.progress import progress_bar
from flytrack_env.validation import convert

Metrics = dict[str, np.ndarray]
Report = Callable[[int, dict[str, float]], None]
RECORD_EVERY = 131_072  # environment steps: metrics are recorded a few times a second
# where all returns are the same there is no variance to explain
MAY_BE_UNDEFINED = "explained_variance"
MAX_NAMES = 4  # in the message on numbers that are not finite: where one is not, most soon are not


class DivergedError(ValueError):
    """The numbers of a training are not finite; the message says since when and what to do."""


class Stopped(KeyboardInterrupt):
    """A training that SIGINT (Ctrl-C) or SIGTERM ended; the message says how to continue.

    Attributes:
        signal_number: of the signal.
    """

    def __init__(self, message: str, signal_number: int):
        super().__init__(message)
        self.signal_number = signal_number


class Options(msgspec.Struct, frozen=True):
    """What a run does beside training; none of it changes the result."""

    checkpoint_every: Annotated[Count, msgspec.Meta(ge=0)] = 0
    """Write step_<N>.safetensors every so many environment steps; 0: only at the end."""
    evaluate_every: Annotated[Count, msgspec.Meta(ge=0)] = 0
    """Fly and draw the policy every so many environment steps; 0: never."""
    evaluation_episodes: PositiveInt = 64
    """Noisy starts of an evaluation."""
    tracking_uri: str = ""
    """MLflow store; local: an SQLite file in OUT."""
    parent_run: Annotated[str, tyro.conf.Suppress] = ""
    """Id of the MLflow run that this one is below, as of a sweep."""


DEFAULT_OPTIONS = Options(checkpoint_every=1_000_000, evaluate_every=4_000_000, tracking_uri=LOCAL)


def is_due(steps: int, every: int, batch_size: int) -> bool:
    """Return whether the update that ends at ``steps`` reaches a new multiple of ``every``."""
    return every > 0 and steps // every > (steps - batch_size) // every


def stack(rows: list[Metrics]) -> Metrics:
    """Return the metrics of several updates, (num_updates,) each."""
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]} if rows else {}


def training_params(env: EpisodicEnvironment, config: Config) -> EnvParams:
    """Return the parameters to train with: short episodes, and a drone thicker than in the race."""
    params = env.default_params
    params = params.replace(
        max_steps_in_episode=config.episode_steps,
        drone_radius=params.drone_radius + config.gate_margin,
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
        raise ValueError(
            f"track: found a {type(track).__name__}, expected a name or the path of a file"
        )
    return str(Path(track).resolve()) if str(track).endswith(".toml") else str(track)


@contextmanager
def collect_signals() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM in a list, so that a training can end between two updates.

    The second signal raises KeyboardInterrupt at once. Nothing is collected in another thread than
    the main one, where signals cannot be handled, nor of a signal that the caller handles or
    ignores.
    """
    received: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) > 1:
            raise KeyboardInterrupt

    defaults = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    is_main = threading.current_thread() is threading.main_thread()
    handled = {
        number: old
        for number, old in defaults.items()
        if is_main and signal.getsignal(number) is old
    }
    for number in handled:
        signal.signal(number, handle)
    try:
        yield received
    finally:
        for number, old in handled.items():
            signal.signal(number, old)


def find_not_finite(metrics: Metrics, policy_params: Any) -> list[str]:
    """Return the names of metrics and parameters that are not finite, and should be."""
    arrays = {name: row for name, row in metrics.items() if name != MAY_BE_UNDEFINED}
    arrays |= files.as_named_arrays(policy_params)
    return [name for name, array in arrays.items() if not np.isfinite(array).all()]


class Trainer:
    """PPO on one environment, compiled once for any number of runs.

    Args:
        config: checked here.
        env_id: of ``flytrack_env.make``.
        mesh: devices that share the environments (devices.py); None: the default device.
        env_arguments: of ``flytrack_env.make``.

    Attributes:
        start: key -> runner.
        update: runner -> (runner, metrics).

    Raises:
        ValueError: settings, id, track or model that cannot be used.
    """

    def __init__(
        self,
        config: Config,
        env_id: str = "FlyTrack-v0",
        mesh: Mesh | None = None,
        **env_arguments: Any,
    ):
        self.config, self.env_id, self.mesh = config.check(), env_id, mesh
        self.track = track_reference(env_arguments.get("track", "flytrack"))
        self.env = flytrack_env.make(env_id, **env_arguments)
        self.env.check_params(self.env.default_params)
        params = training_params(self.env, self.config)
        if mesh is None:
            ppo = make_ppo(self.env, params, self.config)
        else:
            devices.check_divides(self.config, mesh)
            divide = partial(devices.divide_minibatches, mesh)
            ppo = make_ppo(self.env, params, self.config, divide)
        self.network = make_network_for(self.env, params, self.config)
        # Weak types become strong ones, as they come from a file: one program for both.
        strong = partial(
            jax.tree.map, lambda leaf: jnp.asarray(leaf).astype(jnp.asarray(leaf).dtype)
        )
        strong_start = Algorithm(lambda key: strong(ppo.start(key)), ppo.update)
        self.start, self.update = devices.compile_on(mesh, strong_start)

    def train(
        self,
        out: Path,
        seed: int,
        options: Options = Options(),  # noqa: B008, frozen
        resume: Path | Checkpoint | None = None,
        report: Report = lambda steps, values: None,
    ) -> tuple[Checkpoint, Metrics]:
        """Train and write ``out``/final.safetensors. A run that is complete stays as it is.

        Args:
            out: folder of the run.
            seed: of the run.
            options: what is done beside training.
            resume: checkpoint, or its file or folder, to continue from.
            report: called with environment steps and metrics a few times a second.

        Returns:
            The final checkpoint, and the metrics of every update made here.

        Raises:
            CheckpointError: a checkpoint to continue from that cannot be used or is of another run.
            ValueError: ``out`` holds another run.
            DivergedError: numbers that are not finite.
            Stopped: SIGINT or SIGTERM ended it, after a last checkpoint.
        """
        options = convert("options", msgspec.to_builtins(options), Options)
        start = files.newest_intact(resume) if isinstance(resume, Path) else resume
        description = files.describe_run(self.env, self.env_id, self.track, self.config, seed)
        with locked_folder(out) if devices.is_first() else nullcontext():
            if devices.is_first():
                self._check(out, start, description)
            begins_at = 0 if start is None else start.steps
            devices.check_agree(out, {**description, "begins_at": begins_at})
            if start is not None and start.path == out / files.FINAL:
                if start.steps == self.config.num_updates * self.config.batch_size:
                    return start, {}
                # The run is extended, and final is what it will be at its new end.
                stored = out / files.step_file(start.steps)
                if devices.is_first():
                    start.path.rename(stored)
                start = start._replace(path=stored)
            with collect_signals() as signals, devices.noticing_loss(f"--resume {out}"):
                return Run(self, out, options, description, start, report).train(signals)

    def _check(self, out: Path, start: Checkpoint | None, description: dict[str, Any]) -> None:
        """Raise ValueError unless a run can begin in a folder, or continue from a checkpoint."""
        is_own = start is not None and start.path.parent.resolve() == out.resolve()
        if not is_own and files.checkpoints_in(out):
            raise ValueError(
                f"{out} holds the checkpoints of a run; continue it (--resume {out}), give "
                "another folder (--out), or remove it"
            )
        if start is None:
            return
        files.check_same_run(start, description)
        total = self.config.num_updates * self.config.batch_size
        if start.steps > total:
            raise CheckpointError(
                f"{start.path}: steps: found {start.steps}, expected at most {total}"
            )


class Run:
    """A training under way: its state, and the files and the MLflow run that it writes.

    Args:
        trainer: that compiled it.
        out: folder of its files.
        options: what is done beside training.
        description: as ``describe_run`` returns it.
        start: where it continues from; None: it begins.
        report: called with environment steps and metrics.
    """

    def __init__(
        self,
        trainer: Trainer,
        out: Path,
        options: Options,
        description: dict[str, Any],
        start: Checkpoint | None,
        report: Report,
    ):
        self.report = report
        self.trainer, self.config = trainer, trainer.config
        self.out, self.options, self.description = out, options, description
        self.update = 0  # number of updates so far
        self.begun_s = time.perf_counter()
        self.last_stored: Path | None = None
        self.history: list[Metrics] = []  # of the updates
        self.evaluation: dict[str, float] = {}  # metrics of the last one
        key, self.is_first = jax.random.key(description["seed"]), devices.is_first()
        if start is None:
            if self.is_first:
                (out / RUN_FILE).unlink(missing_ok=True)
            self.runner = trainer.start(key)
        else:
            whole = files.restore_runner(start, jax.eval_shape(trainer.start, key))
            self.runner = devices.spread(whole, trainer.mesh)
            self.update, self.last_stored = start.steps // self.config.batch_size, start.path
            self.begun_s -= start.meta["seconds"]
            self._report_learning_rate(start.config)
        name = f"{trainer.env_id} {Path(trainer.track).stem} seed {description['seed']}"
        uri = options.tracking_uri if self.is_first else ""
        self.tracker = Tracker(out, uri, name, description, options.parent_run)

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return self.update * self.config.batch_size

    def _report_learning_rate(self, before: Config) -> None:
        """Print how the learning rate jumps where a new run length changes its schedule."""
        count = self.update * self.config.gradients_per_update
        old, new = (float(make_schedule(config)(count)) for config in (before, self.config))
        if old != new and self.is_first:
            print(
                f"learning rate: {old:.3g} up to step {self.steps}, {new:.3g} from there: "
                "it is annealed anew"
            )

    def train(self, signals: list[int]) -> tuple[Checkpoint, Metrics]:
        """Train to the end; once a signal has arrived, write a checkpoint and raise ``Stopped``."""
        config, status, is_stopped = self.config, "FAILED", False
        total = config.num_updates * config.batch_size
        bar = progress_bar(
            "steps",
            total=total,
            initial=self.steps,
            unit_scale=True,
            desc="compile",
            disable=not self.is_first,
        )
        try:
            if self.options.checkpoint_every and self.update == 0:
                self._store(files.step_file(0))
            jax.block_until_ready(self.trainer.update(self.runner))  # compiles
            bar.set_description("train")
            while self.update < config.num_updates and not is_stopped:
                self._advance()
                is_stopped = devices.any_process(bool(signals))
                bar.set_postfix_str(self._format_progress(), refresh=False)
                bar.update(self.steps - bar.n)
            is_complete = self.update == config.num_updates
            self._store(files.FINAL if is_complete else files.step_file(self.steps))
            status = "FINISHED" if is_complete else "KILLED"
        except SystemExit:  # as Ray Tune ends a trial that falls behind
            status = "KILLED"
            raise
        finally:
            bar.close()
            self.tracker.end(status)
        if is_stopped:
            number = signals[0] if signals else signal.SIGTERM  # another process received one
            name = signal.Signals(number).name
            text = "the run is complete" if is_complete else f"continue with --resume {self.out}"
            raise Stopped(f"stopped by {name} at {self.steps} steps; {text}", number)
        return files.load_checkpoint(self.out / files.FINAL), stack(self.history)

    def _advance(self) -> None:
        """Train until something is due, then evaluate, record and store, in this order.

        A run that is killed before it stores repeats the updates, and loses no evaluation.
        """
        config, options, started_s = self.config, self.options, time.perf_counter()
        first, updates = self.steps, list[Any]()
        is_recorded = is_last = False
        while not (is_recorded or is_last):
            self.runner, metrics = self.trainer.update(self.runner)
            updates.append(metrics)  # read later: a GPU would wait for it after every update
            self.update += 1
            is_last = self.update == config.num_updates
            is_stored, is_evaluated, is_recorded = (
                is_due(self.steps, every, config.batch_size)
                for every in (options.checkpoint_every, options.evaluate_every, RECORD_EVERY)
            )
            is_recorded = is_recorded or is_stored or is_evaluated
        updates = jax.device_get(updates)
        self.history += updates
        rate = (self.steps - first) / (time.perf_counter() - started_s)
        rows = stack(updates)
        values, written = {**summarize_updates(rows), "steps_per_second": rate}, list[Path]()
        params = devices.gather(self.runner.train_state.params, self.trainer.mesh)
        not_finite = find_not_finite(rows, params)
        is_evaluated = bool(options.evaluate_every) and (is_evaluated or is_last)
        if is_evaluated and self.is_first and not not_finite:
            policy, folder = Policy(self.trainer.network, params), self.out / "evaluation"
            self.evaluation, written = evaluate_policy(
                self.trainer.env, policy, options.evaluation_episodes, folder, self.steps, is_last
            )
            values |= self.evaluation
        self.tracker.record(self.steps, values, [(path, "evaluation") for path in written])
        if not_finite:
            raise DivergedError(
                f"training diverged between steps {first} and {self.steps}: found "
                f"{', '.join(not_finite[:MAX_NAMES])} not finite; the last good checkpoint: "
                f"{self.last_stored or 'none'}. Try a smaller --learning-rate (it was "
                f"{config.learning_rate:g})"
            )
        if is_stored and not is_last:
            self._store(files.step_file(self.steps))
        self.report(self.steps, values)

    def _store(self, name: str) -> None:
        """Write a checkpoint, once all that was recorded before it is sent."""
        self.tracker.flush()
        seconds = round(time.perf_counter() - self.begun_s, 1)
        description = {**self.description, "steps": self.steps, "seconds": seconds}
        runner = devices.gather(self.runner, self.trainer.mesh)
        if self.is_first:
            files.save_run(self.out / name, runner, self.config, description)
        devices.any_process(False)  # until the file is there
        self.last_stored = self.out / name
        self.tracker.record(self.steps, {}, [(self.last_stored, "checkpoints")])

    def _format_progress(self) -> str:
        """Return the mean return and the last evaluation's success and best lap as text."""
        text = f"return {self.history[-1]['last_return']:.1f}"
        if "evaluation_success" in self.evaluation:
            text += f", success {self.evaluation['evaluation_success']:.0%}"
        if "evaluation_best_lap_s" in self.evaluation:
            text += f", best lap {self.evaluation['evaluation_best_lap_s']:.2f} s"
        return text


def train_policy(
    out: Path,
    config: Config,
    seed: int,
    env_id: str = "FlyTrack-v0",
    options: Options = Options(),  # noqa: B008, frozen
    resume: Path | None = None,
    **env_arguments: Any,
) -> tuple[Checkpoint, Metrics]:
    """Train and write ``out``/final.safetensors.

    Args:
        out: folder of the run.
        config: hyperparameters.
        seed: of the run.
        env_id: of ``flytrack_env.make``.
        options: what is done beside training.
        resume: checkpoint, or folder of checkpoints, to continue from.
        env_arguments: of ``flytrack_env.make``.

    Returns:
        The final checkpoint, and the metrics of every update made here.

    Raises: ValueError: settings, id, track, model or checkpoint that cannot be used, or ``out``
        that holds another run, before any training. DivergedError: numbers that are not finite.
        Stopped: SIGINT or SIGTERM ended it, after a last checkpoint.
    """
    return Trainer(config, env_id, **env_arguments).train(out, seed, options, resume)
