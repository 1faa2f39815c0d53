"""One seed's training under way: between its chunks checkpoints, evaluations, tracking."""

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import Checkpoint, load_checkpoint
from baselines.purejaxrl_ppo.distributed import is_first
from baselines.purejaxrl_ppo.journal import JOURNAL
from baselines.purejaxrl_ppo.metrics import summarise_updates
from baselines.purejaxrl_ppo.monitor import Seen, evaluate_policy
from baselines.purejaxrl_ppo.named_arrays import as_named_arrays
from baselines.purejaxrl_ppo.options import Options, is_due
from baselines.purejaxrl_ppo.ppo import Runner
from baselines.purejaxrl_ppo.resume import save_run
from baselines.purejaxrl_ppo.run_folder import FINAL, checkpoints_in, steps_of
from baselines.purejaxrl_ppo.tracking import Tracker

if TYPE_CHECKING:
    from baselines.purejaxrl_ppo.training import Trainer

Metrics = dict[str, np.ndarray]
UNDEFINED = "explained_variance"  # where all returns are the same there is no variance to explain
MOST_NAMES = 4  # of what is not finite: where one is, most soon are


class DivergedError(ValueError):
    """A training whose numbers are not finite any more; the message says since when, and what to do."""


class Chunk(NamedTuple):
    """Where a training stands after some updates: state, updates before and after, metrics and rate."""

    runner: Runner
    before: int
    update: int
    metrics: Metrics
    steps_per_second: float


