"""What each wrapper adds to a flight, and that nothing of it survives an episode."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flytrack_env.dynamics import nominal_parameters
from flytrack_env.effects import (
    CommandDelay,
    LinearDrag,
    QuadraticDrag,
    ThrustScale,
    Wind,
    effect_of,
)
from flytrack_env.env import FlyTrack
from flytrack_env.state import Action
from flytrack_env.wrappers import (
    ActionDelay,
    ActionHistory,
    DomainRandomization,
    DroneRaceEnv,
    NoiseParams,
    ObservationNoise,
    RandomizationParams,
)
from flytrack_env.wrappers.domain_randomization import sample_model
from tests.support.coasting import Coasting
from tests.support.wrapped_flights import (
    ALL,
    ENDS,
    NUM_ENVS,
    arrays,
    before_ends,
    fly,
    resets_of,
    steps_of,
    wrapped,
)

SIZE = 29  # of FlyTrack's own observation; behind it, one applied and three commanded actions
NO_NOISE = NoiseParams(0.0, 0.0, 0.0, 0.0, 0.0)
LATE_S = 0.013


def same_model(delay_s=0.0):
    """Return ranges that give the nominal model with a delay, in the default's structure."""
    calm = Wind(0.0, 0.0, None, None, None, None)
    ends = (CommandDelay(delay_s, None, None), ThrustScale(1.0), calm, LinearDrag(0.0, 0.0, 0.0))
    return RandomizationParams(1.0, 1.0, 1.0, 1.0, low=ends, high=ends)


@pytest.fixture(scope="module")
def flight():
    """Flights in all wrappers with their default parameters."""
    env = wrapped(*ALL)
    return fly(env, env.default_params.replace(max_steps_in_episode=50))


@pytest.fixture(scope="module")
def quiet_flights():
    """Flights in all wrappers without noise, with one model; late by effect, wrapper or neither."""
    cases = {"neither": (0.0, 0.0), "effect": (LATE_S, 0.0), "wrapper": (0.0, LATE_S)}
    return {
        name: fly(
            wrapped(*ALL),
            observation_noise=NO_NOISE,
            domain_randomization=same_model(in_effect),
            action_delay=CommandDelay(in_wrapper),
        )
        for name, (in_effect, in_wrapper) in cases.items()
    }


def test_neutral_wrappers_fly_as_none_and_the_delay_as_effect(quiet_flights):
    plain, (neutral, late, delayed) = fly(wrapped()), quiet_flights.values()
    assert_allclose(neutral.observations[..., :SIZE], plain.observations, atol=1e-4)
    assert_allclose(neutral.rewards, plain.rewards, atol=1e-4)
    assert_array_equal(neutral.ended, plain.ended)
    assert plain.ended.any()
    assert_allclose(late.observations, delayed.observations, atol=2e-4)
    assert_array_equal(late.terminated, delayed.terminated)
    assert np.abs(late.observations - neutral.observations).max() > 0.1


@pytest.mark.slow
def test_the_order_of_wrapping_does_not_change_the_flight(flight):
    """What is drawn hangs on names."""
    env = wrapped(ALL[5], ALL[3], ALL[1], ALL[0], ALL[2], ALL[4])
    reordered = fly(env, env.default_params.replace(max_steps_in_episode=50))
    assert_allclose(reordered.observations, flight.observations, atol=5e-4)
    assert_array_equal(reordered.ended, flight.ended)


# --- Each wrapper ---------------------------------------------------------------------------------


def test_statistics_are_those_of_the_episode(flight):
    total, length = np.zeros(NUM_ENVS), np.zeros(NUM_ENVS, int)
    for i, is_end in enumerate(flight.ended):
        total, length = total + np.asarray(flight.rewards[i], float), length + 1
        assert_allclose(flight.info["episode_return"][i], total, atol=1e-4)
        assert_array_equal(flight.info["episode_length"][i], length)
        total, length = np.where(is_end, 0.0, total), np.where(is_end, 0, length)
    assert flight.ended.any() and flight.truncated.any()


