"""The loop of a training: one program for one run or for several seeds side by side, and its line."""

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from baselines.purejaxrl_ppo.monitor import LiveLine, Seen
from baselines.purejaxrl_ppo.options import next_due
from baselines.purejaxrl_ppo.ppo import Runner
from baselines.purejaxrl_ppo.run import Chunk, DivergedError, Metrics, Run

if TYPE_CHECKING:
    from baselines.purejaxrl_ppo.training import Trainer


class Ready(NamedTuple):
    """A run that can begin or go on, its state, and the updates that are behind it."""

    run: Run
    runner: Runner
    update: int


def groups_of(ready: list[Ready]) -> list[list[Ready]]:
    """Return the runs that can share a loop: as far as each other, and looked at from outside as often."""
    groups: dict[tuple[int | None, ...], list[Ready]] = {}
    for one in ready:
        options = one.run.options
        groups.setdefault((one.update, options.checkpoint_every, options.evaluate_every), []).append(one)
    return list(groups.values())


def finish(trainer: "Trainer", group: list[Ready]) -> None:
    """Train runs of a group side by side to their end, and write their final checkpoints.

    A run that diverges ends; the others go on.

    Raises:
        DivergedError: of the first run that did.
    """
    runs, config = [one.run for one in group], trainer.config
    update, total = group[0].update, config.num_updates * config.batch_size
    trainer.steps = update * config.batch_size
    line = LiveLine(total * len(runs), trainer.steps * len(runs))
    diverged: dict[Run, DivergedError] = {}
    try:
        for one in group:
            one.run.begin(one.runner, update)
        for chunks in _chunks(trainer, group, line):
            trainer.steps = chunks[0].update * config.batch_size
            line.trained(trainer.steps * len(runs))
            for run, chunk in zip(runs, chunks, strict=True):
                if run not in diverged:
                    try:
                        run.took(chunk)
                    except DivergedError as error:
                        diverged[run] = error
            _show(line, runs, chunks)
            if len(diverged) == len(runs):
                break
        ends = [one.runner for one in group] if update == config.num_updates else [c.runner for c in chunks]
        for run, runner in zip(runs, ends, strict=True):
            if run not in diverged:
                run.complete(runner)
    except KeyboardInterrupt:
        for run in runs:
            run.stopped()
        raise
    finally:
        line.close()
        for run in runs:
            run.end()
    for first in diverged.values():
        raise first


def _chunks(trainer: "Trainer", group: list[Ready], line: LiveLine) -> Iterator[list[Chunk]]:
    """Train, yielding between chunks how every run stands."""
    config, options, update = trainer.config, group[0].run.options, group[0].update
    if update == config.num_updates:
        return
    advance, split = (trainer.chunk, _only) if len(group) == 1 else (trainer.chunk_of_many, _split)
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
            Chunk(runner, before, update, _first(own, count), rate)
            for runner, own in zip(split(state), split(rows), strict=True)
        ]


def _first(rows: Metrics, count: int) -> Metrics:
    """Return the first rows as arrays of their own: a view would keep JAX's, of every chunk, to the end."""
    return {name: np.asarray(row)[:count].copy() for name, row in rows.items()}


@jax.jit
def _stack(runners: list[Runner]) -> Runner:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *runners)


@jax.jit
def _split(tree: object) -> list[object]:
    size = jax.tree.leaves(tree)[0].shape[0]
    return [jax.tree.map(lambda leaf, index=index: leaf[index], tree) for index in range(size)]


def _only(tree: object) -> list[object]:
    return [tree]


def _show(line: LiveLine, runs: list[Run], chunks: list[Chunk]) -> None:
    """Show means over the runs, and the best lap of any."""
    seen = [run.seen for run in runs]
    successes = [one.success for one in seen if one.success is not None]
    laps_s = [one.best_lap_s for one in seen if one.best_lap_s is not None]
    line.show(
        float(np.mean([chunk.metrics["last_return"][-1] for chunk in chunks])),
        Seen(float(np.mean(successes)) if successes else None, min(laps_s, default=None)),
    )
