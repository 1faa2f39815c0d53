"""Shared fixtures: one environment, its compiled functions, scripted plants and small tracks."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytrack_env.blackbox import BlackBox
from flytrack_env.blackbox import load as load_black_box
from flytrack_env.dynamics import ModelParameters
from flytrack_env.env import EnvParams, EnvState, FlyTrack
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


class OnRails(NamedTuple):
    """State of ``Railway``: the drone and the length flown along the rails, m."""

    drone: Drone
    arc: jax.Array


@dataclass(frozen=True, eq=False)
class Railway(Plant):
    """A plant that flies a closed polyline at constant speed; starts at the nearest corner."""

    corners: np.ndarray
    speed: float

    @property
    def arcs(self) -> np.ndarray:
        """Return the length along the polyline at each corner and, last, of the whole."""
        legs = np.linalg.norm(np.roll(self.corners, -1, axis=0) - self.corners, axis=1)
        return np.concatenate([[0.0], np.cumsum(legs)])

    def reset(self, drone: Drone, model: ModelParameters) -> OnRails:
        """Return the state at the corner nearest to the drone."""
        pos_w = jnp.stack([jnp.asarray(value) for value in drone.pos_w])
        nearest = jnp.argmin(jnp.linalg.norm(jnp.asarray(self.corners) - pos_w, axis=1))
        return OnRails(drone, jnp.asarray(self.arcs[:-1], jnp.float32)[nearest])

    def step(self, state: OnRails, command: Action, dt: Scalar, model: ModelParameters) -> OnRails:
        """Return the state a little further along the rails."""
        arc = (state.arc + self.speed * dt) % self.arcs[-1]
        closed = np.concatenate([self.corners, self.corners[:1]])
        pos_w = Vec3(*(jnp.interp(arc, self.arcs, closed[:, axis]) for axis in range(3)))
        return OnRails(state.drone._replace(pos_w=pos_w), arc)

    def drone(self, state: OnRails) -> Drone:
        """Return the drone."""
        return state.drone


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


def toml_of(track: Track) -> str:
    """Return a track as the text of a track file."""
    signs = {1.0: "+y", -1.0: "-y"}
    lines = [
        f'name = "{track.name}"',
        f"[start]\nposition = {list(track.start_position)}",
        f"quaternion = {list(track.start_quaternion)}",
        f"[bounds]\nlow = {list(track.bounds_low)}\nhigh = {list(track.bounds_high)}",
    ]
    for gate in track.gates:
        lines += [
            f"[[gates]]\nid = {gate.id}\nposition = {list(gate.position)}",
            f'quaternion = {list(gate.quaternion)}\ndirection = "{signs[gate.direction]}"',
            f"opening = {gate.opening}\nframe = {gate.frame}",
        ]
    return "\n".join(lines) + "\n"


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
def rollout() -> Callable[..., Any]:
    """A function that flies a batch: (env, keys, states, actions (T, N, 4), params) -> steps.

    Compiled once per environment; the state before each step and all outputs of ``step`` come back.
    """

    @cache
    def compiled(env: FlyTrack) -> Callable[..., Any]:
        def fly(key: jax.Array, states: EnvState, actions: jax.Array, params: EnvParams) -> Any:
            def one(carry: EnvState, inputs: tuple[jax.Array, jax.Array]) -> Any:
                index, action = inputs
                keys = jax.random.split(jax.random.fold_in(key, index), action.shape[0])
                outputs = jax.vmap(env.step, in_axes=(0, 0, 0, None))(keys, carry, action, params)
                return outputs[1], (carry, outputs)

            return jax.lax.scan(one, states, (jnp.arange(actions.shape[0]), actions))[1]

        return jax.jit(fly)

    return lambda env, *arguments: compiled(env)(*arguments)


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
def write_toml() -> Callable[[Track], str]:
    """``toml_of``."""
    return toml_of


@pytest.fixture(scope="session")
def coasting() -> Coasting:
    """A plant at constant velocity."""
    return Coasting()


@pytest.fixture(scope="session")
def make_railway() -> type[Railway]:
    """A plant on rails."""
    return Railway


@pytest.fixture(scope="session")
def coasting_envs(
    tmp_path_factory: pytest.TempPathFactory, coasting: Coasting
) -> Callable[[Track, str], FlyTrack]:
    """A function that returns the coasting environment of a track and a missed-gate setting."""

    @cache
    def build(track: Track, missed_gate: str) -> FlyTrack:
        path = tmp_path_factory.mktemp("tracks") / "track.toml"
        path.write_text(toml_of(track), encoding="utf-8")
        return FlyTrack(track=path, plant=coasting, missed_gate=missed_gate)

    return build


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


@pytest.fixture(scope="module")
def step_all(env: FlyTrack) -> Callable[..., Any]:
    """``env.step`` for a batch."""
    return jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))


@pytest.fixture(scope="module")
def step_env_all(env: FlyTrack) -> Callable[..., Any]:
    """``env.step_env`` for a batch."""
    return jax.jit(jax.vmap(env.step_env, in_axes=(None, 0, 0, None)))
