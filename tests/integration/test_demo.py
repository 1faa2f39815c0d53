"""The demo, small: everything that it writes."""

import contextlib
import io
import json
from pathlib import Path

import numpy as np
import pytest

from baselines.purejaxrl_ppo.monitor import count_positions, draw_position_density
from flytrack.cli import main
from flytrack_env import load_model, load_track


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


def test_density_counts_positions_in_bins(tmp_path: Path) -> None:
    positions = np.array([[10.02, 10.03, 1.0]] * 50 + [[10.02, 10.13, 2.0]] * 7 + [[1e3, 0.0, 1.0]])
    density, x_edges, y_edges = count_positions(positions, load_track("flytrack"))
    assert np.allclose(np.diff(x_edges), 0.1) and np.allclose(np.diff(y_edges), 0.1)
    column, row = np.searchsorted(x_edges, 10.02) - 1, np.searchsorted(y_edges, 10.03) - 1
    assert (density[column, row], density[column, row + 1], density.sum()) == (50, 7, 57)
    draw_position_density(tmp_path / "density.png", positions, load_track("flytrack"), 4)
    assert (tmp_path / "density.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
