"""Before and after: what both logs lack is no cause, and what changed is named and measured."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.diagnosis import model_of
from benchmarks.hidden import draw_base, draw_outside, fly, measure
from flytrack.cli import main
from flytrack_env import save_model
from flytrack_env.motion import Motion
from flytrack_sysid import diagnose_change, save_log

SECONDS = 30.0
DRAG = {"d_x": 0.4, "d_y": 0.4, "d_z": 0.2}
BASE = replace(draw_base(np.random.default_rng(3)), motion="fine")
# A force that no list has, before and after alike.
BOTH = replace(BASE, outside=draw_outside(np.random.default_rng(4), "heading", 2.0))


def log_of(truth, seed):
    rng = np.random.default_rng(seed)
    return measure(fly(truth, "scripted", SECONDS, rng), "sensors", rng)


@pytest.fixture(scope="module")
def before():
    return log_of(BOTH, 0)


@pytest.mark.slow
def test_what_both_logs_lack_is_no_cause(before) -> None:
    found = diagnose_change(log_of(BOTH, 1), before, model_of(BASE), motion=Motion.CONTINUOUS)
    assert found.verdict == "consistent" and found.causes == () and not found.unexplained.flagged


@pytest.mark.slow
def test_what_changed_is_named_by_the_command(before, tmp_path: Path, capsys) -> None:
    after = log_of(replace(BOTH, effects={"linear_drag": DRAG}), 2)
    files = [tmp_path / name for name in ("after.npz", "before.npz", "model.json")]
    save_log(files[0], after)
    save_log(files[1], before)
    save_model(files[2], model_of(BASE), {})
    flags = ["--model", str(files[2]), "--before", str(files[1]), "--out", str(tmp_path / "report")]
    main(["diagnose", str(files[0]), *flags])
    said = capsys.readouterr().out
    assert "verdict: causes_found\n" in said and "linear_drag: d_x" in said
    assert (tmp_path / "report" / "extended_model.json").exists()
