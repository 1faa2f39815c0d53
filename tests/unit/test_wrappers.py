"""Wrappers: that they compose, and that nothing survives an episode."""

import copy
import pickle
from functools import partial
from itertools import permutations
from typing import Any

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.wrappers import LogWrapper

from flytrack_env import wrappers
from flytrack_env.env import FlyTrack
from flytrack_env.observations import OBSERVATION_SIZE
from flytrack_env.plants import Simulator
from flytrack_env.state import Action, pack
from flytrack_env.wrappers import (
    ActionDelay,
    ActionHistory,
    DomainRandomization,
    EpisodeStatistics,
    LegacyStep,
    NoiseParams,
    ObservationNoise,
    WrapperError,
    layers_of,
)
from tests.support.wrapped_flights import NUM_STEPS, fly, wrapped

ALL = (DomainRandomization, ActionDelay, ObservationNoise, ActionHistory, EpisodeStatistics)
OVER_WRAPPERS = pytest.mark.parametrize("wrapper", ALL, ids=lambda wrapper: wrapper.__name__)


def state_of(env: Any, state: Any, wrapper: type) -> Any:
    """Return the state of one of an environment's wrappers."""
    while type(env) is not wrapper:
        env, state = env.env, state.inner
    return state


# --- Composition ----------------------------------------------------------------------------------


def is_sensible(order: tuple[Any, ...]) -> bool:
    """Return whether wrappers may go around each other, the innermost first."""
    try:
        wrapped(*order)
    except WrapperError:
        return False
    return True


def test_all_wrappers_are_tried() -> None:
    exported = [getattr(wrappers, name) for name in wrappers.__all__]
    public = {one for one in exported if isinstance(one, type) and issubclass(one, wrappers.Wrapper)}
    assert public - {wrappers.Wrapper} == set(ALL)


def test_orders_that_make_sense_have_the_same_spaces_and_parameters() -> None:
    """The others are refused: exactly those with the history of commands inside the delay."""
    with_params = {"domain_randomization", "action_delay", "observation_noise"}
    for order in permutations(ALL):
        is_refused = order.index(ActionHistory) < order.index(ActionDelay)
        assert is_sensible(order) != is_refused, order
        if is_refused:
            continue
        env = wrapped(*order)
        assert env.observation_space().shape == (OBSERVATION_SIZE + 3 * 4,)
        assert set(env.default_params.wrappers) == with_params


# In which of the orders that make sense, as a share of them: the first is as far from that of ALL as can be.
@pytest.mark.parametrize(
    "share", [0.0, pytest.param(0.37, marks=pytest.mark.slow), pytest.param(0.71, marks=pytest.mark.slow)]
)
def test_the_order_does_not_change_the_flight(share: float) -> None:
    """What is drawn hangs on names, not on the order of wrapping."""
    sensible = [order for order in permutations(reversed(ALL)) if is_sensible(order)]
    reference = fly(wrapped(*ALL))
    other = fly(wrapped(*sensible[int(share * len(sensible))]))
    np.testing.assert_allclose(other[2][0], reference[2][0], atol=2e-4)
    np.testing.assert_array_equal(other[2][3], reference[2][3])


@OVER_WRAPPERS
def test_twice_is_refused(wrapper: Any) -> None:
    with pytest.raises(WrapperError, match=f"{wrapper.__name__} around {wrapper.__name__}: both"):
        wrapper(
            ObservationNoise(wrapper(FlyTrack())) if wrapper is not ObservationNoise else wrapped(wrapper)
        )


def test_a_history_inside_the_delay_is_refused_with_the_reason() -> None:
    with pytest.raises(WrapperError, match="ActionDelay around ActionHistory: the history would hold"):
        ActionDelay(ActionHistory(FlyTrack()))


@OVER_WRAPPERS
@pytest.mark.parametrize("inside", [LegacyStep, LogWrapper], ids=lambda inside: inside.__name__)
def test_another_step_inside_is_refused_with_the_reason(wrapper: Any, inside: Any) -> None:
    with pytest.raises(WrapperError, match=rf"found {inside.__name__} inside, .* go outermost"):
        wrapper(inside(FlyTrack()))


def test_randomising_what_is_baked_in_is_refused() -> None:
    class Baked(Simulator):
        dt = 0.01

    with pytest.raises(WrapperError, match="baked in, none can be drawn"):
        DomainRandomization(FlyTrack(plant=Baked()))


def test_layers() -> None:
    env = wrapped(*ALL)
    _, state = env.reset(jax.random.key(0))
    assert len(env.model(state, env.default_params).effects) == 4
    assert FlyTrack().model(None, FlyTrack().default_params).effects == ()
    assert [type(layer) for layer in layers_of(env)] == [*reversed(ALL), FlyTrack]
    assert env.track.name == "flytrack" and env.missed_gate == "terminate"


