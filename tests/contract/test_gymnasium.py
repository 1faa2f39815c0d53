"""The environments as a Gymnasium client sees them, single and vectorised."""

import copy
import importlib
import pickle
import sys
import warnings
from functools import cache, partial

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from gymnasium.wrappers import vector as wrappers
from numpy.testing import assert_allclose, assert_array_equal

import flytrack_env
from flytrack_env.effects import CommandDelay
from flytrack_env.gymnasium_adapter import environments, simulation
from flytrack_env.registration import ENVIRONMENTS
from tests.support.coasting import track_of_row
from tests.support.tables import table

APPLIED_ROLL = 18  # row of the observation

BASE = "FlyTrack-v0"

IDS = sorted(ENVIRONMENTS)
# An id, and packages that are not installed.
CHECKED = [
    (BASE, ()),
    (BASE, ("pygame", "PIL")),
    pytest.param("FlyTrackCornersRobust-v0", (), marks=pytest.mark.slow),
    pytest.param("FlyTrackMask-v0", (), marks=pytest.mark.slow),
]
CRASH = np.full(4, np.nan, np.float32)  # an action that ends the episode


def make_vector(num_envs=3, **arguments):
    """Return the vector environment."""
    return gymnasium.make_vec(
        BASE, num_envs=num_envs, vectorization_mode="vector_entry_point", **arguments
    )


@pytest.fixture(scope="module")
def still(params):
    """Parameters of which every episode begins in the same way, and lasts 12 steps at most."""
    names = ("position_noise", "height_noise", "yaw_noise_deg", "tilt_noise_deg")
    reset = params.reset._replace(course_fraction=0.0, start_charge_low=1.0)
    reset = reset._replace(**{f"start_{name}": 0.0 for name in names})
    return params.replace(reset=reset, max_steps_in_episode=12)


# --- Registration and the protocol --------------------------------------------------------------


@pytest.mark.parametrize(("env_id", "missing"), CHECKED, ids=str)
def test_checker_of_gymnasium_gives_no_warning(env_id, missing, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    for package in missing:
        monkeypatch.setitem(sys.modules, package, None)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(gymnasium.make(env_id).unwrapped)
    assert [str(warning.message) for warning in caught] == []


@pytest.mark.parametrize("env_id", IDS)
def test_ids_are_registered_once_and_without_a_second_time_limit(env_id):
    before = gymnasium.spec(env_id)
    importlib.reload(flytrack_env)
    assert gymnasium.spec(env_id) is before and before.max_episode_steps is None
    env = gymnasium.make(f"flytrack_env:{env_id}")
    while isinstance(env, gymnasium.Wrapper):
        assert not isinstance(env, TimeLimit)
        env = env.env
    assert env.observation_space.is_bounded()


@pytest.mark.parametrize("is_inline", [True, False])
def test_single_environment_agrees_with_gymnax(env, still, is_inline, monkeypatch):
    if not is_inline:  # as with noise, randomisation or much else in a step
        monkeypatch.setattr(simulation, "MAX_INLINE_OPERATIONS", 0)
        monkeypatch.setattr(environments, "single_step", cache(simulation.SingleStep))
    step = jax.jit(env.step_env)
    _, state = env.reset(jax.random.key(0), still)
    single = gymnasium.make(BASE, params=still)
    single.reset()
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 4)).astype(np.float32)
    actions[:, 3] = 0.5  # off the ground
    for index, action in enumerate(actions):
        expected, state, reward, terminated, info = step(None, state, action, still)
        observation, *outcome, own_info = single.step(action)
        assert_allclose(observation, expected, atol=2e-5)
        assert_allclose(outcome[0], reward, atol=2e-5)
        assert outcome[1:] == [terminated, env.is_truncated(state, still)] == [False, index == 11]
        assert set(own_info) == set(info)
        for name, value in own_info.items():
            assert type(value) is type(info[name].item())
            assert_allclose(value, info[name], atol=2e-5)


def test_a_step_is_run_by_the_thread_that_calls_it():
    env = gymnasium.make(BASE).unwrapped
    env.reset()
    inputs = env._states, np.zeros(4, np.float32), env._simulation.params_words
    step = env._compiled_step().compiled.lower(*inputs).compile()
    # Else XLA's client hands it to another one, and waiting for that costs more than the step.
    assert step.cost_analysis()["flops"] < simulation.MAX_INLINE_OPERATIONS


def assert_same(a, b, atol=2e-5):
    """Compare nested infos, except elapsed time: keys, types, and values to rounding."""
    if isinstance(a, dict):
        assert set(a) == set(b)
        for name in set(a) - {"t"}:
            assert_same(a[name], b[name], atol)
    elif a is None or b is None:
        assert a is b
    elif a.dtype == object:
        for left, right in zip(a, b, strict=True):
            assert_same(left, right, atol)
    else:
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        assert a.flags.writeable
        assert_allclose(a, b, atol=atol)


