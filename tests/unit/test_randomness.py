"""Normal draws: close to the normal distribution, and apart from each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from flytrack_env.randomness import BYTES_DEVIATION, NORMAL, Draws, next_word

NUM_DRAWS = 1_000_000


@pytest.fixture(scope="module")
def normals() -> dict[str, np.ndarray]:
    """Draws under two names from a million words."""
    words = jax.random.bits(jax.random.key(0), (NUM_DRAWS,))
    draw = jax.jit(jax.vmap(lambda word, name: Draws(word).normal(name), in_axes=(0, None)), static_argnums=1)
    return {name: np.asarray(draw(words, name), float) for name in ("position_0", "rates_2")}


def exact_distribution() -> tuple[np.ndarray, np.ndarray]:
    """Return every value that a normal draw can have, and the probability of each."""
    byte = np.full(256, 1.0 / 256.0)
    pair = np.convolve(byte, byte)
    probability = np.convolve(pair, pair)
    centred = (np.arange(len(probability)) - 510.0) / BYTES_DEVIATION
    return centred, probability


def test_the_polynomial_is_the_fit_that_it_is_said_to_be() -> None:
    centred, probability = exact_distribution()
    quantile = stats.norm.ppf(np.cumsum(probability) - 0.5 * probability)
    powers = np.stack([centred, centred**3, centred**5], axis=1)
    weight = np.sqrt(probability)
    fitted = np.linalg.lstsq(powers * weight[:, None], quantile * weight, rcond=None)[0]
    fitted /= np.sqrt(probability @ (powers @ fitted) ** 2)  # to unit variance
    np.testing.assert_allclose(NORMAL, fitted, rtol=2e-4)
    value = powers @ NORMAL
    assert (np.diff(value) > 0.0).all() and value[-1] < 4.5
    middle = np.cumsum(probability) - 0.5 * probability
    assert np.abs(stats.norm.cdf(value) - middle).max() < 1e-3


@pytest.mark.parametrize("name", ["position_0", "rates_2"])
def test_draws_are_standard_normal(normals: dict[str, np.ndarray], name: str) -> None:
    found = normals[name]
    assert abs(found.mean()) < 5e-3 and found.std() == pytest.approx(1.0, abs=5e-3)
    assert abs(stats.skew(found)) < 0.02 and abs(stats.kurtosis(found)) < 0.03
    # The steps of the byte sums, 0.007 wide, are in the distance.
    assert stats.kstest(found, "norm").statistic < 4e-3


def test_names_and_steps_are_independent(normals: dict[str, np.ndarray]) -> None:
    first, second = normals.values()
    assert abs(np.corrcoef(first, second)[0, 1]) < 5e-3
    assert abs(np.corrcoef(first**2, second**2)[0, 1]) < 5e-3
    word = jnp.uint32(1)
    chain = []
    for _ in range(2000):
        chain.append(int(word))
        word = next_word(word)
    assert len(set(chain)) == 2000
    series = np.asarray(jax.vmap(lambda word: Draws(word).normal("a"))(jnp.array(chain, jnp.uint32)))
    for lag in (1, 2, 3):
        assert abs(np.corrcoef(series[lag:], series[:-lag])[0, 1]) < 0.08
