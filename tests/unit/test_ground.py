"""Rows on the ground are found in every format, and rows of flight are not taken for them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flytrack_sysid import FlightLog, LogError, import_log
from flytrack_sysid.importing.ground import find_ground
from tests.support.foreign_logs import (
    BLACKBOX_HEADERS,
    BLACKBOX_NAMES,
    PARAMETERS,
    blackbox,
    constant,
    save_messages,
    ulog,
    usd_log,
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

SLACK_S = 0.6  # two blocks and the one beside them
MAPPING = """
[command]
columns = ["{0}u0", "{0}u1", "{0}u2", "{0}u3"]
[rates]
columns = ["{0}w0", "{0}w1", "{0}w2"]
unit = "rad/s"
frame = "flu"
[specific_force]
columns = ["{0}acc0", "{0}acc1", "{0}acc2"]
unit = "m/s^2"
frame = "flu"
[craft]
max_rate_deg_s = [500, 500, 500]
"""
COLUMNS = [
    f"{name}{axis}" for name, size in (("u", 4), ("w", 3), ("acc", 3)) for axis in range(size)
]


def write_csv(log: FlightLog, folder: Path) -> Path:
    values = np.column_stack([log.time, log["u"], log["w"], log["f"]])
    path = folder / "a.csv"
    np.savetxt(path, values, "%.9g", ",", header=",".join(["t", *COLUMNS]), comments="")
    (folder / "map.toml").write_text('[time]\ncolumn = "t"\nunit = "s"\n' + MAPPING.format(""))
    return path


def write_usd(log: FlightLog, folder: Path) -> Path:
    rows = np.column_stack([log.time, log["u"], log["w"], log["f"]])
    (folder / "a").write_bytes(usd_log({"fixedFrequency": (dict.fromkeys(COLUMNS, "f"), rows)}))
    (folder / "map.toml").write_text(MAPPING.format(""))
    return folder / "a"


def write_bag(log: FlightLog, folder: Path) -> Path:
    rows = np.column_stack([log["u"], log["w"], log["f"]])
    contents = (dict(zip(COLUMNS, map(float, row), strict=True)) for row in rows)
    times_ns = np.round(log.time * 1e9).astype(int)
    save_messages(
        folder / "a.mcap",
        (("/a", int(at), row) for at, row in zip(times_ns, contents, strict=True)),
    )
    (folder / "map.toml").write_text(MAPPING.format("/a:"))
    return folder / "a.mcap"


def frames_of(log: FlightLog) -> np.ndarray:
    """Return Betaflight's frames of a log.

    Setpoints and gyroscope are in deg/s, the accelerometer in 1/2048 g.
    """
    throttle = 500.0 * (log["u"][:, 3:] + 1.0)
    count = np.arange(len(log))
    columns = [count, 1e6 * log.time, 500.0 * log["u"][:, :3], throttle, 100.0 * log["v_bat"]]
    return np.round(np.column_stack([*columns, np.rad2deg(log["w"]), 2048.0 / GRAVITY * log["f"]]))


def write_betaflight(log: FlightLog, folder: Path) -> Path:
    (folder / "a.bbl").write_bytes(blackbox(frames_of(log), BLACKBOX_NAMES, BLACKBOX_HEADERS))
    (folder / "map.toml").write_text("[craft]\nmax_rate_deg_s = [500, 500, 500]\n")
    return folder / "a.bbl"


def write_ulog(log: FlightLog, folder: Path) -> Path:
    times = (1_000_000 + np.round(1e6 * log.time)).astype(int)
    flip = np.array([1.0, -1.0, -1.0])

    def rows(values: np.ndarray) -> list[tuple]:
        return [(int(at), *map(float, row)) for at, row in zip(times, values, strict=True)]

    setpoints = np.column_stack(
        [
            log["u"][:, :3] * np.deg2rad(500.0) * flip,
            np.zeros((len(log), 2)),
            -0.5 * (log["u"][:, 3] + 1.0),
        ]
    )
    axes = [("float", name, 0) for name in ("roll", "pitch", "yaw")]
    tables = {
        "vehicle_angular_velocity": ([("float", "xyz", 3)], rows(log["w"] * flip)),
        "vehicle_acceleration": ([("float", "xyz", 3)], rows(log["f"] * flip)),
        "vehicle_attitude": ([("float", "q", 4)], constant((1.0, 0.0, 0.0, 0.0), times)),
        "vehicle_rates_setpoint": ([*axes, ("float", "thrust_body", 3)], rows(setpoints)),
    }
    (folder / "a.ulg").write_bytes(ulog(tables, PARAMETERS))
    (folder / "map.toml").write_text("[craft]\nmax_rate_deg_s = [500, 500, 500]\n")
    return folder / "a.ulg"


WRITERS = {
    "csv": write_csv,
    "usd": write_usd,
    "bag": write_bag,
    "betaflight": write_betaflight,
    "ulog": write_ulog,
}


@pytest.mark.parametrize("form", WRITERS)
def test_ground_is_dropped_and_counted_in_every_format(tmp_path, form):
    pytest.importorskip(
        {"bag": "mcap", "betaflight": "orangebox", "ulog": "pyulog"}.get(form, "numpy")
    )
    truth = stands_flies_and_lands()
    path, mapping = WRITERS[form](truth, tmp_path), tmp_path / "map.toml"
    found = import_log(path, form, mapping, align=False)
    assert found.log.time[0] == pytest.approx(TAKE_OFF_S, abs=SLACK_S)
    assert found.log.time[-1] == pytest.approx(LANDING_S, abs=SLACK_S)
    assert np.diff(found.log.time).max() < 2.0 * STEP_S  # nothing in between is lost
    (note,) = [note for note in found.notes if "on the ground" in note]
    num_rows = len(truth) - (form == "ulog")  # interpolated at the last row of rates
    assert f"{num_rows - len(found.log)} of {num_rows} rows left out" in note or form == "ulog"
    text = mapping.read_text()
    mapping.write_text(text + '[rows]\non_ground = "keep"\n')
    kept = import_log(path, form, mapping, align=False)
    assert len(kept.log) >= num_rows and not any("on the ground" in note for note in kept.notes)
    mapping.write_text(text + f"[rows]\nto_s = {TAKE_OFF_S - 1.0}\n")
    with pytest.raises(
        LogError, match=r"nothing flies: on the ground in all \d+ rows; rows.on_ground ="
    ):
        import_log(path, form, mapping)


def without(log: FlightLog, *names: str) -> FlightLog:
    return replace(log, channels={name: log[name] for name in log.channels if name not in names})


# What is measured, and whether that can show the ground.
SENSORS = {
    "no accelerometer": (("f",), True),
    "no gyroscope": (("w",), True),
    "no velocity": (("v",), True),
    "attitude and gyroscope": (("f", "v"), False),
    "accelerometer only": (("w", "q", "v"), False),
}


@pytest.mark.parametrize("name", SENSORS)
def test_what_is_measured_decides_whether_the_ground_shows(name):
    absent, is_shown = SENSORS[name]
    log = with_pose(stands_flies_and_lands())
    if "w" in absent:  # attitude has to turn as the rates do, or nothing moves
        absent = tuple(one for one in absent if one != "v")
    is_ground = find_ground([without(log, *absent)])[0]
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
        for seed in range(5):
            log = falls(kind, noise, terminal_speed, throttle, seed)
            assert not find_ground([log])[0].any()
    if kind == "descent":  # the end of it alone looks like a craft that stands
        is_end = (log.time > 15.0) & (log.time < 19.8) | (log.time > 19.8)
        assert find_ground([log.select(is_end)])[0].any()


def test_a_low_drop_onto_the_ground_is_a_landing():
    log = stands_flies_and_lands()
    force, is_drop = log["f"].copy(), (log.time >= LANDING_S) & (log.time < LANDING_S + 0.9)
    force[is_drop] = 0.0  # 4 m, and a hit that the accelerometer cannot measure in full
    force[np.flatnonzero(is_drop)[-1] + 1] = [0.0, 0.0, 16.0 * GRAVITY]
    is_ground = find_ground([replace(log, channels={**log.channels, "f": force})])[0]
    assert is_ground[log.time > LANDING_S + 0.9 + SLACK_S].all()
    assert not is_ground[(log.time > LANDING_S - 2.0) & (log.time < LANDING_S + 0.5)].any()


def test_calm_hover_is_flight():
    log = stands_flies_and_lands()
    is_hover = (log.time > TAKE_OFF_S + 2.0) & (log.time < TAKE_OFF_S + 6.0)
    channels = {name: values.copy() for name, values in log.channels.items()}
    channels["u"][is_hover] = [0.0, 0.0, 0.0, -0.2]
    channels["w"][is_hover], channels["f"][is_hover] = 0.0, [0.0, 0.0, GRAVITY]
    is_ground = find_ground([replace(log, channels=channels)])[0]
    assert not is_ground[is_hover].any() and is_ground[log.time < TAKE_OFF_S].all()
    alone = replace(log, channels=channels).select(is_hover)
    assert not find_ground([alone])[0].any()


def test_a_log_on_the_ground_beside_flights_is_no_flight(tmp_path):
    """Its throttle reaches 7 % of its range, more than a fixed limit would have it."""
    pytest.importorskip("orangebox")
    flight = stands_flies_and_lands()
    standing = flight.select(flight.time < TAKE_OFF_S - 0.1)
    standing["u"][:, 3] = 2.0 * 0.07 - 1.0
    logs = [
        blackbox(frames_of(log), BLACKBOX_NAMES, BLACKBOX_HEADERS)
        for log in (flight, standing, flight)
    ]
    path, mapping = tmp_path / "a.bbl", tmp_path / "map.toml"
    path.write_bytes(b"".join(logs))
    found = import_log(path, "betaflight")
    assert [source.rpartition(", ")[2] for source in found.sources] == ["log 1", "log 3"]
    assert f"log 2: nothing flies: on the ground in all {len(standing)} rows" in found.notes[-1]
    mapping.write_text("[rows]\nlogs = [3]\nranges_s = [[6, 8], [10, 11.5]]\n")
    chosen = import_log(path, "betaflight", mapping)
    assert [source.rpartition(", ")[2] for source in chosen.sources] == ["log 3"]
    times = STEP_S * np.arange(round(END_S / STEP_S))
    is_chosen = ((times >= 6.0) & (times <= 8.0)) | ((times >= 10.0) & (times <= 11.5))
    np.testing.assert_allclose(chosen.log.time, times[is_chosen], atol=1e-9)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("logs = [4]", r"map\.toml: rows\.logs: found 4, expected 1 to 1 of .*a\.bbl"),
        ("logs = [0]", r"rows\.logs\[0\]: found 0, expected a whole number from 1"),
        ("ranges_s = [[3, 2]]", r"rows\.ranges_s: found .*, expected the lower one first"),
        ('on_ground = "fly"', r"rows\.on_ground: found 'fly', expected one of drop, keep"),
    ],
)
def test_wrong_rows_are_refused(tmp_path, rows, message):
    pytest.importorskip("orangebox")
    path = write_betaflight(stands_flies_and_lands(), tmp_path)
    (tmp_path / "map.toml").write_text(f"[rows]\n{rows}\n")
    with pytest.raises(LogError, match=message):
        import_log(path, "betaflight", tmp_path / "map.toml")
    csv = write_csv(stands_flies_and_lands(), tmp_path)
    (tmp_path / "map.toml").write_text((tmp_path / "map.toml").read_text() + "[rows]\nlogs = [1]\n")
    with pytest.raises(LogError, match=r"rows\.logs: a file of format csv holds one log"):
        import_log(csv, "csv", tmp_path / "map.toml")


# Folder, file, format, mapping -> seconds on the ground at the start and the end, by the motors'
# outputs. NanoBench's mapping chooses heights.
REAL = {
    "Gecko": ("bf_gecko/btfl_002.bbl", "betaflight", None, 1.25, 0.0),
    "6S acro": ("betaflight_acro_log/shortLog.BFL", "betaflight", None, 2.25, 0.0),
    "PX4": (
        "px4_h520/3DRFlight_1.ulg",
        "ulog",
        None,
        0.0,
        1.82,
    ),  # its own detector says so 0.8 s later
    "Crazyflie": (
        "crazyflie_rate_flights/seed00066_log3.csv.gz",
        "csv",
        "crazyflie_phoenix",
        0.0,
        0.0,
    ),
    "NanoBench": ("nanobench/B8_star_fast_rep1.csv.gz", "csv", "nanobench", 0.0, 0.0),
    "Crazyflie, motors": ("cf_arpl_motors/log15", "usd", "crazyflie_motors", 11.75, 7.7),
}


@pytest.mark.parametrize("name", REAL)
def test_real_flights_lose_their_ground_and_nothing_else(tmp_path, name):
    where, form, mapping, before_s, after_s = REAL[name]
    path = shared(where.partition("/")[0]) / where.partition("/")[2]
    found = import_log(path, form, mapping, align=False).log
    (tmp_path / "map.toml").write_text(
        (f'extends = "{mapping}"\n' if mapping else "") + '[rows]\non_ground = "keep"\n'
    )
    whole = import_log(path, form, tmp_path / "map.toml", align=False).log
    is_flight = (whole.time >= before_s) & (whole.time <= whole.time[-1] - after_s)
    assert abs(len(found) - is_flight.sum()) <= np.sum(whole.time < 0.05)
