"""Checkpoints come back as they were written, or are refused with the reason."""

import dataclasses
import hashlib
import json
import tracemalloc

import flax.serialization
import jax
import jax.numpy as jnp
import msgpack
import numpy as np
import pytest
from baselines.purejaxrl_ppo.unpack import UnpackError, unpack
from msgpack import fallback

from baselines.purejaxrl_ppo import CheckpointError, Config, load_checkpoint, make_network
from baselines.purejaxrl_ppo import checkpoint as checkpoint_module
from baselines.purejaxrl_ppo.checkpoint import find_differences, observation_layout, save_checkpoint
from baselines.purejaxrl_ppo.resume import newest_intact
from flytrack_env import FlyTrack
from flytrack_env.observations import OBSERVATION_SIZE

CONFIG = Config(hidden_sizes=(8,))
DESCRIPTION = {
    "env_id": "FlyTrack-v0",
    "track": "flytrack",
    "missed_gate": "terminate",
    "observation_size": OBSERVATION_SIZE,
}


def content_of(path):
    """Return what a checkpoint file holds beneath its checksum."""
    whole = flax.serialization.msgpack_restore(path.read_bytes())
    return flax.serialization.msgpack_restore(whole["content"])


@pytest.fixture
def params():
    return make_network(CONFIG).init(jax.random.key(0), jnp.zeros((1, OBSERVATION_SIZE)))


@pytest.fixture
def path(tmp_path, params):
    save_checkpoint(tmp_path / "a.msgpack", params, CONFIG, DESCRIPTION)
    return tmp_path / "a.msgpack"


def test_round_trip(path, params):
    checkpoint = load_checkpoint(path)
    jax.tree.map(np.testing.assert_array_equal, checkpoint.params, params)
    assert checkpoint.config == CONFIG
    assert (checkpoint.env_id, checkpoint.track) == ("FlyTrack-v0", "flytrack")
    checkpoint.check_fits(FlyTrack())


def test_a_msgpack_that_is_not_compiled_reads_the_same(path, params, monkeypatch):
    def unpackb(packed, **arguments):
        unpacker = fallback.Unpacker(None, max_buffer_size=len(packed), **arguments)
        unpacker.feed(packed)
        return unpacker.unpack()

    monkeypatch.setattr(msgpack, "unpackb", unpackb)
    jax.tree.map(np.testing.assert_array_equal, load_checkpoint(path).params, params)
    with pytest.raises(UnpackError, match="found names that are not 2 different short texts"):
        unpack(b"\x82\xa1a\x01\xa1a\x02")


def test_other_observation_size_is_refused(tmp_path):
    params = make_network(CONFIG).init(jax.random.key(0), jnp.zeros((1, 5)))
    save_checkpoint(tmp_path / "b.msgpack", params, CONFIG, {**DESCRIPTION, "observation_size": 5})
    with pytest.raises(CheckpointError, match=f"size 5 .*{OBSERVATION_SIZE}"):
        load_checkpoint(tmp_path / "b.msgpack").check_fits(FlyTrack())


def test_parameters_of_another_network_are_refused(tmp_path, params):
    wider = dataclasses.replace(CONFIG, hidden_sizes=(9,))
    save_checkpoint(tmp_path / "c.msgpack", params, wider, DESCRIPTION)
    with pytest.raises(CheckpointError, match="shape"):
        load_checkpoint(tmp_path / "c.msgpack")


def test_values_that_are_not_finite_are_refused(tmp_path, params):
    broken = jax.tree.map(lambda leaf: leaf * np.nan, params)
    save_checkpoint(tmp_path / "d.msgpack", broken, CONFIG, DESCRIPTION)
    with pytest.raises(CheckpointError, match="not finite"):
        load_checkpoint(tmp_path / "d.msgpack")


@pytest.mark.parametrize("kept", [0, 1, 100, 0.5, 0.99])
def test_truncated_file_is_refused(path, kept):
    content = path.read_bytes()
    length = kept if isinstance(kept, int) else int(kept * len(content))
    path.write_bytes(content[:length])
    with pytest.raises(CheckpointError, match=r"a\.msgpack"):
        load_checkpoint(path)


@pytest.mark.parametrize(
    "content", [{}, {"meta": "{}"}, {"meta": "not json"}, {"meta": '{"format": "other"}'}, [1, 2]]
)
def test_another_format_is_refused(tmp_path, content):
    path = tmp_path / "e.msgpack"
    path.write_bytes(flax.serialization.msgpack_serialize(content))
    with pytest.raises(CheckpointError, match=r"e\.msgpack"):
        load_checkpoint(path)


