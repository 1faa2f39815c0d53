"""The demo, small: everything that it writes."""

import contextlib
import io
import json

import numpy as np
import pytest

from baselines.purejaxrl_ppo import monitor
from baselines.purejaxrl_ppo.flights import Score
from flytrack.cli import main
from flytrack.demo import describe_race
from flytrack_env import load_model, load_track


@pytest.mark.slow
def test_demo_writes_everything(tmp_path):
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
    assert summary["adapted"] is None and "not adapted: " in text.getvalue()  # nothing was learned
    assert "noisy starts finish 3 laps" in text.getvalue() and "nan s" not in text.getvalue()
    with pytest.raises(SystemExit):
        main(arguments)  # it does not overwrite a run


def test_times_of_laps_that_nobody_flew_are_left_out():
    nothing = Score(0.0, 0.0, float("nan"), float("nan"))
    assert describe_race(nothing, 16).endswith("on the black box; no lap was completed")
    first = Score(0.5, 8.0, 4.0, float("nan"))
    assert describe_race(first, 16).endswith("on the black box; first lap 4.00 s")


def test_density_is_time_per_flight_in_bins(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(monitor, "png_of", lambda figure, dpi: figures.append(figure) or b"png")
    positions = np.array([[10.02, 10.03, 1.0]] * 40 + [[10.02, 10.13, 2.0]] * 8 + [[1e3, 0.0, 1.0]])
    monitor.draw_position_density(tmp_path / "density.png", positions, load_track("flytrack"), 4)
    assert (tmp_path / "density.png").read_bytes() == b"png"
    times_ms = figures[0].axes[0].collections[0].get_array().compressed()
    assert sorted(times_ms) == pytest.approx([20.0, 100.0])
