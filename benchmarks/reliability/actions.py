"""Actions that no pilot would give: full stick, far beyond it, infinite, not a number."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.randomness import GOLDEN_RATIO_32, UNIFORM_BITS, mix
from flytrack_env.state import ACTION_SIZE

HELD_STEPS = 40  # at full stick: 0.4 s
BEYOND = float(np.nextafter(np.float32(1.0), np.float32(2.0)))  # the first number outside the action space
DENORMAL = 1e-40
NAN_ONE_IN = 64  # steps, of actions that are rarely not a number

CENTRED = (0.0, -0.0, DENORMAL, -DENORMAL)
OUTSIDE = (1.0, -1.0, BEYOND, -BEYOND)
HUGE = (1e38, -1e38, 3.4e38, -3.4e38)
INFINITE = (np.inf, -np.inf)
ANYTHING = (*CENTRED, *OUTSIDE, *HUGE, *INFINITE)


class Words(NamedTuple):
    """What actions are made of: uint32, (num_envs, 4), of this step and of the last HELD_STEPS; the step."""

    now: jax.Array
    held: jax.Array
    step: jax.Array


Kind = Callable[[Words], jax.Array]


def draw_words(seed: jax.Array, step: jax.Array, num_envs: int) -> Words:
    """Return the random words of a step; seed: uint32 scalar, step: int32 scalar."""
    places = jnp.arange(num_envs * ACTION_SIZE, dtype=jnp.uint32).reshape(num_envs, ACTION_SIZE)
    spread = places * jnp.uint32(GOLDEN_RATIO_32)
    now, held = (mix(seed ^ mix(time.astype(jnp.uint32))) for time in (step, step // HELD_STEPS + (1 << 30)))
    return Words(mix(now + spread), mix(held + spread), step)


def _uniform(words: jax.Array) -> jax.Array:
    return (words >> (32 - UNIFORM_BITS)).astype(jnp.float32) * (2.0 / 2**UNIFORM_BITS) - 1.0


def _sign(words: jax.Array) -> jax.Array:
    return jnp.where(words >> 31 == 0, 1.0, -1.0).astype(jnp.float32)


def _of(values: tuple[float, ...]) -> Kind:
    """Return a kind that takes any of some values for every stick."""
    table = np.array(values, np.float32)

    def draw(words: Words) -> jax.Array:
        chosen = jnp.full(words.now.shape, table[0])
        place = (words.now >> 8) % len(table)
        for index, value in enumerate(table[1:], start=1):
            chosen = jnp.where(place == index, value, chosen)
        return chosen

    return draw


def _alternating(words: Words) -> jax.Array:
    return _sign(words.held) * jnp.where(words.step % 2 == 0, 1.0, -1.0)


def _rarely_nan(words: Words) -> jax.Array:
    is_nan = (words.now >> 8) % (NAN_ONE_IN * ACTION_SIZE) == 0
    return jnp.where(is_nan, jnp.nan, _uniform(mix(words.now)))


def _alternately_nan(words: Words) -> jax.Array:
    return jnp.where(words.step % 2 == 0, _uniform(words.now), jnp.nan)


# Each with its share of the environments. What is not a number ends an episode in every step.
KINDS: dict[str, tuple[float, Kind]] = {
    "uniform": (0.22, lambda words: _uniform(words.now)),
    "full stick, held": (0.12, lambda words: _sign(words.held)),
    "full stick, alternating": (0.12, _alternating),
    "full stick, at random": (0.12, lambda words: _sign(words.now)),
    "centred, -0 and denormal": (0.1, _of(CENTRED)),
    "on the edge and just beyond": (0.08, _of(OUTSIDE)),
    "1e38 and more": (0.06, _of(HUGE)),
    "infinite": (0.06, _of(INFINITE)),
    "any of these": (0.06, _of(ANYTHING)),
    "rarely NaN": (0.04, _rarely_nan),
    "every other one NaN": (0.01, _alternately_nan),
    "always NaN": (0.01, lambda words: jnp.full(words.now.shape, jnp.nan)),
}


def kinds_of(num_envs: int) -> np.ndarray:
    """Return which kind of ``KINDS``, by its place there, each environment of a batch gets, (num_envs,)."""
    shares = np.cumsum([share for share, _ in KINDS.values()])
    return np.searchsorted(shares / shares[-1], (np.arange(num_envs) + 0.5) / num_envs)


def draw_actions(seed: jax.Array, step: jax.Array, num_envs: int) -> jax.Array:
    """Return the actions of a step, (num_envs, 4): the kinds in blocks, as ``kinds_of`` has them."""
    words = draw_words(seed, step, num_envs)
    ends = np.searchsorted(kinds_of(num_envs), np.arange(len(KINDS)), side="right")
    parts, start = [], 0
    for (_, kind), end in zip(KINDS.values(), ends.tolist(), strict=True):
        if end > start:
            parts.append(kind(Words(words.now[start:end], words.held[start:end], step)))
        start = end
    return jnp.concatenate(parts)