def with_checksum(content):
    """Return a checkpoint of any content beneath a checksum that fits."""
    parts = {"checksum": hashlib.sha256(content).hexdigest(), "content": content}
    return flax.serialization.msgpack_serialize(parts)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"\xdd" + (2**22).to_bytes(4, "big") + b"\x80" * 2**22, "not a checkpoint, or damaged"),
        (
            msgpack.packb({str(one): {str(other): {} for other in range(1000)} for one in range(100)}),
            "found more than 100000 entries",
        ),
        (msgpack.packb({f"{number:06d}": {} for number in range(100_001)}), "100001 exceeds max_map_len"),
        (b"\x81\xa1a" * 5000 + b"\xc0", "not a checkpoint, or damaged"),
        (b"\x82\xa1a\x01\xa1a\x02", "found names that are not 2 different short texts"),
        (msgpack.packb({"x" * 201: 1}), "found names that are not 1 different short texts"),
        (msgpack.packb({"\x1b[2J": 1}), "found names"),
        (msgpack.packb({"a": msgpack.ExtType(2, b"")}), "found an extension 2, expected arrays"),
        (msgpack.packb({"meta": "[" * 100_000}), "no description in it"),
        (msgpack.packb({"meta": "7" * 5000}), "no description in it"),
        (msgpack.packb({"meta": '{"format": "flytrack-ppo-2"}' + " " * 2**22}), "no description in it"),
        (
            msgpack.packb({"meta": json.dumps({"format": ["x" * 999] * 999})}),
            "format: found .{1,200}, expected",
        ),
    ],
)
def test_what_takes_much_memory_or_many_words_is_refused(tmp_path, content, reason):
    path = tmp_path / "h.msgpack"
    for whole in (content, with_checksum(content)):
        path.write_bytes(whole)
        tracemalloc.start()
        try:
            with pytest.raises(CheckpointError, match=rf"h\.msgpack: .*{reason}"):
                load_checkpoint(path)
            assert tracemalloc.get_traced_memory()[1] < 2**27
        finally:
            tracemalloc.stop()


@pytest.mark.parametrize(
    "array",
    [
        ([2**40], b"float32", b"\0" * 8),
        ([-1], b"float32", b"\0" * 8),
        ([True], b"float32", b"\0" * 4),
        ([1] * 40, b"float32", b"\0" * 4),
        ([1], b"object", b"\0" * 8),
        ([1], b"U2", b"\0" * 8),
        ([1], b"f4,i4", b"\0" * 8),
        ([1], b"\xff", b"\0" * 8),
        (7, b"float32", b"\0" * 4),
    ],
)
def test_arrays_that_lie_are_refused(tmp_path, array):
    path = tmp_path / "i.msgpack"
    path.write_bytes(with_checksum(msgpack.packb({"a": msgpack.ExtType(1, msgpack.packb(array))})))
    with pytest.raises(CheckpointError, match=r"i\.msgpack: not a checkpoint, or damaged"):
        load_checkpoint(path)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16", "int8", "uint32", "bool"])
def test_arrays_of_every_number_come_back(dtype):
    array = np.asarray(jnp.arange(6).reshape(2, 3), jnp.dtype(dtype))
    found = unpack(flax.serialization.msgpack_serialize({"a": array}))["a"]
    assert found.dtype == array.dtype
    np.testing.assert_array_equal(found, array)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("observation_size", 10**12, "found observation_size 1000000000000 and hidden_sizes"),
        ("observation_size", 5.0, "found observation_size 5.0"),
        ("observation_size", "5", "found observation_size '5'"),
        ("observation_size", True, "found observation_size True"),
        ("config", {"hidden_sizes": [8] * 1000}, "expected at most 64 layers"),
        ("config", {"hidden_sizes": [10**9]}, "expected at most 64 layers, 1 to 65536 wide"),
        ("config", {"learning_rate": 10**400}, "learning_rate: found 1000.*, expected a finite number"),
        ("config", {"num_minibatches": 7}, "num_minibatches: found 7, expected a divisor"),
        ("track", ["x" * 999] * 999, "track: found .{1,200}, expected a string"),
    ],
)
def test_descriptions_of_no_network_are_refused(tmp_path, params, path, name, value, reason):
    content = content_of(path)
    meta = {**json.loads(content["meta"]), name: value}
    path.write_bytes(
        with_checksum(flax.serialization.msgpack_serialize({**content, "meta": json.dumps(meta)}))
    )
    with pytest.raises(CheckpointError, match=rf"a\.msgpack: .*{reason}"):
        load_checkpoint(path)


def test_what_would_not_be_read_is_not_written(tmp_path, params, monkeypatch):
    path = tmp_path / "l.msgpack"
    with pytest.raises(CheckpointError, match=r"l\.msgpack: found observation_size 65537"):
        save_checkpoint(path, params, CONFIG, {**DESCRIPTION, "observation_size": 65537})
    deep = dataclasses.replace(CONFIG, hidden_sizes=(8,) * 65)
    with pytest.raises(CheckpointError, match="expected at most 64 layers"):
        save_checkpoint(path, params, deep, DESCRIPTION)
    monkeypatch.setattr(checkpoint_module, "LARGEST_BYTES", 3000)
    with pytest.raises(CheckpointError, match=r"l\.msgpack: found \d+ bytes to write, expected at most 3000"):
        save_checkpoint(path, params, CONFIG, DESCRIPTION)
    assert not path.exists()


