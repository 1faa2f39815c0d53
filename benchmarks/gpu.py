"""FlyTrack on an accelerator: ``python -m benchmarks.gpu [--most 20]``.

Environment steps with random actions, observations and resets included, compilation excluded, from 2^10 to
2^20 environments, beside gymnax's Pendulum; then seeds that train side by side, and a training until 95 % of
256 starts finish. Times are wall times. Without an accelerator the page says so and nothing else; ``--cpu``
measures small sizes without a page.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.training import Trainer
from benchmarks import report
from benchmarks.env_speed import jax_contestant
from benchmarks.learning_curve import held_from, train

IDS = ("FlyTrack-v0", "FlyTrackRobust-v0", "Pendulum-v1")
SEEDS = (1, 4, 16)
REPEATS, LENGTH = 5, 64  # calls, and steps of each
PAGE = report.RESULTS / "gpu.md"


def seconds(call: Callable[[], Any]) -> float:
    """Return the median time of a call that was compiled before."""
    jax.block_until_ready(call())
    times = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - started)
    return statistics.median(times)


def decisions_per_s(env_id: str, num_envs: int) -> float:
    """Return the rate of environment steps; each has its observation and, where it ended, its reset."""
    entry = jax_contestant(env_id, env_id, num_envs, LENGTH, is_batch=False)
    return 1e6 * entry.amount / seconds(entry.run)


def environments(most: int) -> str:
    """Return a table of rates by number of environments; simulated seconds are those of 100 Hz."""
    rows = []
    for power in report.progress(range(10, most + 1), "size"):
        rates = [decisions_per_s(env_id, 2**power) for env_id in IDS]
        rows.append([f"2^{power}", *(f"{rate:.3g}" for rate in rates), f"{0.01 * rates[0]:.3g}"])
    return report.table(["environments", *(f"{one}, decisions/s" for one in IDS), "simulated s/s"], rows)


def trainings(config: Config) -> str:
    """Return a table of training steps a second by number of seeds side by side."""
    trainer, rows = Trainer(config), []
    for number in SEEDS:
        runners = [trainer.start(jax.random.key(seed)) for seed in range(number)]
        together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *runners)
        taken_s = seconds(lambda together=together: trainer.chunk_of_many(together, jnp.int32(1)))
        rows.append([number, f"{number * config.batch_size / taken_s:.3g}"])
    return report.table("seeds side by side | training steps/s, all together", rows)


def time_to_race(config: Config) -> str:
    """Return from when on 95 % of the starts finish, as a sentence."""
    started, held = time.perf_counter(), held_from(train(Trainer(config), 0))
    since = "never" if held is None else f"from {held.steps / 1e6:.2f} M steps on"
    return (
        f"Seed 0: 95 % of 256 starts finish {since}; {time.perf_counter() - started:.0f} s with evaluations."
    )


def main() -> None:
    """Measure, and write the page where there is an accelerator."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--most", type=int, default=20, help="the most environments, as a power of 2")
    parser.add_argument("--steps", type=int, default=8_000_000, help="of the training")
    parser.add_argument("--cpu", action="store_true", help="try it on a CPU: prints, writes nothing")
    asked = parser.parse_args()
    path, parts = (None if asked.cpu else PAGE), ["Not measured."]
    if asked.cpu or jax.default_backend() != "cpu":
        config = Config(total_timesteps=asked.steps)
        parts = [environments(asked.most), trainings(config), time_to_race(config)]
        parts.append(f"{jax.devices()[0].device_kind}. {report.provenance_line(report.provenance())}")
    report.write_page(path, report.page("On a GPU", f"{report.command_line()}.", *parts))


if __name__ == "__main__":
    main()
