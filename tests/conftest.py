"""Shared fixtures: one environment, its compiled functions, scripted plants and small tracks."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytrack_env.blackbox import BlackBox
from flytrack_env.blackbox import load as load_black_box
from flytrack_env.dynamics import ModelParameters
from flytrack_env.env import EnvParams, FlyTrack
from flytrack_env.plants import Plant
from flytrack_env.quaternion import Quaternion, Scalar, Vec3
from flytrack_env.state import Action, Drone
from flytrack_env.tracks import Gate, Track
from tests.support.black_boxes import SHIPPED
from tests.support.compiled_programs import share_compiled_programs

share_compiled_programs()

MEMORY_MAPS, MOST_MEMORY_MAPS = Path("/proc/self/maps"), 25_000
FACING_X = (0.5**0.5, 0.0, 0.0, -(0.5**0.5))  # yaw -90 degrees: the gate's local +y is world +x


class Coasting(Plant):
    """A plant that flies straight on at constant velocity, whatever the command."""

    def reset(self, drone: Drone, model: ModelParameters) -> Drone:
        """Return the drone."""
        return drone

    def step(self, state: Drone, command: Action, dt: Scalar, model: ModelParameters) -> Drone:
        """Return the drone moved along its velocity."""
        return state._replace(pos_w=state.pos_w + state.vel_w.scale(dt))

    def drone(self, state: Drone) -> Drone:
        """Return the drone."""
        return state


def drone_at(
    position: Any, velocity: Any = (0.0, 0.0, 0.0), quat: Any = (1.0, 0.0, 0.0, 0.0), **fields: Any
) -> Drone:
    """Return a drone of float32 leaves; ``fields`` replace the other parts of its state."""
    drone = Drone(
        pos_w=Vec3(*position),
        vel_w=Vec3(*velocity),
        acc_w=Vec3(0.0, 0.0, 0.0),
        quat=Quaternion(*quat),
        rates_b=Vec3(0.0, 0.0, 0.0),
        applied=Action(0.0, 0.0, 0.0, 0.0),
        battery_v=23.5,
    )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), drone._replace(**fields))


def track_of_row(distances: list[float]) -> Track:
    """Return a track of gates in a row along +x at these x, flown towards +x."""
    gates = tuple(Gate(i, (x, 0.0, 2.0), FACING_X, 1.0, 1.5, 2.7) for i, x in enumerate(distances))
    low, high = (min(distances) - 100.0, -50.0, 0.0), (max(distances) + 100.0, 50.0, 50.0)
    return Track("row", gates, (min(distances) - 5.0, 0.0, 2.0), (1.0, 0.0, 0.0, 0.0), low, high)


@pytest.fixture(scope="module", autouse=True)
def few_programs_at_a_time():
    """Forget compiled programs before the process has more memory maps than the system allows.

    A compiled program takes some maps, Linux allows 65,530 a process, and XLA aborts where it gets none.
    """
    yield
    if MEMORY_MAPS.exists() and MEMORY_MAPS.read_bytes().count(b"\n") > MOST_MEMORY_MAPS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def env() -> FlyTrack:
    """The environment as gymnax makes it."""
    return gymnax.make("FlyTrack-v0")[0]


@pytest.fixture(scope="session")
def params(env: FlyTrack) -> EnvParams:
    """Its default parameters."""
    return env.default_params


@pytest.fixture(scope="session")
def reset_many(env: FlyTrack) -> Callable[..., Any]:
    """``env.reset`` for a batch of keys, compiled once per batch size."""
    return jax.jit(jax.vmap(env.reset, in_axes=(0, None)))


@pytest.fixture(scope="session")
def make_drone() -> Callable[..., Drone]:
    """``drone_at``."""
    return drone_at


@pytest.fixture(scope="session")
def row_track() -> Callable[[list[float]], Track]:
    """``track_of_row``."""
    return track_of_row


@pytest.fixture(scope="session")
def coasting() -> Coasting:
    """A plant at constant velocity."""
    return Coasting()


@pytest.fixture(scope="session")
def coasting_envs(coasting: Coasting) -> Callable[[Track, str], FlyTrack]:
    """A function that returns the coasting environment of a track and a missed-gate setting."""
    return cache(lambda track, missed_gate: FlyTrack(track=track, plant=coasting, missed_gate=missed_gate))


@pytest.fixture(scope="module")
def trainer() -> Any:
    """The small trainer of the baseline's tests, compiled once for a process."""
    from tests.support.ppo_runs import make_trainer

    return make_trainer()


@pytest.fixture(scope="module")
def whole(trainer: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray]]:
    """A training run that nothing cut off: its folder and its metrics."""
    from tests.support.ppo_runs import EVERY_OTHER_UPDATE, SEED

    out = tmp_path_factory.mktemp("whole")
    return out, trainer.train(out, SEED, EVERY_OTHER_UPDATE)[1]


@pytest.fixture(scope="module")
def black_box() -> BlackBox:
    """The shipped black box."""
    return load_black_box(SHIPPED)


@pytest.fixture(scope="module")
def fly_black_box(black_box: BlackBox) -> Callable[..., np.ndarray]:
    """One step of the shipped plant, compiled once for the module."""
    step = jax.jit(black_box.step_vector)
    return lambda x, u: np.asarray(step(x, u))
