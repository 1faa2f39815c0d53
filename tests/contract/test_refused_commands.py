"""Commands that cannot be run end with one sentence that says why, before any work."""

import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from baselines.purejaxrl_ppo import evaluate, load_checkpoint
from baselines.purejaxrl_ppo.checkpoint import save_checkpoint
from flytrack import identification
from flytrack_env import nominal_parameters, save_model, save_track
from flytrack_env.rollout import save_rollout
from flytrack_env.tracks import random_track
from flytrack_sysid import save_log
from tests.support.evaluated import write_checkpoint
from tests.support.handout_plant import HandoutPlant, excited
from tests.support.pages import ROOT
from tests.support.recordings import make_flight
from tests.support.refusals import refused
from tests.support.tables import table
from tests.support.written_logs import with_channels

CASES = table("refused_commands")
OWN = """
def hover(observation):
    return 0.1 * observation[:4]

def three(observation):
    return observation[:3]

def broken(x, u):
    raise RuntimeError("motors are off")
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Policies, rollouts, logs and models, some of which cannot be used, and the repository."""
    folder = tmp_path_factory.mktemp("refused")
    (folder / "repository").symlink_to(ROOT)
    (folder / "folder").mkdir()
    (folder / "file").write_text("")
    (folder / "own.py").write_text(OWN)
    suite = (
        (ROOT / "flytrack_bench" / "suites" / "misspec-v1.json").read_text().replace("60.0", "61.0")
    )
    (folder / "settings.toml").write_text("[gamma]\nchoice = [0.9]\n")
    (folder / "changed.json").write_text(suite)
    whole = load_checkpoint(write_checkpoint(folder / "policy.safetensors"))
    meta = {name: value for name, value in whole.meta.items() if name != "model"}
    save_checkpoint(folder / "no_model.safetensors", whole.params, whole.config, meta)
    save_track(folder / "random.toml", random_track(0))
    save_rollout(folder / "flight.npy", *make_flight(3))
    np.save(folder / "pickled.npy", np.array([[None, None]] * 3, object), allow_pickle=True)
    log = excited(HandoutPlant())
    log = log.select(log.segment < 8)
    wrong = with_channels(log, w=np.rad2deg(log["w"]))
    for name, content in (("log", log), ("degrees", wrong), ("short", log.select(slice(50)))):
        save_log(folder / f"{name}.npz", content)
    save_model(folder / "model.json", nominal_parameters(), {})
    for every in ("x", 0):
        learnt_from = {
            "data": {"file": "log.npz", "sha256": log.sha256},
            "split": {"held_out_every": every},
        }
        save_model(folder / f"held_out_{every}.json", nominal_parameters(), learnt_from)
    return folder


def written(folder):
    """Return the files in a folder, and when each was written."""
    paths = [Path(parent, name) for parent, _, names in os.walk(folder) for name in names]
    return {path: path.stat().st_mtime_ns for path in paths if path.suffix != ".pyc"}


@pytest.mark.parametrize("command", CASES)
def test_what_cannot_be_run_is_told_before_any_work(command, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.setattr(evaluate, "can_record", lambda: True)
    monkeypatch.setattr(evaluate.Report, "fly", lambda _: pytest.fail("it flew"))
    monkeypatch.setattr(identification, "motion_of", pytest.fail)
    before = written(folder)
    assert re.search(CASES[command], refused(capsys, *shlex.split(command)))
    assert written(folder) == before
