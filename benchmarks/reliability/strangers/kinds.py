"""Every kind of file that is read: how it is written, damaged and loaded, and what may come of it."""

import gzip
import io
import json
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from baselines.purejaxrl_ppo import CheckpointError, load_checkpoint
from baselines.purejaxrl_ppo.config import ConfigError, settings_in_file
from benchmarks.reliability.strangers import (
    archives,
    crafted_arrays,
    crafted_logs,
    crafted_packed,
    crafted_programs,
    crafted_texts,
    flight_logs,
    packed,
    programs,
    seeds,
    soundness,
)
from benchmarks.reliability.strangers.kind import Hostile, Kind, Mutator
from benchmarks.reliability.strangers.noise import Rng, damage, damage_cells, damage_text
from benchmarks.reliability.strangers.resuming import resume, write_trainings
from benchmarks.reliability.strangers.trees import as_json, as_toml, damage_tree
from flytrack_env import ModelFileError, TrackError, load_model, load_provenance, load_track
from flytrack_env.blackbox import BlackBoxError
from flytrack_env.blackbox import load as load_black_box
from flytrack_env.references import ReferenceFileError, load_reference
from flytrack_env.rollout import RolloutError, load_rollout
from flytrack_sysid import LogError, ScriptError, import_log, load_log, load_script
from flytrack_sysid.importing import load_mapping


def _either(*ways: tuple[float, Mutator]) -> Mutator:
    """Return a mutator that damages in one of some ways; shares."""

    def mutate(rng: Rng, contents: list[bytes]) -> bytes:
        way = rng.choice(len(ways), p=[share for share, _ in ways])
        return ways[int(way)][1](rng, contents)

    return mutate


def _one(rng: Rng, contents: Sequence[bytes]) -> bytes:
    return contents[int(rng.integers(len(contents)))]


def _json(rng: Rng, contents: list[bytes]) -> bytes:
    return as_json(rng, damage_tree(rng, json.loads(_one(rng, contents))))


def _toml(rng: Rng, contents: list[bytes]) -> bytes:
    return as_toml(damage_tree(rng, tomllib.loads(_one(rng, contents).decode())))


def _arrays(content: bytes) -> archives.Arrays:
    with np.load(io.BytesIO(content)) as file:
        return dict(file)


def _npz(rng: Rng, contents: list[bytes]) -> bytes:
    return archives.damage_npz(rng, _arrays(_one(rng, contents)), {})


def _npy(rng: Rng, contents: list[bytes]) -> bytes:
    return archives.damage_npy(rng, np.load(io.BytesIO(_one(rng, contents))))


def _reference(rng: Rng, contents: list[bytes]) -> bytes:
    arrays = _arrays(_one(rng, contents))
    notes = json.loads(str(arrays["notes"]))

    def damaged(rng: Rng) -> str:
        return as_json(rng, damage_tree(rng, notes)).decode(errors="replace")

    return archives.damage_npz(rng, arrays, {"notes": damaged})


def _of_arrays(hostile: Callable[[archives.Arrays], list[bytes]]) -> Hostile:
    """Return what makes hostile archives of the first that is well."""
    return lambda contents: hostile(_arrays(contents[0]))


def _of_texts(hostile: Hostile) -> Hostile:
    """Return what makes hostile texts: those of a kind, and such as are long in one way each."""
    return lambda contents: [*hostile(contents), *crafted_texts.endless(contents)]


def _packed_text(rng: Rng, contents: list[bytes]) -> bytes:
    text = damage_text(rng, [gzip.decompress(_one(rng, contents))])
    return gzip.compress(text, 1, mtime=0)


def _import(form: str) -> Callable[[Path], Any]:
    def load(path: Path) -> Any:
        mapping = path.parent / "map.toml"
        if form == "csv" and not mapping.exists():
            mapping.write_text(seeds.MAPPING)
        return import_log(path, form, mapping if form == "csv" else None)

    return load


def _import_by_mapping(path: Path) -> Any:
    """Return a log that fits, imported by a stranger's mapping."""
    log = path.with_name("file.csv")
    if not log.exists():
        log.write_text(seeds.foreign_csv())
        path.with_name("manifest.csv").write_text(seeds.MANIFEST)
    return import_log(log, "csv", load_mapping(path))


