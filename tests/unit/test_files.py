"""Files written atomically, and new folders."""

import errno
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import Mock

import pytest

from flytrack_env.files import fresh_folder, locked_folder, write_atomically


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "new" / "file"
    write_atomically(path, b"before")
    with monkeypatch.context() as patch, pytest.raises(OSError, match="no more"):
        patch.setattr(os, "replace", Mock(side_effect=OSError("no more")))
        write_atomically(path, b"after")
    assert path.read_bytes() == b"before" and os.listdir(path.parent) == ["file"]
    (tmp_path / "link").symlink_to(path)
    write_atomically(tmp_path / "link", b"after")
    assert path.read_bytes() == b"after" and (tmp_path / "link").is_symlink()


def test_a_full_disk_names_the_file(tmp_path, monkeypatch):
    def fail(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match=r"No space left on device: '.*a\.txt'") as caught:
        write_atomically(tmp_path / "a.txt", b"content")
    assert caught.value.errno == errno.ENOSPC and not list(tmp_path.iterdir())


def test_fresh_folders_are_new(tmp_path):
    wanted = tmp_path / "runs" / "demo"
    assert fresh_folder(wanted) == wanted and wanted.is_dir()
    wanted.with_name("demo_2").write_text("a file")
    assert fresh_folder(wanted) == wanted.with_name("demo_3")


def test_no_two_callers_are_given_the_same_folder(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: fresh_folder(tmp_path / "demo"), range(40)))
    assert len(set(folders)) == 40 and all(folder.is_dir() for folder in folders)


HOLD = """
import sys, time
from pathlib import Path
from flytrack_env.files import locked_folder
with locked_folder(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_folder_is_held_by_one_process_until_it_ends(tmp_path):
    folder = tmp_path / "runs"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout.readline() == "held\n"
        with (
            pytest.raises(OSError, match=f"{folder}: found in use by process {holder.pid}: -c"),
            locked_folder(folder),
        ):
            pass
        holder.kill()
    with locked_folder(folder), locked_folder(folder):  # a command, and the training in it
        assert os.listdir(tmp_path) == [".runs.lock"]
    assert os.listdir(tmp_path) == []
