"""Memory: whether a long training, or many resets in Gymnasium, need more of it the longer they last.

What a process holds grows for a while: libraries are imported, programs compiled, the allocators of C, Python
and JAX find out how much they need. So each measurement has a process of its own, its first WARM_UP is left
out, and what counts is the slope of the rest (Theil and Sen: the median of the slopes of all pairs, which a
jump near either end hardly moves), times the length of the whole. Beside resident memory two numbers are
counted that no allocator blurs: blocks of Python's allocator and live JAX arrays. Cyclic garbage is collected
before each sample.
"""

import gc
import os
import resource
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np
from scipy.stats import theilslopes
from tqdm import trange

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.options import Options
from baselines.purejaxrl_ppo.tracking import local_uri
from baselines.purejaxrl_ppo.training import Trainer
from benchmarks.reliability.section import Section
from flytrack_env import available_tracks, nominal_parameters

TRAINING_STEPS = 200_000_000
# Of a training, as the command makes them by default in so many steps.
NUM_CHECKPOINTS, NUM_EVALUATIONS = 200, 50
SAMPLE_S = 4.0
NUM_RESETS = 10_000
NUM_SAMPLES, UNSEEN_RESETS = 100, 1000  # of the resets; before the first one that counts
STEPS_AFTER_RESET = 3
WARM_UP = 0.2  # of the whole; in a training, a few evaluations
# How much each may grow in the whole. A training returns the metrics of every update and keeps what it told
# MLflow, some 25 numbers an update each. A reset may keep 400 bytes, which is what resident memory can tell
# from noise; the other two tell one in 50 and one in 500.
ALLOWED = {
    "steps": {"resident_mib": lambda amount: 32.0, "arrays": lambda amount: 100.0},
    "resets": {
        "resident_mib": lambda amount: 4.0,
        "blocks": lambda amount: max(100.0, amount / 50),
        "arrays": lambda amount: max(1.0, amount / 500),
    },
}
NAMES = {"resident_mib": "resident MiB", "blocks": "blocks of Python's", "arrays": "JAX arrays"}
SHOWN = (0.2, 0.4, 0.6, 0.8, 1.0)  # of the whole, where the page says what was resident
ENV_ID, NUM_ENVS = "FlyTrackRobust-v0", 16


class Sample(NamedTuple):
    """What a process holds after an amount of work: resident MiB, blocks of Python's, live JAX arrays."""

    amount: int
    resident_mib: float
    blocks: int
    arrays: int


def take_sample(amount: int) -> Sample:
    """Return what this process holds now, after collecting Python's cyclic garbage.

    Python itself collects that of charts about every ten evaluations of a training: it comes and goes.
    """
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    resident_mib = pages * os.sysconf("SC_PAGE_SIZE") / 2**20
    return Sample(amount, resident_mib, sys.getallocatedblocks(), len(jax.live_arrays()))


def growth(samples: list[Sample], field: str) -> float:
    """Return by how much a field of the samples would grow in the whole, at its pace after the warm-up."""
    amounts = np.array([sample.amount for sample in samples], float)
    values = np.array([getattr(sample, field) for sample in samples], float)
    is_warm = amounts >= WARM_UP * amounts[-1]
    return float(theilslopes(values[is_warm], amounts[is_warm]).slope * amounts[-1])


def describe(name: str, unit: str, samples: list[Sample]) -> dict[str, Any]:
    """Return the growth that samples show, and what was resident on the way, as JSON values."""
    whole = samples[-1].amount
    shown = [min(samples, key=lambda sample, at=at: abs(sample.amount - at * whole)) for at in SHOWN]
    return {
        "name": name,
        "unit": unit,
        "amount": whole,
        "resident_mib": [round(sample.resident_mib, 1) for sample in shown],
        **{f"{field}_growth": growth(samples, field) for field in Sample._fields[1:]},
    }


# --- Training ---------------------------------------------------------------------------------------


@contextmanager
def sampling(amount: Callable[[], int], every_s: float) -> Iterator[list[Sample]]:
    """Fill a list with samples, taken in a thread beside whatever is done meanwhile."""
    samples: list[Sample] = []
    is_over = threading.Event()

    def watch() -> None:
        while not is_over.wait(every_s):
            samples.append(take_sample(amount()))

    thread = threading.Thread(target=watch)
    gc.freeze()  # what is there already is not looked through at every sample
    thread.start()
    try:
        yield samples
    finally:
        is_over.set()
        thread.join()
        gc.unfreeze()


def watch_training(trainer: Trainer, out: Path, options: Options, every_s: float) -> list[Sample]:
    """Train, and return samples over environment steps."""
    with sampling(lambda: trainer.steps, every_s) as samples:
        trainer.train(out, 0, options)
    return samples


def measure_training(num_steps: int, out: Path) -> dict[str, Any]:
    """Return what a training of the default recipe shows, with all that the command does by default."""
    options = Options(
        checkpoint_every=num_steps // NUM_CHECKPOINTS,
        evaluate_every=num_steps // NUM_EVALUATIONS,
        tracking_uri=local_uri(out),
    )
    samples = watch_training(Trainer(Config(total_timesteps=num_steps)), out, options, SAMPLE_S)
    return describe("training", "steps", samples)


# --- Gymnasium --------------------------------------------------------------------------------------


