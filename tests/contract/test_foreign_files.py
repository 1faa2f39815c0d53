"""Every loader loads a valid file and refuses others by name, soon; nothing in them runs."""

import gzip
import io
import os
import pickle
import sys
import time
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import hypothesis
import jax
import numpy as np
import pytest
from hypothesis import strategies as st

import flytrack_sysid as sysid
from baselines.purejaxrl_ppo import CheckpointError, load_checkpoint
from baselines.purejaxrl_ppo.config import ConfigError, read_config_file
from benchmarks.champion import CHAMPION
from flytrack_env import ModelFileError, TrackError, blackbox, load_model, load_track
from flytrack_env.dynamics import nominal_parameters
from flytrack_env.effects import QuadraticDrag
from flytrack_env.model_file import save_model
from flytrack_env.references import ReferenceFileError, load_reference, shipped_path
from flytrack_env.rollout import RolloutError, load_rollout, save_rollout
from flytrack_env.tracks.track import TRACK_FOLDER
from flytrack_sysid import LogError, import_log, log_file
from flytrack_sysid.check import load_layout
from flytrack_sysid.importing import load_mapping
from flytrack_sysid.log import log_of_states
from flytrack_sysid.manoeuvres import MANOEUVRES
from tests.support import black_boxes
from tests.support.foreign_logs import WRITERS, flying, write_csv
from tests.support.slow import slow_but
from tests.support.written_logs import npy_bytes, npz_bytes, read_mapping

CPU_S, MAX_MESSAGE_LENGTH, NUM_FILES, NUM_SLOW_FILES = 10.0, 2000, 40, 3
TOKENS = (
    b"nan",
    b"1e999",
    b"-1",
    b"null",
    b'"',
    b"\n",
    b"\0",
    b"\xff",
    b",",
    b"[" * 2000,
    b"9" * 5000,
)
SETTINGS = b"total_timesteps = 2e6\nhidden_sizes = [64, 64]\nlearning_rate = 3e-4\n"
LAYOUT = b"x0 = [0, 0, 5, 1, 0, 0, 0, 0, 0, 0, 0]\ndt = 0.01\nq = [3, 4, 5, 6]\nw = [7, 8, 9]\n"
STATES = np.tile(black_boxes.start(), (12, 1))
ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 4))


class Trap:
    """Fails the test that unpickles it."""

    def __reduce__(self):
        return (pytest.fail, ("a pickle was read",))


class Kind(NamedTuple):
    """A kind of file: a writer or content of a valid one, its loader, and the loader's error.

    Attributes:
        hostile: return files made to do harm from a valid one.
        is_slow: the loader starts a process.
    """

    suffix: str
    valid: bytes | Callable[[Path], Any]
    load: Callable[[Path], Any]
    error: type[Exception]
    hostile: Callable[[bytes], list[bytes]] = lambda content: []
    is_slow: bool = False

    def content(self, folder):
        """Return a valid file."""
        if isinstance(self.valid, bytes):
            return self.valid
        path = folder / f"valid{self.suffix}"
        self.valid(path)
        return path.read_bytes()


def imported(kind, suffix, is_slow=True, **options):
    """Return a kind of log that is imported, with the mapping beside the valid one."""
    form, write = WRITERS[kind]

    def save(path):
        write(path.parent, flying())[0].rename(path)

    def load(path):
        mapping = path.with_name("map.toml")
        return import_log(path, form, mapping if mapping.exists() else None).log

    return Kind(suffix, save, load, LogError, is_slow=is_slow, **options)


