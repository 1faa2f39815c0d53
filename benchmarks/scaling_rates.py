"""Rates of environments and trainings by size, for ``benchmarks.scaling``."""

import statistics
import time
from collections.abc import Callable, Iterable, Iterator
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
TRAINED_ENVS = (256, 1_024, 4_096, 16_384)
WIDTHS = (16, 32, 64, 128, 256)
GATES, ARENA_M = (4, 8, 16, 24), (60.0, 80.0)
NUM_EFFECTS = (0, 1, 2, 4, 8, len(EFFECTS))
SEEDS = (1, 2, 4, 8)
STEPS_PER_CALL = 2**20  # long enough to time, short enough to repeat
REPEATS = 5

Row = tuple[Any, float, float]  # what was varied, million steps a second (median), compile time, s


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


def environments() -> Iterator[Row]:
    """Yield rates over the number of environments."""
    env = flytrack_env.make("FlyTrack-v0")
    for num_envs in ON_CPU if jax.default_backend() == "cpu" else ON_ACCELERATOR:
        yield num_envs, *environment_rate(env, num_envs)


def effects() -> Iterator[Row]:
    """Yield rates over the number of effects in the model, in the order of the list."""
    for number in NUM_EFFECTS:
        chosen = [effect.parameters() for effect in EFFECTS[:number]]
        model = flytrack_env.nominal_parameters().with_effects(*chosen)
        yield number, *environment_rate(flytrack_env.make("FlyTrack-v0", model=model), NUM_ENVS)


def gates() -> Iterator[Row]:
    """Yield rates over the number of gates of a random course."""
    for number in GATES:
        track = random_track(0, num_gates=number, size=ARENA_M)
        yield number, *environment_rate(flytrack_env.make("FlyTrack-v0", track=track), NUM_ENVS)


def training_rate(config: Config, num_seeds: int = 1) -> tuple[float, float]:
    """Return the rate of one update, of one or several seeds trained together."""
    trainer = Trainer(config)
    runners = [trainer.start(jax.random.key(seed)) for seed in range(num_seeds)]
    steps = num_seeds * config.batch_size
    if num_seeds == 1:
        return rate(lambda: trainer.chunk(runners[0], jnp.int32(1)), steps)
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *runners)
    return rate(lambda: trainer.chunk_of_many(together, jnp.int32(1)), steps)


def trained_environments() -> Iterator[Row]:
    """Yield rates of training over the number of environments, at the recipe's minibatch size."""
    recipe = Config()
    for num_envs in TRAINED_ENVS:
        minibatches = max(1, recipe.num_minibatches * num_envs // recipe.num_envs)
        config = Config(num_envs=num_envs, num_minibatches=minibatches)
        yield num_envs, *training_rate(config)


def widths() -> Iterator[Row]:
    """Yield rates of training over the width of both hidden layers."""
    for width in WIDTHS:
        yield f"2 x {width}", *training_rate(Config(hidden_sizes=(width, width)))


def seeds() -> Iterator[Row]:
    """Yield rates of training over the number of seeds trained together, total steps of all."""
    for number in SEEDS:
        yield number, *training_rate(Config(), number)


TABLES: dict[str, tuple[str, Callable[[], Iterable[Row]]]] = {
    "environments": ("environments", environments),
    "effects": ("effects in the model", effects),
    "gates": ("gates", gates),
    "training": ("environments of a training", trained_environments),
    "networks": ("hidden layers", widths),
    "seeds": ("seeds side by side", seeds),
}
