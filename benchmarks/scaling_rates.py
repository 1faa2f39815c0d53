"""Rates of environments and trainings by size, for ``benchmarks.scaling``."""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

import flytrack_env
from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.training import Trainer
from flytrack_env.effects import EFFECTS
from flytrack_env.tracks import random_track

ON_CPU, ON_ACCELERATOR = (64, 256, 1_024, 4_096, 16_384, 65_536), (1_024, 16_384, 131_072, 1_048_576)
NUM_ENVS = 4_096
ARENA_M = (60.0, 80.0)
STEPS_PER_CALL = 2**20  # long enough to time, short enough to repeat
REPEATS = 5


def clock() -> float:
    """Return seconds of CPU time on a CPU, which other processes share; else of wall time."""
    return time.process_time() if jax.default_backend() == "cpu" else time.perf_counter()


def rate(call: Callable[[], Any], num_steps: int) -> tuple[float, float]:
    """Return the median rate of a call, million steps a second, and the first call's additional time, s."""
    started = time.perf_counter()
    jax.block_until_ready(call())
    first_s = time.perf_counter() - started
    times = []
    for _ in range(REPEATS):
        started = clock()
        jax.block_until_ready(call())
        times.append(clock() - started)
    return num_steps / statistics.median(times) / 1e6, max(0.0, first_s - statistics.median(times))


def environment_rate(env: Any, num_envs: int) -> tuple[float, float]:
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
    return environment_rate(flytrack_env.make("FlyTrack-v0", model=model), NUM_ENVS)


def rate_with_gates(number: int) -> tuple[float, float]:
    """Return the rate on a random course."""
    track = random_track(0, num_gates=number, size=ARENA_M)
    return environment_rate(flytrack_env.make("FlyTrack-v0", track=track), NUM_ENVS)


def training_rate(config: Config, num_seeds: int = 1) -> tuple[float, float]:
    """Return the rate of one update, of one or several seeds trained together."""
    trainer = Trainer(config)
    runners = [trainer.start(jax.random.key(seed)) for seed in range(num_seeds)]
    steps = num_seeds * config.batch_size
    if num_seeds == 1:
        return rate(lambda: trainer.chunk(runners[0], jnp.int32(1)), steps)
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *runners)
    return rate(lambda: trainer.chunk_of_many(together, jnp.int32(1)), steps)


def training_rate_with_environments(num_envs: int) -> tuple[float, float]:
    """Return the rate of training with a number of environments, at the recipe's minibatch size."""
    recipe = Config()
    minibatches = max(1, recipe.num_minibatches * num_envs // recipe.num_envs)
    return training_rate(Config(num_envs=num_envs, num_minibatches=minibatches))


# Title, values, rate at a value: million steps a second (median) and compile time, s.
TABLES: dict[str, tuple[str, Sequence[Any], Callable[[Any], tuple[float, float]]]] = {
    "environments": (
        "environments",
        ON_CPU if jax.default_backend() == "cpu" else ON_ACCELERATOR,
        lambda number: environment_rate(flytrack_env.make("FlyTrack-v0"), number),
    ),
    "effects": ("effects in the model", (0, 1, 2, 4, 8, len(EFFECTS)), rate_with_effects),
    "gates": ("gates", (4, 8, 16, 24), rate_with_gates),
    "training": ("environments of a training", (256, 1_024, 4_096, 16_384), training_rate_with_environments),
    "networks": (
        "width of both hidden layers",
        (16, 32, 64, 128, 256),
        lambda width: training_rate(Config(hidden_sizes=(width, width))),
    ),
    "seeds": ("seeds side by side", (1, 2, 4, 8), lambda number: training_rate(Config(), number)),
}