def options_of(index: int) -> dict[str, Any]:
    """Return the options of a reset: none, a pose, a battery or another track, in turn."""
    tracks = available_tracks()
    choices: tuple[dict[str, Any], ...] = (
        {},
        {"yaw_deg": 30.0, "velocity": (3.0, 0.0, 0.0), "gate_index": 1},
        {"battery_v": 23.0},
        {"track": tracks[index // 4 % len(tracks)]},
    )
    return choices[index % len(choices)]


def watch_resets(env: Any, num_resets: int, unseen: int = UNSEEN_RESETS) -> list[Sample]:
    """Reset an environment, single or vector, again and again, a few steps in between; return samples.

    unseen: resets before the first that counts, in which caches of JAX and NumPy fill up.
    """
    every = num_resets // NUM_SAMPLES
    table = np.zeros((NUM_SAMPLES, len(Sample._fields)))  # filled, so that samples are no growth themselves
    env.action_space.seed(0)
    gc.freeze()  # what is there already is not looked through at every sample
    for index in trange(-unseen, every * NUM_SAMPLES, unit="reset", mininterval=1.0):
        env.reset(seed=abs(index) if index % 5 == 0 else None, options=options_of(index))
        for _ in range(STEPS_AFTER_RESET):
            env.step(env.action_space.sample())
        env.render()  # in each, so that what it fills once is full before the first that counts
        if index >= 0 and (index + 1) % every == 0:
            table[index // every] = take_sample(index + 1)
    gc.unfreeze()
    return [Sample(int(row[0]), float(row[1]), int(row[2]), int(row[3])) for row in table]


def make_single() -> Any:
    """Return a single environment."""
    return gymnasium.make(ENV_ID)


def make_drawn() -> Any:
    """Return a single environment that draws pictures, of a model given as numbers."""
    return gymnasium.make(ENV_ID, render_mode="rgb_array", model=nominal_parameters())


def make_vector() -> Any:
    """Return a vector environment."""
    return gymnasium.make_vec(ENV_ID, num_envs=NUM_ENVS, vectorization_mode="vector_entry_point")


MAKERS: dict[str, Callable[[], Any]] = {
    "single environment": make_single,
    "single environment, a model given, pictures": make_drawn,
    f"vector environment of {NUM_ENVS}": make_vector,
}


def measure_resets(name: str, num_resets: int) -> dict[str, Any]:
    """Return what resets of one of MAKERS show."""
    return describe(name, "resets", watch_resets(MAKERS[name](), num_resets))


# --- The part ---------------------------------------------------------------------------------------


def apart(function: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """Return what a function returns in a process of its own."""
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def measure(seed: int, share: float, folder: Path) -> dict[str, Any]:
    """Train TRAINING_STEPS and reset NUM_RESETS times where the share is 1, each in a process of its own."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    rows = [apart(measure_resets, name, max(NUM_SAMPLES, round(share * NUM_RESETS))) for name in MAKERS]
    least = Config().batch_size * NUM_CHECKPOINTS
    num_steps = max(least, round(share * TRAINING_STEPS))
    rows.append(apart(measure_training, num_steps, folder / "run"))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"rows": rows, "cpu_minutes": round(used_s / 60.0, 1)}


def reasons_against(row: dict[str, Any]) -> list[str]:
    """Return what of a row grew more than it may."""
    allowed = ALLOWED[row["unit"]].items()
    return [NAMES[name] for name, most in allowed if row[f"{name}_growth"] > most(row["amount"])]


def is_held(result: dict[str, Any]) -> bool:
    """Return whether nothing grew more than it may."""
    return not any(reasons_against(row) for row in result["rows"])


def as_markdown(result: dict[str, Any]) -> str:
    """Return what was resident, and how it grew."""
    shown = " | ".join(f"{at:.0%}" for at in SHOWN)
    text = (
        f"Each in a process of its own; {result['cpu_minutes']:g} minutes of processor time. Resident MiB on "
        f"the way; and the growth over the whole, at the pace after the first {WARM_UP:.0%}, in which "
        "libraries are imported and allocators warm up (the median of the slopes of all pairs of samples), "
        "of resident MiB, blocks of Python's allocator and live JAX arrays, each with what is allowed; after "
        "cyclic garbage is collected, which comes and goes with the charts of evaluations. A "
        "training returns the metrics of every update and keeps what it told MLflow: that is its growth. It "
        f"evaluates {NUM_EVALUATIONS} times and writes {NUM_CHECKPOINTS} checkpoints. A reset has other "
        f"options than the one before, tracks among them, and {STEPS_AFTER_RESET} steps come after it; "
        f"{UNSEEN_RESETS:,} resets are made before the first that counts.\n\n"
        f"| what | how much | {shown} | growth, MiB | blocks | arrays | |\n"
    )
    text += "|---" * (len(SHOWN) + 6) + "|\n"
    for row in result["rows"]:
        cells = [f"{value:.0f}" for value in row["resident_mib"]]
        for name in Sample._fields[1:]:
            most = ALLOWED[row["unit"]].get(name)
            allowed = "" if most is None else f" (of {most(row['amount']):g})"
            cells.append(f"{row[f'{name}_growth']:.3g}{allowed}")
        cells.append("grows: " + ", ".join(reasons_against(row)) if reasons_against(row) else "held")
        text += f"| {row['name']} | {row['amount']:,} {row['unit']} | {' | '.join(cells)} |\n"
    return text


SECTION = Section("memory", "Memory", measure, as_markdown, is_held)
