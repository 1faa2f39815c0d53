"""The demo, small: everything that it writes; and the evaluation's rollout on the black box."""

import contextlib
import io
import json
import sys
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest

import demo
import eval_agent
from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.density import count_positions, draw_position_density
from flytrack_env import blackbox, load_model, load_track
from flytrack_env.rollout import load_rollout
from tests.support.black_boxes import SHIPPED
from tests.support.pages import ROOT

CHAMPION = next((ROOT / "baselines" / "purejaxrl_ppo" / "champion").glob("flytrack.*"))


@pytest.mark.slow
def test_demo_writes_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rerun")
    out, text = tmp_path / "demo", io.StringIO()
    monkeypatch.setattr(demo, "NUM_STEPS", 100)
    monkeypatch.setattr(demo, "NUM_EPISODES", 4)
    monkeypatch.setattr(demo, "collect", partial(demo.collect, minutes=1.0))
    arguments = ["demo.py", "--out", str(out), "--total-timesteps", str(Config().batch_size)]
    monkeypatch.setattr(sys, "argv", arguments)
    with contextlib.redirect_stdout(text):
        demo.main()
    names = {"model.json", "position_density.png", "rollout.npy", "rollout.rrd", "summary.json"}
    names |= {"rollout_top.png", "rollout_side.png", "rollout_commands.png", "flight_log.npz"}
    assert names <= {path.name for path in out.iterdir()} and list(out.glob("final.*"))
    summary = json.loads((out / "summary.json").read_text())
    assert summary["noisy_starts"]["episodes"] == 4
    assert load_model(out / "model.json").tau.shape == (4,)
    assert "noisy starts finish 3 laps" in text.getvalue()
    with pytest.raises(SystemExit):
        demo.main()  # it does not overwrite a run


@pytest.mark.slow
def test_eval_agent_writes_the_flight_of_the_black_box(tmp_path: Path, monkeypatch) -> None:
    out = tmp_path / "rollout.npy"
    arguments = ["eval_agent.py", "--checkpoint", str(CHAMPION), "--steps", "50", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", arguments)
    monkeypatch.chdir(ROOT)
    eval_agent.main()
    states, actions = load_rollout(out)
    assert len(states) == 50
    step = jax.jit(blackbox.load(SHIPPED).step_vector)
    for before, action, after in zip(states[:-1], actions[:-1], states[1:], strict=True):
        np.testing.assert_allclose(step(before, action), after, atol=1e-5)


def test_density_counts_positions_in_bins(tmp_path: Path) -> None:
    positions = np.array([[10.02, 10.03, 1.0]] * 50 + [[10.02, 10.13, 2.0]] * 7 + [[1e3, 0.0, 1.0]])
    density, x_edges, y_edges = count_positions(positions, load_track("flytrack"))
    assert np.allclose(np.diff(x_edges), 0.1) and np.allclose(np.diff(y_edges), 0.1)
    column, row = np.searchsorted(x_edges, 10.02) - 1, np.searchsorted(y_edges, 10.03) - 1
    assert (density[column, row], density[column, row + 1], density.sum()) == (50, 7, 57)
    draw_position_density(tmp_path / "density.png", positions, load_track("flytrack"), 4)
    assert (tmp_path / "density.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
