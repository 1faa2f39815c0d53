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
from flytrack_env.observations import OBSERVATION_SIZE

IMAGE_AXES, NUM_FEATURES = 3, 64
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


class _Convolutions(nn.Module):
    """Features of an image: convolutions of 8 x 8 pixels, then of 2 x 2 of these, then a layer.

    They do not overlap, and are written as products of matrices: in the loops of a training, XLA's
    convolutions took eleven times as long on a CPU (4.8 s an update of 8,192 steps, not 0.43).
    """

    @nn.compact
    def __call__(self, image: jax.Array) -> jax.Array:
        """Return features, (..., 64), of images (..., height, width, channels), uint8."""
        values = image.astype(jnp.float32) * (1.0 / 255.0)
        for size, width in ((8, 16), (2, 32)):
            values = nn.tanh(nn.Dense(width)(_patches(values, size)))
        return nn.tanh(nn.Dense(NUM_FEATURES)(values.reshape(*values.shape[:-IMAGE_AXES], -1)))


def _patches(image: jax.Array, size: int) -> jax.Array:
    """Return the patches of images as rows, (..., height / size, width / size, size^2 channels).

    Images are filled up with zeros to whole patches.
    """
    *batch, height, width, channels = image.shape
    missing = [(0, -length % size) for length in (height, width)]
    image = jnp.pad(image, [(0, 0)] * len(batch) + [*missing, (0, 0)])
    rows, columns = -(-height // size), -(-width // size)
    split = image.reshape(*batch, rows, size, columns, size, channels)
    return split.swapaxes(-4, -3).reshape(*batch, rows, columns, size * size * channels)


class ActorCritic(nn.Module):
    """Policy and value of an observation and, if the network has one, a memory of the episode.

    The attributes are the fields of ``Config`` of the same names.

    Attributes:
        num_choices: number of discrete actions; 0 for continuous ones.
        num_state_rows: number of rows at the end of an observation that the critic alone sees.
        sees_image: whether an observation is an image, which convolutions make features of.
        estimates_state: whether a linear layer estimates these rows from what the policy knows.
    """

    hidden_sizes: Sequence[int]
    initial_action: Sequence[float]
    initial_std: float
    min_std: float
    num_choices: int = 0
    memory_size: int = 0
    encoder_sizes: Sequence[int] = ()
    num_state_rows: int = 0
    estimates_state: bool = False
    sees_image: bool = False

    def setup(self) -> None:
        """Declare the layers."""
        self.actor = self._tower("actor", self.num_choices or len(self.initial_action), 0.01)
        self.critic = self._tower("critic", 1, 1.0)
        if not self.num_choices:
            start = nn.initializers.constant(np.log(self.initial_std))
            self.log_std = self.param("log_std", start, (len(self.initial_action),))
        if self.estimates_state:
            self.estimator = nn.Dense(self.num_state_rows)
        if self.sees_image:
            self.convolutions = _Convolutions()
        if self.memory_size:
            over_steps = nn.scan(
                _Gru,
                variable_broadcast="params",
                split_rngs={"params": False},
                in_axes=1,
                out_axes=1,
            )
            self.gru = over_steps(self.memory_size)
            if self.encoder_sizes:
                self.encoder = nn.Sequential(self._layers(self.encoder_sizes))

    def _tower(self, name: str, size: int, last_scale: float) -> nn.Sequential:
        layers = self._layers(self.hidden_sizes)
        layers.append(nn.Dense(size, kernel_init=nn.initializers.orthogonal(last_scale)))
        return nn.Sequential(layers, name=f"{name}_tower")

    @nn.nowrap
    def _layers(self, widths: Sequence[int]) -> list[Any]:
        init = nn.initializers.orthogonal(np.sqrt(2))
        return [layer for width in widths for layer in (nn.Dense(width, kernel_init=init), nn.tanh)]

    def policy(self, known: jax.Array) -> distrax.Distribution:
        """Return the distribution over actions, batch shape as that of what is known."""
        if self.num_choices:
            return distrax.Categorical(logits=self.actor(known))
        mean = self.actor(known) + jnp.asarray(self.initial_action)
        std = jnp.maximum(jnp.exp(self.log_std), self.min_std)
        return distrax.MultivariateNormalDiag(mean, jnp.broadcast_to(std, mean.shape))

    def value(self, known: jax.Array, state: jax.Array | None = None) -> jax.Array:
        """Return the value, batch shape as that of what is known; state: that the critic sees."""
        seen = known if state is None else jnp.concatenate([known, state], axis=-1)
        return self.critic(seen).squeeze(-1)

    def state_error(self, known: jax.Array, state: jax.Array | None) -> jax.Array:
        """Return the mean squared error of the state's estimate, a scalar; 0 without estimate."""
        if state is None or not self.estimates_state:
            return jnp.zeros(())
        return ((self.estimator(known) - state) ** 2).mean()

    def __call__(self, observation: jax.Array) -> tuple[distrax.Distribution, jax.Array]:
        """Return policy and value of first observations of episodes, having used every layer."""
        first = self.first_memory(self._batch_shape(observation))
        known, state = self._split(self._look(observation))
        self.state_error(self._remember(first, known)[1], state)
        return self.step(first, observation)[1:]

    @nn.nowrap
    def first_memory(self, batch_shape: tuple[int, ...] = ()) -> Memory:
        """Return the memory at the start of an episode, (*batch_shape, memory_size), or ()."""
        return jnp.zeros((*batch_shape, self.memory_size)) if self.memory_size else ()

    def step(
        self, memory: Memory, observation: jax.Array
    ) -> tuple[Memory, distrax.Distribution, jax.Array]:
        """Return the memory after a step, policy and value."""
        observation, state = self._split(self._look(observation))
        memory, known = self._remember(memory, observation)
        return memory, self.policy(known), self.value(known, state)

    def decide(self, memory: Memory, observation: jax.Array) -> tuple[Memory, distrax.Distribution]:
        """Return the memory after a step and the policy, of what the policy observes."""
        memory, known = self._remember(memory, self._look(observation))
        return memory, self.policy(known)

    def value_of(self, memory: Memory, observation: jax.Array) -> jax.Array:
        """Return the value of an observation after what is remembered."""
        observation, state = self._split(self._look(observation))
        return self.value(self._remember(memory, observation)[1], state)

    def unroll(
        self, memory: Memory, observation: jax.Array, done: jax.Array
    ) -> tuple[distrax.Distribution, jax.Array, jax.Array]:
        """Return policy, value and error of the state's estimate, of steps.

        In any order, or with a memory in their order.

        Args:
            memory: (num_envs, num_steps, memory_size), of which that of the first step counts; or
                ().
            observation: (num_envs, num_steps, size) with a memory, else (num_rows, size).
            done: whether an episode ends after the step, (num_envs, num_steps).
        """
        known, state = self._split(self._look(observation))
        if self.memory_size:
            remembered = self.gru(memory[:, 0], (self._encode(known), done))[1]
            known = jnp.concatenate([known, remembered], axis=-1)
        return self.policy(known), self.value(known, state), self.state_error(known, state)

    def _encode(self, observation: jax.Array) -> jax.Array:
        """Return what the recurrent unit sees of an observation."""
        return self.encoder(observation) if self.encoder_sizes else observation

    def _look(self, observation: jax.Array) -> jax.Array:
        """Return an observation as rows: an image's features."""
        return self.convolutions(observation) if self.sees_image else observation

    def _batch_shape(self, observation: jax.Array) -> tuple[int, ...]:
        return observation.shape[: -IMAGE_AXES if self.sees_image else -1]

    def _split(self, observation: jax.Array) -> tuple[jax.Array, jax.Array | None]:
        """Return the rows that the policy sees, and those of the state if there are any."""
        if not self.num_state_rows:
            return observation, None
        size = observation.shape[-1] - self.num_state_rows
        return observation[..., :size], observation[..., size:]

    def _remember(self, memory: Memory, observation: jax.Array) -> tuple[Memory, jax.Array]:
        """Return the memory after a step, and what is known in it."""
        if not self.memory_size:
            return memory, observation
        rows = self._encode(observation).reshape(memory.size // self.memory_size, 1, -1)
        never = jnp.zeros(rows.shape[:2], bool)
        after = self.gru(memory.reshape(len(rows), -1), (rows, never))[0].reshape(memory.shape)
        return after, jnp.concatenate([observation, after], axis=-1)

    @nn.nowrap
    def act(self, params: Any, memory: Memory, observation: jax.Array) -> tuple[Memory, jax.Array]:
        """Return the memory after a step, and the mean action, in [-1, 1]."""
        decided: Any = self.apply(params, memory, observation, method="decide")
        memory, policy = decided
        return memory, jnp.clip(policy.mode(), -1.0, 1.0)


@struct.dataclass
class Policy:
    """A network and its parameters.

    The network has ``first_memory()`` and ``act(params, memory, observation)``.
    """

    network: Any = struct.field(pytree_node=False)
    params: Any


def make_network(config: Config, num_choices: int = 0, sees_image: bool = False) -> ActorCritic:
    """Return the network that a configuration describes.

    Args:
        num_choices: number of discrete actions; 0 for continuous ones.
        sees_image: whether an observation is an image.
    """
    return ActorCritic(
        hidden_sizes=config.hidden_sizes,
        initial_action=config.initial_action,
        initial_std=config.initial_std,
        min_std=config.min_std,
        num_choices=num_choices,
        memory_size=config.memory_size,
        encoder_sizes=config.encoder_sizes,
        num_state_rows=OBSERVATION_SIZE if config.critic_sees_state else 0,
        estimates_state=config.state_coef > 0.0,
        sees_image=sees_image,
    )
