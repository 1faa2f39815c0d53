"""How fast racing is learnt from scratch: ``python -m benchmarks.learning_curve [--seeds 5]``.

Trains a short recipe on FlyTrack-v0, one seed after the other, and every quarter of a million
environment steps flies 256 noisy starts over 3 laps in the simulator. What counts is from when on
95 % of them finish and do so at every later evaluation. CPU seconds are those of training alone,
without compilation and evaluations. Writes a page and a chart.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.flights import race_many, score, start_keys
from baselines.purejaxrl_ppo.networks import Policy
from baselines.purejaxrl_ppo.training import Trainer, is_due
from benchmarks import report
from flytrack_env.files import write_atomically
from flytrack_env.pictures.drawing import new_figure, plain, png_of

TARGET_SUCCESS, TARGET_STEPS = 0.95, 3_000_000
# Half as many steps per update as by default: it learns to finish sooner, and to be fast later.
SHORT: dict[str, Any] = {"total_timesteps": 4_000_000, "num_steps": 32, "num_minibatches": 32}
EVERY = 250_000  # environment steps
NUM_EPISODES, NUM_LAPS, NUM_STEPS = 256, 3, 2500
EVALUATION_SEED = 30_000
HEADER = (
    "seed | 95 % held from (M steps) | CPU s until then | CPU s of the whole run | "
    "success at the end | first lap (s) | flying lap (s)"
)


class Point(NamedTuple):
    """One evaluation: environment steps and seconds of training so far, and how it flies."""

    steps: int
    spent_s: float
    success: float
    first_lap_s: float
    flying_lap_s: float


def evaluate(trainer: Trainer, policy_params: object, steps: int, spent_s: float) -> Point:
    """Return how a policy flies noisy starts."""
    keys = start_keys(EVALUATION_SEED, NUM_EPISODES)
    policy = Policy(trainer.network, policy_params)
    result = score(race_many(trainer.env, policy, keys, NUM_STEPS, NUM_LAPS))
    return Point(steps, spent_s, result.success, result.first_lap_s, result.flying_lap_s)


def train(
    trainer: Trainer,
    seed: int,
    every: int = EVERY,
    clock: Callable[[], float] = time.process_time,
) -> list[Point]:
    """Train one seed and return its evaluations.

    Args:
        every: environment steps between evaluations.
        clock: measures training alone, without compilation and evaluations.
    """
    config = trainer.config
    runner = trainer.start(jax.random.key(seed))
    jax.block_until_ready(trainer.update(runner))  # compiles
    points, spent_s, started_s = [], 0.0, clock()
    for update in report.progress(range(1, config.num_updates + 1), "update"):
        runner, _ = trainer.update(runner)
        steps = update * config.batch_size
        if is_due(steps, every, config.batch_size) or update == config.num_updates:
            jax.block_until_ready(runner)
            spent_s += clock() - started_s
            points.append(evaluate(trainer, runner.train_state.params, steps, spent_s))
            started_s = clock()
    return points


def held_from(points: list[Point]) -> Point | None:
    """Return the first evaluation from which on all meet the target; None without one."""
    missed = [index for index, point in enumerate(points) if point.success < TARGET_SUCCESS]
    first = missed[-1] + 1 if missed else 0
    return points[first] if first < len(points) else None


def row_of(seed: int, points: list[Point]) -> list[str]:
    """Return a seed's row of the table."""
    held, last = held_from(points), points[-1]
    since = ("never", "") if held is None else (f"{held.steps / 1e6:.2f}", f"{held.spent_s:.1f}")
    laps = (f"{last.first_lap_s:.3f}", f"{last.flying_lap_s:.3f}")
    return [str(seed), *since, f"{last.spent_s:.1f}", f"{last.success:.1%}", *laps]


def draw(path: Path, curves: dict[int, list[Point]]) -> None:
    """Write a PNG of success over environment steps, a panel a seed before those of all others."""
    num_columns = min(5, len(curves))
    num_rows = -(-len(curves) // num_columns)
    figure = new_figure(2.0 * num_columns + 0.8, 1.7 * num_rows + 0.7)
    all_axes = figure.subplots(num_rows, num_columns, sharex=True, sharey=True, squeeze=False)
    lines = {
        seed: ([p.steps / 1e6 for p in points], [100 * p.success for p in points])
        for seed, points in curves.items()
    }
    for axes in all_axes.flat[len(curves) :]:
        axes.set_visible(False)
    for axes, (seed, line) in zip(all_axes.flat, lines.items(), strict=False):
        for other in lines.values():
            plain(axes).plot(*other, color="0.85", linewidth=0.9)
        axes.plot(*line, color="#0072B2", linewidth=1.8)
        axes.axhline(100 * TARGET_SUCCESS, color="0.5", linestyle=":", linewidth=0.9)
        held, last = held_from(curves[seed]), curves[seed][-1]
        text = "not held" if held is None else f"held from {held.steps / 1e6:.2f} M"
        axes.set_title(f"seed {seed}: {text}", fontsize=8, loc="left")
        axes.annotate(
            f"{last.flying_lap_s:.2f} s",
            (0.97, 0.08),
            xycoords="axes fraction",
            ha="right",
            fontsize=8,
        )
        axes.tick_params(labelsize=8)
    figure.supxlabel("environment steps (millions); flying lap at the end", fontsize=9)
    figure.supylabel(f"{NUM_LAPS} laps completed (%)", fontsize=9)
    write_atomically(path, png_of(figure, dpi=140))


def main(seeds: int = 5, out: Path = report.RESULTS / "learning_curve.md") -> None:
    """Measure every seed, print and write page and chart; exit 1 if a seed misses the target.

    Args:
        seeds: how many.
        out: page to write.
    """
    pinned = report.pin_to_one_core()
    trainer = Trainer(Config(**SHORT))
    evaluate(trainer, trainer.start(jax.random.key(0)).train_state.params, 0, 0.0)  # compiles
    curves = {seed: train(trainer, seed) for seed in range(seeds)}
    chart = out.with_suffix(".png")
    draw(chart, curves)
    held = [held_from(points) for points in curves.values()]
    is_held = [point is not None and point.steps <= TARGET_STEPS for point in held]
    name = (
        f"seeds that hold {TARGET_SUCCESS:.0%} from at most {TARGET_STEPS / 1e6:g} M steps on, "
        "to the end"
    )
    report.fill_page(
        out,
        "learning_curve",
        settings=report.list_settings(SHORT),
        every=EVERY / 1e6,
        episodes=NUM_EPISODES,
        laps=NUM_LAPS,
        figures=report.figures_table([report.Figure(name, "100 %", *report.share(is_held))]),
        table=report.table(HEADER, [row_of(seed, points) for seed, points in curves.items()]),
        chart=chart.name,
        pinned=pinned.capitalize(),
    )
    if not all(is_held):
        raise SystemExit(1)


if __name__ == "__main__":
    report.command(main)
