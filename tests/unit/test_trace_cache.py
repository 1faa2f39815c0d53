"""Traces of programs are kept for the next process where compiled programs are."""

import jax
import numpy as np
import pytest

from flytrack_env.compile_cache import FOLDER
from flytrack_sysid.inference.trace_cache import keep_trace


@pytest.fixture
def folder(tmp_path):
    before = getattr(jax.config, FOLDER)
    jax.config.update(FOLDER, str(tmp_path))
    yield tmp_path / "traced"
    jax.config.update(FOLDER, before)


def trace(values):
    """Return the result of a program as a new process has it, and how often it was traced."""
    traced = []

    def double(tree):
        traced.append(tree)
        return 2.0 * tree["values"]

    return np.asarray(keep_trace(double)({"values": values})).tolist(), len(traced)


def test_another_process_reads_the_trace(folder):
    assert trace(np.arange(3.0)) == ([0.0, 2.0, 4.0], 1)
    assert trace(jax.numpy.arange(1.0, 4.0)) == ([2.0, 4.0, 6.0], 0)


def test_other_shapes_and_precisions_have_traces_of_their_own(folder):
    for x64 in (False, True):
        with jax.enable_x64(x64):
            assert trace(np.arange(3.0))[1] == 1
            assert trace(np.arange(2.0))[1] == 1
    assert len(list(folder.iterdir())) == 4


def test_a_damaged_trace_is_made_again(folder):
    trace(np.arange(3.0))
    (path,) = folder.iterdir()
    path.write_bytes(path.read_bytes()[:100])
    assert trace(np.arange(3.0)) == ([0.0, 2.0, 4.0], 1)
    assert trace(np.arange(3.0))[1] == 0


def test_nothing_is_written_where_no_program_is_kept(folder):
    jax.config.update(FOLDER, None)
    assert trace(np.arange(3.0))[1] == trace(np.arange(3.0))[1] == 1
    assert not folder.exists()