@OVER_WRAPPERS
def test_parameters_of_another_environment_are_refused(wrapper: Any) -> None:
    env = wrapped(wrapper)
    if env.own_defaults() is None:
        env.reset(jax.random.key(0), FlyTrack().default_params)
        return
    others = FlyTrack().default_params
    with pytest.raises(ValueError, match=rf"params\.wrappers: found \[\], expected \['{env.key}'\]"):
        env.reset(jax.random.key(0), others)
    _, state = env.reset(jax.random.key(0))
    with pytest.raises(ValueError, match=rf"params\.wrappers: found \[\], expected '{env.key}' among them"):
        env.step(jax.random.key(0), state, jnp.zeros(4), others)
    unknown = others.replace(wrappers={env.key: env.own_defaults(), "nois": NoiseParams()})
    with pytest.raises(ValueError, match=r"params\.wrappers: found \[.*'nois'.*\], expected"):
        env.reset(jax.random.key(0), unknown)


def test_histories_of_both_kinds_and_a_delay_around_applied_actions_make_sense() -> None:
    env = ActionHistory(ActionDelay(ActionHistory(FlyTrack(), kind="applied", length=2)), length=1)
    assert env.observation_space().shape == (OBSERVATION_SIZE + 3 * 4,)
    assert len({entry.key for entry in env.observation_table}) == len(env.observation_table)


def test_a_subclass_counts_as_what_it_is() -> None:
    class Louder(ObservationNoise):
        pass

    class Longer(ActionHistory):
        pass

    with pytest.raises(WrapperError, match="Louder around ObservationNoise: both"):
        Louder(ObservationNoise(FlyTrack()))
    with pytest.raises(WrapperError, match="ActionDelay around Longer: the history would hold"):
        ActionDelay(Longer(FlyTrack()))


@OVER_WRAPPERS
def test_a_reset_may_be_traced_with_parameters_that_are_not(wrapper: Any) -> None:
    env, key = wrapped(wrapper), jax.random.key(0)
    arrays = jax.tree.map(jnp.asarray, env.default_params)
    jax.eval_shape(env.reset, key)
    jax.eval_shape(lambda key: env.reset(key, env.default_params), key)
    jax.eval_shape(lambda key: env.reset(key, arrays), key)
    jax.eval_shape(LogWrapper(env).reset, key)
    jax.eval_shape(LegacyStep(env).reset, key)


def test_gradients_stay_wanted_through_wrapping() -> None:
    smooth = ObservationNoise(FlyTrack()).with_transition_gradients()
    assert ActionHistory(smooth).transition_gradients_enabled
    legacy = LegacyStep(ObservationNoise(FlyTrack())).with_transition_gradients()
    assert isinstance(legacy, LegacyStep) and legacy.transition_gradients_enabled


# --- Nothing survives an episode ------------------------------------------------------------------

# One drone per kind of end that is about to meet it on the FlyTrack course: its state, and its action.
FULL_STICK = (0.9, -0.8, 0.7, -0.6)
ENDS: dict[str, Any] = {
    "ground": ({"position": (15.0, 10.0, 0.05), "velocity": (0.0, 0.0, -20.0)}, FULL_STICK),
    "out_of_bounds": ({"position": (25.4, 10.0, 2.0), "velocity": (20.0, 0.0, 0.0)}, FULL_STICK),
    # Gate 0 stands at x = 12.5, y = 2, and is flown towards -x.
    "missed_gate": ({"position": (12.55, 6.0, 1.35), "velocity": (-20.0, 0.0, 0.0)}, FULL_STICK),
    "crash": ({"position": (12.55, 3.0, 1.35), "velocity": (-20.0, 0.0, 0.0)}, FULL_STICK),
    "battery_empty": ({"position": (15.0, 10.0, 2.0), "battery_v": 22.0}, FULL_STICK),
    "nan": ({"position": (15.0, 10.0, 2.0)}, (np.nan, 0.0, 0.0, 0.0)),
    "truncated": ({"position": (15.0, 10.0, 2.0), "steps": 49}, FULL_STICK),
}


