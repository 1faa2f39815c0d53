"""How the cost of environments and trainings grows: ``python -m benchmarks.scaling``.

Rates are per second of CPU time on one core, or of wall time on an accelerator.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import flytrack_env
from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.training import Trainer
from benchmarks import report
from flytrack_env.effects import EFFECTS
from flytrack_env.tracks import random_track

NUM_ENVS = 4_096
ARENA_M = (60.0, 80.0)
STEPS_PER_CALL = 2**20  # long enough to time, short enough to repeat
REPEATS = 5


def rate(call: Callable[[], Any], num_steps: int) -> tuple[float, float]:
    """Return the median rate of a call, million steps a second, and the first call's additional time, s."""
    # CPU time on a CPU, which other processes share
    clock = time.process_time if jax.default_backend() == "cpu" else time.perf_counter
    started = time.perf_counter()
    jax.block_until_ready(call())
    first_s = time.perf_counter() - started
    times = []
    for _ in range(REPEATS):
        started = clock()
        jax.block_until_ready(call())
        times.append(clock() - started)
    return num_steps / statistics.median(times) / 1e6, max(0.0, first_s - statistics.median(times))


def environment_rate(env: Any, num_envs: int = NUM_ENVS) -> tuple[float, float]:
    """Return the rate of stepping a batch with random actions."""
    length, params = max(1, STEPS_PER_CALL // num_envs), env.default_params
    _, state = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(
        jax.random.split(jax.random.key(0), num_envs), params
    )

    @jax.jit
    def fly(state: Any, key: jax.Array) -> Any:
        def one(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            action = jax.random.uniform(key, (num_envs, 4), minval=-1.0)
            observation, state, reward, *_ = env.step_batch(key, state, action, params)
            return state, observation.sum() + reward.sum()

        return jax.lax.scan(one, state, jax.random.split(key, length))

    return rate(lambda: fly(state, jax.random.key(1)), length * num_envs)


def rate_with_effects(number: int) -> tuple[float, float]:
    """Return the rate of a model with the first effects of the list."""
    chosen = [effect.parameters() for effect in EFFECTS[:number]]
    model = flytrack_env.nominal_parameters().with_effects(*chosen)
    return environment_rate(flytrack_env.make("FlyTrack-v0", model=model))


def rate_with_gates(number: int) -> tuple[float, float]:
    """Return the rate on a random course."""
    track = random_track(0, num_gates=number, size=ARENA_M)
    return environment_rate(flytrack_env.make("FlyTrack-v0", track=track))


def training_rate(config: Config, num_seeds: int = 1) -> tuple[float, float]:
    """Return the rate of one update, of one or several seeds trained together."""
    trainer = Trainer(config)
    runners = [trainer.start(jax.random.key(seed)) for seed in range(num_seeds)]
    if num_seeds == 1:
        return rate(lambda: trainer.chunk(runners[0], jnp.int32(1)), config.batch_size)
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *runners)
    return rate(lambda: trainer.chunk_of_many(together, jnp.int32(1)), num_seeds * config.batch_size)


def training_rate_with_environments(num_envs: int) -> tuple[float, float]:
    """Return the rate of training with a number of environments, at the recipe's minibatch size."""
    recipe = Config()
    minibatches = max(1, recipe.num_minibatches * num_envs // recipe.num_envs)
    return training_rate(Config(num_envs=num_envs, num_minibatches=minibatches))


# Title, values, rate at a value.
TABLES: tuple[tuple[str, tuple[int, ...], Callable[[int], tuple[float, float]]], ...] = (
    (
        "environments",
        (64, 256, 1_024, 4_096, 16_384, 65_536),
        lambda number: environment_rate(flytrack_env.make("FlyTrack-v0"), number),
    ),
    ("effects in the model", (0, 1, 2, 4, 8, len(EFFECTS)), rate_with_effects),
    ("gates", (4, 8, 16, 24), rate_with_gates),
    ("environments of a training", (256, 1_024, 4_096, 16_384), training_rate_with_environments),
    (
        "width of both hidden layers",
        (16, 32, 64, 128, 256),
        lambda width: training_rate(Config(hidden_sizes=(width, width))),
    ),
    ("seeds side by side", (1, 2, 4, 8), lambda number: training_rate(Config(), number)),
)


def main() -> None:
    """Measure all tables and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--page", type=Path, default=report.RESULTS / "scaling.md", help="page to write")
    arguments = parser.parse_args()
    pinned = report.pin_to_one_core()
    parts = []
    for title, values, rate_of in TABLES:
        rows = []
        for value in report.progress(values, title):
            speed, start_s = rate_of(value)
            rows.append((f"{value:,}", f"{speed:.3g}", f"{start_s:.1f}"))
        table = report.table((title, "million steps per second", "start (s)"), rows)
        parts += [f"## {title.capitalize()}", table]
    tables, device = "\n\n".join(parts), jax.devices()[0].device_kind
    report.fill_page(arguments.page, "scaling", tables=tables, device=device, pinned=pinned)


if __name__ == "__main__":
    main()