@pytest.mark.parametrize("training", [[1.0], "a", {"a": {"b": np.zeros(1)}}, {"a": 1.0}])
def test_training_that_is_no_arrays_is_refused(tmp_path, path, training):
    content = {**content_of(path), "training": training}
    path.write_bytes(with_checksum(flax.serialization.msgpack_serialize(content)))
    with pytest.raises(
        CheckpointError, match=r"a\.msgpack: (training: found something else|not a checkpoint)"
    ):
        load_checkpoint(path)


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match=r"missing\.msgpack: cannot be read"):
        load_checkpoint(tmp_path / "missing.msgpack")


@pytest.mark.parametrize(
    ("name", "value"), [("env_id", 5), ("track", 5), ("missed_gate", None), ("config", [1, 2])]
)
def test_damaged_description_is_refused(tmp_path, params, name, value):
    save_checkpoint(tmp_path / "f.msgpack", params, CONFIG, {**DESCRIPTION, name: value})
    with pytest.raises(CheckpointError, match=r"f\.msgpack"):
        load_checkpoint(tmp_path / "f.msgpack")


def test_parameters_that_are_no_tree_are_refused(tmp_path, path):
    content = content_of(path)
    path.write_bytes(flax.serialization.msgpack_serialize({**content, "params": 5}))
    with pytest.raises(CheckpointError, match=r"a\.msgpack.*log_std.*missing"):
        load_checkpoint(path)


def test_every_flipped_bit_is_noticed(path):
    whole = path.read_bytes()
    for place in np.random.default_rng(0).integers(0, len(whole), 50):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(place % 8)
        path.write_bytes(bytes(damaged))
        with pytest.raises(CheckpointError, match=r"a\.msgpack"):
            load_checkpoint(path)


def test_a_policy_of_the_first_format_is_read(path, params):
    content = content_of(path)
    meta = json.loads(content["meta"])
    old = {
        name: value for name, value in meta["config"].items() if name not in ("adam_eps", "affine_shuffle")
    }
    content["meta"] = json.dumps({**meta, "format": "flytrack-ppo-1", "config": old})
    path.write_bytes(flax.serialization.msgpack_serialize(content))
    checkpoint = load_checkpoint(path)
    assert checkpoint.config == CONFIG and checkpoint.training is None
    jax.tree.map(np.testing.assert_array_equal, checkpoint.params, params)


def test_another_observation_of_the_same_size_is_refused_row_by_row(tmp_path, params):
    env = FlyTrack()
    layout = observation_layout(env)
    layout["row 1 (velocity)"]["scale"] = 4.0
    save_checkpoint(tmp_path / "g.msgpack", params, CONFIG, {**DESCRIPTION, "observation": layout})
    with pytest.raises(CheckpointError, match=r"row 1 \(velocity\)\.scale: found 4\.0, expected 5\.0$"):
        load_checkpoint(tmp_path / "g.msgpack").check_fits(env)


def test_differences_name_every_field():
    found = {"a": {"b": 1, "c": [1, 2]}, "d": "x", "same": 3}
    expected = {"a": {"b": 2, "c": [1, 5]}, "e": "y", "same": 3}
    assert sorted(find_differences(found, expected, "run")) == [
        "run.a.b: found 1, expected 2",
        "run.a.c[1]: found 2, expected 5",
        "run.d: found 'x', expected nothing",
        "run.e: found nothing, expected 'y'",
    ]


PROGRESS = {"steps": 3 * CONFIG.batch_size, "seed": 1, "model": {}, "environment": {}}


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("steps", None, "steps: found None, expected a whole number"),
        ("steps", "many", "steps: found 'many', expected a whole number"),
        ("steps", -1, "steps: found -1, expected a whole number"),
        ("steps", 10**400, "steps: found 1000.*, expected a whole number"),
        ("steps", CONFIG.batch_size + 1, "steps: found .*, expected a multiple of"),
        ("steps", 10**6 * CONFIG.batch_size, "steps: found .*, expected at most .*, the whole training"),
        ("seed", 1.5, "seed: found 1.5, expected a whole number"),
        ("seconds", "long", "seconds: found 'long', expected a number"),
        ("seen", [1.0], "seen: found .*, expected an object of numbers"),
        ("seen", {"success": "all"}, "seen: found .*, expected an object of numbers"),
        ("model", "nominal", "model: found 'nominal', expected an object"),
        ("environment", None, "environment: found None, expected an object"),
    ],
)
def test_a_training_that_does_not_say_how_far_it_is_is_not_resumed(tmp_path, params, name, value, reason):
    path, training = tmp_path / "k.msgpack", {"a": np.zeros(1)}
    save_checkpoint(path, params, CONFIG, {**DESCRIPTION, **PROGRESS}, training)
    assert newest_intact(path)[1].meta["steps"] == PROGRESS["steps"]
    save_checkpoint(path, params, CONFIG, {**DESCRIPTION, **PROGRESS, name: value}, training)
    with pytest.raises(CheckpointError, match=rf"k\.msgpack: {reason}"):
        newest_intact(path)
