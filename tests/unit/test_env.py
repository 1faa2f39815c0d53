"""The environment as a gymnax client sees it: episodes, flags, observations."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_env.env import EnvParams, FlyTrack
from flytrack_env.model_file import ModelFileError
from flytrack_env.observations import OBSERVATION, OBSERVATION_SIZE
from flytrack_env.state import Action, pack
from flytrack_env.tracks import TrackError, load_track
from tests.support.trees import assert_close, stack

CAUSES = ("crash", "ground", "out_of_bounds", "missed_gate", "battery_empty")
INFO_KEYS = {
    *CAUSES,
    "gates_passed",
    "laps",
    "lap_completed",
    "lap_time_s",
    "gate_distance_m",
    "terminated",
    "truncated",
    "final_observation",
}


@pytest.fixture(scope="module")
def flight(env: FlyTrack, params: EnvParams, reset_many: Any, rollout: Any) -> Any:
    """States and outputs of 256 random flights of 120 steps, extreme sticks among them."""
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (120, 256, 4)).astype(np.float32)
    actions[:, :64] = np.sign(actions[0, :64])
    actions[:, 64:96] = np.sign(actions[:, 64:96]) * np.float32(np.inf)
    actions[:, 96:112] *= 1e30
    _, states = reset_many(jax.random.split(jax.random.key(1), 256), params)
    return rollout(env, jax.random.key(2), states, jnp.asarray(actions), params)


# --- The protocol -------------------------------------------------------------------------------


def test_step_returns_six_values_of_the_stated_types(
    env: FlyTrack, params: EnvParams, reset_many: Any, step_all: Any
) -> None:
    keys = jax.random.split(jax.random.key(0), 3)
    observation, states = reset_many(keys, params)
    assert observation.shape == (3, OBSERVATION_SIZE) and observation.dtype == jnp.float32
    outputs = step_all(keys, states, jnp.zeros((3, 4)), params)
    assert len(outputs) == 6
    observation, next_states, reward, terminated, truncated, info = outputs
    assert observation.shape == (3, OBSERVATION_SIZE) and observation.dtype == jnp.float32
    assert reward.shape == (3,) and reward.dtype == jnp.float32
    assert terminated.dtype == truncated.dtype == jnp.bool_
    assert set(info) == INFO_KEYS
    assert info["final_observation"].shape == observation.shape
    for before, after in zip(jax.tree.leaves(states), jax.tree.leaves(next_states), strict=True):
        assert (before.shape, before.dtype) == (after.shape, after.dtype)


def test_default_parameters_are_used_when_none_are_given(env: FlyTrack, params: EnvParams) -> None:
    key = jax.random.key(3)
    observation, state = env.reset(key)
    assert_close((observation, state), env.reset(key, params), 1e-6)
    assert_close(env.step(key, state, jnp.zeros(4)), env.step(key, state, jnp.zeros(4), params))


def test_spaces_are_finite_and_contain_every_observation(
    env: FlyTrack, params: EnvParams, flight: Any
) -> None:
    space, actions = env.observation_space(params), env.action_space(params)
    assert space.shape == (OBSERVATION_SIZE,) and actions.shape == (4,)
    assert np.isfinite(space.low).all() and np.isfinite(space.high).all()
    assert env.num_actions == 4
    assert actions.contains(actions.sample(jax.random.key(0)))
    observation, *_, info = flight[1]
    for array in (observation, info["final_observation"]):
        assert np.isfinite(array).all()
        assert jax.jit(jax.vmap(space.contains))(array.reshape(-1, OBSERVATION_SIZE)).all()


def test_flight_ends_in_many_ways_and_stays_finite(flight: Any) -> None:
    _, (_, states, reward, terminated, _, info) = flight
    assert int(terminated.sum()) > 50
    assert sum(bool(info[cause].any()) for cause in CAUSES) >= 3
    assert int(info["gates_passed"].max()) >= 1
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((states, reward)))


def test_auto_reset_leaves_nothing_behind_in_a_flight(flight: Any) -> None:
    _, (observation, states, _, terminated, truncated, info) = flight
    done = np.asarray(terminated | truncated)
    race = states.race
    for leaf in (states.time, race.gates_passed, race.laps, race.lap_start_s, race.lap_time_s):
        assert not np.asarray(leaf)[done].any()
    np.testing.assert_array_equal(
        np.asarray(observation)[~done], np.asarray(info["final_observation"])[~done]
    )
    assert (np.asarray(observation)[done] != np.asarray(info["final_observation"])[done]).any(1).all()


def test_info_belongs_to_the_step_not_to_the_reset(env: FlyTrack, params: EnvParams, flight: Any) -> None:
    before, (_, states, _, terminated, truncated, info) = flight
    done = np.asarray(terminated | truncated)
    causes = np.stack([np.asarray(info[cause]) for cause in CAUSES])
    np.testing.assert_array_equal(causes.any(axis=0), terminated)
    np.testing.assert_array_equal(info["terminated"], terminated)
    np.testing.assert_array_equal(info["truncated"], truncated)
    # An ended episode still shows its own count.
    assert (np.asarray(info["gates_passed"]) >= np.asarray(before.race.gates_passed)).all()
    assert (np.asarray(info["gates_passed"])[done] > 0).any()
    centre = np.stack([np.asarray(x)[~done] for x in states.race.gate.centre])
    position = np.stack([np.asarray(x)[~done] for x in env.drone(states).pos_w])
    distance = np.linalg.norm(position - centre, axis=0)
    np.testing.assert_allclose(np.asarray(info["gate_distance_m"])[~done], distance, atol=1e-4)


def test_same_inputs_give_the_same_outputs(
    env: FlyTrack, params: EnvParams, reset_many: Any, step_all: Any
) -> None:
    keys = jax.random.split(jax.random.key(4), 3)
    first, again = reset_many(keys, params), reset_many(keys, params)
    assert_close(first, again, 0.0)
    actions = jnp.full((3, 4), 0.3)
    assert_close(step_all(keys, first[1], actions, params), step_all(keys, again[1], actions, params), 0.0)


def test_without_jit_the_step_is_the_same(env: FlyTrack, params: EnvParams) -> None:
    key, action = jax.random.key(5), jnp.array([0.2, -0.4, 0.6, 0.1])
    state = env.reset(key, params)[1]
    jitted = env.step(key, state, action, params)
    with jax.disable_jit():
        assert_close(env.step(key, state, action, params), jitted, 1e-5)


def test_parameters_can_differ_between_environments(
    env: FlyTrack, params: EnvParams, reset_many: Any
) -> None:
    _, states = reset_many(jax.random.split(jax.random.key(6), 3), params)
    masses = jnp.array([0.5, 1.0, 2.0])
    batched = params.replace(model=params.model._replace(m=masses))
    axes = jax.tree.map(lambda _: None, params).replace(
        model=jax.tree.map(lambda _: None, params.model)._replace(m=0)
    )
    same = jax.tree.map(lambda leaf: jnp.stack([leaf[0]] * 3), states)
    step = jax.jit(jax.vmap(env.step_env, in_axes=(None, 0, None, axes)))
    after = env.drone(step(None, same, jnp.zeros(4), batched)[1])
    weightless = np.stack([np.asarray(after.acc_w.x), np.asarray(after.acc_w.y)])
    np.testing.assert_allclose(weightless * np.asarray(masses), weightless[:, 1:2].repeat(3, 1), rtol=1e-4)


# --- Actions ------------------------------------------------------------------------------------


def test_actions_beyond_the_range_are_clipped(params: EnvParams, reset_many: Any, step_all: Any) -> None:
    keys = jax.random.split(jax.random.key(11), 1)
    _, state = reset_many(keys, params)
    corners = np.array([[1, -1, 1, 1], [-1, 1, -1, -1]], np.float32)
    pairs = [(c, c * f) for c in corners for f in (1.001, 7.0, 1e30, np.float32(np.inf))]
    for corner, beyond in pairs:
        expected = step_all(keys, state, jnp.asarray(corner)[None], params)
        assert_close(step_all(keys, state, jnp.asarray(beyond)[None], params), expected, 0.0)


def test_integer_actions_are_as_good_as_real_ones(env: FlyTrack, params: EnvParams, make_drone: Any) -> None:
    state = env.begin(make_drone((15.0, 2.0, 1.35)), 0, params)
    key = jax.random.key(0)
    real = env.step(key, state, jnp.array([1.0, 0.0, -1.0, 1.0]), params)
    assert_close(env.step(key, state, jnp.array([1, 0, -1, 1]), params), real, 1e-6)


@pytest.mark.parametrize("shape", [(), (3,), (5,), (4, 1), (1, 4)])
def test_actions_of_another_shape_are_refused(
    shape: tuple[int, ...], env: FlyTrack, params: EnvParams, make_drone: Any
) -> None:
    state = env.begin(make_drone((15.0, 2.0, 1.35)), 0, params)
    with pytest.raises(ValueError, match=r"action: found shape .*expected \(4,\)"):
        env.step(jax.random.key(0), state, jnp.zeros(shape), params)
    with pytest.raises(ValueError, match=r"action: found shape .*expected \(4,\)"):
        env.step_env(None, state, jnp.zeros(shape), params)


@pytest.mark.parametrize("shape", [(2, 3), (3, 4), (4,)])
def test_batches_of_actions_of_another_shape_are_refused(
    shape: tuple[int, ...], env: FlyTrack, params: EnvParams, make_drone: Any
) -> None:
    states = stack([env.begin(make_drone((15.0, 2.0, 1.35)), 0, params)] * 2)
    with pytest.raises(ValueError):
        env.step_batch(jax.random.key(0), states, jnp.zeros(shape), params)


# --- Construction -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"track": "monza"}, TrackError, "track: found 'monza', expected one of .*flytrack"),
        ({"track": Path("no/such.toml")}, TrackError, "no/such.toml: cannot be read"),
        ({"model": "no/such.json"}, ModelFileError, "no/such.json: cannot be read"),
        ({"missed_gate": "ignore"}, ValueError, "missed_gate: found 'ignore', expected one of"),
        ({"missed_gate": True}, ValueError, "missed_gate: found True, expected one of"),
        (
            {"reward": {"speed": 1.0}},
            ValueError,
            "reward: found 'speed', expected one of progress",
        ),
        ({"reward": {"progress": "much"}}, ValueError, r"reward\.progress: found 'much', expected a finite"),
        ({"reward": {"progress": float("nan")}}, ValueError, r"reward\.progress: found nan"),
    ],
)
def test_wrong_arguments_say_what_was_expected(
    arguments: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        FlyTrack(**arguments)


def test_model_of_an_environment_comes_from_its_argument(params: EnvParams) -> None:
    model = params.model._replace(m=1.7)
    assert FlyTrack(model=model).default_params.model.m == 1.7


# --- Observation --------------------------------------------------------------------------------


def expected_observation(x: np.ndarray, gate_index: int) -> np.ndarray:
    """Return the observation of a state (21,) before a gate, from the track's data, in NumPy."""
    track = load_track("flytrack")
    gates = [track.gates[(gate_index + i) % len(track.gates)] for i in (0, 1)]
    axes = [Rotation.from_quat(g.quaternion, scalar_first=True).as_matrix() for g in gates]
    forward, next_forward = (g.direction * a[:, 1] for g, a in zip(gates, axes, strict=True))
    to_gate = np.stack([forward, np.cross(axes[0][:, 2], forward), axes[0][:, 2]])
    body = Rotation.from_quat(x[9:13], scalar_first=True).as_matrix()
    centre, next_centre = (np.array(g.position) for g in gates)
    quantities = (
        to_gate @ (x[0:3] - centre),
        to_gate @ x[3:6],
        (to_gate @ body).ravel(),
        x[13:16],
        x[16:20],
        [x[20] - 23.0],
        to_gate @ (next_centre - centre),
        to_gate @ next_forward,
    )
    rows = zip(OBSERVATION, quantities, strict=True)
    return np.concatenate([np.clip(np.array(q) / e.scale, -e.limit, e.limit) for e, q in rows])


