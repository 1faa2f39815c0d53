"""The step is one kernel, whatever it is made of, and the same as without."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import flytrack_env
from flytrack_env import nominal_parameters
from flytrack_env.effects import EFFECTS
from flytrack_env.fusion import ATTRIBUTES, SWITCH
from flytrack_env.motion import Motion
from flytrack_env.tracks import random_track
from tests.contract.test_effects import inside_ranges
from tests.support.slow import slow_but

NUM_ENVS, NUM_STEPS = 40, 6


def with_effects(*names: str, motion: Motion = Motion.HANDOUT) -> Any:
    """Return an environment whose model has these effects, a third into their ranges."""
    effects = [inside_ranges(effect, 0.3) for effect in EFFECTS if effect.name in names]
    model = nominal_parameters()._replace(motion=motion).with_effects(*effects)
    return flytrack_env.make("FlyTrack-v0", model=model)


EVERY = [effect.name for effect in EFFECTS]
VARIANTS = {
    "plain": lambda: flytrack_env.make("FlyTrack-v0"),
    "all wrappers": lambda: flytrack_env.make("FlyTrackRobust-v0", missed_gate="fly_on"),
    "another track": lambda: flytrack_env.make("FlyTrack-v0", track=random_track(3)),
    "semi-implicit": lambda: with_effects(motion=Motion.SEMI_IMPLICIT),
    "all effects": lambda: with_effects(*EVERY),
    "all effects, continuous": lambda: with_effects(*EVERY, motion=Motion.CONTINUOUS),
}


def flown(env: Any, is_constant: bool) -> Any:
    """Return the outcome of some steps of a batch; is_constant: with parameters that are no argument."""
    params = env.default_params.replace(max_steps_in_episode=4)  # so that episodes end
    keys = jax.random.split(jax.random.key(0), NUM_ENVS)
    actions = jax.random.uniform(jax.random.key(1), (NUM_STEPS, NUM_ENVS, 4), minval=-1.0)

    def fly(params: Any) -> Any:
        _, states = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
        step = jax.vmap(env.step, in_axes=(0, 0, 0, None))
        return jax.lax.scan(lambda states, action: step(keys, states, action, params)[1::-1], states, actions)

    run = jax.jit(lambda: fly(params)) if is_constant else partial(jax.jit(fly), params)
    return jax.block_until_ready(run())


@pytest.mark.parametrize("name", slow_but(["plain"], VARIANTS))
def test_the_kernel_is_the_same_step(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    with_kernel = flown(VARIANTS[name](), is_constant=True)
    monkeypatch.setenv(SWITCH, "0")
    without = flown(VARIANTS[name](), is_constant=False)
    for found, expected in zip(*map(jax.tree.leaves, (with_kernel, without)), strict=True):
        size = max(float(np.abs(expected).max()), 1.0)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * size)


@pytest.mark.parametrize("name", ["plain", "all wrappers", "all effects, continuous"])
def test_a_step_is_a_kernel_unless_switched_off(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    for switch in ("1", "0"):
        monkeypatch.setenv(SWITCH, switch)
        env = VARIANTS[name]()
        keys = jax.random.split(jax.random.key(0), NUM_ENVS)
        states = jax.eval_shape(jax.vmap(env.reset, in_axes=(0, None)), keys, env.default_params)[1]
        args = keys, states, jnp.zeros((NUM_ENVS, 4)), env.default_params
        text = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None))).lower(*args).as_text()
        assert (next(iter(ATTRIBUTES)) in text) is (switch == "1")
