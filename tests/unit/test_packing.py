"""Pytrees as matrices of words: every bit comes back, compiled, on the host and as Python's own."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from flytrack_env.gymnasium_adapter.packing import HOST_DTYPES, WORD, from_words, make_reader, pack

QUIET_NAN = np.uint32(0x7FC01234)  # with a payload
BATCH = {
    "flag": np.array([True, False, True]),
    "index": np.array([-1, 2**31 - 1, 0], np.int32),
    "rows": np.array([[1.5, -0.0], [np.nan, np.inf], [1e-45, 3.0]], np.float32),
    "seed": np.array([2**32 - 1, QUIET_NAN, 7], np.uint32),
    "time": np.array([0.25, -np.inf, 1e-40], np.float32),
}
WIDE = {**BATCH, "count": np.array([-(2**40), 1, 2]), "far": np.array([[0.1], [1e300], [-0.0]])}
OVER_BATCHES = pytest.mark.parametrize("batch", [BATCH, WIDE], ids=["32 bits", "64 bits"])


@OVER_BATCHES
def test_every_bit_comes_back(batch):
    with jax.enable_x64(batch is WIDE):
        packed = jax.jit(pack)(batch)
        unpack = jax.jit(lambda packed: from_words(packed.words, packed.layout).unpack())
        unpacked = jax.tree.map(np.asarray, unpack(packed))
    assert packed.words.dtype == WORD
    for name, leaf in batch.items():
        assert (unpacked[name].dtype, unpacked[name].shape) == (leaf.dtype, leaf.shape)
        assert unpacked[name].tobytes() == leaf.tobytes()
    for name, leaf in packed.to_host().items():
        expected = batch[name].astype(HOST_DTYPES[batch[name].dtype.kind])
        assert leaf.flags.writeable and leaf.dtype == expected.dtype
        assert_array_equal(leaf, expected)


@OVER_BATCHES
@pytest.mark.parametrize("index", range(3))
def test_scalars_are_read_as_pythons_own(batch, index):
    scalars = {name: leaf[index : index + 1] for name, leaf in batch.items() if leaf.ndim == 1}
    with jax.enable_x64(batch is WIDE):
        packed = jax.jit(pack)(scalars)
    column = np.concatenate([np.zeros(5, WORD), np.asarray(packed.words)[:, 0]])
    numbers = make_reader(packed.layout, 5)(column)
    expected = [scalars[name].item() for name in sorted(scalars)]
    assert list(numbers) == expected
    assert list(map(type, numbers)) == list(map(type, expected))


def test_only_scalars_are_read():
    with pytest.raises(ValueError, match=r"layout: found leaves of shapes \[\(\), .*\(2,\)"):
        make_reader(pack(BATCH).layout, 0)
