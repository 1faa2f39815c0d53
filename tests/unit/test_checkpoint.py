"""Checkpoints come back as they were written, or are refused with the reason."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy

from baselines.purejaxrl_ppo import CheckpointError, Config, load_checkpoint, make_network
from baselines.purejaxrl_ppo.checkpoint import (
    FORMAT,
    as_named_arrays,
    check_same_run,
    checksum,
    describe_run,
    observation_layout,
    save_checkpoint,
)
from flytrack_env import FlyTrack, make
from flytrack_env.model_file import model_as_json
from flytrack_env.observations import OBSERVATION_SIZE
from tests.support.tables import table

CONFIG = Config(hidden_sizes=(8,))
DESCRIPTION = {
    "env_id": "FlyTrack-v0",
    "track": "flytrack",
    "missed_gate": "terminate",
    "observation_size": OBSERVATION_SIZE,
}
TRAINING = {
    "key": np.arange(2, dtype=np.uint32),
    "flags": np.array([True, False]),
    "scalar": np.float32(3.0),
}


def initial_params(size=OBSERVATION_SIZE):
    return make_network(CONFIG).init(jax.random.key(0), jnp.zeros((1, size)))


@pytest.fixture(scope="module")
def params():
    return initial_params()


@pytest.fixture
def path(tmp_path, params):
    save_checkpoint(tmp_path / "a.safetensors", params, CONFIG, DESCRIPTION, TRAINING)
    return tmp_path / "a.safetensors"


def test_round_trip(path, params):
    checkpoint = load_checkpoint(path)
    jax.tree.map(np.testing.assert_array_equal, checkpoint.params, params)
    assert checkpoint.config == CONFIG
    assert (checkpoint.env_id, checkpoint.track) == ("FlyTrack-v0", "flytrack")
    for name, array in TRAINING.items():
        np.testing.assert_array_equal(checkpoint.training[name], array, strict=True)
    checkpoint.check_fits(FlyTrack())


def test_a_checkpoint_of_64_bits_loads_in_32(tmp_path):
    with jax.enable_x64(True):
        params = initial_params()
        save_checkpoint(tmp_path / "a.safetensors", params, CONFIG, DESCRIPTION, TRAINING)
    loaded = load_checkpoint(tmp_path / "a.safetensors").params
    jax.tree.map(np.testing.assert_allclose, loaded, params)


def test_observations_that_do_not_fit_are_refused(tmp_path, params):
    path, env = tmp_path / "b.safetensors", FlyTrack()
    layout = observation_layout(env)
    layout["row 1 (velocity)"]["scale"] = 4.0
    save_checkpoint(path, params, CONFIG, {**DESCRIPTION, "observation": layout})
    with pytest.raises(
        CheckpointError, match=r"row 1 \(velocity\)\.scale: found 4\.0, expected 5\.0$"
    ):
        load_checkpoint(path).check_fits(env)
    save_checkpoint(path, initial_params(5), CONFIG, {**DESCRIPTION, "observation_size": 5})
    with pytest.raises(CheckpointError, match=f"size 5 .*{OBSERVATION_SIZE}"):
        load_checkpoint(path).check_fits(env)


def test_a_run_of_an_older_version_continues(tmp_path, params):
    """Its file calls the Euler step by the old name."""
    path = tmp_path / "a.safetensors"
    now = describe_run(FlyTrack(), "FlyTrack-v0", "flytrack", CONFIG, 0)
    old = {**now, "model": {**now["model"], "motion": "handout"}}
    save_checkpoint(path, params, CONFIG, old, TRAINING)
    check_same_run(load_checkpoint(path), now)
    other = {**now, "model": {**now["model"], "motion": "continuous"}}
    with pytest.raises(CheckpointError, match=r"model\.motion: found 'euler'"):
        check_same_run(load_checkpoint(path), other)


def test_policies_of_other_commands_are_refused(tmp_path, params):
    model = model_as_json(make("FlyTrackMotors-v0").default_params.model)
    description = {**DESCRIPTION, "env_id": "FlyTrackMotors-v0", "model": model}
    save_checkpoint(tmp_path / "d.safetensors", params, CONFIG, description)
    checkpoint = load_checkpoint(tmp_path / "d.safetensors")
    checkpoint.check_fits(make("FlyTrackMotors-v0"))
    with pytest.raises(
        CheckpointError, match=r"commands motors .*, expected one that commands sticks"
    ):
        checkpoint.check_fits(FlyTrack())


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (
            (2**40).to_bytes(8, "little") + b"{}",
            "found a header of 1099511627776 bytes, expected at most",
        ),
        (safetensors.numpy.save({"a": np.zeros(3)}), "not a checkpoint, or damaged"),
        (
            safetensors.numpy.save({}, {"meta": "{}", "sha256": checksum("{}", {})}),
            "format: missing, expected a text",
        ),
    ],
)
def test_what_is_not_a_checkpoint_is_refused(tmp_path, content, reason):
    path = tmp_path / "c.safetensors"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=rf"c\.safetensors: .*{reason}"):
        load_checkpoint(path)


def test_every_flipped_bit_is_noticed(path):
    whole = path.read_bytes()
    for index in np.random.default_rng(0).integers(0, len(whole), 50):
        damaged = bytearray(whole)
        damaged[index] ^= 1 << int(index % 8)
        path.write_bytes(bytes(damaged))
        with pytest.raises(CheckpointError, match=r"a\.safetensors"):
            load_checkpoint(path)


@pytest.mark.parametrize(("name", "value", "reason"), table("checkpoints")["refused"])
def test_descriptions_that_cannot_be_used_are_refused(path, params, name, value, reason):
    arrays = {f"policy.{key}": array for key, array in as_named_arrays(params).items()}
    if name == "factor":
        arrays = {key: np.float32(value) * array for key, array in arrays.items()}
    meta = {
        "format": FORMAT,
        "config": {"hidden_sizes": [8]},
        **DESCRIPTION,
        name: value,
    }
    text = json.dumps(meta)
    metadata = {"meta": text, "sha256": checksum(text, arrays)}  # one that fits
    path.write_bytes(safetensors.numpy.save(arrays, metadata))
    with pytest.raises(CheckpointError, match=rf"a\.safetensors: .*{reason}"):
        load_checkpoint(path)
