"""What a delayed command and a drone drawn for every episode change."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytrack_env.effects import CommandDelay, LinearDrag, QuadraticDrag, ThrustScale, effect_of
from flytrack_env.env import FlyTrack
from flytrack_env.wrappers import (
    ActionDelay,
    DomainRandomization,
    RandomizationParams,
)
from tests.support.wrapped_flights import fly, wrapped

# --- Command delay --------------------------------------------------------------------------------


@pytest.mark.parametrize("delay_s", [0.0, 0.013, 0.04])
def test_the_wrapper_does_what_the_effect_in_the_model_does(delay_s: float) -> None:
    outside = fly(wrapped(ActionDelay), wrappers={"action_delay": CommandDelay(delay_s)})
    model = FlyTrack().default_params.model.with_effects(CommandDelay(delay_s))
    inside = fly(wrapped(), model=model)
    np.testing.assert_allclose(outside[2][0], inside[2][0], atol=2e-4)
    np.testing.assert_array_equal(outside[2][3], inside[2][3])


def test_a_delay_beyond_the_memory_is_refused() -> None:
    with pytest.raises(ValueError, match=r"delay_s: found 0\.05, expected 0 to 0\.04 s"):
        ActionDelay(FlyTrack(), delay_s=0.05)
    env = wrapped(ActionDelay)
    negative = {"action_delay": env.own_defaults()._replace(delay_s=-0.01)}
    with pytest.raises(ValueError, match=r"delay_s: found -0\.01"):
        env.reset(jax.random.key(0), env.default_params.replace(wrappers=negative))


def test_what_is_no_number_ends_the_episode_at_once_whatever_the_delay() -> None:
    env = wrapped(partial(ActionDelay, delay_s=0.04))
    params = env.default_params
    _, state = env.reset(jax.random.key(0), params)
    _, after, _, terminated, info = env.step_env(None, state, jnp.array([0.0, jnp.nan, 0.0, 0.0]), params)
    assert bool(terminated) and bool(info["crash"])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))


# --- Domain randomisation -------------------------------------------------------------------------


def sampled_models(num: int = 2000, ranges: RandomizationParams | None = None) -> Any:
    """Return models of that many episodes, leaves (num,), and their environment's parameters."""
    env = wrapped(DomainRandomization)
    params = env.default_params
    if ranges is not None:
        params = params.replace(wrappers={"domain_randomization": ranges})
    keys = jax.random.split(jax.random.key(0), num)

    def model(key: jax.Array) -> Any:
        return env.model(env.reset(key, params)[1], params)

    return jax.jit(jax.vmap(model))(keys), params


def test_everything_that_has_a_range_fills_it_and_independently() -> None:
    models, params = sampled_models()
    ranges = params.wrappers["domain_randomization"]
    columns = [(models.m, 0.8, 1.2)] + [(tau, 0.7 * 0.04, 1.3 * 0.04) for tau in models.tau.T]
    assert len(models.effects) == len(ranges.low)
    for low, high in zip(ranges.low, ranges.high, strict=True):
        found = models.effect(effect_of(low).name)
        for name, lowest in low._asdict().items():
            value = np.asarray(getattr(found, name))
            if lowest is None:
                assert (value == 0.0).all()
            elif lowest < getattr(high, name):
                columns.append((value, lowest, getattr(high, name)))
    assert len(columns) == 1 + 4 + 1 + 1 + 2 + 3
    units = []
    for values, low, high in columns:
        unit = (np.asarray(values, float) - low) / (high - low)
        assert 0.0 <= unit.min() < 0.01 and 0.99 < unit.max() <= 1.0 + 1e-5
        assert abs(unit.mean() - 0.5) < 0.03
        units.append(unit)
    correlation = np.corrcoef(units) - np.eye(len(units))
    assert np.abs(correlation).max() < 0.1