def test_commands_are_remembered_the_latest_first_within_the_episode(flight):
    def repeated(action):
        return np.repeat(action[:, None], 3, axis=1)

    observations, first = np.asarray(flight.observations), np.asarray(flight.first)
    applied, commanded = observations[..., 18:22], observations[..., SIZE + 4 :]
    assert_array_equal(observations[..., SIZE : SIZE + 4], applied)
    expected = repeated(first[:, 18:22])
    assert_array_equal(first[:, SIZE + 4 :].reshape(-1, 3, 4), expected)
    for action, is_end, now, row in zip(
        flight.actions, flight.ended, applied, commanded, strict=True
    ):
        shifted = np.concatenate([action[:, None], expected[:, :-1]], axis=1)
        expected = np.where(is_end[:, None, None], repeated(now), shifted)
        assert_allclose(row.reshape(-1, 3, 4), expected, atol=1e-6)


def test_a_model_and_the_noise_hold_for_their_episode_and_their_step(flight):
    def words_of(state):
        """Of the noise, inside the statistics and the history of commands, and of the model."""
        return state.inner.inner.word, state.inner.inner.inner.inner.inner.word

    noise, model = (
        np.concatenate([first[None], later])
        for first, later in zip(words_of(flight.start), words_of(flight.states), strict=True)
    )
    assert (noise[1:] != noise[:-1]).all()
    assert_array_equal(model[1:] != model[:-1], flight.ended)
    assert len(np.unique(noise[-1])) == len(np.unique(model[-1])) == NUM_ENVS


def test_noise_has_the_stated_deviations():
    """In the observation's rows at rest on the start pose, where the drone does not move."""
    env = wrapped(ObservationNoise)
    noise = NoiseParams(position_m=0.1, velocity_m_per_s=0.2, attitude_deg=2.0, rates_rad_per_s=0.3)
    params = env.default_params.replace(wrappers={"observation_noise": noise})
    drone = env.env.drone(env.env.reset(jax.random.key(0))[1])

    @jax.jit
    @jax.vmap
    def observe(seed):
        return env.observe(None, env.begin(drone, 0, params, seed), None, params)

    noisy = np.asarray(observe(jnp.arange(4000, dtype=jnp.uint32)), float)
    plain = np.asarray(env.env.observe(None, env.env.begin(drone, 0, params), None, params), float)
    error = noisy - plain
    rows, deviations = np.r_[0:6, 15:18], np.repeat([0.1 / 3, 0.2 / 5, 0.3 / 5], 3)
    assert_allclose(error[:, rows].std(axis=0), deviations, rtol=0.05)
    assert (np.abs(error[:, rows].mean(axis=0)) < 0.08 * deviations).all()
    twist = np.einsum("ji,njk->nik", plain[6:15].reshape(3, 3), noisy[:, 6:15].reshape(-1, 3, 3))
    assert np.rad2deg(0.5 * (twist[:, 2, 1] - twist[:, 1, 2])).std() == pytest.approx(2.0, rel=0.05)
    assert (error[:, 18:] == 0.0).all()  # applied action, battery and the track are known


def test_noise_stays_inside_the_space_and_off_the_flight(quiet_flights):
    quiet = {"domain_randomization": same_model(), "action_delay": CommandDelay(0.0)}
    loud = fly(wrapped(*ALL), observation_noise=NoiseParams(50.0, 50.0, 90.0, 50.0), **quiet)
    assert (np.abs(loud.observations) <= np.asarray(wrapped(*ALL).observation_space().high)).all()
    attitude = np.asarray(loud.observations)[..., 6:15].reshape(-1, 3, 3)
    eye = np.broadcast_to(np.eye(3), attitude.shape)
    assert_allclose(attitude @ attitude.transpose(0, 2, 1), eye, atol=1e-5)
    assert_array_equal(loud.rewards, quiet_flights["neither"].rewards)  # of the true flight


