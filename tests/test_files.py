"""Folders in which nothing is lost."""

from flytrack_env.files import fresh_folder, write_atomically


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
