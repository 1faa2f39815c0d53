"""Training speed on one core, and what it costs to watch: ``python -m benchmarks.training_speed``.

Trains the default recipe for a number of steps, alone and with all that the command does by default
(checkpoints, evaluations with their charts, MLflow with a local store), in turns, and counts process CPU
time. Compilation and imports happen before: a first run, which is not counted, does them.
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.run import Options
from baselines.purejaxrl_ppo.tracking import local_uri
from baselines.purejaxrl_ppo.train_ppo import DEFAULTS
from baselines.purejaxrl_ppo.training import Trainer
from benchmarks import report

AIM_STEPS_PER_S = 400_000
AIM_COST = 0.1


def measure(trainer: Trainer, options: Options, is_tracked: bool) -> float:
    """Return the environment steps per CPU second of one run."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        uri = local_uri(out) if is_tracked else None
        started_s = time.process_time()
        checkpoint, _ = trainer.train(out, 0, options._replace(tracking_uri=uri))
        return checkpoint.meta["steps"] / (time.process_time() - started_s)


def main() -> None:
    """Measure in turns, print and write the table; exit 1 if an aim is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--total-timesteps", type=float, default=Config.total_timesteps)
    parser.add_argument("--repeats", type=int, default=1)
    arguments = parser.parse_args()
    pinned = report.pin_to_one_core()
    trainer = Trainer(Config(total_timesteps=int(arguments.total_timesteps)))
    modes = {"alone": Options(), "with everything that is on by default": DEFAULTS}
    rates: dict[str, list[float]] = {name: [] for name in modes}
    measure(trainer, DEFAULTS, is_tracked=True)  # compiles and imports all that is used
    for _ in range(arguments.repeats):
        for name, options in modes.items():
            rates[name].append(measure(trainer, options, is_tracked=options is DEFAULTS))
            print(f"{name}: {rates[name][-1]:,.0f} steps per CPU s", flush=True)
    rows = [[name, f"{statistics.median(found):,.0f}", report.spread(found)] for name, found in rates.items()]
    alone, watched = (statistics.median(found) for found in rates.values())
    report.fill_page(
        report.RESULTS / "training_speed.md",
        "training_speed",
        table=report.table("training | median | lowest to highest", rows),
        steps=arguments.total_timesteps,
        repeats=arguments.repeats,
        cost=1.0 - watched / alone,
        aim_cost=AIM_COST,
        aim=AIM_STEPS_PER_S,
        pinned=pinned.capitalize(),
    )
    if watched < AIM_STEPS_PER_S or 1.0 - watched / alone > AIM_COST:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
