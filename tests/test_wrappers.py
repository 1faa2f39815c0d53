"""Wrappers: what each adds, that they compose, and that nothing survives an episode."""

import copy
import pickle
from functools import cache, partial
from itertools import permutations
from typing import Any

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.wrappers import LogWrapper

from flytrack_env.effects import CommandDelay as Delay
from flytrack_env.effects import LinearDrag, QuadraticDrag, ThrustScale, effect_of
from flytrack_env.env import EnvParams, FlyTrack
from flytrack_env.observations import OBSERVATION_SIZE
from flytrack_env.state import Action, pack
from flytrack_env.wrappers import (
    ActionHistory,
    CommandDelay,
    DomainRandomization,
    EpisodeStatistics,
    LegacyStep,
    NoiseParams,
    ObservationNoise,
    RandomizationParams,
    WrapperError,
    layers_of,
)

ALL = (DomainRandomization, CommandDelay, ObservationNoise, ActionHistory, EpisodeStatistics)
OVER_WRAPPERS = pytest.mark.parametrize("wrapper", ALL, ids=lambda wrapper: wrapper.__name__)
NUM_STEPS, NUM_ENVS = 100, 8


@cache
def wrapped(*wrappers: Any) -> Any:
    """Return FlyTrack in wrappers, the innermost first."""
    env: Any = FlyTrack()
    for wrapper in wrappers:
        env = wrapper(env)
    return env


def fly(env: Any, **changes: Any) -> Any:
    """Return observations, states, rewards, ends and infos of random flights, leaves (T, N, ...).

    ``changes`` are of the default parameters. One shape for all tests: compiling is what takes time.
    """
    return _fly(env, jax.random.key(0), env.default_params.replace(**changes))


@partial(jax.jit, static_argnums=0)
def _fly(env: Any, key: jax.Array, params: EnvParams) -> Any:
    key_reset, key_actions, key_steps = jax.random.split(key, 3)
    actions = jax.random.uniform(key_actions, (NUM_STEPS, NUM_ENVS, 4), minval=-1.0)
    first, start = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(key_reset, NUM_ENVS), params)

    def one(state: Any, inputs: Any) -> Any:
        index, action = inputs
        keys = jax.random.split(jax.random.fold_in(key_steps, index), NUM_ENVS)
        outputs = jax.vmap(env.step, in_axes=(0, 0, 0, None))(keys, state, action, params)
        return outputs[1], outputs

    outputs = jax.lax.scan(one, start, (jnp.arange(NUM_STEPS), actions))[1]
    return (first, start), actions, outputs


# --- Composition ----------------------------------------------------------------------------------


def test_orders_that_make_sense_have_the_same_spaces_and_parameters() -> None:
    """The others are refused: exactly those with the history of commands inside the delay."""
    refused = []
    for order in permutations(ALL):
        try:
            env: Any = FlyTrack()
            for wrapper in order:
                env = wrapper(env)
        except WrapperError:
            refused.append(order)
            continue
        assert env.observation_space().shape == (OBSERVATION_SIZE + 3 * 4,)
        assert set(env.default_params.wrappers) == {
            "domain_randomization",
            "command_delay",
            "observation_noise",
        }
    assert len(refused) == 60
    assert all(order.index(ActionHistory) < order.index(CommandDelay) for order in refused)


