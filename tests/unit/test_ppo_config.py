"""Every hyperparameter is a documented field, a flag, and a key of a file."""

import argparse
import dataclasses
import json

import pytest

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.config import (
    ConfigError,
    add_flags,
    config_from_json,
    field_docs,
    settings_of,
)
from baselines.purejaxrl_ppo.training import training_params
from flytrack_env import make

NAMES = [field.name for field in dataclasses.fields(Config)]


def parse(*arguments: str) -> Config:
    parser = argparse.ArgumentParser()
    add_flags(parser)
    return Config(**settings_of(parser.parse_args([*map(str, arguments)])))


def changed(value):
    """Return a value of the same type that is not the default."""
    if isinstance(value, tuple):
        return (*(2 * one for one in value), type(value[0])(3))
    return not value if isinstance(value, bool) else value + type(value)(1)


OTHER = {field.name: changed(field.default) for field in dataclasses.fields(Config)}


def flag_of(name, value):
    flag = f"--{name.replace('_', '-')}"
    if isinstance(value, bool):
        return [flag if value else f"--no-{flag[2:]}"]
    return [flag, *value] if isinstance(value, tuple) else [flag, value]


def toml_of(values):
    return "".join(f"{name} = {json.dumps(value)}\n" for name, value in values.items())


def test_every_field_is_documented():
    docs = field_docs()
    assert list(docs) == NAMES
    assert all(len(text) > 10 for text in docs.values())


def test_no_flags_are_the_defaults():
    assert parse() == Config()


@pytest.mark.parametrize("name", NAMES)
def test_every_field_is_a_flag(name):
    assert parse(*flag_of(name, OTHER[name])) == dataclasses.replace(Config(), **{name: OTHER[name]})


def test_every_field_is_a_key_of_a_file_which_flags_override(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(toml_of(OTHER))
    assert parse("--config", path) == Config(**OTHER)
    assert parse("--config", path, "--num-envs", 7) == Config(**{**OTHER, "num_envs": 7})


def test_whole_numbers_may_be_written_as_powers_of_ten(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text("total_timesteps = 2e7\n")
    assert (
        parse("--config", path).total_timesteps
        == parse("--total-timesteps", "2e7").total_timesteps
        == 20_000_000
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("learning_rat = 1.0", r"run\.toml: learning_rat: unknown; expected one of .*learning_rate"),
        ("learning_rate = 'high'", r"run\.toml: learning_rate: found 'high', expected a finite number"),
        ("learning_rate = inf", r"run\.toml: learning_rate: found infinity, expected a finite number"),
        ("num_envs = 1.5", r"run\.toml: num_envs: found 1\.5, expected a whole number"),
        ("num_envs = true", r"run\.toml: num_envs: found True, expected a whole number"),
        ("num_envs = nan", r"run\.toml: num_envs: found nan, expected a whole number"),
        ("affine_shuffle = 1", r"run\.toml: affine_shuffle: found 1, expected true or false"),
        ("hidden_sizes = 64", r"run\.toml: hidden_sizes: found 64, expected a list"),
        ("hidden_sizes = ['a']", r"run\.toml: hidden_sizes: found 'a', expected a whole number"),
        ("learning_rate = ", r"run\.toml: not a TOML file"),
        (None, r"run\.toml: cannot be read"),
        (
            "num_envs = 0x" + "f" * 5000,
            r"run\.toml: num_envs: found a number of thousands of digits, expected",
        ),
        (
            "learning_rate = 1" + "0" * 400,
            r"run\.toml: learning_rate: found 1000.*, expected a finite number",
        ),
        ("num_envs = " + "[" * 9000, r"run\.toml: not a TOML file"),
        ("a" + ".a" * 5000 + " = 1", r"run\.toml: not a TOML file: line 1: found 5000 dots"),
    ],
)
def test_files_that_cannot_be_used_are_refused(tmp_path, content, message):
    path = tmp_path / "run.toml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ConfigError, match=message):
        parse("--config", path)


def test_files_from_before_the_margin_were_trained_without():
    values = {name: value for name, value in dataclasses.asdict(Config()).items() if name != "gate_margin"}
    assert config_from_json(values).gate_margin == 0.0 != Config().gate_margin


def test_a_drone_is_thicker_in_training_and_not_in_the_race():
    env = make("FlyTrack-v0")
    params = training_params(env, Config(gate_margin=0.25, episode_steps=77))
    assert params.drone_radius == pytest.approx(env.default_params.drone_radius + 0.25)
    assert params.max_steps_in_episode == 77
    plain = training_params(env, Config(gate_margin=0.0))
    assert plain.drone_radius == env.default_params.drone_radius == 0.15


def test_a_margin_that_leaves_no_opening_is_refused():
    with pytest.raises(ValueError, match=r"gate_margin: found 0.6: drone_radius: found 0.75"):
        training_params(make("FlyTrack-v0"), Config(gate_margin=0.6))


def test_configuration_comes_back_from_json():
    config = Config(**OTHER)
    assert config_from_json(json.loads(json.dumps(dataclasses.asdict(config)))) == config
    with pytest.raises(ConfigError, match="config: from_the_future: unknown to this version"):
        config_from_json({"from_the_future": 1})
    with pytest.raises(ConfigError, match=r"config: gamma: found 1000.*, expected a finite number"):
        config_from_json({"gamma": 10**400})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_envs", 0),
        ("gamma", 1.1),
        ("learning_rate", 0.0),
        ("clip_eps", -0.1),
        ("entropy_coef", -1.0),
        ("min_std", float("nan")),
        ("hidden_sizes", ()),
        ("hidden_sizes", (8, 0)),
    ],
)
def test_values_out_of_range_are_refused(name, value):
    with pytest.raises(ConfigError, match=f"{name}: found .*, expected"):
        dataclasses.replace(Config(), **{name: value}).check()
