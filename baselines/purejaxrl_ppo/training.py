"""Trainings: seeds begun or resumed, checked before anything is written, trained alone or side by side."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from baselines.purejaxrl_ppo import resume
from baselines.purejaxrl_ppo.checkpoint import Checkpoint
from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.interrupts import kept_interrupts
from baselines.purejaxrl_ppo.monitor import ProgressLine
from baselines.purejaxrl_ppo.ppo import Runner
from baselines.purejaxrl_ppo.program import Program
from baselines.purejaxrl_ppo.run import Chunk, DivergedError, Metrics, Options, Run, next_due


class Task(NamedTuple):
    """One seed's run: its folder, its seed, its options, and where it continues from, if anywhere."""

    out: Path
    seed: int
    options: Options
    start: resume.Start | None = None


class Ready(NamedTuple):
    """A run that can begin or continue, its state, and the updates that are behind it."""

    run: Run
    runner: Runner
    update: int


class Trainer(Program):
    """A compiled program with the runs that it trains; ``steps``: of the run under way."""

    steps = 0

    def train(self, out: Path, seed: int, options: Options) -> tuple[Checkpoint, Metrics]:
        """Train and write ``out``/final.safetensors; return it, and the metrics of every update made here.

        A run that is complete stays as it is.

        Raises:
            CheckpointError: a checkpoint to continue from that cannot be used or is of another run.
            ValueError: ``out`` holds another run.
            DivergedError: numbers that are not finite.
        """
        return self.train_all([(out, seed, options)])[0]

    def train_all(self, asked: list[tuple[Path, int, Options]]) -> list[tuple[Checkpoint, Metrics]]:
        """Train seeds side by side, in one program: as ``train``, for each folder, seed and options."""
        tasks = [
            Task(out, seed, options, None if options.resume is None else resume.newest_intact(options.resume))
            for out, seed, options in asked
        ]
        self.check_all(tasks, len(tasks))
        return self.run(tasks)

    def check_all(self, tasks: list[Task], at_once: int) -> None:
        """Raise CheckpointError or ValueError, as ``train``, before anything is written."""
        for task in tasks:
            task.options.check()
            resume.check_free(task.out, task.start)
            description = self.describe(task.seed, at_once)
            if task.start is not None:
                resume.check_same_run(*task.start, description)

    def run(self, tasks: list[Task]) -> list[tuple[Checkpoint, Metrics]]:
        """Train checked tasks; those that are as far as each other side by side."""
        runs, ready = [], list[Ready]()
        for task in tasks:
            run, start = self._load(task, len(tasks))
            runs.append(run)
            ready += [start] if start is not None else []
        for group in group_by_progress(ready):
            with kept_interrupts() as check_interrupt:
                train_group(self, group, check_interrupt)
        return [run.result() for run in runs]

    def _load(self, task: Task, num_seeds: int) -> tuple[Run, Ready | None]:
        """Return a run and its state; None where it is complete."""
        description, key = self.describe(task.seed, num_seeds), jax.random.key(task.seed)
        run = Run(self, task.out, description, task.options, task.start)
        if task.start is None:
            return run, Ready(run, self.start(key), 0)
        self.steps = task.start.steps
        update = self.steps // self.config.batch_size
        if update == self.config.num_updates and task.start.path.name == resume.FINAL:
            run.finish_tracking()
            return run, None
        resume.warn_of_other_machine(*task.start, description)
        runner = resume.restore_runner(task.start, jax.eval_shape(self.start, key))
        return run, Ready(run, runner, update)


def group_by_progress(ready: list[Ready]) -> list[list[Ready]]:
    """Return the runs that can share a loop: all of them, unless some are further than others."""
    are_together = len({(one.update, one.run.options._replace(resume=None)) for one in ready}) == 1
    return [ready] if are_together else [[one] for one in ready]


def train_group(trainer: Trainer, group: list[Ready], check_interrupt: Callable[[], None]) -> None:
    """Train runs side by side to their end, and write their final checkpoints.

    A run that diverges ends and the others go on; its DivergedError is raised at the end.
    """
    runs, config, update = [one.run for one in group], trainer.config, group[0].update
    runners = [one.runner for one in group]
    trainer.steps = update * config.batch_size
    line = ProgressLine(config.num_updates * config.batch_size * len(runs), trainer.steps * len(runs))
    diverged: dict[Run, DivergedError] = {}
    try:
        for one in group:
            one.run.begin(one.runner, update)
        for chunks in train_chunks(trainer, group, line):
            runners = [chunk.runner for chunk in chunks]
            trainer.steps = chunks[0].update * config.batch_size
            for run, chunk in zip(runs, chunks, strict=True):
                if run not in diverged:
                    try:
                        run.advance(chunk)
                    except DivergedError as error:
                        diverged[run] = error
            show_progress(line, runs, chunks, trainer.steps)
            check_interrupt()
            if len(diverged) == len(runs):
                break
        for run, runner in zip(runs, runners, strict=True):
            if run not in diverged:
                run.complete(runner)
    except KeyboardInterrupt:
        for run in runs:
            run.status = run.status if run.status == "FINISHED" else "KILLED"
        raise
    finally:
        line.close()
        for run in runs:
            run.end()
    for first in diverged.values():
        raise first


def train_chunks(trainer: Trainer, group: list[Ready], line: ProgressLine) -> Iterator[list[Chunk]]:
    """Train a group; yield, chunk by chunk, the result of every run."""
    config, options, update = trainer.config, group[0].run.options, group[0].update
    if update == config.num_updates:
        return
    advance, split = (
        (trainer.chunk, lambda tree: [tree]) if len(group) == 1 else (trainer.chunk_of_many, _split)
    )
    state = group[0].runner if len(group) == 1 else _stack([one.runner for one in group])
    advance(state, jnp.int32(0))  # compiles
    line.begin()
    while update < config.num_updates:
        due = (
            next_due(update, every, config.batch_size)
            for every in (options.checkpoint_every, options.evaluate_every)
        )
        before = update
        count = int(min(*due, update + trainer.most, config.num_updates)) - update
        started_s = time.perf_counter()
        state, rows = jax.block_until_ready(advance(state, jnp.int32(count)))
        rate = count * config.batch_size / (time.perf_counter() - started_s)
        update += count
        yield [
            Chunk(runner, before, update, _first_rows(own, count), rate)
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


def show_progress(line: ProgressLine, runs: list[Run], chunks: list[Chunk], steps: int) -> None:
    """Show means over the runs, and the best lap of any."""
    successes = [run.success for run in runs if run.success is not None]
    laps_s = [run.best_lap_s for run in runs if run.best_lap_s is not None]
    last_return = np.mean([chunk.metrics["last_return"][-1] for chunk in chunks])
    success = float(np.mean(successes)) if successes else None
    line.update(steps * len(runs), float(last_return), success, min(laps_s, default=None))


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