def sampled_models(model, num):
    """Return models of that many words, leaves (num,), drawn from the default ranges."""
    words = jax.random.bits(jax.random.key(0), (num,))
    return jax.jit(jax.vmap(lambda word: sample_model(word, model, RandomizationParams())))(words)


def assert_fills(values, low, high, gap):
    """Check that values fill a range up to gaps at its ends; return where in it they lie."""
    unit = (np.asarray(values, float) - low) / (high - low)
    assert -1e-5 <= unit.min() < gap and 1.0 - gap < unit.max() <= 1.0 + 1e-5
    return unit


def test_everything_that_has_a_range_fills_it_and_independently():
    models, ranges = sampled_models(nominal_parameters(), 2000), RandomizationParams()
    columns = [(models.m, 0.8, 1.2), *((tau, 0.7 * 0.04, 1.3 * 0.04) for tau in models.tau)]
    assert len(models.effects) == len(ranges.low)
    for low, high in zip(ranges.low, ranges.high, strict=True):
        drawn = models.effect(effect_of(low).name)
        for values, lowest, highest in zip(drawn, low, high, strict=True):
            if lowest is None:
                assert (values == 0.0).all()
            elif lowest < highest:
                columns.append((values, lowest, highest))
    assert len(columns) == 1 + 4 + 1 + 1 + 2 + 3
    units = [assert_fills(*column, gap=0.01) for column in columns]
    assert (np.abs(np.mean(units, axis=1) - 0.5) < 0.03).all()
    assert np.abs(np.corrcoef(units) - np.eye(len(units))).max() < 0.1


def test_what_the_model_itself_has_is_drawn_around_it():
    """Identified effects are scaled within their range; effects outside the ranges stay."""
    known = (CommandDelay(0.036), ThrustScale(0.6), LinearDrag(1.0, -0.5, 0.0), QuadraticDrag(0.1))
    models = sampled_models(nominal_parameters().with_effects(*known), 500)
    assert {type(effect) for effect in models.effects} == {Wind, *map(type, known)}
    drag = models.effect("linear_drag")
    for values, low, high in (
        (models.effect("command_delay").delay_s, 0.8 * 0.036, 1.2 * 0.036),
        (models.effect("thrust_scale").factor, 1.0 - 0.4 * 1.2, 1.0 - 0.4 * 0.8),
        (drag.d_x, 0.8, 1.2),
        (drag.d_y, -0.6, -0.4),
    ):
        assert_fills(values, low, high, gap=0.05)
    assert (drag.d_z == 0.0).all()
    assert (models.effect("quadratic_drag").k_x == np.float32(0.1)).all()


OK = RandomizationParams()
REFUSALS = [
    (
        DomainRandomization,
        OK._replace(mass_factor_low=1.3),
        r"mass_factor: found a range from 1\.3 to 1\.2",
    ),
    (
        DomainRandomization,
        OK._replace(low=OK.low[1:]),
        r"high: found effects \['CommandDelay', .* of low",
    ),
    (
        DomainRandomization,
        OK._replace(high=(CommandDelay(0.1), *OK.high[1:])),
        r"delay_s: found 0\.1, expected 0 to 0",
    ),
    (ActionDelay, CommandDelay(-0.01), r"delay_s: found -0\.01"),
    (
        ObservationNoise,
        NO_NOISE._replace(position_m=-0.1),
        r"\.position_m: found -0.1, expected 0 to",
    ),
]


