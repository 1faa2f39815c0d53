"""Laps and their times, with a plant on rails through every gate."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_env.env import FlyTrack
from flytrack_env.tracks import load_track
from tests.support.trees import assert_close, stack

SPEED = 20.0


@pytest.fixture(scope="module")
def rails(make_railway: Any) -> tuple[FlyTrack, Any]:
    """The shipped course with a plant on rails straight through every gate, and the rails."""
    corners = []
    for gate in load_track("flytrack").gates:
        axes = Rotation.from_quat(gate.quaternion, scalar_first=True).as_matrix()
        forward = gate.direction * axes[:, 1]
        corners += [gate.position - forward, gate.position + forward]
    railway = make_railway(np.array(corners), SPEED)
    return FlyTrack(plant=railway, missed_gate="fly_on"), railway


NUM_LAPS = 5
FIRST_GATES = (0, 3, 7)


@pytest.fixture(scope="module")
def laps(rails: tuple[FlyTrack, Any], rollout: Any, make_drone: Any) -> Any:
    """Outputs of a little over five laps from before each of the first gates."""
    env, railway = rails
    params = env.default_params.replace(max_steps_in_episode=100_000)
    states = stack([env.begin(make_drone(railway.corners[2 * gate]), gate, params) for gate in FIRST_GATES])
    num_steps = int((NUM_LAPS + 0.1) * railway.arcs[-1] / SPEED / 0.01)
    actions = jnp.zeros((num_steps, len(FIRST_GATES), 4))
    return rollout(env, jax.random.key(0), states, actions, params)[1]


def test_laps_are_counted_from_wherever_the_episode_began(laps: Any) -> None:
    _, states, _, terminated, truncated, info = laps
    assert not (terminated | truncated).any()
    np.testing.assert_array_equal(info["laps"][-1], NUM_LAPS)
    np.testing.assert_array_equal(info["lap_completed"].sum(axis=0), NUM_LAPS)
    gates = np.asarray(info["gates_passed"])
    np.testing.assert_array_equal(gates // 8, info["laps"])
    assert (np.diff(gates, axis=0) >= 0).all() and (np.diff(gates, axis=0) <= 1).all()
    np.testing.assert_array_equal(states.race.gate_index, (gates + np.array(FIRST_GATES)) % 8)


def test_lap_times_are_interpolated_at_the_crossing(laps: Any, rails: tuple[FlyTrack, Any]) -> None:
    info, (_, railway) = laps[5], rails
    length = railway.arcs[-1]
    done = np.asarray(info["lap_completed"])
    times = np.asarray(info["lap_time_s"])
    for column, gate in enumerate(FIRST_GATES):
        lap_times = times[done[:, column], column]
        # The first lap ends a metre behind the corner before the last of the eight gates.
        entries = railway.arcs[:-1:2]
        first = (entries[gate - 1] - entries[gate]) % length + 1.0
        np.testing.assert_allclose(lap_times[0], first / SPEED, atol=1e-3)
        np.testing.assert_allclose(lap_times[1:], length / SPEED, atol=1e-3)
        assert not times[: np.argmax(done[:, column]), column].any()


def test_steps_with_two_seeds_of_the_same_rails_agree(rails: tuple[FlyTrack, Any], make_drone: Any) -> None:
    env, railway = rails
    state = env.begin(make_drone(railway.corners[0]), 0, env.default_params)
    outputs = [env.step(jax.random.key(i), state, jnp.zeros(4)) for i in range(2)]
    assert_close(outputs[0], outputs[1], 0.0)
