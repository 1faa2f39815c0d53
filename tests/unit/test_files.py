"""Files written together or not at all, and new folders."""

import os
from concurrent.futures import ThreadPoolExecutor

import pytest

from flytrack_env.files import fresh_folder, write_together


def test_files_that_cannot_be_renamed_leave_none_that_is_new(tmp_path, monkeypatch):
    paths = [tmp_path / name for name in ("old", "new", "last")]
    paths[0].write_bytes(b"before")
    replace = os.replace

    def fail(source, target):
        if target == paths[2]:
            raise OSError("no more")
        replace(source, target)

    with monkeypatch.context() as patch, pytest.raises(OSError, match="no more"):
        patch.setattr(os, "replace", fail)
        write_together((path, b"after") for path in paths)
    assert [path.name for path in tmp_path.iterdir()] == ["old"]
    write_together((path, b"after") for path in paths)
    assert {path.read_bytes() for path in tmp_path.iterdir()} == {b"after"}


def test_fresh_folders_are_new(tmp_path):
    wanted = tmp_path / "runs" / "demo"
    assert fresh_folder(wanted) == wanted and wanted.is_dir()
    wanted.with_name("demo_2").write_text("a file")
    assert fresh_folder(wanted) == wanted.with_name("demo_3")


def test_no_two_callers_are_given_the_same_folder(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: fresh_folder(tmp_path / "demo"), range(40)))
    assert len(set(folders)) == 40 and all(folder.is_dir() for folder in folders)
