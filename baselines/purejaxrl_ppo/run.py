"""One seed's training under way: between its chunks checkpoints, evaluations, tracking."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import Checkpoint, as_named_arrays, load_checkpoint
from baselines.purejaxrl_ppo.metrics import summarise_updates
from baselines.purejaxrl_ppo.monitor import evaluate_policy
from baselines.purejaxrl_ppo.ppo import Runner
from baselines.purejaxrl_ppo.program import Program
from baselines.purejaxrl_ppo.resume import FINAL, Start, save_run, step_file
from baselines.purejaxrl_ppo.tracking import RUN_FILE, Tracker

Metrics = dict[str, np.ndarray]
MAY_BE_UNDEFINED = "explained_variance"  # where all returns are the same there is no variance to explain
MOST_NAMES = 4  # in the message on numbers that are not finite: where one is not, most soon are not


class DivergedError(ValueError):
    """A training whose numbers are not finite any more; the message says since when, and what to do."""


class Options(NamedTuple):
    """What a run does beside training; none of it changes the result.

    checkpoint_every, evaluate_every: environment steps; None: only the final checkpoint, no evaluation.
    evaluation_episodes: noisy starts of an evaluation. tracking_uri: MLflow store; None: no tracking.
    resume: checkpoint, or folder of checkpoints, to continue from. seeds: that one command trains, this one
    among them. parent_run_id: MLflow run that this is a part of. report: called with steps and metrics after
    every evaluation.
    """

    checkpoint_every: int | None = None
    evaluate_every: int | None = None
    evaluation_episodes: int = 64
    tracking_uri: str | None = None
    resume: Path | None = None
    seeds: tuple[int, ...] = ()
    parent_run_id: str | None = None
    report: Callable[[int, dict[str, float]], None] | None = None

    def check(self) -> None:
        """Raise ValueError, naming the option, for numbers that are not positive."""
        for name in ("checkpoint_every", "evaluate_every", "evaluation_episodes"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name}: found {value}, expected at least 1")

    def as_json(self) -> dict[str, Any]:
        """Return what a checkpoint keeps, so that a resumed run does the same."""
        kept = ("checkpoint_every", "evaluate_every", "evaluation_episodes", "tracking_uri", "seeds")
        return {name: getattr(self, name) for name in kept}


def next_due(update: int, every: int | None, batch_size: int) -> float:
    """Return the first update, after one, that reaches another multiple of ``every`` environment steps."""
    if every is None:
        return float("inf")
    reached = update * batch_size // every
    return -(-(reached + 1) * every // batch_size)


def is_due(update: int, every: int | None, batch_size: int) -> bool:
    """Return whether an update reaches another multiple of ``every`` environment steps."""
    return next_due(update - 1, every, batch_size) == update


class Chunk(NamedTuple):
    """The result of some updates: state, updates before and after, metrics, environment steps per second."""

    runner: Runner
    before: int
    update: int
    metrics: Metrics
    steps_per_second: float


class Run:
    """One seed's training under way, and the files and the MLflow run that it writes.

    rows: metrics of the chunks. success, best_lap_s: of the last evaluation, and the shortest flying lap of
    all; None before the first.
    """

    def __init__(
        self, program: Program, out: Path, description: dict[str, Any], options: Options, start: Start | None
    ):
        self.program, self.config, self.out = program, program.config, out
        self.description, self.options, self.start = description, options, start
        before = {} if start is None else start.checkpoint.meta
        self.started_s = time.perf_counter() - before.get("seconds", 0.0)
        self.success: float | None = before.get("success")
        self.best_lap_s: float | None = before.get("best_lap_s")
        self.last_good = None if start is None else start.path
        self.status, self.rows = "FAILED", list[Metrics]()
        self.tracker: Tracker | None = None
        out.mkdir(parents=True, exist_ok=True)
        if start is None:
            (out / RUN_FILE).unlink(missing_ok=True)
        if options.tracking_uri is not None:
            # Parameters are the whole description but the observation's table.
            params = {name: value for name, value in description.items() if name != "observation"}
            params["package_version"] = flytrack_env.__version__
            name = f"{program.env_id} {Path(program.track).stem} seed {description['seed']}"
            self.tracker = Tracker(out, options.tracking_uri, name, params, options.parent_run_id)

    def begin(self, runner: Runner, update: int) -> None:
        """Begin or continue the MLflow run, and write the checkpoint of the untrained policy."""
        if self.tracker is not None:
            self.tracker.begin()
            if self.start is not None:  # a killed process may not have recorded it
                self.tracker.file(self.start.path, "checkpoints")
        if self.options.checkpoint_every is not None and update == 0:
            self._checkpoint(step_file(0), runner, update)

    def finish_tracking(self) -> None:
        """Record the end of a run that is complete, if it was killed before it could."""
        if self.tracker is not None and (self.out / RUN_FILE).exists():
            self.begin(None, self.config.num_updates)  # type: ignore[arg-type]  # nothing is stored
            self.tracker.end("FINISHED")

    def advance(self, chunk: Chunk) -> None:
        """Evaluate, record and store what is due after a chunk.

        The checkpoint is last: a run that is killed before it repeats the chunk, and loses no evaluation.

        Raises:
            DivergedError: metrics or parameters that are not finite; no checkpoint has them.
        """
        config, options, update = self.config, self.options, chunk.update
        steps, is_last = update * config.batch_size, update == config.num_updates
        self.rows.append(chunk.metrics)
        values = {**summarise_updates(chunk.metrics), "steps_per_second": chunk.steps_per_second}
        broken = find_not_finite(chunk)
        is_evaluated = is_last or is_due(update, options.evaluate_every, config.batch_size)
        if options.evaluate_every and is_evaluated and not broken:
            values |= self._evaluate(chunk.runner, steps, is_last)
        if self.tracker is not None:
            self.tracker.metrics(steps, values)
        if broken:
            raise DivergedError(self._diverged_text(chunk, broken))
        if not is_last and is_due(update, options.checkpoint_every, config.batch_size):
            self._checkpoint(step_file(steps), chunk.runner, update)

    def _diverged_text(self, chunk: Chunk, broken: list[str]) -> str:
        first, last = (update * self.config.batch_size for update in (chunk.before, chunk.update))
        return (
            f"training diverged between steps {first} and {last}: found {', '.join(broken[:MOST_NAMES])} not "
            f"finite; the last good checkpoint: {self.last_good or 'none'}. Try a smaller --learning-rate "
            f"(it was {self.config.learning_rate:g})"
        )

    def _evaluate(self, runner: Runner, steps: int, is_last: bool) -> dict[str, float]:
        """Fly and draw the policy as it is; return the metrics, few where it could not be flown."""
        params, num_episodes = runner.train_state.params, self.options.evaluation_episodes
        metrics, files = evaluate_policy(
            self.program.env, self.program.network, params, num_episodes, self.out, steps, is_recorded=is_last
        )
        for path in files:
            self._record(path, "evaluation")
        self.success = metrics.get("evaluation_success", self.success)
        laps_s = [
            lap_s for lap_s in (self.best_lap_s, metrics.get("evaluation_best_lap_s")) if lap_s is not None
        ]
        self.best_lap_s = min(laps_s, default=None)
        if self.options.report is not None:
            self.options.report(steps, metrics)
        if self.best_lap_s is not None:
            metrics["evaluation_best_lap_so_far_s"] = self.best_lap_s
        return metrics

    def complete(self, runner: Runner) -> None:
        """Write the final checkpoint."""
        self._checkpoint(FINAL, runner, self.config.num_updates)
        self.status = "FINISHED"

    def end(self) -> None:
        """Record how it ended."""
        if self.tracker is not None:
            self.tracker.end(self.status)

    def result(self) -> tuple[Checkpoint, Metrics]:
        """Return the final checkpoint, and the metrics of every update made here."""
        metrics = jax.tree.map(lambda *parts: np.concatenate(parts), *self.rows) if self.rows else {}
        return load_checkpoint(self.out / FINAL), metrics

    def _checkpoint(self, name: str, runner: Runner, update: int) -> None:
        path = self.out / name
        progress = {
            "steps": update * self.config.batch_size,
            "seconds": round(time.perf_counter() - self.started_s, 1),
            "success": self.success,
            "best_lap_s": self.best_lap_s,
            "options": self.options.as_json(),
        }
        if self.tracker is not None:
            self.tracker.flush()
        save_run(path, runner, self.config, {**self.description, **progress})
        self.last_good = path
        self._record(path, "checkpoints")

    def _record(self, path: Path, group: str) -> None:
        if self.tracker is not None:
            self.tracker.file(path, group)


def find_not_finite(chunk: Chunk) -> list[str]:
    """Return the names of metrics and parameters that are not finite after a chunk, and should be."""
    metrics = [
        name for name, row in chunk.metrics.items() if name != MAY_BE_UNDEFINED and not np.isfinite(row).all()
    ]
    arrays = as_named_arrays(chunk.runner.train_state.params)
    return metrics + [name for name, array in arrays.items() if not np.isfinite(array).all()]
