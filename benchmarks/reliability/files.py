"""Files: valid ones of every kind that is read, damaged by hypothesis or crafted to do harm, and loaded.

Promised is a sound result or the loader's own error, naming the file, within CPU_S and MEMORY_BYTES and without
unpickling anything.
"""

import contextlib
import gzip
import io
import json
import resource
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from jax import export

import flytrack_sysid
from baselines.purejaxrl_ppo import CheckpointError, load_checkpoint
from baselines.purejaxrl_ppo.config import ConfigError, settings_in_file
from benchmarks.champion import CHAMPION
from benchmarks.reliability import foreign_logs
from benchmarks.report import ROOT, table
from flytrack_env import ModelFileError, TrackError, blackbox, load_model, load_track, sandbox
from flytrack_env.references import ReferenceFileError, load_reference, shipped_path
from flytrack_env.rollout import RolloutError, load_rollout, save_rollout
from flytrack_env.tracks import build_course
from flytrack_env.tracks.track import TRACK_FOLDER
from flytrack_sysid import LogError, ScriptError
from flytrack_sysid.importing import load_mapping
from flytrack_sysid.manoeuvres import MANOEUVRES

CPU_S, MEMORY_BYTES = 10.0, 2 * 2**30
LONGEST_MESSAGE = 2000  # characters, and the file's name
NUM_FILES, SLOW_SHARE = 1000, 0.2  # of each kind; of those that start a process for each
TOKENS = [b"nan", b"1e999", b"-1", b"0", b"null", b'"', b"\n", b"\0", b"\xff", b",", b"[" * 2000, b"9" * 5000]
SETTINGS = b'total_timesteps = 2e6\nhidden_sizes = [64, 64]\nlearning_rate = 3e-4\n'
PLANT = ((21,), (4,))  # shapes of a black box's arguments


class Kind(NamedTuple):
    """A kind of file. content: a valid one. numbers: of a loaded one, which must be finite.

    crafted: return files made to do harm, of a valid one. is_slow: loading starts a process.
    """

    suffix: str
    content: Callable[[], bytes]
    load: Callable[[Path], Any]
    error: type[Exception]
    numbers: Callable[[Any], Any] = lambda loaded: ()
    crafted: Callable[[bytes], list[bytes]] = lambda content: []
    is_slow: bool = False


def _written(save: Callable[..., None], suffix: str, *values: Any) -> bytes:
    """Return the file that one of the package's writers makes."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        save(path := Path(folder) / f"a{suffix}", *values)
        return path.read_bytes()


def _log(suffix: str) -> bytes:
    from tests.support.written_logs import make_log

    return _written(flytrack_sysid.save_log, suffix, make_log(num_rows=12))
