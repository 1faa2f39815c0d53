"""What ``eval_agent.py`` refuses before it flies: numbers, files, tracks and checkpoints of no use."""

import os
from dataclasses import replace
from pathlib import Path

import pytest

import eval_agent
from baselines.purejaxrl_ppo.checkpoint import load_checkpoint, save_checkpoint
from flytrack_env import load_track, save_track
from flytrack_env.tracks import random_track
from tests.support.evaluated import run, write_checkpoint


def make_bad_files(folder: Path) -> None:
    """Write what is refused: a policy of before the model was told, tracks without a reference."""
    old = load_checkpoint(write_checkpoint(folder / "policy.msgpack"))
    meta = {name: value for name, value in old.meta.items() if name != "model"}
    save_checkpoint(folder / "no_model.msgpack", old.params, old.config, meta)
    save_track(folder / "random.toml", random_track(0))
    moved = load_track("flytrack")
    moved = replace(moved, start_position=(moved.start_position[0] + 0.5, *moved.start_position[1:]))
    save_track(folder / "moved.toml", moved)
    (folder / "file").write_text("")


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        (["--episodes", "0"], ["--episodes: found 0", "expected 1 to"]),
        (["--episodes", "2000000"], ["--episodes: found 2000000"]),
        (["--plants", "0"], ["--plants: found 0"]),
        (["--plants", "2000", "--episodes", "1000"], ["--plants: found 2000", "expected 1 to 100"]),
        (["--plants", "2", "--black-box", "any.bin"], ["--plants", "--black-box any.bin", "one of the two"]),
        (["--plants", "2", "--checkpoint", "no_model.msgpack"], ["model", "found none"]),
        (["--laps", "0"], ["--laps: found 0"]),
        (["--steps", "10000000"], ["--steps: found 10000000"]),
        (["--seed", "-1"], ["--seed: found -1"]),
        (["--track", "nowhere"], ["nowhere", "flytrack"]),
        (["--track", "random.toml", "--ghost"], ["found no 'random", "expected one of", "flytrack_nominal"]),
        (["--track", "moved.toml", "--ghost"], ["flytrack", "another track of that name"]),
        (["--out", "."], ["--out: . is a folder"]),
        (["--out", "policy.msgpack"], ["--out: found policy.msgpack, which is read"]),
        (["--out", "locked/rollout.npy"], ["--out: locked/rollout.npy", "no permission to write"]),
        (["--json", "file/report.json"], ["--json", "found a file", "expected a folder"]),
        (["--json", "rollout_ghost.npy"], ["--json", "the rollout of the ghost, expected another file"]),
        (["--rrd", "rollout.npy"], ["--rrd", "which is that of --out, expected another file"]),
        (["--rrd", "a.rrd", "--json", "a.rrd"], ["--json", "which is that of --rrd, expected another file"]),
        (["--rrd", "."], ["--rrd", "is a folder"]),
        (["--checkpoint", "file"], ["file", "not a checkpoint"]),
    ],
)
def test_command_refuses_before_it_flies(
    arguments: list[str],
    messages: list[str],
    bad_files: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(bad_files)
    # Whoever runs the tests as root may write anywhere.
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "locked")
    monkeypatch.setattr(eval_agent, "fly_scene", lambda *_: pytest.fail("it flew"))
    with pytest.raises(SystemExit) as ended:
        run(monkeypatch, "--checkpoint", "policy.msgpack", "--steps", "5", *arguments)
    said = capsys.readouterr().err
    assert ended.value.code == 2 and all(message in said for message in messages), said


@pytest.fixture(scope="module")
def bad_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bad")
    make_bad_files(folder)
    (folder / "locked").mkdir()
    return folder
