"""Lines of benchmarks: those of other commits count where the measured code is the same."""

import subprocess

import pytest

from benchmarks import diagnosis, report


@pytest.fixture
def commit_of(tmp_path, monkeypatch):
    """Write files into a repository, commit them, and return the commit."""
    monkeypatch.setattr(report, "ROOT", tmp_path)

    def git(*command):
        author = "-c", "user.name=a", "-c", "user.email=a@b.c"
        run = subprocess.run(
            ["git", *author, *command], cwd=tmp_path, check=True, capture_output=True, text=True
        )
        return run.stdout.strip()

    def commit(**files):
        for name, text in files.items():
            (tmp_path / name).write_text(text)
        git("add", ".")
        git("commit", "-m", "files")
        return git("describe", "--always")

    git("init")
    return commit


def test_the_measured_code_is_where_it_says():
    assert [path for path in diagnosis.CODE if not (report.ROOT / path).exists()] == []


def test_lines_of_a_commit_with_the_same_code_count(commit_of, tmp_path):
    first = commit_of(code="a", other="a")
    second = commit_of(code="b", other="a")
    third = commit_of(code="b", other="b")
    path = tmp_path / "lines.jsonl"
    for commit in (first, second, f"{third}-dirty", "unknown", third):
        report.append_line(path, {"commit": commit})
    of_code = report.lines_of_commit(path, code=["code"])
    assert report.list_commits(of_code) == [second, third]
    assert report.list_commits(report.lines_of_commit(path)) == [third]
    assert report.lines_of_commit(path, first, ["code"]) == [{"commit": first}]
