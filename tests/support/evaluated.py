"""What evaluations are tested with: a plant on rails, a policy that has learned nothing, the command."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.checkpoint import describe_run, save_checkpoint
from baselines.purejaxrl_ppo.networks import make_network
from flytrack.cli import main
from flytrack_env import make, nominal_parameters
from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import LinearDrag
from flytrack_env.plants import Plant
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.references import shipped_reference
from flytrack_env.state import BATTERY_FULL_V, POSITION, Action, Drone

SLOWER_PER_V = 0.1
FAILS_BELOW_V, FAILS_AT_S = 23.6, 2.0


class OnReference(NamedTuple):
    """State of ``Rails``: the drone and the time since the reset, s."""

    drone: Drone
    time_s: jax.Array


class Rails(Plant):
    """A plant that flies the time-optimal start and laps, whatever the command.

    The lower its battery, the slower it is, by ``pace``; one that is low indeed falls to the ground.
    """

    def __init__(self) -> None:
        self.references = [shipped_reference("flytrack", kind) for kind in ("standing", "flying")]

    @staticmethod
    def pace(battery_v: Any) -> Any:
        """Return how many times longer than the optimum it takes."""
        return 1.0 + SLOWER_PER_V * (BATTERY_FULL_V - battery_v)

    def _at(self, drone: Drone, time_s: jax.Array) -> Drone:
        standing, flying = self.references
        own_s = time_s / self.pace(drone.battery_v)
        lap_s = (own_s - standing.time_s) % flying.time_s

        def position(reference: Any, at_s: jax.Array) -> jax.Array:
            """Return where the reference is, (3,): straight lines between its samples."""
            table = jnp.asarray(reference.states[:, POSITION], jnp.float32)
            sample = jnp.clip(at_s / reference.dt_s, 0.0, len(table) - 1.001)
            before = sample.astype(int)
            part = sample - before
            return (1.0 - part) * table[before] + part * table[before + 1]

        is_start = own_s < standing.time_s
        pos_w = Vec3(*jnp.where(is_start, position(standing, own_s), position(flying, lap_s)))
        is_falling = (drone.battery_v < FAILS_BELOW_V) & (time_s > FAILS_AT_S)
        return drone._replace(pos_w=pos_w._replace(z=jnp.where(is_falling, -1.0, pos_w.z)))

    def reset(self, drone: Drone, model: ModelParameters) -> OnReference:
        """Return the drone at the start of the rails."""
        return OnReference(self._at(drone, jnp.float32(0.0)), jnp.float32(0.0))

    def step(self, state: OnReference, command: Action, dt: Scalar, model: ModelParameters) -> OnReference:
        """Return the drone a step further."""
        time_s = state.time_s + dt
        return OnReference(self._at(state.drone, time_s), time_s)

    def drone(self, state: OnReference) -> Drone:
        """Return the drone."""
        return state.drone


def write_checkpoint(path: Path) -> Path:
    """Write a policy that has learned nothing, with all that a checkpoint tells."""
    env_id = "FlyTrackRandomized-v0"
    env = make(env_id, model=nominal_parameters().with_effects(LinearDrag(0.3, 0.3, 0.1)))
    config = Config(hidden_sizes=(8,))
    size = env.observation_space().shape[0]
    params = make_network(config).init(jax.random.key(0), jnp.zeros((1, size)))
    save_checkpoint(path, params, config, describe_run(env, env_id, "flytrack", config, seed=0))
    return path


def run(*arguments: Any) -> None:
    main(["eval", *map(str, arguments)])
