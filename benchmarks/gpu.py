"""FlyTrack on an accelerator: ``python -m benchmarks.gpu [--most 20]``.

The same actions and the same policy in 256 flights on the accelerator and on the CPU; environment
steps with random actions, observations and resets included, compilation excluded, from 2^10 to 2^20
environments, beside gymnax's Pendulum; seeds that train side by side, and a training until 95 % of
256 starts finish. Times are wall times. Without an accelerator the page says so and nothing else;
``--cpu`` measures small sizes without a page.
"""

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo import Config, load_checkpoint
from baselines.purejaxrl_ppo.flights import race_many, score, start_keys
from baselines.purejaxrl_ppo.training import Trainer
from benchmarks import report
from benchmarks.champion import CHAMPION, MODEL
from benchmarks.env_speed import Contestant, jax_contestant, measure
from benchmarks.learning_curve import held_from, train

IDS = ("FlyTrack-v0", "FlyTrackRobust-v0", "Pendulum-v1")
SEEDS = (1, 4, 16)
NUM_FLIGHTS = 256
REPEATS, LENGTH = 5, 64  # calls, and steps of each
PAGE = report.RESULTS / "gpu.md"
WHAT = (
    "256 flights on the accelerator and on the CPU; rates with random actions, observations and "
    "resets included, compilation excluded, wall time; training by PPO as shipped. Both devices "
    "run the same equations: their agreement says something of rounding, not of physics."
)


def rate_of(entry: Contestant) -> float:
    """Return the median rate of a contestant, amount per second."""
    rates = measure([entry._replace(clock=time.perf_counter)], REPEATS, warm_up=1)
    return statistics.median(rates[entry.name])


def open_loop(keys: jax.Array) -> jax.Array:
    """Return positions, (num_flights, 3), after a second of random actions from the start pose.

    The actions are the same in every call.
    """
    env = flytrack_env.make("FlyTrack-v0")
    actions = jax.random.uniform(jax.random.key(1), (NUM_FLIGHTS, 100, 4), minval=-1.0)

    def fly(key: jax.Array, actions: jax.Array) -> jax.Array:
        _, state = env.reset(key, env.default_params)

        def step(state: Any, action: jax.Array) -> tuple[Any, None]:
            return env.step_env(key, state, action, env.default_params)[1], None

        return jnp.stack(env.drone(jax.lax.scan(step, state, actions)[0]).pos_w)

    return jax.jit(jax.vmap(fly))(keys, actions)


def agreement() -> str:
    """Compare flights on the accelerator with those on the CPU, and a champion's races on both."""
    champion = load_checkpoint(CHAMPION)
    env = flytrack_env.make("FlyTrack-v0", model=MODEL)
    ends, rows = [], []
    for device in (jax.devices()[0], jax.devices("cpu")[0]):
        with jax.default_device(device):
            keys = start_keys(0, NUM_FLIGHTS)
            ends.append(np.asarray(open_loop(keys)))
            races = score(race_many(env, champion.policy, keys, 2500, 3))
        rows.append([device.device_kind, f"{races.success:.1%}", f"{races.flying_lap_s:.4f}"])
    apart_m = np.abs(ends[0] - ends[1]).max()
    return (
        report.table("the champion on | finish | flying lap (s)", rows)
        + "\n\nAfter the same second of random actions, positions differ by at most "
        f"{apart_m:.1g} m."
    )


def environments(most: int) -> str:
    """Return a table of rates by number of environments; simulated seconds are those of 100 Hz.

    A step has its observation and, where it ended, its reset.
    """
    rows = []
    for power in report.progress(range(10, most + 1, 2), "size"):
        rates = [
            1e6 * rate_of(jax_contestant(name, name, 2**power, LENGTH, is_batch=False))
            for name in IDS
        ]
        rows.append([f"2^{power}", *(f"{rate:.3g}" for rate in rates), f"{0.01 * rates[0]:.3g}"])
    return report.table(
        ["environments", *(f"{name}, decisions/s" for name in IDS), "simulated s/s"], rows
    )


def run_and_wait(run: Callable[[], Any]) -> None:
    """Call a function and wait for what it returns."""
    jax.block_until_ready(run())


def trainings(config: Config) -> str:
    """Return a table of training steps a second by number of seeds side by side."""
    trainer, rows = Trainer(config), []
    for number in SEEDS:
        runners = [trainer.start(jax.random.key(seed)) for seed in range(number)]
        together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *runners)
        update = partial(jax.jit(jax.vmap(trainer.update)), together)
        entry = Contestant("", number * config.batch_size, partial(run_and_wait, update))
        rows.append([number, f"{rate_of(entry):.3g}"])
    return report.table("seeds side by side | training steps/s, all together", rows)


def race(config: Config) -> str:
    """Return when a training's policy races, and how long that took."""
    started, held = time.perf_counter(), held_from(train(Trainer(config), 0))
    since = "never" if held is None else f"from {held.steps / 1e6:.2f} M steps on"
    spent = f"{time.perf_counter() - started:.0f} s with evaluations and compilation"
    return (
        f"Seed 0, {config.total_timesteps / 1e6:g} M steps: 95 % of 256 starts finish {since}; "
        f"{spent}."
    )


def main(most: int = 20, steps: int = 8_000_000, cpu: bool = False) -> None:
    """Measure, and write the page where there is an accelerator.

    most: environments, as a power of 2. steps: of the training. cpu: print what a CPU does, write
    nothing.
    """
    path, parts = (None if cpu else PAGE), ["Not measured."]
    if cpu or jax.default_backend() != "cpu":
        config, parts = Config(total_timesteps=steps), []
        for part in (
            agreement,
            partial(environments, most),
            partial(trainings, config),
            partial(race, config),
        ):
            parts.append(part())
            print(parts[-1], end="\n\n", flush=True)
        parts.append(
            f"{jax.devices()[0].device_kind}. {report.provenance_line(report.provenance())}"
        )
    report.write_page(path, report.page("On a GPU", f"{report.command_line()}: {WHAT}", *parts))


if __name__ == "__main__":
    report.command(main)
