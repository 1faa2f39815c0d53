"""Cheap named random draws.

Sampling a reset happens in every step of every environment (auto-reset selects it where an episode
ended), and so does noise; a draw must cost a few integer operations. One word is drawn from the JAX
key of an episode; every named draw hashes that word with the name. Not for cryptography, and not
for drawing more than a few dozen numbers per word.
"""

import zlib
from typing import Any

import jax
import jax.numpy as jnp

from flytrack_env.fusion import compute_once
from flytrack_env.messages import quote_value
from flytrack_env.quaternion import Scalar

UNIFORM_BITS = 24  # the mantissa of a float32
GOLDEN_RATIO_32 = 0x9E3779B9
EVEN_BYTES = 0x00FF00FF
BYTES_DEVIATION = 147.8  # of the sum of four bytes: sqrt(4 (256^2 - 1) / 12)
# Least squares of the normal quantiles over that sum (tests/unit/test_randomness.py).
NORMAL = (0.96776, 0.0040022, 0.0019047)


def mix(word: jax.Array) -> jax.Array:
    """Return a well-mixed uint32 of a uint32: an invertible two-multiply integer hash.

    Source: C. Wellons, "Prospecting for hash functions" (2018), the constants of ``lowbias32``.
    """
    word = (word ^ (word >> 16)) * jnp.uint32(0x7FEB352D)
    word = (word ^ (word >> 15)) * jnp.uint32(0x846CA68B)
    return word ^ (word >> 16)


def check_key(key: Any) -> None:
    """Raise TypeError unless this is one JAX key, typed or a legacy array, traced or not."""
    dtype = getattr(key, "dtype", None)
    if dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key):
        num_axes = 0
    elif dtype == jnp.uint32 and key.ndim:
        num_axes = 1
    else:
        raise TypeError(
            f"key: found {quote_value(key)}, expected a key of JAX, such as jax.random.key(0)"
        )
    if key.ndim != num_axes:
        keys = key.shape[: key.ndim - num_axes]
        raise TypeError(
            f"key: found keys of shape {keys}, expected one key; for a batch: jax.vmap(env.reset)"
        )


def seed_of(key: jax.Array) -> jax.Array:
    """Return one random word, uint32 scalar, of a JAX key (typed, or the legacy array of words).

    The words of a key are hashed directly: keys come from a generator already, and its rounds would
    cost as much as the rest of the step.
    """
    is_typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    words = jax.random.key_data(key) if is_typed else key
    seed = jnp.uint32(GOLDEN_RATIO_32)
    # The fence: a batch of keys is strided, and what reads strided memory is not vectorised.
    for word in compute_once([words[i] for i in range(words.shape[-1])]):
        seed = mix(seed ^ word)
    return seed


def seeds_of(word: jax.Array, indices: jax.Array) -> jax.Array:
    """Return random words, uint32, of a single one: one for each index of an environment."""
    return mix(word + indices.astype(jnp.uint32) * jnp.uint32(GOLDEN_RATIO_32))


def next_word(word: jax.Array) -> jax.Array:
    """Return the word after this one, for draws that are repeated in every step."""
    return mix(word + jnp.uint32(GOLDEN_RATIO_32))


class Draws:
    """Named uniform draws that all derive from one random word, a uint32 scalar."""

    def __init__(self, seed: jax.Array):
        self.seed = jnp.asarray(seed, jnp.uint32)

    def word(self, name: str) -> jax.Array:
        """Return a uint32 for further draws; the same name gives the same word."""
        return mix(self.seed ^ jnp.uint32(zlib.crc32(name.encode())))

    def uniform(self, name: str, low: Scalar, high: Scalar) -> jax.Array:
        """Return a float32 in [low, high]; the same name gives the same number."""
        unit = (self.word(name) >> (32 - UNIFORM_BITS)).astype(jnp.float32) * (2.0**-UNIFORM_BITS)
        return jnp.asarray(low + (high - low) * unit)

    def normal(self, name: str) -> jax.Array:
        """Return an approximately standard normal float32, at most 4.5 from 0.

        Its distribution function is off by up to 0.001. It is the sum of a word's four bytes,
        stretched by an odd polynomial: noise is drawn in every step, twice, and the inverse
        distribution function would cost more than the rest of the observation.
        """
        return self.normal_pair(name)[0]

    def normal_pair(self, name: str) -> tuple[jax.Array, jax.Array]:
        """Return two such numbers that are uncorrelated, for little more than one.

        They are a sum and a difference of the same bytes, so that one is seldom large where the
        other is; the first is that of ``normal``.
        """
        word = self.word(name)
        pairs = (word & EVEN_BYTES) + ((word >> 8) & EVEN_BYTES)
        low, high = ((pairs & 0xFFFF).astype(jnp.float32), (pairs >> 16).astype(jnp.float32))
        return _stretch(low + high - 2.0 * 255.0), _stretch(low - high)

    def index(self, name: str, count: int) -> jax.Array:
        """Return an int32 in [0, count)."""
        return jnp.minimum(self.uniform(name, 0.0, count).astype(jnp.int32), count - 1)


def _stretch(total: jax.Array) -> jax.Array:
    """Return an approximately standard normal of the sum of four bytes less its mean."""
    centred = total * (1.0 / BYTES_DEVIATION)
    square = centred * centred
    return centred * (NORMAL[0] + square * (NORMAL[1] + square * NORMAL[2]))