def test_observation_index_by_index(env: FlyTrack, params: EnvParams, flight: Any) -> None:
    assert [entry.size for entry in OBSERVATION] == [3, 3, 9, 3, 4, 1, 3, 3]
    states, outputs = flight
    observed = outputs[0][:-1, ::5].reshape(-1, OBSERVATION_SIZE)
    seen = jax.tree.map(lambda leaf: leaf[1:, ::5].ravel(), states)
    x = np.asarray(jax.vmap(pack)(seen.plant), float)
    gate_indices = np.asarray(seen.race.gate_index)
    assert set(gate_indices) == set(range(8))
    rows = range(0, len(x), 7)
    expected = np.stack([expected_observation(x[i], gate_indices[i]) for i in rows])
    np.testing.assert_allclose(observed[np.array(rows)], expected, atol=2e-5)


def test_observation_is_clipped_to_its_range(env: FlyTrack, params: EnvParams, make_drone: Any) -> None:
    drone = make_drone((1e6, -1e6, 0.0), (1e5, 0.0, 0.0), applied=Action(2.0, -2.0, 0.0, 0.0), battery_v=30.0)
    observation = env.observe(None, env.begin(drone, 0, params), None, params)
    assert env.observation_space(params).contains(observation)
    limits = np.asarray(env.observation_space(params).high)
    rows, signs = np.array([0, 1, 3, 18, 19, 22]), np.array([-1, 1, -1, 1, -1, 1])
    np.testing.assert_allclose(observation[rows], signs * limits[rows])
