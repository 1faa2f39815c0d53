"""The environments as a Gymnasium client sees them, single and vectorised."""

import copy
import importlib
import json
import pickle
import subprocess
import sys
import warnings
from importlib.util import find_spec
from typing import Any

import cloudpickle
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RecordEpisodeStatistics, TimeLimit
from gymnasium.wrappers.vector import RecordEpisodeStatistics as RecordVectorStatistics

import flytrack_env
from flytrack_env.env import EnvParams, FlyTrack
from flytrack_env.registration import ENVIRONMENTS
from tests.support.gymnasium_envs import BASE, make_vector

IDS = sorted(ENVIRONMENTS)
# For what takes long to compile: the last row of the table has everything that the others have.
LAST = list(ENVIRONMENTS)[-1]
SOME_SLOW_IDS = [pytest.param(env_id, marks=[] if env_id == LAST else pytest.mark.slow) for env_id in IDS]
CRASH = np.full(4, np.nan, np.float32)  # an action that ends the episode
# Before, Gymnasium's wrapper left out the first step after an end (Gymnasium, pull request 1624).
COUNTS_EVERY_STEP = tuple(map(int, gymnasium.__version__.split(".")[:2])) >= (1, 4)
CAUSES = {"crash", "ground", "out_of_bounds", "missed_gate", "battery_empty"}


def fly(env: Any, seed: int, num_steps: int = 5) -> np.ndarray:
    """Return the observations of a flight from a seeded reset."""
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, (num_steps, 4))
    return np.stack([env.reset(seed=seed)[0], *(env.step(action)[0] for action in actions)])


@pytest.fixture(scope="module")
def still(params: EnvParams) -> EnvParams:
    """Parameters of which every episode begins in the same way, and lasts 12 steps at most."""
    names = ("position_noise", "height_noise", "yaw_noise_deg", "tilt_noise_deg")
    reset = params.reset._replace(course_fraction=0.0, start_battery_low_v=24.0)
    reset = reset._replace(**{f"start_{name}": 0.0 for name in names})
    return params.replace(reset=reset, max_steps_in_episode=12)


# --- Registration and the protocol --------------------------------------------------------------


