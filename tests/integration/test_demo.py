"""The demo, small: everything that it writes; and the evaluation's rollout on the black box."""

import contextlib
import io
import json
from pathlib import Path

import numpy as np
import pytest

from baselines.purejaxrl_ppo.monitor import count_positions, draw_position_density
from benchmarks.champion import CHAMPION
from flytrack.cli import main
from flytrack_env import load_model, load_track
from flytrack_env.rollout import load_rollout


@pytest.mark.slow
def test_demo_writes_everything(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    out, text = tmp_path / "demo", io.StringIO()
    arguments = ["demo", "--quick", "--out", str(out)]
    with contextlib.redirect_stdout(text):
        main(arguments)
    names = {"model.json", "position_density.png", "rollout.npy", "rollout.rrd", "summary.json"}
    names |= {"rollout_top.png", "rollout_side.png", "rollout_commands.png", "flight_log.npz"}
    assert names <= {path.name for path in out.iterdir()} and list(out.glob("final.*"))
    summary = json.loads((out / "summary.json").read_text())
    assert summary["noisy_starts"]["episodes"] == 16
    assert load_model(out / "model.json").tau.shape == (4,)
    assert "noisy starts finish 3 laps" in text.getvalue()
    with pytest.raises(SystemExit):
        main(arguments)  # it does not overwrite a run


@pytest.mark.slow
def test_eval_writes_the_flight_of_the_black_box_and_overwrites_no_other(
    tmp_path: Path, monkeypatch, fly_black_box
) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        main(["eval", "--checkpoint", str(CHAMPION), "--steps", "50"])
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {"eval", "eval_2"}
    states, actions = load_rollout(tmp_path / "runs/eval_2/rollout.npy")
    assert len(states) == 50
    for before, action, after in zip(states[:-1], actions[:-1], states[1:], strict=True):
        np.testing.assert_allclose(fly_black_box(before, action), after, atol=1e-5)


def test_density_counts_positions_in_bins(tmp_path: Path) -> None:
    positions = np.array([[10.02, 10.03, 1.0]] * 50 + [[10.02, 10.13, 2.0]] * 7 + [[1e3, 0.0, 1.0]])
    density, x_edges, y_edges = count_positions(positions, load_track("flytrack"))
    assert np.allclose(np.diff(x_edges), 0.1) and np.allclose(np.diff(y_edges), 0.1)
    column, row = np.searchsorted(x_edges, 10.02) - 1, np.searchsorted(y_edges, 10.03) - 1
    assert (density[column, row], density[column, row + 1], density.sum()) == (50, 7, 57)
    draw_position_density(tmp_path / "density.png", positions, load_track("flytrack"), 4)
    assert (tmp_path / "density.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
