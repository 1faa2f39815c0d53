"""Any order of the wrappers composes or is refused with the reason; an episode's end forgets all of them."""

import re
from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.wrappers import LogWrapper
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from flytrack_env import FlyTrack, wrappers
from flytrack_env.observations import OBSERVATION_SIZE
from flytrack_env.wrappers import (
    ActionDelay,
    ActionHistory,
    DomainRandomization,
    EpisodeStatistics,
    LegacyStep,
    ObservationNoise,
    WrapperError,
)

# Every public wrapper, both kinds of history among them, and one of gymnax's: how it is made, its key if any.
MAKERS: dict[str, Any] = {
    "noise": ObservationNoise,
    "commanded": partial(ActionHistory, length=2),
    "applied": partial(ActionHistory, length=1, kind="applied"),
    "delay": ActionDelay,
    "randomization": DomainRandomization,
    "statistics": EpisodeStatistics,
    "legacy": LegacyStep,
    "log": LogWrapper,
}
OTHER_STEP = ("legacy", "log")
ROWS = {"commanded": 8, "applied": 4}
orders = st.lists(st.sampled_from(sorted(MAKERS)), max_size=7)


def test_every_public_wrapper_is_tried() -> None:
    exported = [getattr(wrappers, name) for name in wrappers.__all__]
    public = {one for one in exported if isinstance(one, type) and issubclass(one, wrappers.Wrapper)}
    assert public - {wrappers.Wrapper} < {type(make(FlyTrack())) for make in MAKERS.values()}


def reasons_against(name: str, inside: list[str]) -> list[str]:
    """Return why a wrapper may not go around others, innermost first: none, or any of these is said."""
    if name == "legacy":
        return ["the step inside has five values already"] * (inside[-1:] == ["legacy"])
    if name == "log":
        return []
    if any(other in OTHER_STEP for other in inside):
        return ["found (LegacyStep|LogWrapper) inside, expected FlyTrack or a wrapper that acts before"]
    reasons = ["both have the name"] * (name in inside)
    is_late = name == "delay" and "commanded" in inside
    return reasons + ["the history would hold the delayed commands; put the history outside"] * is_late


def wrap(order: list[str]) -> tuple[Any, int, str | None]:
    """Return the environment in wrappers, how many went around it, and why the next one did not."""
    env: Any = FlyTrack()
    for index, name in enumerate(order):
        try:
            env = MAKERS[name](env)
        except WrapperError as error:
            return env, index, str(error)
    return env, len(order), None


@settings(max_examples=300, deadline=None)
@given(order=orders)
def test_any_order_composes_or_is_refused_with_the_reason(order: list[str]) -> None:
    env, number, message = wrap(order)
    reasons = [reasons_against(name, order[:index]) for index, name in enumerate(order)]
    assert not any(reasons[:number])
    if message is None:
        assert number == len(order)
    else:
        assert any(re.search(reason, message) for reason in reasons[number])
    if any(name in OTHER_STEP for name in order[:number]):
        return
    keys = [entry.key for entry in env.observation_table]
    assert len(set(keys)) == len(keys)
    size = OBSERVATION_SIZE + sum(ROWS.get(name, 0) for name in order[:number])
    assert env.observation_space().shape == (size,)
    env.check_params(env.default_params)


@settings(max_examples=8, deadline=None)
@given(order=orders)
def test_what_composes_can_be_reset_and_stepped(order: list[str]) -> None:
    """Traced, not compiled: the same structures go in and come out, for one and for a batch."""
    assume(("legacy", "log") not in pairwise(order))  # gymnax's wants six values of a step
    env, _, _ = wrap(order)
    key = jax.random.key(0)
    observation, state = jax.eval_shape(env.reset, key)
    outputs = jax.eval_shape(env.step, key, state, jnp.zeros(4))
    form = jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), (observation, state))
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tuple(outputs[:2])) == form
    assert observation.shape == env.observation_space(FlyTrack().default_params).shape


# --- Nothing survives an episode --------------------------------------------------------------------

NUM_ENVS, LIMIT = 64, 50
ALL = ("randomization", "delay", "applied", "noise", "commanded", "statistics")
POISONS = ("nan", "infinite", "huge", "random", "zero")


@pytest.fixture(scope="module")
def ended() -> Any:
    """The environment in every wrapper, its parameters, a batch of states and the compiled steps."""
    env = wrap(list(ALL))[0]
    params = env.default_params.replace(max_steps_in_episode=LIMIT)
    keys = jax.random.split(jax.random.key(0), NUM_ENVS)
    states = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)[1]
    return env, params, states, jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))


def poisoned(states: Any, poison: str, rng: np.random.Generator) -> Any:
    """Return states of which every number is anything, at an episode's last step."""

    def anything(path: Any, leaf: jax.Array) -> np.ndarray:
        if getattr(path[-1], "name", "") == "time":
            return np.full(leaf.shape, LIMIT - 1, leaf.dtype)
        if leaf.dtype == bool:
            return rng.random(leaf.shape) < 0.5
        if jnp.issubdtype(leaf.dtype, jnp.integer):
            return rng.integers(0, 1000, leaf.shape).astype(leaf.dtype)
        values = rng.normal(size=leaf.shape)
        fill = {"nan": np.nan, "infinite": np.inf * values, "huge": 3e38 * np.sign(values), "zero": 0.0}
        return np.broadcast_to(fill.get(poison, values), leaf.shape).astype(leaf.dtype)

    return jax.tree_util.tree_map_with_path(anything, states)


@settings(max_examples=30, deadline=None)
@given(poison=st.sampled_from(POISONS), seed=st.integers(0, 2**32 - 1))
def test_what_begins_depends_on_nothing_of_what_ended(ended: Any, poison: str, seed: int) -> None:
    """Bit for bit: the same key, another past, another last action, in every wrapper at once."""
    env, params, states, step = ended
    rng = np.random.default_rng(seed)
    keys = jax.random.split(jax.random.key(seed), NUM_ENVS)
    found = []
    for past in ("zero", poison):
        actions = rng.choice([0.3, 1.0, np.inf, np.nan], (NUM_ENVS, 4)).astype(np.float32)
        before = poisoned(states, past, rng)
        one = step(keys, before, actions, params)
        batch = env.step_batch(keys[0], before, actions, params)
        for outputs in (one, batch):
            assert np.asarray(outputs[4]).all()
        found.append(jax.tree.leaves((one[:2], batch[:2])))
    for clean, after in zip(*found, strict=True):
        np.testing.assert_array_equal(np.asarray(clean), np.asarray(after))
        assert np.isfinite(np.asarray(after)).all()


def test_an_episode_that_goes_on_does_depend_on_its_past(ended: Any) -> None:
    """So that the test above can see what survives."""
    _, params, states, step = ended
    keys = jax.random.split(jax.random.key(1), NUM_ENVS)
    found = []
    for stick in (0.3, -0.3):
        outputs = step(keys, states, jnp.full((NUM_ENVS, 4), stick), params)
        assert not np.asarray(outputs[3] | outputs[4]).all()
        found.append(outputs[1])
    is_alike = [np.array_equal(*pair) for pair in zip(*map(jax.tree.leaves, found), strict=True)]
    assert not all(is_alike) and not np.array_equal(
        found[0].inner.actions[0].roll, found[1].inner.actions[0].roll
    )
