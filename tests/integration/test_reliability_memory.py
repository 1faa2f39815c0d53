"""The part of the reliability page on memory: what does not grow passes, what does is seen."""

import gc
import mmap
import weakref
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from baselines.purejaxrl_ppo.density import draw_position_density
from baselines.purejaxrl_ppo.options import Options
from baselines.purejaxrl_ppo.run import Run
from baselines.purejaxrl_ppo.training import Trainer
from benchmarks.reliability import memory
from benchmarks.reliability.memory import (
    SECTION,
    Sample,
    describe,
    growth,
    options_of,
    reasons_against,
    take_sample,
    watch_resets,
    watch_training,
)
from flytrack_env import load_track
from tests.support.ppo_runs import CONFIG, SEED, make_trainer

AMOUNTS = range(100, 10_001, 100)


def samples_of(values: Any) -> list[Sample]:
    """Return samples of 10,000 resets with these resident MiB."""
    return [Sample(amount, float(value), 0, 0) for amount, value in zip(AMOUNTS, values, strict=True)]


def test_a_warm_up_a_jump_and_noise_are_no_growth_and_a_leak_is() -> None:
    at = np.array(AMOUNTS)
    rng = np.random.default_rng(0)
    warm_up = 500.0 - 300.0 * np.exp(-at / 400.0)
    jump, noise = np.where(at > 9000, 30.0, 0.0), rng.normal(0.0, 0.5, len(at))
    for values in (warm_up, warm_up + noise, jump + noise):
        assert abs(growth(samples_of(values), "resident_mib")) < 2.0
    leak = 0.0005 * at  # 500 bytes in each
    assert growth(samples_of(warm_up + noise + leak), "resident_mib") == pytest.approx(5.0, abs=0.6)
    row = describe("leak", "resets", samples_of(warm_up + noise + leak))
    assert reasons_against(row) == ["resident MiB"]
    assert row["resident_mib"][0] < row["resident_mib"][-1] and row["amount"] == 10_000
    result = {"rows": [row], "cpu_minutes": 0.1}
    assert not SECTION.is_held(result) and "grows: resident MiB" in SECTION.as_markdown(result)
    result = {"rows": [describe("none", "resets", samples_of(warm_up))], "cpu_minutes": 0.1}
    assert SECTION.is_held(result) and "grows" not in SECTION.as_markdown(result)


def fresh_pages(num_bytes: int) -> mmap.mmap:
    """Return memory that was nobody's: what an earlier test gave back to C's allocator would hide a leak."""
    pages = mmap.mmap(-1, num_bytes)
    pages.write(b"\1" * num_bytes)
    return pages


class Empty(gymnasium.Env[np.ndarray, np.ndarray]):
    """An environment that does nothing, and keeps what it is told to."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def __init__(self, keep: Any = None):
        self.keep, self.kept = keep, list[Any]()

    def reset(self, **_: Any) -> Any:
        """Keep something."""
        if self.keep is not None:
            self.kept.append(self.keep())

    def step(self, action: Any) -> Any:
        """Do nothing."""

    def render(self) -> Any:
        """Draw nothing."""


LEAKS: dict[str, Any] = {
    "nothing": None,
    "JAX arrays": lambda: jnp.zeros(3),
    "blocks of Python's": lambda: float(np.random.default_rng().random()),
    "resident MiB": lambda: fresh_pages(2**15),
}


@pytest.mark.parametrize("name", LEAKS)
def test_resets_that_leak_are_seen(name: str) -> None:
    """In what leaks; what that takes beside is seen, too."""
    found = reasons_against(describe(name, "resets", watch_resets(Empty(LEAKS[name]), 2000, 0)))
    assert name in found if LEAKS[name] else found == []


@pytest.mark.parametrize("is_vector", [False, True])
def test_a_small_share_of_resets_holds(is_vector: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of resident memory and JAX arrays: Python's allocator warms up for longer than this lasts."""
    monkeypatch.setattr(memory, "available_tracks", lambda: ("flytrack", "figure_eight"))
    env_id = "FlyTrack-v0"
    make = gymnasium.make
    if is_vector:
        make = lambda env_id: gymnasium.make_vec(  # noqa: E731
            env_id, num_envs=3, vectorization_mode="vector_entry_point"
        )
    row = describe("", "resets", watch_resets(make(env_id), 400, 100))
    assert row["resident_mib_growth"] < 4.0 and row["arrays_growth"] < 1.0
    assert 100.0 < row["resident_mib"][-1] < 20_000.0


def test_options_of_resets_are_all_kinds() -> None:
    names = {name for index in range(16) for name in options_of(index)}
    assert {"track", "battery_v", "velocity"} <= names and options_of(0) == {}
    assert len({options_of(index)["track"] for index in range(3, 19, 4)}) == 4


@pytest.fixture
def slow_trainer() -> Trainer:
    """The trainer of the baseline's tests, which looks from outside after every update."""
    trainer = make_trainer()
    trainer.most = 1
    yield trainer
    trainer.most = CONFIG.num_updates


def test_a_training_keeps_no_arrays_of_jax(slow_trainer: Trainer, tmp_path: Path) -> None:
    """It kept those of every chunk's metrics, of which it only kept views: 150 MB in 200 M steps."""
    counts: list[int] = []
    options = Options(report=None)
    with pytest.MonkeyPatch.context() as patch:
        took = Run.took

        def counted(self: Run, chunk: Any) -> None:
            took(self, chunk)
            counts.append(len(jax.live_arrays()))

        patch.setattr(Run, "took", counted)
        _, metrics = slow_trainer.train(tmp_path / "run", SEED, options)
    assert len(counts) == CONFIG.num_updates and len(set(counts[1:])) == 1
    assert all(len(row) == CONFIG.num_updates for row in metrics.values())


def test_a_training_that_leaks_is_seen(slow_trainer: Trainer, tmp_path: Path) -> None:
    kept: list[Any] = []
    with pytest.MonkeyPatch.context() as patch:
        took = Run.took

        def leaking(self: Run, chunk: Any) -> None:
            took(self, chunk)
            kept.append((chunk.runner, fresh_pages(2**23)))

        patch.setattr(Run, "took", leaking)
        samples = watch_training(slow_trainer, tmp_path / "run", Options(), 0.001)
    total = CONFIG.num_updates * CONFIG.batch_size
    samples = [sample for sample in samples if sample.amount] + [take_sample(total)]
    row = describe("training", "steps", samples)
    assert row["amount"] == total and reasons_against(row) == ["resident MiB", "JAX arrays"]


def test_a_chart_holds_nothing_that_its_caller_has(tmp_path: Path) -> None:
    """What drew its powers of ten kept the frames of all callers, and with them the flights, for long."""

    def draw(flights: np.ndarray) -> None:
        draw_position_density(tmp_path / "chart.png", flights + 1.0, load_track("flytrack"), 4)

    flights = np.zeros((64, 3))
    held = weakref.ref(flights)
    gc.collect()
    gc.disable()
    try:
        draw(flights)
        del flights
        assert held() is None
    finally:
        gc.enable()
