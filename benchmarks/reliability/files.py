"""Files: valid ones of every kind that is read, damaged by hypothesis or crafted to do harm, and loaded.

Promised is a sound result or the loader's own error, which names the file, within CPU_S and MEMORY_BYTES and
without unpickling anything.
"""

import gzip
import io
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from jax import export
from tqdm import tqdm

import flytrack_sysid as sysid
from baselines.purejaxrl_ppo import CheckpointError, load_checkpoint
from baselines.purejaxrl_ppo.config import ConfigError, settings_in_file
from benchmarks.reliability import foreign_logs
from benchmarks.report import ROOT, table
from flytrack_env import ModelFileError, TrackError, blackbox, load_model, load_track, sandbox
from flytrack_env.dynamics import nominal_parameters
from flytrack_env.effects import QuadraticDrag
from flytrack_env.model_file import save_model
from flytrack_env.references import ReferenceFileError, load_reference, shipped_path
from flytrack_env.rollout import RolloutError, load_rollout, save_rollout
from flytrack_env.tracks.track import TRACK_FOLDER
from flytrack_sysid.importing import load_mapping
from flytrack_sysid.log import log_of_states
from flytrack_sysid.manoeuvres import MANOEUVRES

CPU_S, MEMORY_BYTES = 10.0, 2 * 2**30  # that one file may take; the sandbox's own limits are lower
NUM_FILES = 1000  # of each kind
LONGEST_MESSAGE = 2000  # characters
SLOW_SHARE = 0.05  # of the files, of kinds whose loader starts a process
TOKENS = (b"nan", b"1e999", b"-1", b"null", b'"', b"\n", b"\0", b"\xff", b",", b"[" * 2000, b"9" * 5000)
CHAMPION = next((ROOT / "baselines" / "purejaxrl_ppo" / "champion").glob("flytrack.*"))
SETTINGS = "total_timesteps = 2e6\nhidden_sizes = [64, 64]\nlearning_rate = 3e-4\n"


class Kind(NamedTuple):
    """A kind of file: a valid one, its loader, the error that the loader raises.

    crafted: return files made to do harm from a valid one. is_slow: the loader starts a process.
    """

    suffix: str
    content: Callable[[], bytes]
    load: Callable[[Path], Any]
    error: type[Exception]
    crafted: Callable[[bytes], list[bytes]] = lambda content: []
    is_slow: bool = False


