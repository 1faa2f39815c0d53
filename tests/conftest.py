"""Shared fixtures: an environment, its compiled functions, the trainer, the shipped black box."""

import os
from pathlib import Path

import jax
import numpy as np
import pytest

MEMORY_MAPS, MOST_MEMORY_MAPS = Path("/proc/self/maps"), 25_000


def pytest_configure(config):
    """Have programs compiled by LLVM's first level, and by XLA's older code for fusions.

    Both take less time: the second a fifth of all of 264 tests. XLA reads its flags once, so that
    this file imports nothing that computes before this function is called.
    """
    flags = "--xla_backend_optimization_level=1 --xla_cpu_use_fusion_emitters=false"
    os.environ.setdefault("XLA_FLAGS", flags)


@pytest.fixture(scope="module", autouse=True)
def few_programs_at_a_time():
    """Forget compiled programs before the process has more memory maps than the system allows.

    A compiled program takes some maps, Linux allows 65,530 a process, and XLA aborts where it gets
    none.
    """
    yield
    if MEMORY_MAPS.exists() and MEMORY_MAPS.read_bytes().count(b"\n") > MOST_MEMORY_MAPS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def env():
    """The environment as gymnax makes it."""
    import gymnax

    import flytrack_env  # noqa: F401, registers the ids

    return gymnax.make("FlyTrack-v0")[0]


@pytest.fixture(scope="session")
def params(env):
    """Its default parameters."""
    return env.default_params


@pytest.fixture(scope="module")
def trainer():
    """The small trainer of the baseline's tests, compiled once for a process."""
    from tests.support.ppo_runs import make_trainer

    return make_trainer()


@pytest.fixture(scope="module")
def whole(trainer, tmp_path_factory):
    """A training run that nothing cut off: its folder and its metrics."""
    from tests.support.ppo_runs import EVERY_OTHER_UPDATE, SEED

    out = tmp_path_factory.mktemp("whole")
    return out, trainer.train(out, SEED, EVERY_OTHER_UPDATE)[1]


@pytest.fixture(scope="module")
def black_box():
    """The shipped black box."""
    from flytrack_env import blackbox

    return blackbox.load(blackbox.SHIPPED)


@pytest.fixture(scope="module")
def fly_black_box(black_box):
    """One step of the shipped plant, compiled once for the module."""
    step = jax.jit(black_box.step_vector)
    return lambda x, u: np.asarray(step(x, u))


@pytest.fixture(scope="session")
def truth():
    """A made-up flight of 20 s at 100 Hz, all clocks the same."""
    from tests.support.made_flight import TIME_S, flight

    return flight(TIME_S)