@pytest.mark.parametrize(
    "order",
    [
        (EpisodeStatistics, ObservationNoise, CommandDelay, ActionHistory, DomainRandomization),
        pytest.param(
            (CommandDelay, ActionHistory, DomainRandomization, EpisodeStatistics, ObservationNoise),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            (ObservationNoise, EpisodeStatistics, DomainRandomization, CommandDelay, ActionHistory),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_order_does_not_change_the_flight(order: tuple[Any, ...]) -> None:
    """What is drawn hangs on names, not on the order of wrapping."""
    reference = fly(wrapped(*ALL))
    other = fly(wrapped(*order))
    np.testing.assert_allclose(other[2][0], reference[2][0], atol=2e-4)
    np.testing.assert_array_equal(other[2][3], reference[2][3])


@OVER_WRAPPERS
def test_twice_is_refused(wrapper: Any) -> None:
    with pytest.raises(WrapperError, match=f"{wrapper.__name__} around {wrapper.__name__}: both"):
        wrapper(
            ObservationNoise(wrapper(FlyTrack())) if wrapper is not ObservationNoise else wrapped(wrapper)
        )


def test_a_history_inside_the_delay_is_refused_with_the_reason() -> None:
    with pytest.raises(WrapperError, match="CommandDelay around ActionHistory: the history would hold"):
        CommandDelay(ActionHistory(FlyTrack()))


@OVER_WRAPPERS
@pytest.mark.parametrize("inside", [LegacyStep, LogWrapper], ids=lambda inside: inside.__name__)
def test_another_step_inside_is_refused_with_the_reason(wrapper: Any, inside: Any) -> None:
    with pytest.raises(WrapperError, match=rf"found {inside.__name__} inside, .* go outermost"):
        wrapper(inside(FlyTrack()))


def test_randomising_what_is_baked_in_is_refused() -> None:
    class Baked:
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
    env = ActionHistory(CommandDelay(ActionHistory(FlyTrack(), kind="applied", length=2)), length=1)
    assert env.observation_space().shape == (OBSERVATION_SIZE + 3 * 4,)
    assert len({entry.key for entry in env.observation_table}) == len(env.observation_table)


def test_a_subclass_counts_as_what_it_is() -> None:
    class Louder(ObservationNoise):
        pass

    class Longer(ActionHistory):
        pass

    with pytest.raises(WrapperError, match="Louder around ObservationNoise: both"):
        Louder(ObservationNoise(FlyTrack()))
    with pytest.raises(WrapperError, match="CommandDelay around Longer: the history would hold"):
        CommandDelay(Longer(FlyTrack()))


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
    history = np.asarray(stacked.inner.actions[0].roll)
    assert (history != np.asarray(after.inner.actions[0].roll)).all()


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
    assert len(words) == 2  # the noise's and the model's
    for word in words:
        assert len(np.unique(np.asarray(word))) == 16
    np.testing.assert_array_equal(states.episode_length, 0)


def test_final_observation_is_the_next_one_where_the_episode_goes_on() -> None:
    _, _, outputs = fly(wrapped(*ALL))
    goes_on = ~np.asarray(outputs[3] | outputs[4])
    final = np.asarray(outputs[5]["final_observation"])
    np.testing.assert_allclose(final[goes_on], np.asarray(outputs[0])[goes_on], atol=1e-6)


# --- Observation noise ----------------------------------------------------------------------------


def without_noise() -> dict[str, Any]:
    return {"wrappers": {"observation_noise": NoiseParams(0.0, 0.0, 0.0, 0.0)}}


def test_no_noise_is_the_identity() -> None:
    noisy = fly(wrapped(ObservationNoise), **without_noise())
    plain = fly(wrapped())
    np.testing.assert_array_equal(noisy[0][0], plain[0][0])
    np.testing.assert_array_equal(noisy[2][0], plain[2][0])


def test_noise_has_the_stated_deviations_and_is_white() -> None:
    """In the observation's rows, at rest on the start pose, where the drone itself does not move."""
    env = wrapped(ObservationNoise)
    noise = NoiseParams(position_m=0.1, velocity_m_per_s=0.2, attitude_deg=2.0, rates_rad_per_s=0.3)
    params = env.default_params.replace(wrappers={"observation_noise": noise})
    drone = env.drone(env.reset(jax.random.key(0), params)[1])
    seeds = jnp.arange(4000, dtype=jnp.uint32)

    def observations(seed: jax.Array) -> jax.Array:
        state = env.begin(drone, 0, params, seed)
        first = env.observe(None, state, None, params)
        later = env.advance(state, drone.applied, params)[0]
        return jnp.stack([first, jnp.stack(env.observe_drone(drone, later, params))])

    both = np.asarray(jax.jit(jax.vmap(observations))(seeds), float)
    plain = np.asarray(env.env.observe(None, env.env.begin(drone, 0, params), None, params), float)
    error = both[:, 0] - plain
    for rows, deviation in ((slice(0, 3), 0.1 / 3), (slice(3, 6), 0.2 / 5), (slice(15, 18), 0.3 / 5)):
        np.testing.assert_allclose(error[:, rows].std(axis=0), deviation, rtol=0.05)
        np.testing.assert_allclose(error[:, rows].mean(axis=0), 0.0, atol=0.08 * deviation)
        # White: the next step's noise does not know this one's.
        next_error = both[:, 1, rows] - both[:, 1, rows].mean(axis=0)
        for axis in range(3):
            assert abs(np.corrcoef(error[:, rows][:, axis], next_error[:, axis])[0, 1]) < 0.06
    turned = both[:, 0, 6:15].reshape(-1, 3, 3)
    level = plain[6:15].reshape(3, 3)
    twist = np.einsum("ji,njk->nik", level, turned)
    angle_x = 0.5 * (twist[:, 2, 1] - twist[:, 1, 2])
    assert np.rad2deg(angle_x).std() == pytest.approx(2.0, rel=0.05)
    np.testing.assert_allclose(twist @ twist.transpose(0, 2, 1), np.tile(np.eye(3), (4000, 1, 1)), atol=1e-5)
    assert (error[:, 18:] == 0.0).all()  # applied action, battery and the track are known


def test_noise_stays_inside_the_space_and_off_the_flight() -> None:
    env = wrapped(ObservationNoise)
    loud = {"wrappers": {"observation_noise": NoiseParams(50.0, 50.0, 90.0, 50.0)}}
    noisy, plain = fly(env, **loud), fly(wrapped())
    limit = np.asarray(env.observation_space().high)
    assert (np.abs(np.asarray(noisy[2][0])) <= limit).all()
    attitude = np.asarray(noisy[2][0])[..., 6:15].reshape(-1, 3, 3)
    np.testing.assert_allclose(
        attitude @ attitude.transpose(0, 2, 1), np.tile(np.eye(3), (800, 1, 1)), atol=1e-5
    )
    np.testing.assert_allclose(noisy[2][2], plain[2][2], atol=1e-5)  # rewards are of the true flight


@pytest.mark.parametrize(
    ("field", "value"),
    [("position_m", -0.1), ("attitude_deg", np.inf), ("attitude_deg", 181.0), ("rates_rad_per_s", np.nan)],
)
def test_bad_deviations_are_refused(field: str, value: float) -> None:
    env = wrapped(ObservationNoise)
    bad = {"observation_noise": NoiseParams()._replace(**{field: value})}
    with pytest.raises(ValueError, match=rf"\.{field}: found {value}, expected finite"):
        env.reset(jax.random.key(0), env.default_params.replace(wrappers=bad))


# --- Action history -------------------------------------------------------------------------------


def test_one_applied_action_is_the_one_in_the_observation() -> None:
    env = wrapped(partial(ActionHistory, length=1, kind="applied"))
    (first, _), _, outputs = fly(env)
    for observation in (first, outputs[0], outputs[5]["final_observation"]):
        np.testing.assert_array_equal(observation[..., 29:], observation[..., 18:22])


def test_commands_are_remembered_the_latest_first_within_the_episode() -> None:
    env = wrapped(ActionHistory)
    (first, _), actions, outputs = fly(env)
    history = np.asarray(outputs[0])[..., 29:].reshape(NUM_STEPS, -1, 3, 4)
    ended = np.asarray(outputs[3] | outputs[4])
    applied = np.asarray(outputs[0])[..., 18:22]
    expected = np.repeat(np.asarray(first)[:, None, 18:22], 3, axis=1)
    np.testing.assert_array_equal(np.asarray(first)[:, 29:].reshape(-1, 3, 4), expected)
    for i in range(NUM_STEPS):
        shifted = np.concatenate([np.asarray(actions)[i][:, None], expected[:, :-1]], axis=1)
        fresh = np.repeat(applied[i][:, None], 3, axis=1)
        expected = np.where(ended[i][:, None, None], fresh, shifted)
        np.testing.assert_allclose(history[i], expected, atol=1e-6)


def test_what_is_no_number_is_remembered_as_zero() -> None:
    env = wrapped(ActionHistory)
    params = env.default_params
    _, state = env.reset(jax.random.key(0), params)
    action = jnp.array([jnp.nan, 2.0, -jnp.inf, 0.5])
    observation, _, _, terminated, _ = env.step_env(None, state, action, params)
    assert bool(terminated)
    np.testing.assert_allclose(observation[29:33], [0.0, 1.0, -1.0, 0.5])
    assert np.isfinite(np.asarray(observation)).all()


@pytest.mark.parametrize(("argument", "value"), [("length", 0), ("kind", "wanted")])
def test_bad_histories_are_refused(argument: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{argument}: found {value!r}, expected"):
        ActionHistory(FlyTrack(), **{argument: value})


# --- Command delay --------------------------------------------------------------------------------


@pytest.mark.parametrize("delay_s", [0.0, 0.013, 0.04])
def test_the_wrapper_does_what_the_effect_in_the_model_does(delay_s: float) -> None:
    outside = fly(wrapped(CommandDelay), wrappers={"command_delay": Delay(delay_s)})
    model = FlyTrack().default_params.model.with_effects(Delay(delay_s))
    inside = fly(wrapped(), model=model)
    np.testing.assert_allclose(outside[2][0], inside[2][0], atol=2e-4)
    np.testing.assert_array_equal(outside[2][3], inside[2][3])


def test_a_delay_beyond_the_memory_is_refused() -> None:
    with pytest.raises(ValueError, match=r"delay_s: found 0\.05, expected 0 to 0\.04 s"):
        CommandDelay(FlyTrack(), delay_s=0.05)
    env = wrapped(CommandDelay)
    negative = {"command_delay": env.own_defaults()._replace(delay_s=-0.01)}
    with pytest.raises(ValueError, match=r"delay_s: found -0\.01"):
        env.reset(jax.random.key(0), env.default_params.replace(wrappers=negative))


def test_what_is_no_number_ends_the_episode_at_once_whatever_the_delay() -> None:
    env = wrapped(partial(CommandDelay, delay_s=0.04))
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
    known = (Delay(0.036), ThrustScale(0.6), LinearDrag(1.0, -0.5, 0.0), QuadraticDrag(0.1))
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