def written(save: Callable[..., Any], suffix: str, *values: Any) -> bytes:
    """Return the file that one of the package's writers makes of some values."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"valid{suffix}"
        save(path, *values)
        return path.read_bytes()


def flight() -> tuple[np.ndarray, np.ndarray]:
    """Return states (12, 21) and actions (12, 4) of a drone near hover."""
    states = np.tile(np.asarray(blackbox.start_vector(), float), (12, 1))
    states[:, 2] = 5.0
    return states, np.random.default_rng(0).uniform(-1.0, 1.0, (12, 4))


def script() -> bytes:
    """Return a script of two flights."""
    states, actions = flight()
    return written(
        sysid.save_script, ".npz", sysid.Script(tuple(MANOEUVRES)[:2], states[:2], np.stack([actions] * 2))
    )


def plant() -> bytes:
    """Return a black box."""
    arguments = [jax.ShapeDtypeStruct((size,), jnp.float32) for size in (21, 4)]
    step = jax.jit(lambda x, u: 0.5 * x + u.sum())
    return bytes(export.export(step, platforms=["cpu"])(*arguments).serialize())


def hostile_arrays(content: bytes) -> list[bytes]:
    """Return archives with pickles, arrays of other sizes than declared, and bombs."""
    arrays = dict(np.load(io.BytesIO(content)))
    name = next(iter(arrays))
    odd = (np.array([print], object), np.zeros(2**27, np.int8), np.full(8, 2**31 - 1, np.int32).view("<U1"))
    saved = [npz({**arrays, name: value}) for value in odd]
    header = npz(arrays).replace(b"'shape': (", b"'shape': (9")
    return [*saved, header, content + content, content.replace(b"\x93NUMPY\x01", b"\x93NUMPY\x02")]


def npz(arrays: dict[str, np.ndarray]) -> bytes:
    """Return arrays as a compressed archive."""
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()


def hostile_texts(content: bytes) -> list[bytes]:
    """Return texts that are very long, nested deeply, or have keys of very many parts."""
    dots, nested = b"\n".join(b"a%d" % number + b".a" * 999 + b" = 1" for number in range(100)), b"[" * 10**5
    return [content + b" " * 2**26, content + b"x" * 2**22, nested, b"a = " + nested, dots, b"9" * 10**5]


def hostile_rollouts(content: bytes) -> list[bytes]:
    """Return a header that declares terabytes, and one that is itself gigabytes long."""
    terabytes = content.replace(b"(12, 25), }" + b" " * 11, b"(12000000000, 25), }")
    return [terabytes, b"\x93NUMPY\x02\x00\xff\xff\xff\x7f{'descr'" + bytes(200)]


def hostile_gzips(_: bytes) -> list[bytes]:
    """Return compressed files that unpack to 256 MiB, or have 100,000 parts."""
    return [gzip.compress(b"0," * 2**27, 1), gzip.compress(b"\n" * 2**28, 1), gzip.compress(b"") * 100_000]


def import_mapped(path: Path, form: str, content: str) -> Any:
    """Return the log in a file of a format that needs a mapping."""
    mapping = path.with_name(f"mapping_of_{form}.toml")
    mapping.write_text(content)
    return sysid.import_log(path, form, mapping).log


LOG = log_of_states([flight()], 0.01)
MODEL = nominal_parameters().with_effects(QuadraticDrag(0.1, 0.1, 0.2))
track, reference = TRACK_FOLDER / "flytrack.toml", shipped_path("flytrack", "flying", "nominal")
npz_log, csv_log = (partial(written, sysid.save_log, suffix, LOG) for suffix in (".npz", ".csv"))
rollout = partial(written, save_rollout, ".npy", *flight())
model = partial(written, save_model, ".json", MODEL, {})
gzipped = partial(gzip.compress, foreign_logs.foreign_csv(), mtime=0)
import_csv, import_usd, import_bag = (
    partial(import_mapped, form=form, content=content)
    for form, content in (
        ("csv", foreign_logs.MAPPING),
        ("usd", foreign_logs.USD_MAPPING),
        ("bag", foreign_logs.BAG_MAPPING),
    )
)
import_ulog, import_bbl = (partial(sysid.import_log, format=form) for form in ("ulog", "betaflight"))
KINDS = {
    "track": Kind(".toml", track.read_bytes, load_track, TrackError, hostile_texts),
    "model": Kind(".json", model, load_model, ModelFileError, hostile_texts),
    "rollout": Kind(".npy", rollout, load_rollout, RolloutError, hostile_rollouts),
    "flight log, .npz": Kind(".npz", npz_log, sysid.load_log, sysid.LogError, hostile_arrays),
    "flight log, .csv": Kind(".csv", csv_log, sysid.load_log, sysid.LogError, hostile_texts),
    "script": Kind(".npz", script, sysid.load_script, sysid.ScriptError, hostile_arrays),
    "reference": Kind(".npz", reference.read_bytes, load_reference, ReferenceFileError, hostile_arrays),
    "import mapping": Kind(".toml", foreign_logs.MAPPING.encode, load_mapping, sysid.LogError, hostile_texts),
    "imported CSV": Kind(".csv", foreign_logs.foreign_csv, import_csv, sysid.LogError, hostile_texts),
    "imported CSV, gzip": Kind(".csv.gz", gzipped, import_csv, sysid.LogError, hostile_gzips),
    "imported PX4 log": Kind(".ulg", foreign_logs.ulog, import_ulog, sysid.LogError, is_slow=True),
    "imported Betaflight log": Kind(
        ".bbl", foreign_logs.betaflight, import_bbl, sysid.LogError, is_slow=True
    ),
    "imported uSD log": Kind("", foreign_logs.usd, import_usd, sysid.LogError),
    "imported bag": Kind(".mcap", foreign_logs.mcap_bag, import_bag, sysid.LogError, is_slow=True),
    "training settings": Kind(".toml", SETTINGS.encode, settings_in_file, ConfigError, hostile_texts),
    "checkpoint": Kind(CHAMPION.suffix, CHAMPION.read_bytes, load_checkpoint, CheckpointError),
    "black box": Kind(".bin", plant, blackbox.load, blackbox.BlackBoxError, is_slow=True),
}


def numbers(loaded: Any) -> list[np.ndarray]:
    """Return the arrays of floating point numbers in anything that was loaded."""
    if hasattr(loaded, "log"):
        loaded = loaded.log
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(getattr(loaded, "__dict__", loaded))]
    return [leaf for leaf in leaves if leaf.dtype.kind == "f"]


@st.composite
def damaged(draw: st.DrawFn, valid: bytes) -> bytes:
    """Return a file with one to four parts changed, cut, extended or duplicated."""
    content = valid
    if content[:2] == b"PK" and draw(st.booleans()):
        return draw(damaged_arrays(valid))
    is_packed = content[:2] == b"\x1f\x8b" and draw(st.booleans())
    content = gzip.decompress(content) if is_packed else content
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(content)))
        end = min(start + draw(st.integers(0, 40)), len(content))
        part = content[start:end]
        new = draw(st.sampled_from(TOKENS) | st.binary(max_size=8) | st.just(part * 2) | st.just(part[::-1]))
        content = content[:start] + new + (content[end:] if draw(st.integers(0, 9)) else b"")
    return gzip.compress(content, 1) if is_packed else content


@st.composite
def damaged_arrays(draw: st.DrawFn, valid: bytes) -> bytes:
    """Return an archive of which one array is missing, or of another type, shape or value."""
    arrays = dict(np.load(io.BytesIO(valid)))
    name = draw(st.sampled_from(sorted(arrays)))
    old = arrays.pop(name)
    other = old.astype(float) if old.dtype.kind in "iuf" else np.zeros(3)
    changed = other.copy()
    changed.flat[draw(st.integers(0, other.size - 1))] = draw(st.floats())
    odd = [changed, other[:-1], other[None], other.astype(np.int8), np.float64(1.0)]
    new = draw(st.none() | st.sampled_from(odd))
    return npz(arrays if new is None else {**arrays, draw(st.sampled_from([name, "../other"])): new})


class Broken(AssertionError):
    """A file that broke the promise."""


def judge(kind: Kind, path: Path, unpickled: list[str]) -> str:
    """Return "loaded" or "refused"; raises Broken for anything else that a file brings about."""
    started_s = time.process_time()
    unpickled.clear()
    try:
        loaded, outcome = kind.load(path), "loaded"
    except kind.error as error:
        text, loaded, outcome = str(error), None, "refused"
        if path.name not in text or len(text) > LONGEST_MESSAGE or not text.isprintable():
            raise Broken(f"refused with the message {text[:200]!r}") from error
    except Exception as error:
        raise Broken(f"raised {type(error).__name__}: {str(error)[:200]}") from error
    if not all(np.isfinite(values).all() for values in numbers(loaded)):
        raise Broken("loaded numbers that are not finite")
    if unpickled or time.process_time() - started_s > CPU_S:
        raise Broken(f"unpickled {unpickled}, took {time.process_time() - started_s:.1f} s")
    return outcome


def soak_kind(kind: Kind, num_files: int, folder: Path) -> dict[str, Any]:
    """Return how many files of a kind were loaded and refused, the slowest, and what was broken first."""
    outcomes: Counter[str] = Counter()
    slowest_s, unpickled, path = 0.0, list[str](), folder / f"a{kind.suffix}"
    sys.addaudithook(lambda event, _: unpickled.append(event) if event == "pickle.find_class" else None)

    def check(content: bytes) -> None:
        nonlocal slowest_s
        path.write_bytes(content)
        started_s = time.perf_counter()
        outcomes[judge(kind, path, unpickled)] += 1
        slowest_s = max(slowest_s, time.perf_counter() - started_s)

    valid = kind.content()
    settings = hypothesis.settings(
        max_examples=max(round(num_files * (SLOW_SHARE if kind.is_slow else 1.0)), 1),
        deadline=None,
        database=None,
        derandomize=True,
        phases=[hypothesis.Phase.generate, hypothesis.Phase.shrink],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    broken = ""
    try:
        check(valid)
        if not outcomes["loaded"]:
            raise Broken("refused the valid file")
        for content in kind.crafted(valid):
            check(content)
        settings(hypothesis.given(damaged(valid))(check))()
    except Broken as error:
        broken = f"{error}; the file: {path.read_bytes()[:100]!r}"
    return {**outcomes, "slowest_s": round(slowest_s, 2), "broken": broken}


def measure(share: float) -> dict[str, Any]:
    """Return what came of a share of ``NUM_FILES`` damaged files of every kind, and the crafted ones."""
    num_files = max(round(share * NUM_FILES), 1)
    sandbox.limit_memory(MEMORY_BYTES)
    with tempfile.TemporaryDirectory() as folder:
        kinds = {name: soak_kind(kind, num_files, Path(folder)) for name, kind in tqdm(KINDS.items())}
    return {"kinds": kinds, "is_held": not any(found["broken"] for found in kinds.values())}


def as_markdown(result: dict[str, Any]) -> str:
    """Return a table of all kinds."""
    rows = [
        (name, found.get("loaded", 0), found.get("refused", 0), found["slowest_s"], found["broken"] or "no")
        for name, found in result["kinds"].items()
    ]
    text = (
        "Valid files of every kind, damaged at random (bytes changed, cut, extended, duplicated; arrays of "
        "other types and shapes) or crafted to do harm. Each must be loaded with finite numbers or refused "
        f"with the loader's own error, which names the file, within {CPU_S:g} s of processor time and "
        f"{MEMORY_BYTES / 2**30:g} GiB, without unpickling: [foreign files](../foreign_files.md)."
    )
    return f"{text}\n\n{table('kind of file | loaded | refused | slowest, s | promise broken', rows)}"
