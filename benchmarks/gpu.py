"""FlyTrack on an accelerator: ``python -m benchmarks.gpu [--most 20]``.

Environment steps with random actions, observations and resets included, compilation excluded, from 2^10 to
2^20 environments, beside gymnax's Pendulum; then seeds that train side by side, and a training until 95 % of
256 starts finish. Times are wall times. Without an accelerator the page says so and nothing else; ``--cpu``
measures small sizes without a page.
"""

import statistics
import time
from functools import partial

import jax
import jax.numpy as jnp

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.training import Trainer
from benchmarks import report
from benchmarks.env_speed import Contestant, jax_contestant, measure
from benchmarks.learning_curve import held_from, train

IDS = ("FlyTrack-v0", "FlyTrackRobust-v0", "Pendulum-v1")
SEEDS = (1, 4, 16)
REPEATS, LENGTH = 5, 64  # calls, and steps of each
PAGE = report.RESULTS / "gpu.md"


def rate_of(entry: Contestant) -> float:
    """Return the median rate of a contestant, amount per second."""
    found = measure([entry._replace(clock=time.perf_counter)], REPEATS, warm_up=1)
    return statistics.median(found[entry.name])


def environments(most: int) -> str:
    """Return a table of rates by number of environments; simulated seconds are those of 100 Hz.

    A step has its observation and, where it ended, its reset.
    """
    rows = []
    for power in report.progress(range(10, most + 1), "size"):
        rates = [1e6 * rate_of(jax_contestant(one, one, 2**power, LENGTH, is_batch=False)) for one in IDS]
        rows.append([f"2^{power}", *(f"{rate:.3g}" for rate in rates), f"{0.01 * rates[0]:.3g}"])
    return report.table(["environments", *(f"{one}, decisions/s" for one in IDS), "simulated s/s"], rows)


def trainings(config: Config) -> str:
    """Return a table of training steps a second by number of seeds side by side."""
    trainer, rows = Trainer(config), []
    for number in SEEDS:
        runners = [trainer.start(jax.random.key(seed)) for seed in range(number)]
        together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *runners)
        update = partial(trainer.chunk_of_many, together, jnp.int32(1))
        entry = Contestant("", number * config.batch_size, lambda run=update: jax.block_until_ready(run()))
        rows.append([number, f"{rate_of(entry):.3g}"])
    return report.table("seeds side by side | training steps/s, all together", rows)


def main(most: int = 20, steps: int = 8_000_000, cpu: bool = False) -> None:
    """Measure, and write the page where there is an accelerator.

    most: environments, as a power of 2. steps: of the training. cpu: print what a CPU does, write nothing.
    """
    path, parts = (None if cpu else PAGE), ["Not measured."]
    if cpu or jax.default_backend() != "cpu":
        config = Config(total_timesteps=steps)
        parts = [environments(most), trainings(config)]
        started, held = time.perf_counter(), held_from(train(Trainer(config), 0))
        since = "never" if held is None else f"from {held.steps / 1e6:.2f} M steps on"
        spent = f"{time.perf_counter() - started:.0f} s with evaluations"
        parts.append(f"Seed 0: 95 % of 256 starts finish {since}; {spent}.")
        parts.append(f"{jax.devices()[0].device_kind}. {report.provenance_line(report.provenance())}")
    report.write_page(path, report.page("On a GPU", f"{report.command_line()}.", *parts))


if __name__ == "__main__":
    report.command(main)
