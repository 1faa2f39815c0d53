"""Actor and critic: separate tanh networks with orthogonal initialisation.

The standard deviation of the actions does not depend on the state.
"""

from collections.abc import Sequence
from typing import Any

import distrax
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from baselines.purejaxrl_ppo.config import Config

Memory = Any  # what a policy remembers of an episode, a pytree; () of one that remembers nothing


class _Gru(nn.Module):
    """A gated recurrent unit (K. Cho et al., arXiv 1406.1078), reset where an episode ends.

    Attributes:
        size: of its memory.
    """

    size: int

    @nn.compact
    def __call__(
        self, memory: jax.Array, step: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        """Return the memory after a step: for the next one, and before a reset."""
        observation, done = step
        memory, _ = nn.GRUCell(self.size)(memory, observation)
        return jnp.where(done[..., None], 0.0, memory), memory


class ActorCritic(nn.Module):
    """Policy and value of an observation and, if the network has one, a memory of the episode.

    The attributes are the fields of ``Config`` of the same names.

    Attributes:
        num_choices: number of discrete actions; 0 for continuous ones.
    """

    hidden_sizes: Sequence[int]
    initial_action: Sequence[float]
    initial_std: float
    min_std: float
    num_choices: int = 0
    memory_size: int = 0

    def setup(self) -> None:
        """Declare the layers."""
        self.actor = self._tower("actor", self.num_choices or len(self.initial_action), 0.01)
        self.critic = self._tower("critic", 1, 1.0)
        if not self.num_choices:
            start = nn.initializers.constant(np.log(self.initial_std))
            self.log_std = self.param("log_std", start, (len(self.initial_action),))
        if self.memory_size:
            over_steps = nn.scan(
                _Gru,
                variable_broadcast="params",
                split_rngs={"params": False},
                in_axes=1,
                out_axes=1,
            )
            self.gru = over_steps(self.memory_size)

    def _tower(self, name: str, size: int, last_scale: float) -> nn.Sequential:
        layers: list[Any] = []
        for width in self.hidden_sizes:
            layers += [nn.Dense(width, kernel_init=nn.initializers.orthogonal(np.sqrt(2))), nn.tanh]
        layers.append(nn.Dense(size, kernel_init=nn.initializers.orthogonal(last_scale)))
        return nn.Sequential(layers, name=f"{name}_tower")

    def policy(self, known: jax.Array) -> distrax.Distribution:
        """Return the distribution over actions, batch shape as that of what is known."""
        if self.num_choices:
            return distrax.Categorical(logits=self.actor(known))
        mean = self.actor(known) + jnp.asarray(self.initial_action)
        std = jnp.maximum(jnp.exp(self.log_std), self.min_std)
        return distrax.MultivariateNormalDiag(mean, jnp.broadcast_to(std, mean.shape))

    def value(self, known: jax.Array) -> jax.Array:
        """Return the value, batch shape as that of what is known."""
        return self.critic(known).squeeze(-1)

    def __call__(self, observation: jax.Array) -> tuple[distrax.Distribution, jax.Array]:
        """Return policy and value of first observations of episodes."""
        return self.step(self.first_memory(observation.shape[:-1]), observation)[1:]

    @nn.nowrap
    def first_memory(self, batch_shape: tuple[int, ...] = ()) -> Memory:
        """Return the memory at the start of an episode, (*batch_shape, memory_size), or ()."""
        return jnp.zeros((*batch_shape, self.memory_size)) if self.memory_size else ()

    def step(
        self, memory: Memory, observation: jax.Array
    ) -> tuple[Memory, distrax.Distribution, jax.Array]:
        """Return the memory after a step, policy and value."""
        memory, known = self._remember(memory, observation)
        return memory, self.policy(known), self.value(known)

    def value_of(self, memory: Memory, observation: jax.Array) -> jax.Array:
        """Return the value of an observation after what is remembered."""
        return self.value(self._remember(memory, observation)[1])

    def unroll(
        self, memory: Memory, observation: jax.Array, done: jax.Array
    ) -> tuple[distrax.Distribution, jax.Array]:
        """Return policy and value of steps: in any order, or with a memory in their order.

        Args:
            memory: (num_envs, num_steps, memory_size), of which that of the first step counts; or
                ().
            observation: (num_envs, num_steps, size) with a memory, else (num_rows, size).
            done: whether an episode ends after the step, (num_envs, num_steps).
        """
        if self.memory_size:
            remembered = self.gru(memory[:, 0], (observation, done))[1]
            observation = jnp.concatenate([observation, remembered], axis=-1)
        return self.policy(observation), self.value(observation)

    def _remember(self, memory: Memory, observation: jax.Array) -> tuple[Memory, jax.Array]:
        """Return the memory after a step, and what is known in it."""
        if not self.memory_size:
            return memory, observation
        rows = observation.reshape(-1, 1, observation.shape[-1])
        never = jnp.zeros(rows.shape[:2], bool)
        after = self.gru(memory.reshape(len(rows), -1), (rows, never))[0].reshape(memory.shape)
        return after, jnp.concatenate([observation, after], axis=-1)

    @nn.nowrap
    def act(self, params: Any, memory: Memory, observation: jax.Array) -> tuple[Memory, jax.Array]:
        """Return the memory after a step, and the mean action, in [-1, 1]."""
        found: Any = self.apply(params, memory, observation, method="step")
        return found[0], jnp.clip(found[1].mode(), -1.0, 1.0)


@struct.dataclass
class Policy:
    """A network and its parameters.

    The network has ``first_memory()`` and ``act(params, memory, observation)``.
    """

    network: Any = struct.field(pytree_node=False)
    params: Any


def make_network(config: Config, num_choices: int = 0) -> ActorCritic:
    """Return the network that a configuration describes.

    num_choices: number of discrete actions; 0 for continuous ones.
    """
    return ActorCritic(
        hidden_sizes=config.hidden_sizes,
        initial_action=config.initial_action,
        initial_std=config.initial_std,
        min_std=config.min_std,
        num_choices=num_choices,
        memory_size=config.memory_size,
    )