def test_a_model_holds_for_its_episode_and_changes_with_the_next() -> None:
    env = wrapped(DomainRandomization)
    (_, start), _, outputs = fly(env, max_steps_in_episode=20)
    words = np.concatenate([np.asarray(start.word)[None], np.asarray(outputs[1].word)])
    ended = np.asarray(outputs[3] | outputs[4])
    assert ended.any()
    np.testing.assert_array_equal(words[1:][~ended], words[:-1][~ended])
    assert (words[1:][ended] != words[:-1][ended]).all()


def test_no_range_is_the_plain_environment() -> None:
    nothing = RandomizationParams(1.0, 1.0, 1.0, 1.0, low=(), high=())
    randomised = fly(wrapped(DomainRandomization), wrappers={"domain_randomization": nothing})
    np.testing.assert_allclose(randomised[2][0], fly(wrapped())[2][0], atol=1e-5)


def test_what_the_model_itself_has_is_drawn_around_it() -> None:
    """An identified effect is known: scaled, within its range. What is not among the ranges stays."""
    env = wrapped(DomainRandomization)
    known = (CommandDelay(0.036), ThrustScale(0.6), LinearDrag(1.0, -0.5, 0.0), QuadraticDrag(0.1))
    params = env.default_params.replace(model=FlyTrack().default_params.model.with_effects(*known))
    keys = jax.random.split(jax.random.key(0), 500)
    models = jax.jit(jax.vmap(lambda key: env.model(env.reset(key, params)[1], params)))(keys)
    assert models.tau.shape == (500, 4)
    by_name = {effect_of(effect).name: jax.tree.map(np.asarray, effect) for effect in models.effects}
    assert set(by_name) == {"command_delay", "thrust_scale", "wind", "linear_drag", "quadratic_drag"}
    delay_s = by_name["command_delay"].delay_s
    assert 0.8 * 0.036 <= delay_s.min() < 0.03 and delay_s.max() == np.float32(0.04)
    factor, drag = by_name["thrust_scale"].factor, by_name["linear_drag"]
    assert 1.0 - 0.4 * 1.2 <= factor.min() < 0.54 and 0.66 < factor.max() <= 1.0 - 0.4 * 0.8 + 1e-6
    assert 0.8 <= drag.d_x.min() < 0.83 and 1.17 < drag.d_x.max() <= 1.2 + 1e-6
    assert -0.6 - 1e-6 <= drag.d_y.min() < -0.58 and (drag.d_z == 0.0).all()
    assert (by_name["quadratic_drag"].k_x == np.float32(0.1)).all()


BASE = RandomizationParams()
BAD_RANGES = [
    (BASE._replace(mass_factor_low=1.3), r"mass_factor: found a range from 1\.3 to 1\.2"),
    (BASE._replace(lag_factor_low=0.0), r"lag_factor: found a range from 0\.0 to 1\.3"),
    (
        BASE._replace(mass_factor_high=np.inf),
        r"mass_factor: found a range from 0\.8 to inf, expected one within",
    ),
    (BASE._replace(mass_factor_low=1e-4), r"mass_factor: .* expected one within 0\.00099999 to 1000\.01"),
    (BASE._replace(effect_factor_high=np.inf), r"effect_factor: found a range from 0\.8 to inf"),
    (BASE._replace(low=BASE.low[1:]), r"high: found effects \['CommandDelay', .* expected those of low"),
    (
        BASE._replace(high=(BASE.high[0]._replace(delay_s=0.1), *BASE.high[1:])),
        r"command_delay\.delay_s: found 0\.1, expected 0 to 0\.04 s",
    ),
    (
        BASE._replace(high=(BASE.high[0]._replace(delay_s=None), *BASE.high[1:])),
        r"command_delay\.delay_s: found a range from 0\.0 to None",
    ),
]


@pytest.mark.parametrize(("ranges", "reason"), BAD_RANGES)
def test_bad_ranges_are_refused(ranges: RandomizationParams, reason: str) -> None:
    env = wrapped(DomainRandomization)
    with pytest.raises(ValueError, match=reason):
        env.reset(jax.random.key(0), env.default_params.replace(wrappers={"domain_randomization": ranges}))
