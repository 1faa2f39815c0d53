"""Hyperparameters: from files and checkpoints, and what is refused."""

import dataclasses
import json

import pytest

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.config import ConfigError, read_settings, settings_in_file
from baselines.purejaxrl_ppo.training import training_params
from flytrack_env import make
from tests.support.tables import table


def changed(value):
    """Return a value of the same type that is not the default."""
    if isinstance(value, tuple):
        return (*(2 * one for one in value), type(value[0])(3))
    return not value if isinstance(value, bool) else value + type(value)(1)


OTHER = {field.name: changed(field.default) for field in dataclasses.fields(Config)}


def test_every_field_comes_back_from_toml_and_json(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text("".join(f"{name} = {json.dumps(value)}\n" for name, value in OTHER.items()))
    assert Config(**settings_in_file(path)) == Config(**OTHER)
    values = json.loads(json.dumps(dataclasses.asdict(Config(**OTHER))))
    assert Config(**read_settings("config", values)) == Config(**OTHER)


@pytest.mark.parametrize(("content", "message"), table("settings")["refused"])
def test_settings_that_cannot_be_trained_with_are_refused(tmp_path, content, message):
    path = tmp_path / "run.toml"
    path.write_text(content)
    with pytest.raises(ConfigError, match=message):
        Config(**settings_in_file(path)).check()


def test_a_drone_is_thicker_in_training_and_not_in_the_race():
    env = make("FlyTrack-v0")
    params = training_params(env, Config(gate_margin=0.25, episode_steps=77))
    assert params.drone_radius == pytest.approx(env.default_params.drone_radius + 0.25)
    assert params.max_steps_in_episode == 77
    with pytest.raises(ValueError, match=r"gate_margin: found 0.6: drone_radius: found 0.75"):
        training_params(env, Config(gate_margin=0.6))
