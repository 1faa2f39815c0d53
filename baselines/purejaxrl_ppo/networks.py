"""Actor and critic: separate tanh networks, orthogonal initialisation, state-independent std."""

from collections.abc import Sequence

import distrax
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from baselines.purejaxrl_ppo.config import Config


class ActorCritic(nn.Module):
    """Policy and value of an observation; fields as in ``Config``."""

    hidden_sizes: Sequence[int]
    initial_action: Sequence[float]
    initial_std: float
    min_std: float

    def setup(self) -> None:
        """Declare the layers."""
        self.actor = self._tower("actor", len(self.initial_action), 0.01)
        self.critic = self._tower("critic", 1, 1.0)
        self.log_std = self.param(
            "log_std",
            nn.initializers.constant(np.log(self.initial_std)),
            (len(self.initial_action),),
        )

    def _tower(self, name: str, size: int, last_scale: float) -> nn.Sequential:
        layers: list = []
        for width in self.hidden_sizes:
            layers += [nn.Dense(width, kernel_init=nn.initializers.orthogonal(np.sqrt(2))), nn.tanh]
        layers.append(nn.Dense(size, kernel_init=nn.initializers.orthogonal(last_scale)))
        return nn.Sequential(layers, name=f"{name}_tower")

    def policy(self, observation: jax.Array) -> distrax.Distribution:
        """Return the Gaussian over actions, batch shape as the observation's."""
        mean = self.actor(observation) + jnp.asarray(self.initial_action)
        std = jnp.maximum(jnp.exp(self.log_std), self.min_std)
        return distrax.MultivariateNormalDiag(mean, jnp.broadcast_to(std, mean.shape))

    def value(self, observation: jax.Array) -> jax.Array:
        """Return the value."""
        return self.critic(observation).squeeze(-1)

    def __call__(self, observation: jax.Array) -> tuple[distrax.Distribution, jax.Array]:
        """Return policy and value."""
        return self.policy(observation), self.value(observation)


def make_network(config: Config) -> ActorCritic:
    """Return the network that a configuration describes."""
    return ActorCritic(
        hidden_sizes=config.hidden_sizes,
        initial_action=config.initial_action,
        initial_std=config.initial_std,
        min_std=config.min_std,
    )