NEXT_STEP, SAME_STEP = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP


# Gymnasium's wrappers of observations refuse SAME_STEP.
@pytest.mark.parametrize(
    ("mode", "wrapper"),
    [
        *((mode, wrappers.RecordEpisodeStatistics) for mode in (NEXT_STEP, SAME_STEP)),
        (SAME_STEP, wrappers.NormalizeReward),
        (NEXT_STEP, wrappers.NormalizeObservation),
        (NEXT_STEP, partial(wrappers.DtypeObservation, dtype=np.float64)),
    ],
)
@pytest.mark.filterwarnings(
    "ignore:overflow encountered in cast"
)  # of the limits, in DtypeObservation
def test_vector_environment_returns_what_gymnasiums_own_does(mode, wrapper, still):
    make = partial(gymnasium.make, BASE, params=still)
    plain = (
        make_vector(params=still, autoreset_mode=mode),
        SyncVectorEnv([make] * 3, autoreset_mode=mode),
    )
    assert plain[0].metadata["autoreset_mode"] is plain[0].autoreset_mode is mode
    ours, theirs = map(wrapper, plain)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert_same(ours.reset(seed=5)[0], theirs.reset(seed=5)[0])
    # Rounding is divided by the deviation, too, of observations that hardly differ.
    atol = 1e-3 if wrapper is wrappers.NormalizeObservation else 2e-5
    rng, num_ended = np.random.default_rng(1), []
    for index in range(18):
        actions = rng.uniform(-1.0, 1.0, (3, 4)).astype(np.float32)
        # Two of them, one, and all: a step without an info of an episode that goes on.
        actions[{3: 1, 6: 2, 9: 0, 10: 0}.get(index, 3) :] = CRASH
        results = ours.step(actions), theirs.step(actions)
        for a, b in zip(*results, strict=True):
            assert_same(a, b, atol)
        num_ended.append(int((results[0][2] | results[0][3]).sum()))
    assert {0, 1, 2, 3} <= set(num_ended)  # steps in which none, some and all episodes ended


def test_64_bit_numbers_may_be_switched_on_between_steps():
    env = gymnasium.make(BASE)
    env.reset(seed=3)
    with jax.enable_x64(True):
        with_x64 = env.step(np.zeros(4))
    again = env.step(np.zeros(4))
    env.reset(seed=3)
    expected = env.step(np.zeros(4)), env.step(np.zeros(4))
    for step, expected_step in zip((with_x64, again), expected, strict=True):
        assert_allclose(step[0], expected_step[0], atol=2e-5)
        assert step[2:4] == expected_step[2:4]
        assert step[4] == pytest.approx(expected_step[4], abs=2e-5)


# --- Seeding ------------------------------------------------------------------------------------


def test_vector_seeds():
    env, crash, flights = make_vector(autoreset_mode="SameStep"), np.tile(CRASH, (3, 1)), []
    for _ in range(2):
        flights.append([env.reset(seed=20)[0], env.step(crash)[0], env.step(crash)[0]])
    assert_array_equal(*flights)
    starts = np.concatenate(flights[0])
    assert len(np.unique(starts, axis=0)) == 9
    partly = env.reset(seed=[20, None, 22])[0]
    assert_array_equal(partly[[0, 2]], starts[[0, 2]])
    assert (partly[1] != starts[1]).any()
    assert (env.reset()[0] != env.reset()[0]).any(axis=1).all()
    with pytest.raises(ValueError, match="seed: found 2 seeds, expected one per environment, 3"):
        env.reset(seed=[1, 2])


# --- Wrappers and copies ------------------------------------------------------------------------


@pytest.mark.parametrize("is_vector", [False, True])
def test_copies_fly_on_alike_and_apart(is_vector):
    env = make_vector() if is_vector else gymnasium.make(BASE).unwrapped
    env.reset(seed=8)
    action = np.full(env.action_space.shape, 0.2, np.float32)
    env.step(action)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    flown, *again = (
        np.stack([*(each.step(action)[0] for _ in range(3)), each.reset()[0]])
        for each in (env, *copies)
    )
    for each in again:
        assert_array_equal(each, flown)


# --- Options of reset ---------------------------------------------------------------------------

POSE = {
    "position": (15.0, 2.5, 1.2),
    "yaw_deg": 180.0,
    "velocity": [-9.0, 0.0, 1.0],
    "battery_v": 22.5,
}