def test_after_every_kind_of_end_an_episode_begins_as_if_nothing_had_been(make_drone: Any) -> None:
    """The state after an end is that of a reset with the same key, in every leaf of every wrapper."""
    env = wrapped(*ALL)
    params = env.default_params.replace(max_steps_in_episode=50)
    states, actions = [], []
    for i, (drone, action) in enumerate(ENDS.values()):
        drone, applied = dict(drone), jax.tree.map(jnp.float32, Action(0.5, -0.5, 0.4, 0.3))
        steps = drone.pop("steps", 0)
        state = env.begin(make_drone(**drone, applied=applied), 0, params, jnp.uint32(i))
        states.append(jax.tree_util.tree_map_with_path(partial(_aged, steps), state))
        actions.append(action)
    keys = jax.random.split(jax.random.key(7), len(ENDS))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    step = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))
    observation, after, _, terminated, truncated, info = step(keys, stacked, jnp.array(actions), params)
    for i, end in enumerate(ENDS):
        cause = "crash" if end == "nan" else end
        assert bool(info[cause][i]), end
        assert bool(truncated[i]) == (end == "truncated") and bool(terminated[i]) != bool(truncated[i])
    fresh = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)
    pairs = zip(jax.tree.leaves((observation, after)), jax.tree.leaves(fresh), strict=True)
    for found, expected in pairs:
        np.testing.assert_allclose(found, expected, atol=1e-5)
    # What a wrapper kept was not that of the fresh episode already.
    before, fresh_history = (state_of(env, state, ActionHistory).actions[0] for state in (stacked, after))
    assert (np.asarray(before.roll) != np.asarray(fresh_history.roll)).all()


def _aged(steps: int, path: Any, leaf: jax.Array) -> jax.Array:
    """Return a leaf, or that number of steps where it is the environment's time."""
    return jnp.int32(steps) if getattr(path[-1], "name", "") == "time" else leaf


def test_step_batch_begins_episodes_afresh_and_each_its_own() -> None:
    env = wrapped(*ALL)
    params = env.default_params.replace(max_steps_in_episode=3)
    _, states = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(jax.random.key(0), 16), params)
    for i in range(3):
        actions = jax.random.uniform(jax.random.key(i), (16, 4), minval=-1.0)
        observations, states, _, _, truncated, info = env.step_batch(
            jax.random.key(i), states, actions, params
        )
    assert truncated.all()
    assert (np.asarray(info["final_observation"]) != np.asarray(observations)).any(axis=1).all()
    expected = jax.vmap(env.observe, in_axes=(None, 0, None, None))(None, states, None, params)
    np.testing.assert_allclose(observations, expected, atol=1e-6)
    drones = jax.vmap(lambda state: pack(env.drone(state)))(states)
    assert len(np.unique(np.asarray(drones), axis=0)) == 16
    words = [leaf for leaf in jax.tree.leaves(states) if leaf.dtype == jnp.uint32]
    assert len(words) >= 2  # the noise's and the model's
    for word in words:
        assert len(np.unique(np.asarray(word))) == 16
    np.testing.assert_array_equal(state_of(env, states, EpisodeStatistics).episode_length, 0)


def test_final_observation_is_the_next_one_where_the_episode_goes_on() -> None:
    _, _, outputs = fly(wrapped(*ALL))
    goes_on = ~np.asarray(outputs[3] | outputs[4])
    final = np.asarray(outputs[5]["final_observation"])
    np.testing.assert_allclose(final[goes_on], np.asarray(outputs[0])[goes_on], atol=1e-6)


# --- Episode statistics ---------------------------------------------------------------------------


def test_returns_and_lengths_are_those_of_the_episode() -> None:
    _, _, outputs = fly(wrapped(EpisodeStatistics), max_steps_in_episode=50)
    rewards, ended = np.asarray(outputs[2], float), np.asarray(outputs[3] | outputs[4])
    total, length = np.zeros(8), np.zeros(8, int)
    for i in range(NUM_STEPS):
        total, length = total + rewards[i], length + 1
        np.testing.assert_allclose(outputs[5]["episode_return"][i], total, atol=1e-4)
        np.testing.assert_array_equal(outputs[5]["episode_length"][i], length)
        total, length = np.where(ended[i], 0.0, total), np.where(ended[i], 0, length)
    assert ended.any()


# --- The five-value step --------------------------------------------------------------------------


def test_legacy_step_goes_around_all_of_them_and_can_be_copied() -> None:
    env = LegacyStep(wrapped(*ALL))
    params = env.default_params
    for copied in (env, copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        observation, state = copied.reset(jax.random.key(0), params)
        outputs = copied.step(jax.random.key(1), state, jnp.zeros(4), params)
        assert len(outputs) == 5 and outputs[0].shape == observation.shape


def test_gymnax_wrappers_go_around_ours() -> None:
    env = LogWrapper(wrapped(*ALL))
    params = wrapped(*ALL).default_params
    observation, state = env.reset(jax.random.key(0), params)
    outputs = env.step(jax.random.key(1), state, jnp.zeros(4), params)
    assert outputs[0].shape == observation.shape
    assert "returned_episode_returns" in outputs[-1]
    assert gymnax.make("FlyTrack-v0")[0].observation_space().shape == (OBSERVATION_SIZE,)
