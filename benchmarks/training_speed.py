"""Training speed on one core, and what it costs to watch: ``python -m benchmarks.training_speed``.

Trains the default recipe for a number of steps, alone and with all that the command does by default
(checkpoints, evaluations with their charts, MLflow with a local store), in turns, and counts
process CPU time. Compilation and imports happen before: a first run, which is not counted, does
them.
"""

import statistics
import tempfile
import time
from pathlib import Path

from msgspec.structs import replace

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.tracking import local_uri
from baselines.purejaxrl_ppo.training import DEFAULT_OPTIONS, Options, Trainer
from benchmarks import report

TARGET_STEPS_PER_S, TARGET_COST = 800_000, 0.1
ALL_ON = "steps per CPU second with everything on"
COST = "cost of checkpoints, evaluations, charts and MLflow, a new store included"


def measure(trainer: Trainer, options: Options, is_tracked: bool) -> float:
    """Return the environment steps per CPU second of one run."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        uri = local_uri(out) if is_tracked else ""
        started_s = time.process_time()
        checkpoint, _ = trainer.train(out, 0, replace(options, tracking_uri=uri))
        return checkpoint.meta["steps"] / (time.process_time() - started_s)


def main(total_timesteps: float = Config.total_timesteps, repeats: int = 1) -> None:
    """Measure in turns, print and write the table; exit 1 if a target is missed."""
    pinned = report.pin_to_one_core()
    trainer = Trainer(Config(total_timesteps=int(total_timesteps)))
    modes = {"alone": Options(), "with everything that is on by default": DEFAULT_OPTIONS}
    rates: dict[str, list[float]] = {name: [] for name in modes}
    measure(trainer, DEFAULT_OPTIONS, is_tracked=True)  # compiles and imports all that is used
    for _ in range(repeats):
        for name, options in modes.items():
            rates[name].append(measure(trainer, options, is_tracked=options is DEFAULT_OPTIONS))
            print(f"{name}: {rates[name][-1]:,.0f} steps per CPU s", flush=True)
    rows = [
        [name, f"{statistics.median(values):,.0f}", report.spread(values)]
        for name, values in rates.items()
    ]
    alone, watched = map(statistics.median, rates.values())
    cost = 1.0 - watched / alone
    figures = [
        report.Figure(ALL_ON, f"at least {TARGET_STEPS_PER_S:,}", f"{watched:,.0f}", repeats),
        report.Figure(COST, f"at most {TARGET_COST:.0%}", f"{cost:.1%}", repeats),
    ]
    report.fill_page(
        report.RESULTS / "training_speed.md",
        "training_speed",
        table=report.table("training | median | lowest to highest", rows),
        figures=report.figures_table(figures),
        steps=total_timesteps,
        repeats=repeats,
        pinned=pinned.capitalize(),
    )
    if watched < TARGET_STEPS_PER_S or cost > TARGET_COST:
        raise SystemExit(1)


if __name__ == "__main__":
    report.command(main)