@pytest.mark.parametrize("is_vector", [False, True])
def test_options_set_the_start_of_one_episode(is_vector):
    env = make_vector() if is_vector else gymnasium.make(BASE)
    observation = np.atleast_2d(env.reset(seed=0, options=POSE)[0])
    # Gate 0 at (12.5, 2, 1.35) is flown towards -x.
    place, velocity = np.array([-2.5, -0.5, -0.15]) / 3, np.array([9.0, 0.0, 1.0]) / 5
    expected = [*place, *velocity, *np.eye(3).ravel(), *[0.0] * 6, -1.0, -0.5]
    assert_allclose(observation[:, :23], [expected] * len(observation), atol=1e-5)
    following = np.atleast_2d(env.reset()[0])
    assert (abs(following[:, 22] + 0.5) > 1e-3).all()


@pytest.mark.parametrize(("options", "message"), table("reset_options")["refused"])
def test_bad_options_are_refused_and_change_nothing(options, message):
    env, vector = gymnasium.make(BASE), make_vector()
    for each in (env, vector):
        each.reset(seed=1)
        with pytest.raises(ValueError, match=message):
            each.reset(seed=2, options=options)
    following = env.reset()[0]
    env.reset(seed=1)
    assert_array_equal(following, env.reset()[0])


# --- Arguments and misuse -------------------------------------------------------------------------


def test_arguments_reach_the_environment(params):
    # Past a gate, outside its frame.
    beside = {"position": (-0.05, 4.0, 2.0), "velocity": (10.0, 0.0, 0.0)}
    beside["track"] = track_of_row([10.0 * index for index in range(8)])
    for arguments, is_end in (({"missed_gate": "fly_on"}, False), ({}, True)):
        env = gymnasium.make(BASE, **arguments)
        env.reset(options=beside)
        assert env.step(np.zeros(4))[2] is is_end
    with pytest.raises(TypeError, match="params: found dict, expected EnvParams"):
        gymnasium.make(BASE, params={})
    with pytest.raises(ValueError, match="drone_radius"):
        make_vector(params=params.replace(drone_radius=1.0))
    with pytest.raises(ValueError, match=r"params\.model\.m: found shape \(3,\), expected \(\)"):
        gymnasium.make(BASE, params=params.replace(model=params.model._replace(m=np.ones(3))))


def test_wrong_use_is_refused():
    env, vector = gymnasium.make(BASE).unwrapped, make_vector()
    for each in (env, vector):
        with pytest.raises(gymnasium.error.ResetNeeded, match="expected a reset"):
            each.step(np.zeros(each.action_space.shape))
        each.reset()
        with pytest.raises(ValueError, match=r"actions?: found shape \(5,\), expected"):
            each.step(np.zeros(5))
        assert each.render() is None
        with pytest.raises(ValueError, match="render_mode: found 'ansi', expected None, "):
            type(each)(BASE, render_mode="ansi")
    with pytest.raises(ValueError, match="num_envs: found 0"):
        make_vector(num_envs=0)
    with pytest.raises(
        ValueError, match="autoreset_mode: found 'Disabled', expected 'NextStep' or"
    ):
        make_vector(autoreset_mode=AutoresetMode.DISABLED)


def test_integers_and_numbers_of_numpy_are_as_good_as_pythons(params):
    assert make_vector(num_envs=np.int64(3)).reset()[0].shape[0] == 3
    with pytest.raises(ValueError, match=r"num_envs: found 2\.0, expected an integer"):
        make_vector(num_envs=2.0)
    compiled = []
    for dt in (0.01, np.float32(0.01), np.float64(0.01)):
        env = gymnasium.make(BASE, params=params.replace(dt=dt))
        env.reset()
        env.step(np.zeros(4))
        caches = simulation.begin._cache_size(), simulation.single_step.cache_info().currsize
        compiled.append((*caches, env.unwrapped._compiled_step().compiled._cache_size()))
    assert len(set(compiled)) == 1


@pytest.mark.slow  # two programs are compiled
def test_models_with_other_delays_are_flown_with_their_own():
    steps = {}
    for delay_s in (0.04, 0.06, 0.04):
        model = flytrack_env.nominal_parameters().with_effects(CommandDelay(delay_s))
        env = gymnasium.make("flytrack_env:FlyTrack-v0", model=model)
        env.reset(seed=0, options={"gate_index": 0})  # at rest: no roll is applied
        rolls = [env.step(np.array([1.0, 0.0, 0.0, 1.0]))[0][APPLIED_ROLL] for _ in range(10)]
        steps[delay_s] = int(np.flatnonzero(rolls)[0])
    assert steps == {0.04: 4, 0.06: 6}
