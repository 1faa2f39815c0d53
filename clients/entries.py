"""Policies of other trainers for ``flytrack bench``: ``clients.entries:sb3_0`` is that of seed 0.

Each policy is trained on FlyTrack-v0 at its first use, with the settings and number of steps of
this folder.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import torch

from clients import evosax_es, rejax_ppo, sb3_ppo

STEPS = 5_000_000
Act = Callable[[jax.Array], jax.Array]


def act_of(model: Any) -> Act:
    """Return the mean action of a policy of Stable-Baselines3 as a function of the observation."""
    layers = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
    linear = [one for one in layers if isinstance(one, torch.nn.Linear)]
    arrays = [(one.weight.detach().numpy().T, one.bias.detach().numpy()) for one in linear]
    *hidden, last = [(jnp.array(weight), jnp.array(bias)) for weight, bias in arrays]

    def act(observation: jax.Array) -> jax.Array:
        for weight, bias in hidden:
            observation = jnp.tanh(observation @ weight + bias)
        return observation @ last[0] + last[1]

    return act


def sb3(seed: int) -> Act:
    """Return Stable-Baselines3's PPO."""
    model = sb3_ppo.make_model(seed)
    model.learn(STEPS)
    return act_of(model)


def rejax(seed: int) -> Act:
    """Return rejax's PPO."""
    ppo = rejax_ppo.make_ppo().replace(total_timesteps=STEPS, eval_freq=STEPS)
    train_state, _ = jax.jit(ppo.train)(jax.random.key(seed))

    def act(observation: jax.Array) -> jax.Array:
        params = train_state.actor_ts.params
        return ppo.actor.apply(params, observation[None], method="_action_dist").mode()[0]

    return act


def evosax(seed: int) -> Act:
    """Return the mean of evosax's strategy; its length is that of its own settings."""
    problem, network, state = evosax_es.evolve(seed)
    return lambda observation: problem.policy.apply(
        network, problem.normalize_obs(observation, state), jax.random.key(0)
    )


TRAINERS = {"sb3": sb3, "rejax": rejax, "evosax": evosax}


def __getattr__(name: str) -> Act:
    trainer, _, seed = name.rpartition("_")
    if trainer not in TRAINERS or not seed.isdecimal():
        raise AttributeError(
            f"found {name}, expected one of {', '.join(TRAINERS)}, and a seed: sb3_0"
        )
    return TRAINERS[trainer](int(seed))
