"""Measured flights: black boxes on logs that have rates only, and the page of the records that are kept."""

import json
import re

import numpy as np
import pytest

from benchmarks import real_logs
from benchmarks.real import page
from benchmarks.real.black_boxes import _arx, base_steps, flown, linear, posed, rows_of
from flytrack_env.dynamics import nominal_parameters
from flytrack_sysid import FlightLog
from flytrack_sysid.prediction_windows import QUANTITIES, make_windows
from tests.support.slow import slow_but

STEP_S, LAG_S, GAIN = 0.01, 0.05, 10.0


def test_a_black_box_learns_a_lag_from_rates_alone():
    rng, num_rows = np.random.default_rng(5), 2000
    commands = np.clip(np.cumsum(rng.normal(size=(num_rows, 4)), axis=0) * 0.05 % 2.0 - 1.0, -1.0, 1.0)
    rates = np.zeros((num_rows, 3))
    for row in range(1, num_rows):
        rates[row] = rates[row - 1] + (GAIN * commands[row - 1, :3] - rates[row - 1]) * STEP_S / LAG_S
    log = FlightLog(STEP_S * np.arange(num_rows), {"u": commands, "w": rates}, np.zeros(num_rows, int))
    windows = make_windows(log, np.arange(num_rows) > num_rows // 2, 0.25, 100)
    assert [
        name for name, is_judged in zip(QUANTITIES, windows.counts.any(axis=(0, 1)), strict=True) if is_judged
    ] == ["rates"]
    rows = rows_of(posed(log), nominal_parameters())
    errors = flown(linear(rows, _arx), windows, base_steps(nominal_parameters(), posed(log))).rms()[0]
    assert np.all(errors[:2, QUANTITIES.index("rates")] < 0.05 * rates.std())
    assert np.isnan(errors[:, QUANTITIES.index("position")]).all()


def test_fits_of_one_drone_agree_where_intervals_overlap_and_times_are_within_5_ms(tmp_path, monkeypatch):
    fits = [
        {
            "policy": policy,
            "values": {"tau_roll": [tau, 0.01]},
            "half_response_s": {"roll": 0.03, "yaw": late},
        }
        for policy, tau, late in (("48", 0.03, 0.1), ("49", 0.045, 0.104), ("50", 0.06, 0.11))
    ]
    path = tmp_path / "fits.json"
    path.write_text(json.dumps(fits))
    monkeypatch.setattr(page, "FITS", path)
    ends = {line.split(" | ")[0]: line.split(" | ")[-1] for line in page.fits_part().splitlines()}
    assert ends == ends | {
        "| `tau_roll`": "2 of 3 |",
        "| half response, roll": "3 of 3 |",
        "| half response, yaw": "1 of 3 |",
    }


@pytest.mark.parametrize("name", slow_but(["crazyflie"], real_logs.CRAFTS))
def test_every_record_gives_a_section_with_a_paragraph_and_its_picture(name):
    if not real_logs.kept(name).exists():
        pytest.skip(f"no record of {name}")
    text, pictures = real_logs.page()
    part = text.partition(f"## {real_logs.CRAFTS[name].title}\n")[2].partition("\n## ")[0]
    assert "From a small step of the stick" in part and not re.search(r"\bnan\b|None", part)
    shown = set(re.findall(r"\((real_.*\.png)\)", part))
    assert shown and shown <= set(pictures)
