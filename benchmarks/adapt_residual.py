"""A rival of ``flytrack adapt``: a small network learns what acceleration a model misses.

As in work that learns residual dynamics online and differentiates through them (J. Pan et al.,
"Learning on the Fly: Rapid Policy Adaptation via Differentiable Simulation", 2025): the policy's
own model plus a network of the state. The policy descends through both by the same polishing as
``flytrack adapt``, and moves there in the same way.
"""

from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

from baselines.purejaxrl_ppo import Checkpoint
from baselines.purejaxrl_ppo.checkpoint_env import plant_env
from baselines.purejaxrl_ppo.polish import LostError, polish
from flytrack_env import ModelParameters
from flytrack_env.dynamics import step as step_row
from flytrack_env.effects import LearnedLaw
from flytrack_env.plants import Simulator, SimulatorState
from flytrack_env.quaternion import Quaternion, Scalar, Vec3
from flytrack_env.state import VELOCITY, Action, Drone, unpack
from flytrack_loop.adapt import Settings, draw_moving, embed
from flytrack_sysid import FlightLog
from flytrack_sysid.diagnosis.plausible import PlausibleModels
from flytrack_sysid.inference.parameters import to_vector

WINDOW = 10  # rows over which accelerations are summed, since one row's is mostly noise
LEAD_IN = 50  # rows of a flight until the lagged action that it began with is forgotten
UPDATES, LEARNING_RATE, DECAY = 2000, 3e-3, 1e-3
SCALES = np.array([10.0] * 3 + [5.0] * 3 + [1.0] * 5, np.float32)  # m/s, rad/s, 1, V


class Residual(nn.Module):
    """An acceleration in body axes, m/s^2, of a drone's features."""

    @nn.compact
    def __call__(self, features: jax.Array) -> jax.Array:
        hidden = nn.tanh(nn.Dense(32)(features / SCALES))
        hidden = nn.tanh(nn.Dense(32)(hidden))
        return nn.Dense(3, kernel_init=nn.initializers.zeros)(hidden)


def compute_features(drone: Drone, full_v: Scalar) -> jax.Array:
    """Return velocity, rates and the vertical in body axes, applied thrust and voltage, (11,)."""
    to_body = Quaternion(drone.quat.w, -drone.quat.x, -drone.quat.y, -drone.quat.z)
    seen = to_body.rotate(drone.vel_w), drone.rates_b, to_body.rotate(Vec3(0.0, 0.0, 1.0))
    return jnp.stack([*seen[0], *seen[1], *seen[2], drone.applied.thrust, drone.battery_v - full_v])


class WithResidual(Simulator):
    """A simulator whose drone a network accelerates, as much as the learnt law's scale says."""

    def __init__(self, weights: Any):
        super().__init__()
        self.weights = weights

    def reset(self, drone: Drone, model: ModelParameters) -> SimulatorState:
        """Return the drone with fresh memories."""
        return super().reset(drone, without_law(model))

    def step(
        self, state: SimulatorState, command: Action, dt: Scalar, model: ModelParameters
    ) -> SimulatorState:
        """Return the next state of the model, and of the network's acceleration over the step."""
        after = super().step(state, command, dt, without_law(model))
        features = compute_features(state.drone, model.battery.full_v)
        change_b = jnp.asarray(Residual().apply(self.weights, features)) * dt
        change = state.drone.quat.rotate(Vec3(*(change_b * model.effect("learned_law").scale)))
        velocity = Vec3(*(a + b for a, b in zip(after.drone.vel_w, change, strict=True)))
        return after._replace(drone=after.drone._replace(vel_w=velocity))


def without_law(model: ModelParameters) -> ModelParameters:
    """Return a model without the law that only has the network's scale."""
    others = tuple(one for one in model.effects if not isinstance(one, LearnedLaw))
    return model._replace(effects=others)


def learn(log: FlightLog, base: ModelParameters, seed: int) -> Any:
    """Return the network's weights: sums of its accelerations are what the model misses."""
    dt = float(np.median(np.diff(log.time)))
    steps_s = np.diff(log.time, prepend=log.time[0])  # sensors lose rows
    commands = log["u"].astype(np.float32)
    applied = commands.copy()
    for row in np.flatnonzero(~log.is_start()):
        fades = np.exp(-steps_s[row] / np.asarray(base.tau))
        applied[row] = commands[row - 1] + (applied[row - 1] - commands[row - 1]) * fades
    states = np.concatenate(
        [log["p"], log["v"], np.zeros((len(log), 3)), log["q"], log["w"], applied, log["v_bat"]],
        axis=1,
    ).astype(np.float32)
    after = jax.jit(jax.vmap(lambda x, u: step_row(x, u, dt, base)))(states, commands)
    explained = np.asarray(after)[:, VELOCITY] - states[:, VELOCITY]
    starts = np.maximum.accumulate(np.where(log.is_start(), np.arange(len(log)), 0))
    rows = np.arange(len(log) - WINDOW)
    rows = rows[(rows - starts[rows] >= LEAD_IN) & (starts[rows] == starts[rows + WINDOW])]
    rows = rows[log.time[rows + WINDOW] - log.time[rows] < (WINDOW + 0.5) * dt]  # without gaps
    windows = rows[:, None] + np.arange(WINDOW)
    missed = states[rows + WINDOW][:, VELOCITY] - states[rows][:, VELOCITY]
    missed = (missed - explained[windows].sum(axis=1)) / dt
    features = jax.vmap(lambda x: compute_features(unpack(x), base.battery.full_v))(states)
    weights = Residual().init(jax.random.key(seed), features[0])
    optimizer = optax.adamw(optax.cosine_decay_schedule(LEARNING_RATE, UPDATES), weight_decay=DECAY)

    def cost(weights: Any) -> jax.Array:
        acc_b = Residual().apply(weights, features)
        acc_w = jax.vmap(lambda x, a: jnp.stack(unpack(x).quat.rotate(Vec3(*a))))(states, acc_b)
        return optax.huber_loss(acc_w[windows].sum(axis=1), missed, delta=float(WINDOW)).mean()

    def update(carry: Any, _: None) -> tuple[Any, None]:
        weights, state = carry
        changes, state = optimizer.update(jax.grad(cost)(weights), state, weights)
        return (optax.apply_updates(weights, changes), state), None

    train = jax.jit(lambda carry: jax.lax.scan(update, carry, None, UPDATES)[0])
    return train((weights, optimizer.init(weights)))[0]


def adapt_with_residual(
    log: FlightLog, policy: Checkpoint, model: ModelParameters, seed: int
) -> Checkpoint:
    """Return a policy adapted to its model and a network; as it was if that does not race."""
    plant = WithResidual(learn(log, model, seed))
    like = model.with_effects(LearnedLaw(scale=1.0))
    vector = to_vector(like)
    exact = PlausibleModels(like, vector, np.zeros((len(vector), 1)), vector, vector)
    moving = partial(draw_moving, models=exact, start=to_vector(embed(model, like)))
    try:
        params = polish(plant_env(policy, plant), policy.policy, seed, Settings().polishing, moving)
    except LostError:
        return policy
    return policy._replace(params=params)