_TEXT = _either((0.3, damage), (0.35, damage_text), (0.35, _toml))
_ARRAYS = _either((0.3, damage), (0.7, _npz))
_TABLE = _either((0.2, damage), (0.4, damage_text), (0.4, damage_cells))

KINDS: dict[str, Kind] = {
    "track": Kind(
        ".toml",
        seeds.write_tracks,
        load_track,
        TrackError,
        soundness.track,
        _TEXT,
        _of_texts(crafted_texts.tomls),
    ),
    "model": Kind(
        ".json",
        seeds.write_models,
        lambda path: (load_model(path), load_provenance(path)),
        ModelFileError,
        soundness.model,
        _either((0.3, damage), (0.3, damage_text), (0.4, _json)),
        _of_texts(crafted_texts.models),
    ),
    "rollout": Kind(
        ".npy",
        seeds.write_rollouts,
        load_rollout,
        RolloutError,
        soundness.rollout,
        _either((0.3, damage), (0.7, _npy)),
        lambda contents: crafted_arrays.hostile_rollouts(np.load(io.BytesIO(contents[0]))),
    ),
    "log_npz": Kind(
        ".npz",
        seeds.write_logs(".npz"),
        load_log,
        LogError,
        soundness.log,
        _ARRAYS,
        _of_arrays(crafted_arrays.hostile_logs),
    ),
    "log_csv": Kind(
        ".csv",
        seeds.write_logs(".csv"),
        load_log,
        LogError,
        soundness.log,
        _TABLE,
        _of_texts(crafted_texts.logs_csv),
    ),
    "script": Kind(
        ".npz",
        seeds.write_scripts,
        load_script,
        ScriptError,
        soundness.script,
        _ARRAYS,
        _of_arrays(crafted_arrays.hostile_scripts),
    ),
    "reference": Kind(
        ".npz",
        seeds.write_references,
        load_reference,
        ReferenceFileError,
        soundness.reference,
        _either((0.3, damage), (0.7, _reference)),
        _of_arrays(crafted_arrays.hostile_references),
    ),
    "mapping": Kind(
        ".toml",
        seeds.write_mappings,
        _import_by_mapping,
        LogError,
        soundness.imported,
        _TEXT,
        _of_texts(crafted_texts.mappings),
    ),
    "import_csv": Kind(
        ".csv",
        seeds.write_foreign_csv,
        _import("csv"),
        LogError,
        soundness.imported,
        _TABLE,
        _of_texts(crafted_texts.imported_csvs),
    ),
    "import_gz": Kind(
        ".csv.gz",
        seeds.write_packed_csv,
        _import("csv"),
        LogError,
        soundness.imported,
        _either((0.5, damage), (0.5, _packed_text)),
        crafted_logs.packed_csvs,
    ),
    "ulog": Kind(
        ".ulg",
        seeds.write_ulogs,
        _import("ulog"),
        LogError,
        soundness.imported,
        _either((0.4, damage), (0.6, flight_logs.damage_ulog)),
        crafted_logs.ulogs,
    ),
    "betaflight": Kind(
        ".bbl",
        seeds.write_blackboxes,
        _import("betaflight"),
        LogError,
        soundness.imported,
        _either((0.4, damage), (0.6, flight_logs.damage_blackbox)),
        crafted_logs.blackboxes,
    ),
    "settings": Kind(
        ".toml",
        seeds.write_settings,
        settings_in_file,
        ConfigError,
        soundness.settings,
        _TEXT,
        _of_texts(crafted_texts.settings),
    ),
    "checkpoint": Kind(
        ".msgpack",
        seeds.write_policies,
        load_checkpoint,
        CheckpointError,
        soundness.checkpoint,
        _either((0.3, damage), (0.7, packed.damage_checkpoint)),
        crafted_packed.hostile_policies,
    ),
    "resume": Kind(
        ".msgpack",
        write_trainings,
        resume,
        CheckpointError,
        soundness.runner,
        _either((0.1, damage), (0.9, packed.damage_checkpoint)),
        crafted_packed.hostile_trainings,
    ),
    "black_box": Kind(
        ".bin",
        programs.write_plants,
        load_black_box,
        BlackBoxError,
        soundness.black_box,
        _either((0.4, damage), (0.6, programs.damage_program)),
        crafted_programs.on_purpose,
    ),
}
