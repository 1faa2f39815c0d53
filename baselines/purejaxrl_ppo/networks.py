"""Actor and critic: separate tanh networks, orthogonal initialisation, state-independent deviation."""

from collections.abc import Sequence
from typing import Any

import distrax
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from baselines.purejaxrl_ppo.config import Config


class ActorCritic(nn.Module):
    """Policy and value of an observation.

    hidden_sizes, initial_action, initial_std, min_std: as in ``Config``. num_choices: number of discrete
    actions; 0 for continuous ones.
    """

    hidden_sizes: Sequence[int]
    initial_action: Sequence[float]
    initial_std: float
    min_std: float
    num_choices: int = 0

    def setup(self) -> None:
        """Declare the layers."""
        self.actor = self._tower("actor", self.num_choices or len(self.initial_action), 0.01)
        self.critic = self._tower("critic", 1, 1.0)
        if self.num_choices:
            return
        self.log_std = self.param(
            "log_std", nn.initializers.constant(np.log(self.initial_std)), (len(self.initial_action),)
        )

    def _tower(self, name: str, size: int, last_scale: float) -> nn.Sequential:
        layers: list[Any] = []
        for width in self.hidden_sizes:
            layers += [nn.Dense(width, kernel_init=nn.initializers.orthogonal(np.sqrt(2))), nn.tanh]
        layers.append(nn.Dense(size, kernel_init=nn.initializers.orthogonal(last_scale)))
        return nn.Sequential(layers, name=f"{name}_tower")

    def policy(self, observation: jax.Array) -> distrax.Distribution:
        """Return the distribution over actions, batch shape as the observation's."""
        if self.num_choices:
            return distrax.Categorical(logits=self.actor(observation))
        mean = self.actor(observation) + jnp.asarray(self.initial_action)
        std = jnp.maximum(jnp.exp(self.log_std), self.min_std)
        return distrax.MultivariateNormalDiag(mean, jnp.broadcast_to(std, mean.shape))

    def value(self, observation: jax.Array) -> jax.Array:
        """Return the value, batch shape as the observation's."""
        return self.critic(observation).squeeze(-1)

    def __call__(self, observation: jax.Array) -> tuple[distrax.Distribution, jax.Array]:
        """Return policy and value."""
        return self.policy(observation), self.value(observation)


def make_network(config: Config, num_choices: int = 0) -> ActorCritic:
    """Return the network that a configuration describes; num_choices: of discrete actions, if they are."""
    return ActorCritic(
        hidden_sizes=config.hidden_sizes,
        initial_action=config.initial_action,
        initial_std=config.initial_std,
        min_std=config.min_std,
        num_choices=num_choices,
    )
