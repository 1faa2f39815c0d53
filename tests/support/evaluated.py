"""What evaluations are tested with: a plant on rails, a policy that has learned nothing."""

import jax
import jax.numpy as jnp
import numpy as np

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.checkpoint import describe_run, save_checkpoint
from baselines.purejaxrl_ppo.networks import make_network
from flytrack_env import make, nominal_parameters
from flytrack_env.effects import LinearDrag
from flytrack_env.plants import Plant
from flytrack_env.quaternion import Vec3
from flytrack_env.references import shipped_reference
from flytrack_env.state import BATTERY_FULL_V, POSITION

SLOWER_PER_V = 0.1
FAILS_BELOW_V, FAILS_AT_S = 23.6, 2.0


class Rails(Plant):
    """A plant that flies the time-optimal start and laps, whatever the command.

    The lower its battery, the slower it is, by ``pace``; one that is low indeed falls to the
    ground.
    """

    def __init__(self):
        standing, flying = (shipped_reference("flytrack", kind) for kind in ("standing", "flying"))
        laps = (standing, flying, flying, flying)
        ends_s = np.cumsum([lap.time_s for lap in laps])
        own_s = [lap.dt_s * np.arange(len(lap.commands)) - lap.time_s for lap in laps]
        self.time_s = np.concatenate(
            [end + times for end, times in zip(ends_s, own_s, strict=True)]
        )
        self.positions = np.concatenate([lap.states[:-1, POSITION] for lap in laps])

    @staticmethod
    def pace(battery_v):
        """Return how many times longer than the optimum it takes."""
        return 1.0 + SLOWER_PER_V * (BATTERY_FULL_V - battery_v)

    def _at(self, drone, time_s):
        own_s = time_s / self.pace(drone.battery_v)
        pos_w = Vec3(*(jnp.interp(own_s, self.time_s, axis) for axis in self.positions.T))
        is_falling = (drone.battery_v < FAILS_BELOW_V) & (time_s > FAILS_AT_S)
        return drone._replace(pos_w=pos_w._replace(z=jnp.where(is_falling, -1.0, pos_w.z))), time_s

    def reset(self, drone, model):
        """Return the drone at the start of the rails, and the time since then, s."""
        return self._at(drone, jnp.float32(0.0))

    def step(self, state, command, dt, model):
        return self._at(state[0], state[1] + dt)

    def drone(self, state):
        return state[0]


def write_checkpoint(path, env_id="FlyTrackRandomized-v0", track="flytrack", hidden_sizes=(8,)):
    """Write a policy that has learned nothing, with all that a checkpoint tells."""
    env = make(
        env_id, track=track, model=nominal_parameters().with_effects(LinearDrag(0.3, 0.3, 0.1))
    )
    config = Config(hidden_sizes=hidden_sizes)
    size = env.observation_space().shape[0]
    params = make_network(config).init(jax.random.key(5), jnp.zeros((1, size)))
    uneven = jax.tree.map(
        lambda leaf: 0.1 * jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape), params
    )
    params = jax.tree.map(jnp.add, params, uneven)
    save_checkpoint(path, params, config, describe_run(env, env_id, track, config, seed=0))
    return path
