"""Options of a reset and arguments of an environment in Gymnasium."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from flytrack_env.env import EnvParams
from flytrack_env.tracks import load_track
from tests.support.gymnasium_envs import BASE, make_vector

# --- Options of reset ---------------------------------------------------------------------------

POSE = {"position": (15.0, 2.5, 1.2), "yaw_deg": 180.0, "velocity": [-9.0, 0.0, 1.0], "battery_v": 22.5}


@pytest.mark.parametrize("is_vector", [False, True])
def test_options_set_the_start_of_one_episode(is_vector: bool) -> None:
    env = make_vector() if is_vector else gymnasium.make(BASE)
    observation = np.atleast_2d(env.reset(seed=0, options=POSE)[0])
    # Gate 0 at (12.5, 2, 1.35) is flown towards -x.
    np.testing.assert_allclose(
        observation[:, :3], [[-2.5 / 3, -0.5 / 3, -0.15 / 3]] * len(observation), atol=1e-5
    )
    np.testing.assert_allclose(observation[:, 3:6], [[9 / 5, 0.0, 1 / 5]] * len(observation), atol=1e-5)
    np.testing.assert_allclose(observation[:, 6:15], [np.eye(3).ravel()] * len(observation), atol=1e-5)
    np.testing.assert_allclose(observation[:, 15:18], 0.0, atol=1e-6)
    np.testing.assert_allclose(
        observation[:, 18:23], [[0.0, 0.0, 0.0, -1.0, -0.5]] * len(observation), atol=1e-5
    )
    following = np.atleast_2d(env.reset()[0])
    assert (abs(following[:, 22] + 0.5) > 1e-3).all()


def test_battery_alone_leaves_the_drawn_start_as_it_is() -> None:
    for env, size in ((gymnasium.make(BASE), ()), (make_vector(), (3,))):
        drawn = env.reset(seed=4)[0]
        lowered = env.reset(seed=4, options={"battery_v": 22.25})[0]
        np.testing.assert_allclose(lowered[..., 22], np.full(size, -0.75), atol=1e-5)
        np.testing.assert_allclose(np.delete(lowered, 22, -1), np.delete(drawn, 22, -1), atol=1e-5)


def test_gate_and_quaternion_options() -> None:
    env = gymnasium.make(BASE)
    gate = load_track("flytrack").gates[3]
    options = {"gate_index": 3, "position": gate.position, "quaternion": (0.0, 0.0, 0.0, 1.0)}
    observation, _ = env.reset(options=options)
    np.testing.assert_allclose(observation[:3], 0.0, atol=1e-6)
    # Gate 3 is flown towards +y; the drone faces -x, which is to the left.
    np.testing.assert_allclose(observation[6:15], [0, -1, 0, 1, 0, 0, 0, 0, 1], atol=1e-5)
    start = env.reset(options={"gate_index": 0})[0]
    np.testing.assert_allclose(start[:3], [-6.1 / 3, 0.0, -1.25 / 3], atol=1e-5)
    np.testing.assert_allclose(start[3:6], 0.0, atol=1e-6)
    assert start[22] == 1.0


@pytest.mark.parametrize("is_vector", [False, True])
def test_a_track_stays_until_another_is_named(
    is_vector: bool, row_track: Any, write_toml: Any, tmp_path: Path
) -> None:
    path = tmp_path / "row.toml"
    num_gates = 8 if is_vector else 3  # another number of gates is compiled anew
    gates = row_track([10.0 * index for index in range(num_gates)])
    path.write_text(write_toml(gates), encoding="utf-8")
    env = make_vector() if is_vector else gymnasium.make(BASE)
    at_start = {"gate_index": 0}
    home = np.atleast_2d(env.reset(options=at_start)[0])
    for options in ({"track": path} | at_start, at_start):
        observation = np.atleast_2d(env.reset(options=options)[0])
        np.testing.assert_allclose(observation[:, :3], [[-5 / 3, 0.0, 0.0]] * len(observation), atol=1e-5)
    action = np.zeros((3, 4)) if is_vector else np.zeros(4)
    distance = env.step(action)[4]["gate_distance_m"]
    np.testing.assert_allclose(distance, 5.0, atol=0.1)
    back = np.atleast_2d(env.reset(options={"track": "flytrack"} | at_start)[0])
    np.testing.assert_array_equal(back, home)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"speed": 3.0}, r"options: found 'speed', expected one of position, .*track"),
        ([1], "options: found list, expected a dict"),
        ({"position": (1.0, 2.0)}, r"options\['position'\]: found \(1.0, 2.0\), expected 3 finite numbers"),
        ({"position": (1.0, 2.0, np.nan)}, "position.*expected 3 finite numbers"),
        ({"position": (1.0, (2.0,), 3.0)}, "position.*expected 3 finite numbers"),
        ({"position": "start"}, "position.*found 'start', expected 3 finite numbers"),
        ({"position": (100.0, 2.0, 1.0)}, "position.*expected within the bounds"),
        ({"position": (10.0, 2.0, -0.1)}, "position.*expected within the bounds"),
        ({"quaternion": (1.0, 1.0, 0.0, 0.0)}, "quaternion.*expected norm 1"),
        ({"quaternion": (1.0, 0.0, 0.0, 0.0), "yaw_deg": 3.0}, "expected one of them"),
        ({"yaw_deg": True}, "yaw_deg.*found True, expected a finite number"),
        ({"yaw_deg": [3.0]}, "yaw_deg.*expected a finite number"),
        ({"velocity": (1e39, 0.0, 0.0)}, "velocity.*expected 3 finite numbers"),
        ({"velocity": (0.0, -1001.0, 0.0)}, "velocity.*expected at most 1000 m/s along every axis"),
        ({"battery_v": 21.9}, "battery_v.*found 21.9, expected above 22 and up to 24 V"),
        ({"battery_v": 24.1}, "battery_v.*expected above 22 and up to 24 V"),
        ({"gate_index": 8}, "gate_index.*found 8, expected an integer from 0 to 7"),
        ({"gate_index": 1.0}, "gate_index.*expected an integer from 0 to 7"),
        ({"gate_index": True}, "gate_index.*expected an integer from 0 to 7"),
        ({"track": "nowhere"}, "track: found 'nowhere', expected one of"),
        ({"track": 3}, r"options\['track'\]: found int, expected a name, a path or a Track"),
    ],
)
def test_bad_options_are_refused_and_change_nothing(options: Any, message: str) -> None:
    env, vector = gymnasium.make(BASE), make_vector()
    for each in (env, vector):
        each.reset(seed=1)
        with pytest.raises(ValueError, match=message):
            each.reset(seed=2, options=options)
    np.testing.assert_array_equal(env.reset()[0], following_of_seed(env, 1))


def following_of_seed(env: Any, seed: int) -> np.ndarray:
    """Return the second start after a seeded reset."""
    env.reset(seed=seed)
    return env.reset()[0]


# --- Arguments ----------------------------------------------------------------------------------


def test_arguments_reach_the_environment(params: EnvParams, row_track: Any) -> None:
    track = row_track([0.0, 10.0])
    env = gymnasium.make(BASE, track=track, missed_gate="fly_on", params=None)
    observation, _ = env.reset(options={"gate_index": 1})
    np.testing.assert_allclose(observation[0], -5.0, atol=1e-5)  # 15 m before it
    # Past the plane of a gate, outside its frame.
    beside = {"position": (-0.05, 4.0, 2.0), "velocity": (10.0, 0.0, 0.0)}
    for missed_gate, is_end in (("fly_on", False), ("terminate", True)):
        env = gymnasium.make(BASE, track=track, missed_gate=missed_gate)
        env.reset(options=beside)
        assert env.step(np.zeros(4))[2] is is_end
    with pytest.raises(ValueError, match="missed_gate"):
        gymnasium.make(BASE, missed_gate="sometimes")
    with pytest.raises(TypeError, match="params: found dict, expected EnvParams"):
        gymnasium.make(BASE, params={})
    with pytest.raises(ValueError, match="drone_radius"):
        make_vector(params=params.replace(drone_radius=1.0))
    with pytest.raises(ValueError, match=r"params\.model\.m: found shape \(3,\), expected \(\)"):
        gymnasium.make(BASE, params=params.replace(model=params.model._replace(m=np.ones(3))))


def test_track_files_are_read_again(row_track: Any, write_toml: Any, tmp_path: Path) -> None:
    path = tmp_path / "track.toml"
    for far in (10.0, 30.0):
        path.write_text(write_toml(row_track([0.0, far])), encoding="utf-8")
        observation, _ = gymnasium.make(BASE, track=str(path)).reset(options={"gate_index": 1})
        np.testing.assert_allclose(observation[0], -(far + 5.0) / 3.0, atol=1e-4)


def test_wrong_use_is_refused() -> None:
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