class Run:
    """One seed's training under way: where it writes, and who is told of it.

    Of a training's processes the first writes and tells; the others only take part in what all have to.
    status: how it ended, as MLflow says it. rows: metrics of its chunks.
    """

    def __init__(
        self,
        trainer: "Trainer",
        out: Path,
        description: dict[str, Any],
        options: Options,
        before: dict[str, Any] | None = None,
    ):
        self.trainer, self.config, self.out = trainer, trainer.config, out
        self.description, self.options = description, options
        before = before or {}
        self.started_s = time.perf_counter() - float(before.get("seconds") or 0.0)
        seen = before.get("seen") or {}
        self.seen = Seen(*(seen.get(name) for name in Seen._fields))
        self.tracker: Tracker | None = None
        self.last_path: Path | None = options.resume
        self.status, self.rows = "FAILED", list[Metrics]()
        self.is_first = is_first()
        if self.is_first:
            out.mkdir(parents=True, exist_ok=True)

    def send_unsent(self) -> None:
        """Tell what a run that is complete had not told when it was killed; nothing of one not tracked."""
        if not self.is_first or self.options.tracking_uri is None or not (self.out / JOURNAL).exists():
            return
        tracker = self.tracker = self._make_tracker(self.options.tracking_uri)
        self._tell_checkpoints(math.inf)
        if not tracker.has_ended("FINISHED"):
            tracker.end("FINISHED")
        tracker.send()

    def begin(self, runner: Runner, update: int) -> None:
        """Tell of a run that begins or goes on, and of checkpoints that a killed process had not told."""
        if self.is_first and self.options.tracking_uri is not None:
            self.tracker = self._make_tracker(self.options.tracking_uri)
            self.tracker.begin()
        self._tell_checkpoints(update * self.config.batch_size)
        if self.options.checkpoint_every is not None and update == 0:
            self.checkpoint("step_0.msgpack", runner, update)

    def _tell_checkpoints(self, steps: float) -> None:
        """Tell of the checkpoints that there are, up to a number of steps."""
        for path in reversed(checkpoints_in(self.out)):
            if steps_of(path) <= steps:
                self._tell(path, "checkpoints")

    def _make_tracker(self, uri: str) -> Tracker:
        """Return who tells MLflow; parameters are the whole description but the observation's table."""
        params = {name: value for name, value in self.description.items() if name != "observation"}
        params["package_version"] = flytrack_env.__version__
        name = f"{self.trainer.env_id} {Path(self.trainer.track).stem} seed {self.description['seed']}"
        return Tracker(self.out, uri, name, params, self.options.parent)

    def took(self, chunk: Chunk) -> None:
        """Evaluate, tell and store what is due after a chunk.

        The checkpoint is last: a run that is killed before it comes here again, and loses no evaluation.

        Raises:
            DivergedError: metrics or parameters that are not finite; no checkpoint has them.
        """
        config, options = self.config, self.options
        runner, update = chunk.runner, chunk.update
        steps, is_last = update * config.batch_size, update == config.num_updates
        self.rows.append(chunk.metrics)
        values = {**summarise_updates(chunk.metrics), "steps_per_second": chunk.steps_per_second}
        broken = find_not_finite(chunk)
        is_evaluated = is_last or is_due(update, options.evaluate_every, config.batch_size)
        if self.is_first and options.evaluate_every and is_evaluated and not broken:
            evaluation = self._evaluate(runner, steps, is_last)
            self.seen = self.seen.after(evaluation)
            if options.report is not None:
                options.report(steps, evaluation)
            values = {**values, **evaluation, **self.seen.metrics()}
        if self.tracker is not None:
            self.tracker.metrics(steps, values)
        if broken:
            raise DivergedError(self._say_diverged(chunk, broken))
        if not is_last and is_due(update, options.checkpoint_every, config.batch_size):
            self.checkpoint(f"step_{steps}.msgpack", runner, update)

    def _say_diverged(self, chunk: Chunk, broken: list[str]) -> str:
        first, last = (update * self.config.batch_size for update in (chunk.before, chunk.update))
        good = "there is none" if self.last_path is None else self.last_path
        rate = self.config.learning_rate
        return (
            f"training diverged between steps {first} and {last}: found {', '.join(broken[:MOST_NAMES])} not "
            f"finite; the last good checkpoint: {good}. Try a smaller --learning-rate (it was {rate:g})"
        )

    def _evaluate(self, runner: Runner, steps: int, is_last: bool) -> dict[str, float]:
        """Fly and draw the policy as it is; return the metrics, none where it could not be flown."""
        env, params = self.trainer.env, self.trainer.policy_of(runner)
        num_episodes = self.options.evaluation_episodes
        metrics, files = evaluate_policy(
            env, self.trainer.network, params, num_episodes, self.out, steps, is_recorded=is_last
        )
        for path in files:
            self._tell(path, "evaluation")
        return metrics

    def complete(self, runner: Runner) -> None:
        """Write the final checkpoint."""
        self.checkpoint(FINAL, runner, self.config.num_updates)
        self.status = "FINISHED"

    def stopped(self) -> None:
        """Note that somebody stopped it, unless it is complete."""
        self.status = self.status if self.status == "FINISHED" else "KILLED"

    def end(self) -> None:
        """Tell how it ended."""
        if self.tracker is not None:
            self.tracker.end(self.status)

    def result(self) -> tuple[Checkpoint, Metrics]:
        """Return the final checkpoint, and the metrics of every update made here."""
        metrics = jax.tree.map(lambda *parts: np.concatenate(parts), *self.rows) if self.rows else {}
        return load_checkpoint(self.out / FINAL), metrics

    def checkpoint(self, name: str, runner: Runner, update: int) -> None:
        """Write a checkpoint."""
        path, runner = self.out / name, self.trainer.whole(runner)
        if not self.is_first:
            return
        progress = {
            "steps": update * self.config.batch_size,
            "seconds": round(time.perf_counter() - self.started_s, 1),
            "seen": self.seen._asdict(),
        }
        if self.tracker is not None:
            self.tracker.keep()
        save_run(path, runner, self.config, {**self.description, **progress})
        self.last_path = path
        self._tell(path, "checkpoints")

    def _tell(self, path: Path, group: str) -> None:
        if self.tracker is not None:
            self.tracker.file(path, group)


def find_not_finite(chunk: Chunk) -> list[str]:
    """Return the names of metrics and parameters that are not finite after a chunk, and should be."""
    metrics = [
        name for name, row in chunk.metrics.items() if name != UNDEFINED and not np.isfinite(row).all()
    ]
    arrays = as_named_arrays(chunk.runner.train_state.params)
    return metrics + [name for name, array in arrays.items() if not np.isfinite(array).all()]