def hostile_arrays(content):
    """Return archives with pickles, arrays of other sizes than declared, and bombs."""
    arrays = dict(np.load(io.BytesIO(content)))
    name = next(iter(arrays))
    odd = (
        np.array([print], object),
        np.zeros(2**27, np.int8),
        np.full(8, 2**31 - 1, np.int32).view("<U1"),
    )
    odd_arrays = [npz_bytes({**arrays, name: value}) for value in odd]
    header = npz_bytes(arrays).replace(b"'shape': (", b"'shape': (9")
    version = content.replace(b"\x93NUMPY\x01", b"\x93NUMPY\x02")
    unannounced = io.BytesIO()
    with zipfile.ZipFile(unannounced, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{name}.npy", npy_bytes(arrays[name]) + bytes(2**28))
        archive.getinfo(f"{name}.npy").file_size = len(npy_bytes(arrays[name]))
    return [*odd_arrays, header, content + content, version, unannounced.getvalue()]


def hostile_texts(content):
    """Return texts that are very long, nested deeply, or have keys of very many parts."""
    dots = b"\n".join(b"a%d" % number + b".a" * 999 + b" = 1" for number in range(100))
    nested, digits = b"[" * 10**5, b"9" * 10**5
    long_texts = [content + b" " * 2**26, content + b"x" * 2**22]
    return [*long_texts, nested, b"a = " + nested, dots, digits]


def save_script(path):
    """Write a script of two flights."""
    flown = np.stack([ACTIONS] * 2)
    sysid.save_script(path, sysid.Script(tuple(MANOEUVRES)[:2], STATES[:2], flown))


def save_log(path):
    """Write a log of one flight."""
    sysid.save_log(path, log_of_states([(STATES, ACTIONS)], 0.01))


TRACK = (TRACK_FOLDER / "flytrack.toml").read_bytes()
REFERENCE = shipped_path("flytrack", "flying", "nominal").read_bytes()
DRAGGED = nominal_parameters().with_effects(QuadraticDrag(0.1, 0.1, 0.2))
save_drag = partial(save_model, model=DRAGGED, provenance={})
save_flight = partial(save_rollout, states=STATES, actions=ACTIONS)
BLACK_BOX, POLICY = black_boxes.SHIPPED.read_bytes(), CHAMPION.read_bytes()
MAPPING = read_mapping("every_unit").encode()
KINDS = {
    "track": Kind(".toml", TRACK, load_track, TrackError, hostile_texts),
    "model": Kind(".json", save_drag, load_model, ModelFileError, hostile_texts),
    "rollout": Kind(".npy", save_flight, load_rollout, RolloutError),
    "flight log, .npz": Kind(".npz", save_log, sysid.load_log, LogError, hostile_arrays),
    "flight log, .csv": Kind(".csv", save_log, sysid.load_log, LogError, hostile_texts),
    "script": Kind(".npz", save_script, sysid.load_script, sysid.ScriptError),
    "reference": Kind(".npz", REFERENCE, load_reference, ReferenceFileError),
    "import mapping": Kind(".toml", MAPPING, load_mapping, LogError, hostile_texts),
    "imported CSV": imported("CSV", ".csv", False, hostile=hostile_texts),
    "imported PX4 log": imported("ULog", ".ulg"),
    "imported Betaflight log": imported("blackbox", ".bbl"),
    "imported ArduPilot log": imported("DataFlash", ".bin"),
    "imported uSD log": imported("uSD", "", False),
    "imported bag": imported("bag", ".mcap"),
    "layout": Kind(".toml", LAYOUT, load_layout, LogError, hostile_texts),
    "training settings": Kind(".toml", SETTINGS, read_config_file, ConfigError, hostile_texts),
    "checkpoint": Kind(CHAMPION.suffix, POLICY, load_checkpoint, CheckpointError),
    "black box": Kind(".bin", BLACK_BOX, blackbox.load, blackbox.BlackBoxError, is_slow=True),
}
FAST = KINDS.keys() - {"black box"}


@st.composite
def damaged(draw, valid):
    """Return a file with one to four parts, or one of its arrays, damaged.

    A part is changed, cut, extended or duplicated.
    """
    if valid[:2] == b"PK" and draw(st.booleans()):
        return draw(damaged_arrays(valid))
    content = valid
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(content)))
        end = min(start + draw(st.integers(0, 40)), len(content))
        part = content[start:end]
        new = draw(
            st.sampled_from(TOKENS)
            | st.binary(max_size=8)
            | st.just(part * 2)
            | st.just(part[::-1])
        )
        content = content[:start] + new + (content[end:] if draw(st.integers(0, 9)) else b"")
    return content


