"""Folders and files in which nothing is lost."""

import os

import pytest

from flytrack_env.files import fresh_folder, write_atomically, write_together


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


def test_a_folder_that_holds_something_is_never_chosen(tmp_path):
    wanted = tmp_path / "runs" / "demo"
    assert fresh_folder(wanted) == wanted and not wanted.exists()
    wanted.mkdir(parents=True)
    assert fresh_folder(wanted) == wanted
    for name in ("demo_2", "demo_3"):
        write_atomically(fresh_folder(wanted) / "final.msgpack", b"kept")
        assert fresh_folder(wanted) == wanted.with_name(name)
    (wanted.with_name("demo_3")).write_text("a file")
    assert fresh_folder(wanted) == wanted.with_name("demo_4")
