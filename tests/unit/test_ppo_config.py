"""Hyperparameters: from files and checkpoints, and what is refused."""

import dataclasses
import json

import numpy as np
import pytest

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.config import ConfigError, read_config, read_config_file
from baselines.purejaxrl_ppo.training import training_params
from flytrack_env import make
from tests.support.tables import table


def changed(value):
    """Return a value of the same type that is valid and not the default."""
    if isinstance(value, tuple):
        kind = type(value[0]) if value else int
        return (*(2 * size for size in value), kind(3))
    if isinstance(value, float):
        return value / 2 if value else 0.5
    return not value if isinstance(value, bool) else value + 1


OTHER = {field.name: changed(field.default) for field in dataclasses.fields(Config)}


def test_every_field_comes_back_from_toml_and_json(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text("".join(f"{name} = {json.dumps(value)}\n" for name, value in OTHER.items()))
    assert read_config_file(path) == Config(**OTHER)
    assert read_config("config", json.loads(json.dumps(Config(**OTHER).as_json()))) == Config(
        **OTHER
    )
    path.write_text("seed = 1")
    with pytest.raises(
        ConfigError, match=r"run\.toml: seed: unknown; expected one of total_timesteps, "
    ):
        read_config_file(path)


@pytest.mark.parametrize(("content", "message"), table("settings")["refused"])
def test_settings_that_cannot_be_trained_with_are_refused(tmp_path, content, message):
    path = tmp_path / "run.toml"
    path.write_text(content)
    with pytest.raises(ConfigError, match=message):
        read_config_file(path).check()


def test_numbers_of_numpy_are_numbers():
    config = Config(
        num_envs=np.int64(512), learning_rate=np.float32(0.5), hidden_sizes=np.array([8, 8])
    ).check()
    assert config == Config(num_envs=512, learning_rate=0.5, hidden_sizes=(8, 8))
    assert type(config.num_envs) is int and json.dumps(config.as_json())


def test_a_drone_is_thicker_in_training_and_not_in_the_race():
    env = make("FlyTrack-v0")
    params = training_params(env, Config(gate_margin=0.25, episode_steps=77))
    assert params.drone_radius == pytest.approx(env.default_params.drone_radius + 0.25)
    assert params.max_steps_in_episode == 77
    with pytest.raises(ValueError, match=r"gate_margin: found 0.6: drone_radius: found 0.75"):
        training_params(env, Config(gate_margin=0.6))