@st.composite
def damaged_arrays(draw, valid):
    """Return an archive of which one array is missing, or of another type, shape or value."""
    arrays = dict(np.load(io.BytesIO(valid)))
    name = draw(st.sampled_from(sorted(arrays)))
    old = arrays.pop(name)
    other = old.astype(float) if old.dtype.kind in "iuf" else np.zeros(3)
    changed = other.copy()
    changed.flat[draw(st.integers(0, other.size - 1))] = draw(st.floats())
    odd = [changed, other[:-1], other[None], other.astype(np.int8), np.float64(1.0)]
    new = draw(st.none() | st.sampled_from(odd))
    return npz_bytes(
        arrays if new is None else {**arrays, draw(st.sampled_from([name, "../other"])): new}
    )


def loaded_or_refused(kind, path):
    """Return whether a file is loaded; only finite numbers or the loader's own error may result."""
    started_s = time.process_time()
    try:
        loaded = kind.load(path)
    except kind.error as error:
        text = str(error)
        assert path.name in text and len(text) <= MAX_MESSAGE_LENGTH and text.isprintable(), text
        return False
    finally:
        assert time.process_time() - started_s <= CPU_S
    loaded = getattr(loaded, "log", loaded)
    leaves = map(np.asarray, jax.tree.leaves(getattr(loaded, "__dict__", loaded)))
    assert all(np.isfinite(leaf).all() for leaf in leaves if leaf.dtype.kind == "f")
    return True


@pytest.fixture(scope="module")
def unpickled():
    """What was unpickled since the first test that asked for this."""
    seen: list[str] = []
    sys.addaudithook(lambda event, _: seen.append(event) if event == "pickle.find_class" else None)
    return seen


@pytest.mark.parametrize("kind", slow_but(FAST, KINDS))
def test_damaged_and_hostile_files_are_loaded_or_refused(kind, tmp_path, unpickled):
    file_kind, outcomes = KINDS[kind], list[bool]()
    path, valid = tmp_path / f"b{file_kind.suffix}", file_kind.content(tmp_path)

    def check(content):
        path.write_bytes(content)
        unpickled.clear()
        outcomes.append(loaded_or_refused(file_kind, path))
        assert not unpickled

    settings = hypothesis.settings(
        max_examples=NUM_SLOW_FILES if file_kind.is_slow else NUM_FILES,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    check(valid)
    assert outcomes == [True]
    for content in file_kind.hostile(valid):
        check(content)
    settings(hypothesis.given(damaged(valid))(check))()
    assert not all(outcomes)


@pytest.mark.parametrize("kind", slow_but(FAST, KINDS))
def test_what_is_no_such_file_is_refused(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    contents = {
        "garbage": b"\x80\x01\xff garbage",
        "pickle": pickle.dumps(Trap()),
        "cut": KINDS[kind].content(tmp_path)[:40],
    }
    suffix = KINDS[kind].suffix
    for name, content in contents.items():
        Path(name + suffix).write_bytes(content)
    Path(f"folder{suffix}").mkdir()
    os.mkfifo(f"pipe{suffix}")
    Path(f"device{suffix}").symlink_to("/dev/zero")
    for name in (*contents, "folder", "pipe", "device", "missing"):
        with pytest.raises(KINDS[kind].error, match=name + suffix):
            KINDS[kind].load(Path(name + suffix))


def test_compressed_logs_are_read_and_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(log_file, "PACKED_BYTES", 50_000)
    path, mapping = write_csv(tmp_path, flying())
    expected, text = import_log(path, "csv", mapping).log, path.read_bytes()
    path = tmp_path / "a.csv.gz"
    path.write_bytes(gzip.compress(text[:100]) + gzip.compress(text[100:]) + bytes(100))
    assert (import_log(path, "csv", mapping).log["w"] == expected["w"]).all()
    for content, message in (
        (gzip.compress(text)[:-1], "ended before"),
        (text, "Not a gzipped file"),
        (gzip.compress(text + b"\n" * 2**20), "found more than [0-9]+ characters"),
        (gzip.compress(b"," * 2**20), "found a row of 65536 characters or more"),
    ):
        path.write_bytes(content)
        with pytest.raises(LogError, match=rf"a\.csv\.gz: .*{message}"):
            import_log(path, "csv", mapping)
