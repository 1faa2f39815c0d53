"""Named draws: uniform or normal, and independent of each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from flytrack_env.randomness import Draws, next_word, seed_of, seeds_of

NUM_DRAWS = 1_000_000


def test_draws_are_standard_normal():
    words = jax.random.bits(jax.random.key(0), (NUM_DRAWS,))
    draws = np.asarray(jax.jit(jax.vmap(lambda word: Draws(word).normal("rates_2")))(words), float)
    assert abs(draws.mean()) < 5e-3 and draws.std() == pytest.approx(1.0, abs=5e-3)
    assert abs(stats.skew(draws)) < 0.02 and abs(stats.kurtosis(draws)) < 0.03
    # The steps of the byte sums, 0.007 wide, are in the distance.
    assert stats.kstest(draws, "norm").statistic < 4e-3


def test_steps_are_independent():
    chain = jax.lax.scan(lambda word, _: (next_word(word), word), jnp.uint32(1), length=2000)[1]
    assert len(np.unique(chain)) == 2000
    series = np.asarray(jax.vmap(lambda word: Draws(word).normal("a"))(chain))
    for lag in (1, 2, 3):
        assert abs(np.corrcoef(series[lag:], series[:-lag])[0, 1]) < 0.08


# --- Uniform draws and words ----------------------------------------------------------------------

NAMES = ("kind", "gate", "roll", "pitch", "offset_x", "offset_y", "speed", "battery")
NUM_WORDS = 20_000
WORDS = {
    "of keys": lambda: jax.vmap(seed_of)(jax.random.split(jax.random.key(0), NUM_WORDS)),
    "of counted keys": lambda: jax.vmap(lambda i: seed_of(jax.random.key(i)))(
        jnp.arange(NUM_WORDS)
    ),
    "of one key": lambda: seeds_of(seed_of(jax.random.key(0)), jnp.arange(NUM_WORDS)),
    "of a counter": lambda: jnp.arange(NUM_WORDS, dtype=jnp.uint32),
}


@pytest.mark.parametrize("source", WORDS)
def test_draws_are_uniform_and_uncorrelated(source):
    words = WORDS[source]()
    assert words.dtype == jnp.uint32
    draw_all = jax.vmap(
        lambda word: jnp.stack([Draws(word).uniform(name, 0.0, 1.0) for name in NAMES])
    )
    values = np.asarray(jax.jit(draw_all)(words), float)
    assert values.min() >= 0.0 and values.max() < 1.0
    for column in values.T:
        assert stats.kstest(column, "uniform").pvalue > 1e-3
    correlation = np.corrcoef(values.T) - np.eye(len(NAMES))
    assert np.abs(correlation).max() < 4.5 / np.sqrt(NUM_WORDS)
    lagged = [np.corrcoef(column[:-1], column[1:])[0, 1] for column in values.T]
    assert np.abs(lagged).max() < 4.5 / np.sqrt(NUM_WORDS)


def test_legacy_keys_are_as_good_as_typed_ones():
    for seed in range(16):
        assert int(seed_of(jax.random.key(seed))) == int(seed_of(jax.random.PRNGKey(seed)))
