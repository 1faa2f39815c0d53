"""Every loader, given what is no file: pipes, sockets, devices, folders. It refuses, and does not wait."""

import os
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from baselines.purejaxrl_ppo import CheckpointError, load_checkpoint
from baselines.purejaxrl_ppo.config import ConfigError, settings_in_file
from baselines.purejaxrl_ppo.resume import newest_intact
from benchmarks.reliability.strangers import seeds
from flytrack_env import ModelFileError, TrackError, blackbox, load_model, load_provenance, load_track
from flytrack_env.references import ReferenceFileError, load_reference
from flytrack_env.rollout import RolloutError, load_rollout
from flytrack_sysid import LogError, ScriptError, import_log, load_log, load_script
from flytrack_sysid.importing import load_mapping

WAIT_S = 5
MAPPING = "[time]\nstep_s = 0.01\n[command]\ncolumns = ['a', 'b', 'c', 'd']\n"


def _imported(form: str) -> Callable[[Path], Any]:
    def load(path: Path) -> Any:
        mapping = path.with_name("mapping_of_csv.toml")
        mapping.write_text(MAPPING)
        return import_log(path, form, mapping if form == "csv" else None)

    return load


def _counted(path: Path) -> Any:
    """Import a log of which the path is the manifest."""
    log, mapping = path.with_name("log.csv"), path.with_name("mapping_of_log.toml")
    log.write_text(seeds.foreign_csv())
    mapping.write_text(seeds.SHORT_MAPPING.replace("manifest.csv", path.name))
    return import_log(log, "csv", mapping)


LOADERS: dict[str, tuple[str, Callable[[Path], Any], type[Exception]]] = {
    "track": (".toml", load_track, TrackError),
    "model": (".json", load_model, ModelFileError),
    "provenance": (".json", load_provenance, ModelFileError),
    "rollout": (".npy", load_rollout, RolloutError),
    "old rollout": (".npy", lambda path: load_rollout(path, allow_pickle=True), RolloutError),
    "reference": (".npz", load_reference, ReferenceFileError),
    "log .npz": (".npz", load_log, LogError),
    "log .csv": (".csv", load_log, LogError),
    "script": (".npz", load_script, ScriptError),
    "import of CSV": (".csv", _imported("csv"), LogError),
    "import of compressed CSV": (".csv.gz", _imported("csv"), LogError),
    "import of PX4": (".ulg", _imported("ulog"), LogError),
    "import of Betaflight": (".bbl", _imported("betaflight"), LogError),
    "mapping": (".toml", load_mapping, LogError),
    "manifest": (".csv", _counted, LogError),
    "settings": (".toml", settings_in_file, ConfigError),
    "checkpoint": (".msgpack", load_checkpoint, CheckpointError),
    "resume": (".msgpack", newest_intact, CheckpointError),
    "black box": (".bin", blackbox.load, blackbox.BlackBoxError),
}
MAY_BE_EMPTY = ("mapping", "settings")
ODD = ("pipe", "socket", "folder", "/dev/zero", "/dev/null")


@pytest.fixture
def alarm() -> Iterator[None]:
    """End a test that waits for what never comes."""

    class NoAnswer(BaseException):
        """Which no loader takes for what is wrong with a file."""

    def ring(*_: Any) -> None:
        raise NoAnswer(f"for {WAIT_S} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(WAIT_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def _make(path: Path, odd: str) -> None:
    if odd == "pipe":
        os.mkfifo(path)
    elif odd == "socket":
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(str(path))  # the file stays when it is closed
    elif odd == "folder":
        path.mkdir()
    else:
        path.symlink_to(odd)


@pytest.mark.parametrize("odd", ODD)
@pytest.mark.parametrize("kind", LOADERS)
def test_what_is_no_file_is_refused_at_once(
    kind: str, odd: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, alarm: None
) -> None:
    suffix, load, error = LOADERS[kind]
    monkeypatch.chdir(tmp_path)  # a socket's path is short
    path = Path(f"odd{suffix}")
    _make(path, odd)
    if odd == "/dev/null" and kind in MAY_BE_EMPTY:
        load(path)
        return
    with pytest.raises(error, match="odd"):
        load(path)
