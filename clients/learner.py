"""The smallest PPO, for loops of one's own: what they do with a flight."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

NUM_ENVS, NUM_STEPS, NUM_UPDATES, NUM_EPOCHS, NUM_MINIBATCHES = 256, 64, 120, 4, 8
GAMMA, LAMBDA, CLIP, STD = 0.99, 0.95, 0.2, 0.3
OPTIMIZER = optax.adam(1e-3)


class Network(nn.Module):
    """Mean action and value of an observation."""

    @nn.compact
    def __call__(self, observation: Any) -> tuple[jax.Array, jax.Array]:
        outputs = []
        for size in (4, 1):
            hidden = nn.tanh(nn.Dense(64)(nn.tanh(nn.Dense(64)(observation))))
            outputs.append(nn.Dense(size, kernel_init=nn.initializers.orthogonal(0.01))(hidden))
        return outputs[0], outputs[1][..., 0]


def begin(key: jax.Array, observations: Any) -> tuple[Any, Any]:
    """Return the variables of a network for these observations, and the optimiser's state."""
    variables = Network().init(key, observations)
    return variables, OPTIMIZER.init(variables)


@jax.jit
def act(training: Any, observations: Any, key: jax.Array) -> jax.Array:
    """Return actions, (NUM_ENVS, 4), around the policy's mean."""
    mean = Network().apply(training[0], observations)[0]
    return mean + STD * jax.random.normal(key, mean.shape)


@jax.jit
def learn(training: Any, key: jax.Array, last: Any, steps: Any) -> Any:
    """Return the training after a flight. A truncation counts as an end.

    Args:
        last: observations after the flight.
        steps: observations before each step, actions, rewards, whether the episode ended and
            whether the step counts, which a reset does not, (NUM_STEPS, NUM_ENVS, ...).
    """
    observations, actions, rewards, done, counts = steps
    everything = jnp.concatenate([observations, last[None]])
    outputs: Any = Network().apply(training[0], everything)
    means, values = outputs

    def back(advantage: jax.Array, step: Any) -> Any:
        value, next_value, reward, done = step
        advantage = reward + (1.0 - done) * GAMMA * (next_value + LAMBDA * advantage) - value
        return advantage, advantage

    flown = values[:-1], values[1:], rewards, done
    advantages = jax.lax.scan(back, jnp.zeros(NUM_ENVS), flown, reverse=True)[1]
    scaled = (advantages - advantages.mean()) / advantages.std()
    batch: Any = observations, actions, counts, means[:-1], scaled, advantages + values[:-1]
    batch = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)

    def loss(variables: Any, places: jax.Array) -> jax.Array:
        observations, actions, counts, old_means, advantages, targets = (x[places] for x in batch)
        mean, value = Network().apply(variables, observations)
        change = ((actions - old_means) ** 2 - (actions - mean) ** 2).sum(-1)
        ratio = jnp.exp(change / (2.0 * STD**2))
        gain = jnp.minimum(ratio * advantages, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantages)
        return jnp.mean(counts * (0.5 * (value - targets) ** 2 - gain))

    def improve(training: Any, places: jax.Array) -> Any:
        changes, memory = OPTIMIZER.update(jax.grad(loss)(training[0], places), training[1])
        return (optax.apply_updates(training[0], changes), memory), None

    orders = [jax.random.permutation(each, done.size) for each in jax.random.split(key, NUM_EPOCHS)]
    return jax.lax.scan(
        improve, training, jnp.stack(orders).reshape(NUM_EPOCHS * NUM_MINIBATCHES, -1)
    )[0]