@pytest.mark.parametrize(("wrapper", "parameters", "reason"), REFUSALS)
def test_bad_parameters_are_refused(wrapper, parameters, reason):
    env = wrapped(wrapper)
    with pytest.raises(ValueError, match=reason):
        env.check_params(env.default_params.replace(wrappers={env.key: parameters}))


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match=r"delay_s: found 0\.05, expected 0 to 0\.04 s"):
        ActionDelay(FlyTrack(), delay_s=0.05)
    for argument, value in (("length", 0), ("kind", "wanted")):
        with pytest.raises(ValueError, match=f"{argument}: found {value!r}, expected"):
            ActionHistory(FlyTrack(), **{argument: value})


# --- Nothing survives an episode ------------------------------------------------------------------


POISONS = {
    "nan": lambda values: np.nan * values,
    "infinite": lambda values: np.inf * values,
    "huge": lambda values: 3e38 * np.sign(values),
    "random": lambda values: values,
}
LAST_STEP = wrapped().default_params.max_steps_in_episode - 1


def poisoned(states, poison, rng):
    """Return states of which every number is anything, at an episode's last step."""

    def anything(path, leaf):
        if getattr(path[-1], "name", "") == "time":
            return np.full(leaf.shape, LAST_STEP, leaf.dtype)
        if leaf.dtype == bool:
            return rng.random(leaf.shape) < 0.5
        if jnp.issubdtype(leaf.dtype, jnp.integer):
            return rng.integers(0, 1000, leaf.shape).astype(leaf.dtype)
        return POISONS[poison](rng.normal(size=leaf.shape)).astype(leaf.dtype)

    return jax.tree_util.tree_map_with_path(anything, states)


def test_after_every_kind_of_end_an_episode_begins_as_if_nothing_had_been():
    """After an end, the state is that of a reset with the same key, in every leaf and wrapper."""
    env = wrapped(*ALL)
    params, applied = arrays(env.default_params), Action(0.5, -0.5, 0.4, 0.3)
    ends = {name: end for name, end in ENDS.items() if end[-2] or end[-1]}
    assert len(ends) == NUM_ENVS
    states, actions = before_ends(env, params, ends.values(), applied=applied)
    keys = jax.random.split(jax.random.key(7), NUM_ENVS)
    step = steps_of(env)
    observation, after, _, terminated, truncated, info = step(keys, states, actions, params)
    assert (terminated | truncated).all()
    chex.assert_trees_all_close((observation, after), resets_of(env)(keys, params), atol=1e-5)
    last = np.asarray(info["final_observation"])
    assert np.isfinite(last).all() and (last != np.asarray(observation)).any(axis=1).all()
    # What is no number is remembered as 0, and the rest of the action clipped.
    assert_allclose(last[list(ends).index("nan roll"), SIZE + 4 : SIZE + 8], [0.0, 1.0, -1.0, 0.5])
    starts = np.stack(jax.tree.leaves(env.drone(after).pos_w), -1)
    assert len(np.unique(starts, axis=0)) == NUM_ENVS
    # Bit for bit the same after another past, in which every number may be anything.
    rng = np.random.default_rng(0)
    for poison in POISONS:
        actions = jnp.float32(rng.choice([0.3, 1.0, np.inf, np.nan], (NUM_ENVS, 4)))
        output = step(keys, poisoned(states, poison, rng), actions, params)
        assert np.asarray(output[4]).all()
        chex.assert_trees_all_equal(output[:2], (observation, after))


def test_the_handouts_environment_is_flytrack_with_a_step_of_five_values():
    env, same = (make(track="split_s", plant=Coasting()) for make in (DroneRaceEnv, FlyTrack))
    params, key, action = env.default_params, jax.random.key(3), jnp.zeros(4)
    begun = jax.eval_shape(lambda key: env.reset(rng=key, params=params), key)
    assert begun == jax.eval_shape(same.reset, key, params)
    chex.assert_trees_all_equal(params, same.default_params)

    def step(key, state):
        return env.step(rng=key, state=state, action=action, params=params)

    *outcome, terminated, _, info = jax.eval_shape(same.step, key, begun[1], action, params)
    assert jax.eval_shape(step, key, begun[1]) == (*outcome, terminated, info)