@pytest.mark.parametrize("env_id", IDS)
def test_checker_of_gymnasium_gives_no_warning(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    is_renderable = all(find_spec(package) for package in ("PIL", "pygame"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(gymnasium.make(env_id).unwrapped, skip_render_check=not is_renderable)
    assert [str(warning.message) for warning in caught] == []


@pytest.mark.parametrize("env_id", IDS)
def test_ids_are_registered_once_and_without_a_second_time_limit(env_id: str) -> None:
    before = gymnasium.spec(env_id)
    importlib.reload(flytrack_env)
    assert gymnasium.spec(env_id) is before
    assert before.max_episode_steps is None
    env = gymnasium.make(f"flytrack_env:{env_id}")
    while isinstance(env, gymnasium.Wrapper):
        assert not isinstance(env, TimeLimit)
        env = env.env
    assert np.isfinite(env.observation_space.low).all() and np.isfinite(env.observation_space.high).all()


@pytest.mark.parametrize("env_id", SOME_SLOW_IDS)
def test_vector_environment_of_every_id_resets_in_the_same_step(env_id: str) -> None:
    env = make_vector(env_id)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    observations, infos = env.reset(seed=3)
    assert infos == {} and observations in env.observation_space
    np.testing.assert_allclose(observations[1], gymnasium.make(env_id).reset(seed=4)[0], atol=1e-6)
    actions = np.stack([np.zeros(4), CRASH, np.zeros(4)])
    observations, rewards, terminated, truncated, infos = env.step(actions)
    assert observations in env.observation_space
    assert rewards.shape == (3,) and not truncated.any()
    np.testing.assert_array_equal(terminated, infos["_final_obs"])
    assert terminated[1] and infos["final_info"]["crash"][1]
    assert infos["final_obs"][1] in env.single_observation_space
    assert (infos["final_obs"][1] != observations[1]).any()


def test_step_returns_python_types() -> None:
    env = gymnasium.make(BASE)
    env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(np.zeros(4))
    assert observation.dtype == np.float32 and observation.flags.writeable
    assert type(reward) is float and type(terminated) is bool and type(truncated) is bool
    assert set(info) >= CAUSES and not {"final_observation", "terminated", "truncated"} & set(info)
    assert all(type(info[name]) is bool for name in (*CAUSES, "lap_completed"))
    assert type(info["laps"]) is int and type(info["lap_time_s"]) is float


def test_both_environments_agree_with_gymnax(env: FlyTrack, still: EnvParams) -> None:
    key, (_, state) = jax.random.key(0), env.reset(jax.random.key(0), still)
    single, vector = gymnasium.make(BASE, params=still), make_vector(params=still)
    single.reset()
    vector.reset()
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 4)).astype(np.float32)
    actions[:, 3] = 0.5  # off the ground
    for index, action in enumerate(actions):
        _, state, reward, terminated, truncated, info = env.step(key, state, jnp.asarray(action), still)
        observation, *outcome, own_info = single.step(action)
        np.testing.assert_allclose(observation, info["final_observation"], atol=2e-5)
        np.testing.assert_allclose(outcome[0], reward, atol=2e-5)
        assert outcome[1:] == [terminated, truncated] == [False, index == 11]
        for name, value in own_info.items():
            np.testing.assert_allclose(value, info[name], atol=2e-5)
        observations, rewards, *flags, infos = vector.step(np.stack([action] * 3))
        last = infos["final_obs"] if truncated else observations
        np.testing.assert_allclose(np.stack(last), np.stack([observation] * 3), atol=2e-5)
        np.testing.assert_allclose(rewards, [outcome[0]] * 3, atol=2e-5)
        np.testing.assert_array_equal(np.array(flags).T, [outcome[1:]] * 3)


def assert_same(a: Any, b: Any) -> None:
    """Compare nested infos: keys, types, and values to rounding."""
    if isinstance(a, dict):
        assert set(a) == set(b)
        for name in a:
            assert_same(a[name], b[name])
    elif a is None or b is None:
        assert a is b
    elif a.dtype == object:
        for one, other in zip(a, b, strict=True):
            assert_same(one, other)
    else:
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        assert a.flags.writeable
        np.testing.assert_allclose(a, b, atol=2e-5)


def test_vector_environment_returns_what_gymnasiums_own_does(still: EnvParams) -> None:
    ours = make_vector(params=still)
    theirs = SyncVectorEnv(
        [lambda: gymnasium.make(BASE, params=still)] * 3, autoreset_mode=AutoresetMode.SAME_STEP
    )
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert_same(ours.reset(seed=5)[0], theirs.reset(seed=5)[0])
    rng, num_ended = np.random.default_rng(1), []
    for index in range(16):
        actions = rng.uniform(-1.0, 1.0, (3, 4)).astype(np.float32)
        if index in (3, 6):
            actions[index // 3 :] = CRASH  # some of them, and then more
        if index == 9:
            actions[:] = CRASH  # all of them: a step without an info of an episode that goes on
        results = ours.step(actions), theirs.step(actions)
        for a, b in zip(*results, strict=True):
            assert_same(a, b)
        num_ended.append(int((results[0][2] | results[0][3]).sum()))
    assert {0, 1, 2, 3} <= set(num_ended)  # steps in which none, some and all episodes ended


def test_truncation_and_termination_are_apart(still: EnvParams) -> None:
    env = gymnasium.make(BASE, params=still)
    env.reset(seed=0)
    hover = np.array([0.0, 0.0, 0.0, 0.5])
    flags = [env.step(hover)[2:4] for _ in range(12)]
    assert flags == [(False, False)] * 11 + [(False, True)]
    env.reset()
    *_, terminated, truncated, info = env.step(CRASH)
    assert terminated and not truncated and info["crash"]


def test_returned_arrays_are_the_callers_own() -> None:
    spoilt, untouched = make_vector(), make_vector()
    spoilt.reset(seed=1)[0][:] = 7.0
    untouched.reset(seed=1)
    for _ in range(3):
        result = spoilt.step(np.zeros((3, 4), np.float32))
        expected = untouched.step(np.zeros((3, 4), np.float32))
        assert_same(result[4], expected[4])
        for array in (*result[:4], *result[4].values()):
            array[:] = 1


# --- Seeding ------------------------------------------------------------------------------------


def test_same_seed_same_flight() -> None:
    env, other = gymnasium.make(BASE), gymnasium.make(BASE)
    first = fly(env, seed=11)
    np.testing.assert_array_equal(first, fly(other, seed=11))
    following = env.reset()[0]
    assert (following != first[0]).any()
    np.testing.assert_array_equal(following, other.reset()[0])
    assert (fly(env, seed=12)[0] != first[0]).any()


def test_vector_seeds() -> None:
    env, single = make_vector(), gymnasium.make(BASE)
    observations, _ = env.reset(seed=20)
    np.testing.assert_array_equal(observations, env.reset(seed=[20, 21, 22])[0])
    starts = [single.reset(seed=seed)[0] for seed in (20, 21, 22)]
    np.testing.assert_allclose(observations, starts, atol=1e-6)
    crash = np.tile(CRASH, (3, 1))
    env.reset(seed=20)
    after = env.step(crash)[0]
    env.reset(seed=20)
    np.testing.assert_array_equal(env.step(crash)[0], after)
    assert len(np.unique(np.concatenate([observations, after, env.step(crash)[0]]), axis=0)) == 9
    partly = env.reset(seed=[20, None, 22])[0]
    np.testing.assert_array_equal(partly[[0, 2]], observations[[0, 2]])
    assert (partly[1] != observations[1]).any()
    assert (env.reset()[0] != env.reset()[0]).any(axis=1).all()
    with pytest.raises(ValueError, match="seed: found 2 seeds, expected one per environment, 3"):
        env.reset(seed=[1, 2])


def test_another_process_flies_the_same_and_imports_no_viewer() -> None:
    code = f"""
import json, sys, gymnasium
env = gymnasium.make("flytrack_env:{BASE}")
start = env.reset(seed=9)[0].tolist()
viewers = [name for name in ("pygame", "flytrack_env.rendering.views") if name in sys.modules]
print(json.dumps([start, env.step([0.1] * 4)[0].tolist(), viewers]))
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    start, after, viewers = json.loads(result.stdout)
    env = gymnasium.make(BASE)
    np.testing.assert_array_equal(env.reset(seed=9)[0], np.float32(start))
    np.testing.assert_array_equal(env.step([0.1] * 4)[0], np.float32(after))
    assert viewers == []


@pytest.mark.slow
def test_worker_processes_fly_the_same() -> None:
    # Not "fork": JAX has threads, which a forked process lacks.
    workers = AsyncVectorEnv([lambda: gymnasium.make(f"flytrack_env:{BASE}")] * 2, context="spawn")
    try:
        found = fly_vector(workers, seed=9)
    finally:
        workers.close()
    np.testing.assert_array_equal(found, fly_vector(SyncVectorEnv([lambda: gymnasium.make(BASE)] * 2), 9))


def fly_vector(env: Any, seed: int) -> np.ndarray:
    """Return the observations of two flights from a seeded reset."""
    action = np.full((2, 4), 0.1, np.float32)
    return np.stack([env.reset(seed=seed)[0], *(env.step(action)[0] for _ in range(4))])


# --- Wrappers and copies ------------------------------------------------------------------------


def test_episode_statistics_add_up(still: EnvParams) -> None:
    env = RecordEpisodeStatistics(gymnasium.make(BASE, params=still))
    env.reset(seed=0)
    rewards = []
    for _ in range(12):
        *_, info = result = env.step(np.array([0.0, 0.0, 0.0, 0.5]))
        rewards.append(result[1])
    assert info["episode"]["l"] == 12
    np.testing.assert_allclose(info["episode"]["r"], sum(rewards), rtol=1e-5)


def test_vector_episode_statistics_add_up(still: EnvParams) -> None:
    env = RecordVectorStatistics(make_vector(params=still))
    env.reset(seed=0)
    totals, lengths, ends = np.zeros(3), np.zeros(3, int), np.zeros(3, int)
    for index in range(20):
        actions = np.tile([0.0, 0.0, 0.0, 0.5], (3, 1))
        if index == 4:
            actions[1] = CRASH
        _, rewards, terminated, truncated, infos = env.step(actions)
        totals, lengths = totals + rewards, lengths + 1
        done = terminated | truncated
        if done.any():
            np.testing.assert_array_equal(infos["_episode"], done)
            checked = done if COUNTS_EVERY_STEP else done & (ends == 0)
            np.testing.assert_allclose(infos["episode"]["r"][checked], totals[checked], rtol=1e-5)
            np.testing.assert_array_equal(infos["episode"]["l"][checked], lengths[checked])
            totals[done], lengths[done], ends = 0.0, 0, ends + done
    assert ends.tolist() == [1, 2, 1]


@pytest.mark.parametrize("is_vector", [False, True])
def test_copies_fly_on_alike_and_apart(is_vector: bool) -> None:
    env = make_vector() if is_vector else gymnasium.make(BASE).unwrapped
    env.reset(seed=8)
    action = np.full(env.action_space.shape, 0.2, np.float32)
    env.step(action)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    flown = np.stack([*(env.step(action)[0] for _ in range(3)), env.reset()[0]])
    for other in copies:
        again = np.stack([*(other.step(action)[0] for _ in range(3)), other.reset()[0]])
        np.testing.assert_array_equal(again, flown)


def test_constructors_survive_cloudpickle(params: EnvParams) -> None:
    short = params.replace(max_steps_in_episode=1)
    make_env = cloudpickle.loads(cloudpickle.dumps(lambda: gymnasium.make(BASE, params=short)))
    env = make_env()
    env.reset(seed=0)
    assert env.step(np.zeros(4))[3] is True
