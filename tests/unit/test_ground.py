"""Rows on the ground are found, and rows of flight are not taken for them."""

import numpy as np
import pytest

from flytrack_sysid import LogError, import_log
from flytrack_sysid.importing.ground import find_ground
from tests.support.foreign_logs import (
    blackbox,
    blackbox_frames,
    flying,
    write_betaflight,
    write_csv,
)
from tests.support.grounded_flights import (
    END_S,
    LANDING_S,
    STEP_S,
    TAKE_OFF_S,
    falls,
    stands_flies_and_lands,
    with_pose,
)
from tests.support.handout_plant import GRAVITY
from tests.support.real_logs import shared
from tests.support.slow import slow_but
from tests.support.tables import table

SLACK_S = 0.6  # two blocks and the one beside them


SENSORS = table("ground_sensors")


@pytest.mark.parametrize("name", SENSORS)
def test_what_is_measured_decides_whether_the_ground_shows(name):
    absent, is_shown = SENSORS[name]
    log = with_pose(stands_flies_and_lands())
    is_ground = find_ground([log.without(*absent)])[0]
    is_flight = (log.time > TAKE_OFF_S + SLACK_S) & (log.time < LANDING_S - SLACK_S)
    assert not is_ground[is_flight].any()
    assert (
        is_ground[log.time < TAKE_OFF_S].all() == is_ground[log.time > LANDING_S].all() == is_shown
    )


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("throttle", [0.0, 0.1])
@pytest.mark.parametrize("kind", ["ballistic", "descent"])
def test_falls_are_flight(kind, throttle, noise):
    for terminal_speed in (8.0, 12.0, 25.0):
        for seed in range(2):
            log = falls(kind, noise, terminal_speed, throttle, seed)
            assert not find_ground([log])[0].any()
    if kind == "descent":  # the end of it alone looks like a craft that stands
        assert find_ground([log.select(log.time > 15.0)])[0].any()


def test_a_low_drop_onto_the_ground_is_a_landing():
    log = stands_flies_and_lands()
    is_drop = (log.time >= LANDING_S) & (log.time < LANDING_S + 0.9)
    log["f"][is_drop] = 0.0  # 4 m, and a hit that the accelerometer cannot measure in full
    log["f"][np.flatnonzero(is_drop)[-1] + 1] = [0.0, 0.0, 16.0 * GRAVITY]
    is_ground = find_ground([log])[0]
    assert is_ground[log.time > LANDING_S + 0.9 + SLACK_S].all()
    assert not is_ground[(log.time > LANDING_S - 2.0) & (log.time < LANDING_S + 0.5)].any()


def test_calm_hover_is_flight():
    log = stands_flies_and_lands()
    is_hover = (log.time > TAKE_OFF_S + 2.0) & (log.time < TAKE_OFF_S + 6.0)
    log["u"][is_hover] = [0.0, 0.0, 0.0, -0.2]
    log["w"][is_hover], log["f"][is_hover] = 0.0, [0.0, 0.0, GRAVITY]
    is_ground = find_ground([log])[0]
    assert not is_ground[is_hover].any() and is_ground[log.time < TAKE_OFF_S].all()
    assert not find_ground([log.select(is_hover)])[0].any()


def test_a_log_on_the_ground_beside_flights_is_no_flight(tmp_path):
    """Its throttle reaches 7 % of its range, more than a fixed limit would have it."""
    pytest.importorskip("orangebox")
    flight = stands_flies_and_lands()
    standing = flight.select(flight.time < TAKE_OFF_S - 0.1)
    standing["u"][:, 3] = 2.0 * 0.07 - 1.0
    logs = [blackbox(blackbox_frames(log)) for log in (flight, standing, flight)]
    path, mapping = tmp_path / "a.bbl", tmp_path / "map.toml"
    path.write_bytes(b"".join(logs))
    imported = import_log(path, "betaflight")
    assert [source.rpartition(", ")[2] for source in imported.sources] == ["log 1", "log 3"]
    assert f"log 2: nothing flies: on the ground in all {len(standing)} rows" in imported.notes[-1]
    mapping.write_text("[rows]\nlogs = [3]\nranges_s = [[6, 8], [10, 11.5]]\n")
    chosen = import_log(path, "betaflight", mapping)
    assert [source.rpartition(", ")[2] for source in chosen.sources] == ["log 3"]
    times = STEP_S * np.arange(round(END_S / STEP_S))
    is_chosen = ((times >= 6.0) & (times <= 8.0)) | ((times >= 10.0) & (times <= 11.5))
    np.testing.assert_allclose(chosen.log.time, times[is_chosen], atol=1e-9)


@pytest.mark.parametrize(("form", "rows", "message"), table("csv_mappings")["rows"])
def test_wrong_rows_are_refused(tmp_path, form, rows, message):
    pytest.importorskip("orangebox")
    path = {"csv": write_csv, "betaflight": write_betaflight}[form](tmp_path, flying())[0]
    with (tmp_path / "map.toml").open("a") as mapping:
        mapping.write(f"[rows]\n{rows}\n")
    with pytest.raises(LogError, match=message):
        import_log(path, form, tmp_path / "map.toml")


REAL_FLIGHTS = {flight[0]: flight for flight in table("real_flights")["ground"]}
FAST_FLIGHT = "cf_arpl_motors/log15"  # on the ground at both ends


@pytest.mark.parametrize("name", slow_but([FAST_FLIGHT], REAL_FLIGHTS))
def test_real_flights_lose_their_ground_and_nothing_else(tmp_path, name):
    where, form, mapping, before_s, after_s = REAL_FLIGHTS[name]
    folder, _, file = where.partition("/")
    path = shared(folder) / file
    log = import_log(path, form, mapping or None, align=False).log
    keep = tmp_path / "map.toml"
    base = f'extends = "{mapping}"\n' if mapping else ""
    keep.write_text(base + '[rows]\non_ground = "keep"\n')
    whole = import_log(path, form, keep, align=False).log
    is_flight = (whole.time >= before_s) & (whole.time <= whole.time[-1] - after_s)
    assert abs(len(log) - is_flight.sum()) <= np.sum(whole.time < 0.05)
    assert log.time[0] >= before_s - 0.05
